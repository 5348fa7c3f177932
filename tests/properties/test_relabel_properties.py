"""Relabelling by any rule equals labelling the same scenes again by casting rays, bit for bit."""

from __future__ import annotations

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from datagen import cli
from datagen.configuration.stored_scenes import open_stored_scenes, specify_again
from datagen.jobs.relabelling import relabel_run, relabelled_specification
from datagen.schemas.run import Run
from datagen.schemas.specification import HeuristicParams
from datagen.schemas.storage import open_storage
from tests.small_runs import PER_SCENE, arrays_of, assert_equal_runs, make_small_run

N = 2 * PER_SCENE


@st.composite
def rules(draw: st.DrawFn) -> dict[str, Any]:
    """Parameters of a rule, any of them left out."""
    positive = st.floats(0.01, 3.0)
    d_min = draw(st.floats(0.0, 0.8))
    chosen = {
        "mu": positive,
        "sigma_l": positive,
        "sigma_r": positive,
        "a": positive,
        "alpha": st.floats(0, 1),
        "tau": st.floats(0, 1.5),
        "distance": st.sampled_from(["planar", "planar-over-reach", "mount-over-reach"]),
        "d_max": st.floats(d_min + 0.01, 5.0),
    }
    rule = {name: draw(values) for name, values in chosen.items() if draw(st.booleans())}
    return rule | ({"d_min": d_min} if "d_max" in rule else {})


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_small_run(tmp_path_factory.mktemp("source") / "run", N, "--seed", "9")


def relabelled(source: Path, out: Path, rule: dict[str, Any]) -> Run:
    run = Run.open(source)
    spec = relabelled_specification(run, {f"heuristic.{name}": value for name, value in rule.items()})
    done = relabel_run(open_storage(out), run, spec)
    assert done.end == "complete"
    return Run.open(out)


def score(d: float, rho: float, params: HeuristicParams) -> float:
    """H as the paper's text has it."""
    near = 0.0
    if params.d_min <= d <= params.d_max:
        sigma = params.sigma_l if d < params.mu else params.sigma_r
        near = params.a * math.exp(-((d - params.mu) ** 2) / (2 * sigma**2))
    seen = 0.05 + 6.25 * rho if rho < 0.04 else 0.3 if rho <= 0.8 else 0.3 + 1.5 * (rho - 0.8)
    return params.alpha * seen + (1 - params.alpha) * near


# Each example writes two runs, so few are drawn, and none is made smaller.
@settings(max_examples=3, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(rule=rules().filter(lambda rule: HeuristicParams(**rule) != HeuristicParams()))
def test_relabelling_is_casting_rays_again(rule: dict[str, Any], source: Path) -> None:
    with TemporaryDirectory() as folder:
        place = Path(folder)
        ours = relabelled(source, place / "ours", rule)
        lines = [f"{name} = {value!r}" for name, value in rule.items()]
        (place / "rule.toml").write_text("\n".join(["[heuristic]", *lines]))
        again = ["--scenes-from", str(source), "--config", str(place / "rule.toml"), "--workers", "0"]
        assert cli.run(["submit", "heuristic", "--n", str(N), "--out", str(place / "cast"), *again]) == 0
        theirs = Run.open(place / "cast")
        assert ours.manifest.spec == theirs.manifest.spec
        for mine, other in zip(ours.commits(), theirs.commits(), strict=True):
            assert mine.object.sha256 == other.object.sha256
        arrays = arrays_of(place / "ours")
        assert_equal_runs(arrays, arrays_of(place / "cast"))
    params = ours.manifest.spec.heuristic
    for k in range(N):
        d = float(arrays["mount_distance_m" if params.distance.startswith("mount") else "distance_m"][k])
        d /= 1.0 if params.distance == "planar" else float(arrays["arm_reach_m"][k])
        expected = score(d, float(arrays["visibility"][k]), params)
        assert arrays["heuristic_score"][k] == pytest.approx(expected, abs=1e-6)
    np.testing.assert_array_equal(arrays["label"], arrays["heuristic_score"] >= np.float32(params.tau))


@settings(max_examples=25, deadline=None)
@given(rule=rules())
def test_the_specification_is_that_of_scenes_from(rule: dict[str, Any], source: Path) -> None:
    run = Run.open(source)
    options = {f"heuristic.{name}": value for name, value in rule.items()}
    ours = relabelled_specification(run, options)
    stored = open_stored_scenes(str(source), None, None, {})
    assert ours == specify_again("heuristic", stored, None, options=options)
    assert ours.scenes_hash == run.manifest.spec_hash
    assert ours.hash() != run.manifest.spec_hash
