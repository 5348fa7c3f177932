"""Colour, marker and description of each outcome of `plan` and `sim` labels.

Outcomes are grouped by the stage that decides them. A group has one hue and one marker, and its members
differ in lightness, so that they can be told apart by colour-blind readers and in print.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Look:
    """One outcome's group, colour, matplotlib marker and words."""

    group: str
    colour: str
    marker: str
    words: str


_BASE, _ARM, _PATH, _PHYSICS = "base", "hand and arm", "path", "execution"

LOOKS: dict[str, Look] = {
    "success": Look("success", "#0a9148", "o", "the arm takes the target from there"),
    "base_collision": Look(_BASE, "#6b6b6b", "s", "the robot does not fit there"),
    "out_of_reach": Look(_BASE, "#c2c2c2", "s", "the arm is too short"),
    "no_grasp": Look(_ARM, "#86d3e3", "^", "no grasp is free for the hand alone"),
    "no_ik": Look(_ARM, "#2a8be0", "^", "no joint angles put the hand there"),
    "arm_collision": Look(_ARM, "#102a83", "^", "the arm would hit something or itself"),
    "no_start": Look(_PATH, "#ffdf3d", "D", "every tucked start pose collides"),
    "no_path": Look(_PATH, "#f79a0c", "D", "no free way to the pregrasp"),
    "no_approach": Look(_PATH, "#b5610a", "D", "no straight way to the grasp"),
    "no_lift": Look(_PATH, "#5b3206", "D", "no straight way up"),
    "not_reached": Look(_PHYSICS, "#ffadc2", "X", "the arm did not arrive"),
    "missed": Look(_PHYSICS, "#f2509f", "X", "closed on nothing"),
    "slipped": Look(_PHYSICS, "#dd1f1a", "X", "held, but not lifted with the hand"),
    "dropped": Look(_PHYSICS, "#8f0d4c", "X", "lifted, then lost"),
    "unstable": Look(_PHYSICS, "#8046d6", "X", "the physics left sense"),
}
