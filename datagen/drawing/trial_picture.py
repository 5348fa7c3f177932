"""Picture of one candidate's trial for `datagen show --trial`."""

from __future__ import annotations

from pathlib import Path

from datagen.drawing.arm_picture import best_success
from datagen.drawing.film import film_of
from datagen.drawing.filmstrip import (
    MOTION_NEAR_PX,
    MOTION_WIDE_PX,
    SHEET_NEAR_PX,
    SHEET_WIDE_PX,
    Title,
    write_motion,
    write_sheet,
)
from datagen.drawing.posed_robot import robot_bodies
from datagen.drawing.retrial import Retrial, try_again
from datagen.drawing.shown import Lines, Shown
from datagen.schemas.errors import InputError
from datagen.schemas.outcomes import OUTCOMES
from datagen.schemas.styles import OUTCOME_STYLES
from datagen.workers.labels.arm_labelling import arm_of
from datagen.workers.scenes.reconstruct import reconstruct_candidates


def draw_trial(shown: Shown, candidate: int | None, out: Path) -> Lines:
    """Draw a candidate's trial as a filmstrip, or an animation where `out` is a .gif; None: the best success.

    Raises InputError where there is no such candidate, no success, or no motion to animate.
    """
    arm = arm_of(shown.spec)
    row = _candidate(shown, candidate)
    retrial = try_again(
        shown.recalled, reconstruct_candidates(shown.samples, shown.recalled), row, shown.spec
    )
    outcome, robot = retrial.trial.outcome, retrial.robot
    moving = out.suffix.lower() == ".gif"
    if moving and not retrial.moves:
        problem = f"candidate {row} ended as {outcome} before the arm moved: there is nothing to animate"
        raise InputError(out, "--out", problem, "Give a name that ends in .png")
    stored = tuple(OUTCOMES)[int(shown.samples["outcome"][row])]
    title = Title(
        OUTCOME_STYLES[outcome].colour,
        f"candidate {row}: {outcome} ({_words(retrial)})",
        (
            shown.title,
            f"{arm.robot}, reach {robot.reach_m:.2f} m, mount {robot.base_height_m:.2f} m high"
            f"   {_measured(retrial)}" + (f"   stored as {stored}" if stored != outcome else ""),
        ),
    )
    sizes = (MOTION_WIDE_PX, MOTION_NEAR_PX) if moving else (SHEET_WIDE_PX, SHEET_NEAR_PX)
    bodies = robot_bodies(robot, shown.spec.candidates.base_radius_m)
    film = film_of(shown.recalled, bodies, retrial.T_world_base, retrial.recording, retrial.told, *sizes)
    (write_motion if moving else write_sheet)(film, title, out)
    return [
        ("candidate", f"{row} at {shown.place(row)}"),
        ("outcome", outcome),
        ("measured", _measured(retrial)),
    ]


def _candidate(shown: Shown, candidate: int | None) -> int:
    samples, scene = shown.samples, shown.recalled.index
    count = len(samples["label"])
    if candidate is None:
        best = best_success(samples)
        if best is None:
            problem = f"no candidate of scene {scene} succeeded"
            raise InputError(
                shown.run, "--trial", problem, f"Give one from 0 to {count - 1} to see why it failed"
            )
        return best
    if not 0 <= candidate < count:
        problem = f"{candidate} is not a candidate of scene {scene}"
        raise InputError(shown.run, "--trial", problem, f"Give one from 0 to {count - 1}")
    return candidate


def _words(retrial: Retrial) -> str:
    if retrial.trial.outcome != "success":
        return OUTCOME_STYLES[retrial.trial.outcome].words
    return "a whole plan" if retrial.result is None else "lifted and held"


def _measured(retrial: Retrial) -> str:
    trial, result = retrial.trial, retrial.result
    if result is None:
        return "planned, not executed" if trial.plan is not None else "no plan, nothing executed"
    numbers = (
        f"lift {100 * result.lift_m:.1f} cm, slip {100 * result.slip_m:.1f} cm, "
        f"others moved {100 * result.disturbed_m:.1f} cm"
    )
    if retrial.shown is None or len(trial.results) == 1:
        return numbers
    return f"{numbers}, execution {retrial.shown + 1} of {len(trial.results)}"
