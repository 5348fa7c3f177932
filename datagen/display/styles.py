"""Styles of labels, outcomes and marks in every figure: one colour and one marker each.

Outcomes are grouped by the stage that decided them. A group has one hue and one marker, and its members
differ in lightness, so that groups and members differ for colour-blind readers and in print. Marks (camera,
picks) have markers of their own. `tests/schemas/test_styles.py` measures the distances between colours.
"""

from __future__ import annotations

from dataclasses import dataclass

# matplotlib's name of a marker, the corners of a polygon, or "" for an area.
Marker = str | tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Style:
    """Style of one item of a figure: colour, matplotlib marker, words and edge colour."""

    colour: str
    marker: Marker
    words: str
    edge: str = "#000000"


_GOOD, _BAD = "#1764c0", "#f08c00"


def _outcome(colour: str, marker: str, words: str) -> Style:
    return Style(colour, marker, words, colour)


# Outcomes of one stage have one marker.
OUTCOME_STYLES: dict[str, Style] = {
    "success": _outcome(_GOOD, "o", "the arm lifts the target and holds it"),
    "base_collision": _outcome("#6b6b6b", "s", "the robot's base collides"),
    "out_of_reach": _outcome("#c2c2c2", "s", "the arm is too short"),
    "no_grasp": _outcome("#9fdc8a", "^", "the hand collides in every grasp"),
    "no_ik": _outcome("#2f9e44", "^", "no joint angles reach a grasp"),
    "arm_collision": _outcome("#0b4d1f", "^", "the arm collides at every grasp"),
    "no_start": _outcome("#ffdf3d", "D", "every tucked start pose collides"),
    "no_path": _outcome("#f79a0c", "D", "no free path to the pregrasp"),
    "no_approach": _outcome("#b5610a", "D", "no straight path to the grasp"),
    "no_lift": _outcome("#5b3206", "D", "no straight path up"),
    "not_reached": _outcome("#ffadc2", "X", "the arm did not arrive"),
    "missed": _outcome("#f2509f", "X", "closed on nothing"),
    "slipped": _outcome("#dd1f1a", "X", "held, but not lifted with the hand"),
    "dropped": _outcome("#8f0d4c", "X", "lifted, then lost"),
    "unstable": _outcome("#8046d6", "X", "the physics diverged"),
}

LABEL_STYLES = {1: Style(_GOOD, "o", "good", _GOOD), 0: Style(_BAD, "v", "bad", _BAD)}

# A camera from its side: body and lens, looking along +x.
_CAMERA_OUTLINE = (
    (-1.0, -0.6), (0.3, -0.6), (0.3, -0.2), (0.9, -0.6),
    (0.9, 0.6), (0.3, 0.2), (0.3, 0.6), (-1.0, 0.6), (-1.0, -0.6),
)  # fmt: skip
CAMERA = Style("#111111", _CAMERA_OUTLINE, "camera", "#ffffff")
BEST = Style("#ffc400", "*", "best success")
BEST_BY_SCORE = Style("#ffffff", "P", "highest score where the base fits")
TARGET = Style("#ff2d6f", "", "target", "#ffffff")
CLUTTER = Style("#c9d2db", "", "other objects", "#4a5560")
# matplotlib's and plotly's scale of scores: red is low, blue is high.
SCORE_COLOURS = "RdYlBu"
PHASE_COLOURS = {
    "reach": "#c9d3df",
    "approach": "#f4b942",
    "close": "#d1495b",
    "lift": "#3a86c8",
    "hold": "#14375e",
}
