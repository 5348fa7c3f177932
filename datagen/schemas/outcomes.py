"""Causes of rejected scenes, and outcomes of candidates."""

from __future__ import annotations

# Causes for resampling a scene; their order is part of the data format.
REDRAW_CAUSES = (
    "bad_house",  # the house's record in its source is broken
    "no_surface",  # the house has no support surface of the required height and size
    "no_placement",  # target or clutter found no free place on the surface
    "not_at_rest",  # still moving after the last step
    "fell_off",  # an object left its support
    "penetration",  # a body ended inside another
    "not_finite",  # the physics returned NaN or infinite poses
    "no_viewpoint",  # no free viewpoint from which enough of the target is visible
    "no_base",  # no candidate of the required set (clear, in-range) around the target
)

# Outcome of a candidate of `plan` and `sim`, and the stage that decided it; the order is part of the data
# format. Where several grasps failed, the one that came furthest counts.
OUTCOMES: dict[str, str] = {
    "success": "execute",  # lifted and held; for `plan`: a whole plan was found
    "base_collision": "base",  # the robot's body does not fit where it would stand
    "out_of_reach": "reach",  # the target is farther from the mount than the arm is long
    "no_grasp": "grasps",  # the hand alone collides with the scene in every grasp of the target
    "no_ik": "ik",  # no joint configuration puts the hand at pregrasp and grasp
    "arm_collision": "collision",  # at every such configuration the arm hits the scene or itself
    "no_start": "path",  # every tucked start pose collides
    "no_path": "path",  # no collision-free path to the pregrasp within the iteration cap
    "no_approach": "path",  # the straight line to the grasp jumps, leaves the limits or collides
    "no_lift": "path",  # the straight line up jumps, leaves the limits or collides
    "not_reached": "execute",  # the arm did not arrive: it was blocked or its drives fell behind
    "missed": "execute",  # closed, with nothing between the fingers
    "slipped": "execute",  # held after closing, not lifted with the hand
    "dropped": "execute",  # lifted, and lost before the end of holding
    "unstable": "execute",  # the physics diverged: NaN, impossible speeds, or an object thrown
}

# Outcome of the last execution, where the first failed; the order is part of the data format.
RETRY_OUTCOMES = ("none", *OUTCOMES)
