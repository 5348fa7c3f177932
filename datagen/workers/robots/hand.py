"""The hand of a robot: its bodies from a URDF, and how one coordinate opens them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from datagen.schemas.errors import InputError
from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.tree import KinematicTree
from datagen.workers.robots.gripper import Gripper
from datagen.workers.robots.hand_measures import Fingers, HandMeasures
from datagen.workers.robots.links import Cluster, LinkBody, body_of, cluster_of, refuse_followers
from datagen.workers.robots.robot_file import RobotSource
from datagen.workers.robots.urdf import Joint, UrdfTree


@dataclass(frozen=True, eq=False)
class Hand:
    """A palm and the links that its joints move. Joint k moves body k + 1."""

    bodies: tuple[LinkBody, ...]  # (B,), the palm first
    joints: tuple[Joint, ...]  # (B - 1,), names of parent and child are those of bodies
    open: tuple[float, ...]  # (B - 1,) positions with the hand fully open
    T_palm_tcp: F64
    gripper: Gripper


def hand_of(source: RobotSource, tree: UrdfTree, palm: str) -> Hand:
    """The hand below a link of a URDF. Raises InputError naming the link or joint and what to change."""
    keys, held = source.keys.hand, source.keys.arm.held
    joints = _moving(source, tree, palm)
    known = {joint.name for joint in joints}
    clusters, bodies = dict[str, Cluster](), dict[str, LinkBody]()
    for name in (palm, *(joint.child for joint in joints)):
        clusters[name] = cluster_of(tree, name, {joint.name for joint in joints}, held)
        bodies[name] = body_of(name, clusters[name], cuts_m=source.keys.arm.cuts_m)
    if not bodies[palm].parts_m:
        fix = "Name the palm of the hand, or give it <collision>, to which a <visual> does not count"
        raise source.wrong("hand.palm", f"link {palm} has no collision shape", fix)
    carried = {joint.child: next(n for n, c in clusters.items() if joint.parent in c) for joint in joints}
    for joint in reversed(joints):  # joints that move no shape
        if not bodies[joint.child].parts_m and joint.child not in carried.values():
            joints.remove(joint)
            del bodies[joint.child], carried[joint.child]
    if not joints:
        raise source.wrong(
            "hand", f"no link that moves below {palm} has a shape", "Name the palm in hand.palm"
        )
    names = list(bodies)
    parents = [names.index(carried[joint.child]) for joint in joints]
    joints = [
        replace(
            joint, parent=names[k], T_parent_child=clusters[names[k]][joint.parent][1] @ joint.T_parent_child
        )
        for joint, k in zip(joints, parents, strict=True)
    ]
    T_tcp = _given_tcp(source, clusters[palm])
    parts_m = [body.parts_m for body in bodies.values()]
    tree_of = _Opening(source, tree, joints, parents, known)
    fingers = tree_of.opened(parts_m, None if T_tcp is None else T_tcp[:3, 1])
    measures = HandMeasures(source, fingers, T_tcp)
    gripper = measures.gripper(keys.name or palm, keys.pad_size_m)
    order = list(range(len(names)))
    if gripper.linkage is None and measures.side[1] < 0:
        order = [0, 2, 1]  # the finger on the side of +y first
    at = fingers.tree.ratio + fingers.tree.offset
    return Hand(
        tuple(bodies[names[k]] for k in order),
        tuple(joints[k - 1] for k in order[1:]),
        tuple(float(at[k - 1]) for k in order[1:]),
        measures.T_palm_tcp,
        gripper,
    )


def _moving(source: RobotSource, tree: UrdfTree, palm: str) -> list[Joint]:
    """The joints that open the hand, each after the one that carries it."""
    keys, found, waiting = source.keys.hand, list[Joint](), [palm]
    refuse_followers(source, tree, "hand.fingers", keys.fingers)
    refuse_followers(source, tree, "hand.range", keys.range)
    while waiting:
        for joint in tree.children(waiting.pop(0)):
            waiting.append(joint.child)
            driver = tree.driver(joint)[0].name
            moves = (
                joint.kind in ("revolute", "continuous", "prismatic") and driver not in source.keys.arm.held
            )
            if moves and (not keys.fingers or driver in keys.fingers):
                found.append(joint)
    drivers = {tree.driver(joint)[0].name for joint in found}
    for field, names in (("hand.fingers", keys.fingers), ("hand.range", keys.range)):
        if other := next((name for name in names if name not in drivers), None):
            raise source.wrong(field, f"joint {other} does not open the hand", f"Name one below {palm}")
    if not found:
        raise source.wrong("hand.palm", f"no joint moves below link {palm}", "Name the palm in hand.palm")
    return found


def _given_tcp(source: RobotSource, palm: Cluster) -> F64 | None:
    """The pose (4, 4) of the TCP in the palm's frame; None where the file has none."""
    keys = source.keys.hand.tcp
    if keys is None or keys.link is None:
        return None if keys is None else keys.pose()
    if keys.link not in palm:
        problem = f"link {keys.link} is not fixed to the palm"
        raise source.wrong("hand.tcp.link", problem, "Name a link that is")
    return palm[keys.link][1] @ keys.pose()


class _Opening:
    """Joints of a hand as they follow one coordinate from 0, closed, to 1, open."""

    def __init__(
        self,
        source: RobotSource,
        tree: UrdfTree,
        joints: Sequence[Joint],
        parents: Sequence[int],
        known: set[str],
    ) -> None:
        self._tree, self._joints, self._parents = tree, joints, parents
        self._given, self._ends = source.keys.hand.range, dict[str, tuple[float, float]]()
        for joint in joints:
            driver = tree.driver(joint)[0]
            if driver.name not in known:
                problem = f"joint {joint.name} mimics {driver.name}, which is not below the palm"
                raise source.wrong("hand.palm", problem, "Name a link above both")
            try:
                self._ends[driver.name] = self._given.get(driver.name) or tree.limits(driver)
            except InputError as error:
                fix = f"Give [hand.range] {driver.name} = [closed, open]"
                raise source.wrong(f"hand.range.{driver.name}", error.problem, fix) from None

    def opened(self, parts_m: Sequence[tuple[np.ndarray, ...]], closing: F64 | None) -> Fingers:
        """The fingers: a joint opens towards the end at which they lie farther apart along `closing` (3,)."""
        fingers = Fingers(self._tree_of(self._ends), tuple(parts_m), tuple(self._parents))
        along = fingers.closing() if closing is None else closing
        for name, ends in self._ends.items():
            if name not in self._given:
                apart = list[float]()
                for at in ends:
                    some = {n: (at, at) if n == name else (low, low) for n, (low, _) in self._ends.items()}
                    means = replace(fingers, tree=self._tree_of(some)).means(0.0)
                    apart.append(float(np.ptp(means @ along)) if len(means) else 0.0)
                self._ends[name] = ends if apart[1] >= apart[0] else (ends[1], ends[0])
        return replace(fingers, tree=self._tree_of(self._ends))

    def _tree_of(self, ends: Mapping[str, tuple[float, float]]) -> KinematicTree:
        """The joints in the palm's frame; frames: the bodies."""
        n, ratio, offset = len(self._joints), list[float](), list[float]()
        for joint in self._joints:
            driver, times, plus = self._tree.driver(joint)
            closed, opened = ends[driver.name]
            ratio.append(times * (opened - closed))
            offset.append(times * closed + plus)
        return KinematicTree(
            np.array(self._parents) - 1,
            np.stack([joint.T_parent_child for joint in self._joints]),
            np.stack([joint.axis for joint in self._joints]),
            np.array([joint.kind == "prismatic" for joint in self._joints]),
            np.zeros(n, np.int64),
            np.array(ratio),
            np.array(offset),
            np.zeros(1),
            np.ones(1),
            np.arange(-1, n),
            np.tile(np.eye(4), (n + 1, 1, 1)),
        )
