"""The drive of the node, which needs ROS 2: its modules are stood in for by names alone, Nav2 by a script."""

from __future__ import annotations

import ast
import asyncio
import importlib
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "ros2" / "datagen_ros"
REACHED, CANCELED, ABORTED = 4, 5, 6  # of action_msgs/GoalStatus
POSE = {"pose": {}, "score": 0.9, "level": "good", "reasons": []}


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A node that has an answer, without its subscriptions."""
    source = (PACKAGE / "datagen_ros" / "base_pose_node.py").read_text()
    for imported in (each for each in ast.parse(source).body if isinstance(each, ast.ImportFrom)):
        module = str(imported.module)
        parent = module.partition(".")[0]
        if parent not in {*sys.stdlib_module_names, "datagen_ros"}:
            for name in (parent, module):
                monkeypatch.setitem(sys.modules, name, sys.modules.get(name) or ModuleType(name))
            for alias in imported.names:
                setattr(sys.modules[module], alias.name, type(alias.name, (SimpleNamespace,), {}))
    sys.modules["action_msgs.msg"].GoalStatus.STATUS_SUCCEEDED = REACHED
    sys.modules["action_msgs.msg"].GoalStatus.STATUS_CANCELED = CANCELED
    sys.modules["nav2_msgs.action"].NavigateToPose.Goal = SimpleNamespace
    sys.modules["rclpy.action"].CancelResponse.ACCEPT = 2
    sys.modules["datagen_interfaces.action"].GoToBasePose.Feedback = SimpleNamespace
    monkeypatch.syspath_prepend(str(PACKAGE))
    monkeypatch.delitem(sys.modules, "datagen_ros.base_pose_node", raising=False)
    kind = importlib.import_module("datagen_ros.base_pose_node").BasePoseNode
    made = kind.__new__(kind)
    goal = {name: POSE[name] for name in ("score", "level", "reasons")} | {
        "goal": POSE,
        "alternatives": [POSE],
    }
    answer = {"goal": goal, "reasons": []}
    made._driving, made._ask, made._stamped = None, lambda _: answer, lambda pose: pose
    return made


class Nav2:
    """Accepts each goal, and ends it as reached unless it was asked to cancel it."""

    accepted = True

    def __init__(self, node: Any, client: SimpleNamespace, moment: str, status: int = REACHED) -> None:
        self.node, self.client, self.moment, self.status, self.goals = node, client, moment, status, 0

    def wait_for_server(self, timeout_sec: float) -> bool:
        return True

    def cancel_goal_async(self) -> None:
        self.status = CANCELED

    def _may_be_cancelled(self, moment: str) -> None:
        if moment == self.moment:  # as rclpy does: first the callback, then the state
            self.node._cancel(None)
            self.client.is_cancel_requested = True

    async def send_goal_async(self, goal: Any, feedback_callback: Any) -> Nav2:
        self.goals += 1
        self._may_be_cancelled("while it considers")
        return self

    async def get_result_async(self) -> SimpleNamespace:
        self._may_be_cancelled("while it drives")
        return SimpleNamespace(status=self.status)


@pytest.mark.parametrize(
    ("moment", "ended"),
    [("never", "reached"), ("while it considers", "cancelled"), ("while it drives", "cancelled")],
)
def test_a_cancelled_drive_is_cancelled_in_nav2(node: Any, moment: str, ended: str) -> None:
    ends: list[str] = []
    client = SimpleNamespace(
        is_cancel_requested=False, request=SimpleNamespace(allow_doubtful=True),
        succeed=lambda: ends.append("reached"), canceled=lambda: ends.append("cancelled"),
    )  # fmt: skip
    node._navigator = Nav2(node, client, moment)
    asyncio.run(node._drive(client, SimpleNamespace()))
    assert ends == [ended]


@pytest.mark.parametrize(
    ("status", "changed", "goals", "words"),
    [
        (CANCELED, {}, 1, "cancelled by another program"),  # no goal follows one that somebody stopped
        (ABORTED, {}, 2, "2 poses were tried, none was reached"),
        (REACHED, {"goal": None, "reasons": ["no clear pose"]}, 0, "no clear pose"),
        (
            REACHED,
            {"goal": {**POSE, "level": "doubtful", "goal": POSE, "alternatives": []}},
            0,
            "allow_doubtful",
        ),
    ],
)
def test_why_no_pose_was_reached(
    node: Any, status: int, changed: dict[str, Any], goals: int, words: str
) -> None:
    request = SimpleNamespace(allow_doubtful=False)
    client = SimpleNamespace(is_cancel_requested=False, request=request)
    node._ask(None).update(changed)
    node._navigator = Nav2(node, client, "never", status)
    with pytest.raises(Exception, match=words):
        asyncio.run(node._drive(client, SimpleNamespace()))
    assert node._navigator.goals == goals
