"""A node that asks `datagen serve` for base poses, and drives to them by Nav2.

Never run on a live graph, neither on a robot nor in a simulator: subscriptions and their quality of service,
tf, the service, the action and its cancellation, and Nav2. What runs in tests is `conversions.py`, with
serialised messages against a running service, and how a drive ends, with a script in place of Nav2.
"""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import rclpy
from action_msgs.msg import GoalStatus
from datagen_interfaces.action import GoToBasePose
from datagen_interfaces.srv import FindBasePose
from geometry_msgs.msg import Pose, PoseStamped
from message_filters import ApproximateTimeSynchronizer, Subscriber
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image
from tf2_ros import Buffer, TransformException, TransformListener

from datagen_ros.conversions import fill_pose, next_pose, ranked_poses, request_body, request_query

PARAMETERS: dict[str, Any] = {  # config/base_pose.yaml says what they are
    "url": "http://127.0.0.1:8765",
    "token_file": "",
    "map_frame": "map",
    "max_pose_age": 0.2,
    "request_timeout": 30.0,
    "rectified": True,
    "send_map": True,
    "navigate_action": "navigate_to_pose",
}


class NoAnswerError(Exception):
    """Why there is no answer."""


class BasePoseNode(Node):
    """Service `find_base_pose` and action `go_to_base_pose`, of the latest frame of one camera."""

    def __init__(self) -> None:
        super().__init__("base_pose")
        self.declare_parameters("", list(PARAMETERS.items()))
        self._frame: tuple[Any, Any, Any] | None = None
        self._map: Any = None
        self._driving: Any = None  # the goal of Nav2
        self._busy = threading.Lock()  # held while an action runs
        self._buffer = Buffer()
        self._listener = TransformListener(self._buffer, self, spin_thread=True)
        group = ReentrantCallbackGroup()
        pictures = [("color", Image), ("depth", Image), ("camera_info", CameraInfo)]
        self._pictures = ApproximateTimeSynchronizer(
            [Subscriber(self, kind, name, qos_profile=qos_profile_sensor_data) for name, kind in pictures],
            queue_size=10,
            slop=0.05,  # s, between stamps
        )
        self._pictures.registerCallback(self._keep_frame)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(OccupancyGrid, "map", self._keep_map, latched, callback_group=group)
        self.create_service(FindBasePose, "find_base_pose", self._find, callback_group=group)
        name, driver = self._value("navigate_action"), "go_to_base_pose"
        self._navigator = ActionClient(self, NavigateToPose, name, callback_group=group)
        self._server = ActionServer(
            self, GoToBasePose, driver, self._go, callback_group=group, cancel_callback=self._cancel
        )

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _keep_frame(self, color: Any, depth: Any, info: Any) -> None:
        self._frame = color, depth, info

    def _keep_map(self, grid: Any) -> None:
        self._map = grid if grid.header.frame_id == self._value("map_frame") else None

    def _ask(self, asked: Any) -> dict[str, Any]:
        """The answer of the service. NoAnswerError where there is none."""
        if self._frame is None:
            raise NoAnswerError("no colour, depth and CameraInfo with the same stamp were received")
        color, depth, info = self._frame
        token_file, headers = self._value("token_file"), {}
        try:
            moment, wait = Time.from_msg(depth.header.stamp), Duration(seconds=self._value("max_pose_age"))
            found = self._buffer.lookup_transform(
                self._value("map_frame"), depth.header.frame_id, moment, timeout=wait
            )
            grid = self._map if self._value("send_map") else None
            body = request_body(color, depth, info, found.transform, grid, self._value("rectified"))
            if token_file:
                headers["Authorization"] = f"Bearer {Path(token_file).read_text().strip()}"
            request = Request(f"{self._value('url')}/base?{request_query(asked)}", body, headers)
            with urlopen(request, timeout=self._value("request_timeout")) as answer:
                return json.load(answer)
        except HTTPError as error:
            raise NoAnswerError(error.read(2000).decode("utf-8", "replace")) from error
        except (OSError, ValueError, TransformException) as error:
            raise NoAnswerError(f"{type(error).__name__}: {error}") from error

    def _stamped(self, pose: dict[str, Any]) -> PoseStamped:
        message = PoseStamped()
        message.header.frame_id = self._value("map_frame")
        message.header.stamp = self.get_clock().now().to_msg()
        fill_pose(message.pose, pose)
        return message

    def _find(self, request: Any, response: Any) -> Any:
        try:
            answer = self._ask(request)
        except NoAnswerError as error:
            response.success, response.message = False, str(error)
            return response
        poses = ranked_poses(answer)
        response.success, response.level = bool(poses), answer["level"]
        response.message, response.reasons = "; ".join(answer["reasons"]), answer["reason_codes"]
        if poses:
            response.child_frame_id = answer["goal"]["child_frame_id"]
            response.scores = [each["score"] for each in poses]
            response.pose = self._stamped(poses[0]["pose"])
            response.alternatives.header = response.pose.header
            response.alternatives.poses = [fill_pose(Pose(), each["pose"]) for each in poses[1:]]
        return response

    def _cancel(self, _: Any) -> CancelResponse:
        if self._driving is not None:
            self._driving.cancel_goal_async()
        return CancelResponse.ACCEPT

    async def _go(self, handle: Any) -> Any:
        result = GoToBasePose.Result()
        if not self._busy.acquire(blocking=False):
            result.message = "another goal is being driven to"
            handle.abort()
            return result
        try:
            await self._drive(handle, result)
        except NoAnswerError as error:
            result.message = str(error)
            handle.abort()
        finally:
            self._driving = None
            self._busy.release()
        return result

    async def _drive(self, handle: Any, result: Any) -> None:
        """Drive to the poses in turn, until one is reached."""
        answer, tried = self._ask(handle.request), list[int]()
        poses = ranked_poses(answer)
        if not self._navigator.wait_for_server(timeout_sec=5.0):
            raise NoAnswerError(f"no action server {self._value('navigate_action')}")
        feedback = GoToBasePose.Feedback()

        def show(message: Any) -> None:
            feedback.distance_remaining = message.feedback.distance_remaining
            handle.publish_feedback(feedback)

        while not handle.is_cancel_requested:
            row = next_pose(poses, tried, handle.request.allow_doubtful)
            if row is None:
                why = [f"{len(tried)} poses were tried, none was reached"] if tried else answer["reasons"]
                left = len(poses) - len(tried)
                more = [f"{left} doubtful poses were not tried: set allow_doubtful"] if left else []
                raise NoAnswerError("; ".join([*why, *more]))
            tried.append(row)
            result.pose, result.score = self._stamped(poses[row]["pose"]), poses[row]["score"]
            feedback.pose, feedback.tried, result.tried = result.pose, len(tried), len(tried)
            goal = NavigateToPose.Goal(pose=result.pose)
            self._driving = await self._navigator.send_goal_async(goal, feedback_callback=show)
            if not self._driving.accepted:
                continue
            if handle.is_cancel_requested:  # since before Nav2 had a goal to cancel
                self._driving.cancel_goal_async()
            outcome = await self._driving.get_result_async()
            if outcome.status == GoalStatus.STATUS_SUCCEEDED:
                result.success = True
                handle.succeed()
                return
            if outcome.status == GoalStatus.STATUS_CANCELED and not handle.is_cancel_requested:
                raise NoAnswerError("Nav2's goal was cancelled by another program")
        handle.canceled()


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    try:
        rclpy.spin(BasePoseNode(), MultiThreadedExecutor())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
