"""Assembly of a robot: the URDF's links from the base to the tip, scaled, with the hand on it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import sha256

import numpy as np

from datagen.schemas.identity import digest_of
from datagen.schemas.safe_files import read_regular
from datagen.workers.geometry.mesh import F32, F64, transformed
from datagen.workers.geometry.planar import prism_corners, unit_circle
from datagen.workers.geometry.transforms import inverse
from datagen.workers.kinematics.tree import KinematicTree
from datagen.workers.robots.arm_chain import TURN, ArmChain
from datagen.workers.robots.base import Base, base_of
from datagen.workers.robots.hand import Hand, hand_of
from datagen.workers.robots.links import (
    LinkBody,
    body_of,
    motion,
    scaled_pose,
    without_shapes,
)
from datagen.workers.robots.reach import farthest_m, largest_reach_m
from datagen.workers.robots.resources import resource
from datagen.workers.robots.robot_file import RobotSource, ScaleKeys
from datagen.workers.robots.urdf import FIX, Joint, UrdfTree, read_urdf

_TUBE_SIDES = 12
_MOST_BYTES = 64 << 20


@dataclass(frozen=True, eq=False)
class Assembly:
    """Bodies 0 (root), 1..J (arm), then the palm and the fingers. Joint k moves body k + 1."""

    bodies: tuple[LinkBody, ...]
    arm: tuple[Joint, ...]  # (J,), with scaled origins; names of parent and child are those of bodies
    palm: Joint
    hand: Hand
    base: Base
    chain: ArmChain  # how the coordinates move the joints
    scale: float
    shoulder_m: F64  # (3,), base frame: where the reach is measured from
    reach_m: float

    @property
    def hand_placements(self) -> list[F64]:
        """Poses (4, 4) of the hand's bodies in the frame of the last joint, fully open."""
        T = [self.palm.T_parent_child]
        names = [self.palm.child]
        for joint, position in zip(self.hand.joints, self.hand.open, strict=True):
            names.append(joint.child)
            T.append(T[names.index(joint.parent)] @ joint.T_parent_child @ motion(joint, position))
        return T

    def tree(self) -> KinematicTree:
        """All joints, and a frame for every body, fingers open, and for the TCP."""
        J = len(self.arm)
        T_base_root, chain = inverse(self.base.T_root_mount), self.chain
        joints = [joint.T_parent_child for joint in self.arm]
        hand = self.hand_placements
        return KinematicTree(
            np.arange(J) - 1,
            np.stack([T_base_root @ joints[0], *joints[1:]]),
            np.stack([joint.axis for joint in self.arm]),
            np.array([joint.kind == "prismatic" for joint in self.arm]),
            chain.coordinate,
            chain.ratio,
            chain.offset,
            chain.lower,
            chain.upper,
            np.array([-1, *range(J), *[J - 1] * (len(hand) + 1)]),
            np.stack([T_base_root, *[np.eye(4)] * J, *hand, hand[0] @ self.hand.T_palm_tcp]),
        )


def read_trees(source: RobotSource) -> tuple[UrdfTree, UrdfTree]:
    """The URDFs of arm and hand, without the shapes to ignore. InputError naming the file and its fault."""
    keys, folder = source.keys, source.path.parent
    tree = read_urdf(resource(keys.urdf, folder, source.path, "urdf"))
    hand = tree
    if keys.hand.urdf is not None:
        hand = read_urdf(resource(keys.hand.urdf, folder, source.path, "hand.urdf"))
    source.refuse_unknown("arm.base", keys.arm.base, tree.links)
    source.refuse_unknown("arm.tip", keys.arm.tip, tree.links)
    source.refuse_unknown("hand.palm", keys.hand.palm or next(iter(hand.links), ""), hand.links)
    for name in keys.arm.ignore:
        source.refuse_unknown("arm.ignore", name, [*tree.links, *hand.links])
    for name in keys.arm.cuts_m:
        source.refuse_unknown("arm.cuts_m", name, [*tree.links, *hand.links])
    bare = [without_shapes(t, [name for name in keys.arm.ignore if name in t.links]) for t in (tree, hand)]
    return bare[0], bare[0] if hand is tree else bare[1]


_DECK = 2  # how links are checked against a deck


def content_digest(source: RobotSource) -> str:
    """sha256 of all that a robot is made from: its keys, URDFs and collision meshes, wherever they lie."""
    keys = source.keys.model_dump(mode="json")
    keys.pop("about")
    if source.keys.base.height_m is not None:
        keys["deck"] = _DECK
    keys["urdf"] = keys["hand"]["urdf"] = None
    contents: list[str] = []
    trees = read_trees(source)
    for tree in trees if trees[0] is not trees[1] else trees[:1]:
        contents.append(sha256(read_regular(tree.path, _MOST_BYTES, FIX)).hexdigest())
        for link in tree.links.values():
            for shape in link.collisions:
                if shape.mesh is not None and shape.mesh.is_file():
                    contents.append(sha256(read_regular(shape.mesh, _MOST_BYTES, FIX)).hexdigest())
    return digest_of({"keys": keys, "contents": contents})


# Scaled arms share them.
@lru_cache(maxsize=8)
def _arm_and_hand(source: RobotSource) -> tuple[ArmChain, Hand]:
    tree, hand_tree = read_trees(source)
    palm = source.keys.hand.palm or source.keys.arm.tip
    if source.keys.hand.urdf is not None and source.keys.hand.palm is None:
        raise source.wrong("hand.palm", "is missing", "Name the link of the hand's URDF that is mounted")
    return ArmChain(source, tree, palm), hand_of(source, hand_tree, palm)


def assemble(source: RobotSource, reach_m: float | None) -> Assembly:
    """Read the URDFs and assemble the robot; `reach_m` is for a robot that is scaled to its reach.

    Raises InputError naming the file and what is wrong in it.
    """
    keys = source.keys
    arm, hand = _arm_and_hand(source)
    scale, tube_m = 1.0, 0.0
    if keys.scaled is not None and reach_m is not None:
        rule = keys.scaled
        if reach_m < rule.no_tube_from_m:
            share = (rule.no_tube_from_m - reach_m) / (rule.no_tube_from_m - rule.reach_m[0])
            tube_m = rule.tube_m * min(share, 1.0)
        scale = arm.scale_for(hand, tube_m, reach_m)
    joints, T_palm = arm.joints(scale), arm.palm(scale, tube_m)
    cuts = keys.arm.cuts_m
    bodies = [
        body_of(name, cluster, scale, cuts) for name, cluster in zip(arm.names, arm.clusters, strict=True)
    ]
    if not any(body.parts_m for body in bodies[int(arm.turns) + 1 :]):
        fix = "Give them <collision>, to which a <visual> does not count"
        raise source.wrong("arm", "no link that moves has a shape", fix)
    k = int(arm.turns)
    base = base_of(source, bodies[k], joints, arm.turns)
    if base.deck_m is not None:
        bodies[k] = replace(
            bodies[k], parts_m=(*bodies[k].parts_m, base.deck_m), drawn_m=(*bodies[k].drawn_m, base.deck_m)
        )
    if tube_m > 0.0 and keys.scaled is not None:
        tube = _tube(scaled_pose(arm.T_tip, scale), tube_m, keys.scaled)
        last = bodies[-1]
        bodies[-1] = replace(last, parts_m=(*last.parts_m, tube), drawn_m=(*last.drawn_m, tube))
    no_axis = np.array([0.0, 0.0, 1.0])
    mount = Joint("hand_mount", "fixed", arm.names[-1], hand.bodies[0].name, T_palm, no_axis, 0.0, 0.0, 0.0)
    found = Assembly((*bodies, *hand.bodies), joints, mount, hand, base, arm, scale, np.zeros(3), 0.0)
    return _with_reach(source, found)


def _with_reach(source: RobotSource, found: Assembly) -> Assembly:
    """With the shoulder and the largest distances from it."""
    arm, T_base_root = found.chain, inverse(found.base.T_root_mount)
    if not arm.slides.any() and not arm.turns and len(arm.coordinates) == len(found.arm):
        shoulder_m = (T_base_root @ found.arm[0].T_parent_child)[:3, 3]
        reach_m = largest_reach_m(arm.chain(found.arm, found.palm.T_parent_child, found.hand))
    else:
        # Lifts that come first stand in the middle of their range.
        tree = found.tree()
        T, shoulder_m = np.eye(4), np.zeros(3)
        for j, joint in enumerate(found.arm):
            T = T @ tree.T_parent_joint[j]
            if joint.kind == "prismatic":
                k = arm.coordinate[j]
                position = float(arm.ratio[j] * (arm.lower[k] + arm.upper[k]) / 2 + arm.offset[j])
                T = T @ motion(joint, position)
                shoulder_m = T[:3, 3]
            elif joint.name != TURN:
                shoulder_m = T[:3, 3]
                break
        if arm.turns:
            shoulder_m = np.array([0.0, 0.0, shoulder_m[2]])
        reach_m = farthest_m(tree, shoulder_m)
    given = source.keys.reach_m
    if given is not None and abs(given - reach_m) > 0.01:
        raise source.wrong(
            "reach_m", f"is {given:g} m, and the URDF's arm has {reach_m:.3f} m", "Correct or omit it"
        )
    return replace(found, shoulder_m=shoulder_m, reach_m=reach_m)


def _tube(T_flange: F64, length_m: float, rule: ScaleKeys) -> F32:
    outer = rule.tube_radius_m / np.cos(np.pi / _TUBE_SIDES)  # the prism's sides touch the tube from outside
    points = prism_corners(outer * unit_circle(_TUBE_SIDES, 0.5), 0.0, length_m)
    return transformed(points, T_flange).astype(np.float32)
