"""`datagen estimate` on runs: which labels it joins, what it prints, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen import cli
from datagen.commands.estimate import estimate
from datagen.estimation.mixed_labels import read_mixed
from datagen.schemas.fields import sized_schema
from datagen.schemas.run import Run
from datagen.schemas.specification import ScenesFrom
from tests.made_runs import make_run, small_spec
from tests.refusals import refused
from tests.small_runs import json_of

SCENES, PER_SCENE, DEAR_SCENES = 60, 5, 24


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Random cheap labels, and the same ones again under the name of `plan` in the first 24 scenes."""
    folder = tmp_path_factory.mktemp("mixed")
    cheap = make_run(folder / "cheap", n=SCENES * PER_SCENE)
    spec = small_spec(label_source="plan", scenes_from=ScenesFrom(spec_hash=cheap.manifest.spec_hash))
    make_run(folder / "dear", n=DEAR_SCENES * PER_SCENE, spec=spec)
    make_run(folder / "other", n=50, spec=small_spec(seed=7))
    return {name: folder / name for name in ("cheap", "dear", "other")}


def test_dear_labels_equal_to_cheap_ones_add_nothing_to_them(runs: dict[str, Path]) -> None:
    report = estimate([str(runs["cheap"])], dear=[str(runs["dear"])])
    labels = read_mixed([str(runs["cheap"])], [str(runs["dear"])])
    assert (report["scenes"], report["dear_labels"]) == (SCENES, DEAR_SCENES * PER_SCENE)
    assert [row["population"] for row in report["estimates"]] == ["grid", "clear", "in-range"]
    for row in report["estimates"]:
        member = labels.member(row["population"]) > 0
        every = labels.population.cheap[member, 0].mean()
        assert row["candidates"] == member.sum() and row["cheap_rates"] == {"heuristic": every}
        if row["weights"]["heuristic"]:
            assert row["rate"] == pytest.approx(every, abs=0.003)
            assert row["weights"]["heuristic"] == pytest.approx(1, abs=0.1)
    assert report["estimates"][0]["weights"]["heuristic"]


def test_the_numbers_are_those_of_the_stored_arrays(runs: dict[str, Path]) -> None:
    labels = read_mixed([str(runs["cheap"])], [str(runs["dear"])])
    dear = labels.population.is_dear
    np.testing.assert_array_equal(labels.population.label[dear], labels.population.cheap[dear, 0] == 1)
    assert set(labels.population.scene[dear]) == set(range(DEAR_SCENES))
    np.testing.assert_allclose(labels.population.probability, DEAR_SCENES / SCENES)


def test_rows_beyond_n_do_not_count(runs: dict[str, Path], tmp_path: Path) -> None:
    make_run(tmp_path / "cut", n=13 * PER_SCENE + 2)
    labels = read_mixed([str(tmp_path / "cut")], [str(runs["dear"])])
    assert labels.population.n_scenes == 13


def test_the_tables_and_the_json_are_there(runs: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    words = ["estimate", str(runs["cheap"]), "--with", str(runs["dear"]), "--half-width", "0.2"]
    report: dict[str, Any] = json_of(capsys, words)
    row = report["estimates"][0]
    assert row["low"] < row["rate"] < row["high"]
    assert (row["further_labels"], row["further_cpu_s"], row["scenes_suffice"]) == (0, 0, True)
    assert cli.run(words) == 0
    told = capsys.readouterr().out
    assert f"{100 * row['rate']:.1f}% [{100 * row['low']:.1f}, {100 * row['high']:.1f}]" in told
    assert "further plan labels for an interval of ±20%" in told
    assert cli.run([*words[:-1], "0.01"]) == 0
    assert "more cheap labels are needed first" in capsys.readouterr().out


def test_what_is_not_over_the_same_candidates_is_refused(
    runs: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    cheap, dear, other = (str(runs[name]) for name in ("cheap", "dear", "other"))
    for words, told in (
        ([other, "--with", dear], "no run here has plan labels"),
        ([cheap, other, "--with", dear], "no run here has plan labels"),
        ([cheap, "--with", cheap], "has heuristic labels, as the runs of --with have"),
        ([cheap, cheap, "--with", dear], "Name one of the two"),
        ([cheap, "--with", dear, "--half-width", "2"], "is not between 0 and 0.5"),
        ([cheap, "--with", dear, "--methods", "proximty"], "Did you mean proximity?"),
        ([cheap, "--with", dear, "--methods", "scalars"], "needs runs to fit"),
        ([cheap, "--with", str(runs["cheap"].parent / "none")], "no such"),
    ):
        assert told in refused(["estimate", *words], capsys)


def test_made_runs_have_the_schema_that_the_specification_names(runs: dict[str, Path]) -> None:
    run = Run.open(runs["dear"])
    assert run.schema == sized_schema("heuristic", run.manifest.spec)
