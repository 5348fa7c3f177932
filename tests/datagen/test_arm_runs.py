"""Runs of `plan` and `sim` over the stored scenes of a heuristic run: paired labels, and their audit."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from datagen import cli
from datagen.configuration.stored_scenes import open_stored_scenes, specify_again
from datagen.schemas.fields import OUTCOMES
from datagen.schemas.run import Run
from tests.datagen.conftest import PAIRED
from tests.sim_extra import needs_sim
from tests.small_runs import arrays_of, json_of

pytestmark = needs_sim


def test_all_label_the_same_candidates_of_the_same_scenes(paired: dict[str, Path]) -> None:
    arrays = {name: arrays_of(run) for name, run in paired.items()}
    first = arrays["heuristic"]
    for name in ("plan", "sim", "disturbed"):
        for column in first.keys() - {"sample_id", "label", "label_source", "label_version"}:
            np.testing.assert_array_equal(arrays[name][column], first[column], err_msg=f"{name} {column}")
        np.testing.assert_array_equal(arrays[name]["heuristic_label"], first["label"])
    ids = {row.tobytes() for a in arrays.values() for row in a["sample_id"]}
    assert len(ids) == 4 * PAIRED
    assert len({Run.open(run).manifest.spec.scenes_hash for run in paired.values()}) == 1


def test_a_label_is_its_outcome_and_execution_begins_from_the_plan(paired: dict[str, Path]) -> None:
    plan, sim, disturbed = (arrays_of(paired[name]) for name in ("plan", "sim", "disturbed"))
    success = list(OUTCOMES).index("success")
    for arrays in (plan, sim, disturbed):
        np.testing.assert_array_equal(arrays["label"] == 1, arrays["outcome"] == success)
    not_planned = plan["label"] == 0
    assert 0 < not_planned.sum() < PAIRED
    np.testing.assert_array_equal(sim["outcome"][not_planned], plan["outcome"][not_planned])
    assert (sim["trials"][not_planned] == 0).all() and (sim["trials"][~not_planned] == 1).all()
    assert (disturbed["trials"][~not_planned] == 2).all()
    assert not ({"base_collision"} & {list(OUTCOMES)[code] for code in plan["outcome"]})  # all are clear


def test_specifications_hold_the_arm_and_what_moves_it(paired: dict[str, Path]) -> None:
    plan, sim, disturbed = (Run.open(paired[name]).manifest for name in ("plan", "sim", "disturbed"))
    arms = [manifest.spec.arm for manifest in (plan, sim, disturbed)]
    assert all(arm is not None and arm.grasps.per_object == 40 for arm in arms)
    assert [arm is not None and arm.trial is not None for arm in arms] == [False, True, True]
    assert [arm is not None and arm.disturbance is not None for arm in arms] == [False, False, True]
    for manifest in (plan, sim, disturbed):
        assert {"numba", "coal", "mani_skill", "sapien", "scenes", "labels"} <= manifest.spec.engines.keys()
        assert {"numba", "coal", "mani_skill"} <= manifest.libraries.keys()
    assert not Run.open(paired["heuristic"]).manifest.spec.engines.keys() & {"numba", "coal", "mani_skill"}


def test_the_arm_of_a_stored_run_stays_and_its_disturbance_does_not(paired: dict[str, Path]) -> None:
    disturbed = open_stored_scenes(str(paired["disturbed"]), None, None, {})
    before = disturbed.run.manifest.spec
    again, planned, judged = (specify_again(name, disturbed, None) for name in ("sim", "plan", "heuristic"))
    assert before.arm is not None and again.arm is not None and planned.arm is not None
    assert again.arm == before.arm.model_copy(update={"disturbance": None})
    assert planned.arm == before.arm.model_copy(update={"disturbance": None, "trial": None})
    assert judged.arm is None
    assert {spec.scenes_hash for spec in (before, again, planned, judged)} == {before.scenes_hash}
    assert again.hash() == Run.open(paired["sim"]).manifest.spec_hash  # the same labels, the same names


def test_the_audit_holds_every_source_against_the_next(
    paired: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    # Named in another order: what is nearer to the truth counts as it.
    places = [str(paired[name]) for name in ("disturbed", "plan", "heuristic", "sim")]
    report = json_of(capsys, ["audit", *places])
    assert [source["label_source"] for source in report["sources"]] == ["heuristic", "plan", "sim"]
    assert [source["counts"]["label"] for source in report["sources"]] == [PAIRED, PAIRED, 2 * PAIRED]
    plan = arrays_of(paired["plan"])
    near = (plan["base_is_clear"] == 1) & (plan["mount_distance_m"] <= plan["arm_reach_m"])
    codes = list(OUTCOMES)
    counts = Counter(codes[code] for code in plan["outcome"][near].tolist())
    assert report["sources"][1]["outcomes_within_reach"] == counts
    compared = [(pair["labels"], pair["reference"]) for pair in report["agreement"]]
    fidelities = ("heuristic", "plan", "sim", "sim disturbed")
    assert compared == [(a, b) for k, a in enumerate(fidelities) for b in fidelities[k + 1 :]]
    assert all(pair["candidates"] == near.sum() for pair in report["agreement"])
    assert cli.run(["audit", *places]) == 0
    shown = capsys.readouterr().out
    assert "plan equals sim for" in shown and "sim equals sim disturbed for" in shown
