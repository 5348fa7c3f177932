"""The stores of every format that was released are read by every path that reads, as on their first day."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen import cli
from datagen.regeneration.deep_check import deep_findings
from datagen.regeneration.scenes import open_sources, what_differs_here
from datagen.schemas.fields import OLDEST_SCHEMA_VERSION, SCHEMA_VERSION
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.run import Run
from datagen.schemas.run_records import FORMAT_VERSION
from datagen.schemas.scene_rows import read_scene
from datagen.train.reader import SampleReader
from datagen.workers.houses import open_houses
from datagen.workers.labels import load_label_source
from datagen.workers.objects import open_objects
from tests.golden.archive import digest_of, digests_of, unpack
from tests.made_runs import check_digests
from tests.small_runs import json_of

HERE = Path(__file__).parent
STORES = sorted(path.stem for path in HERE.glob("*.zip"))


@pytest.fixture(scope="module", params=STORES)
def golden(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Golden:
    folder = tmp_path_factory.mktemp("golden")
    unpack(HERE / f"{request.param}.zip", folder)
    return Golden(folder, json.loads((HERE / f"{request.param}.json").read_text()))


class Golden:
    """An unpacked store, and what is to be read in it."""

    def __init__(self, folder: Path, expected: dict[str, Any]) -> None:
        self.run, self.merged, self.expected = folder / "run", folder / "merged", expected

    @property
    def has_its_world(self) -> bool:
        """Whether the built-in houses and objects are still those that it was made from."""
        spec = Run.open(self.run).manifest.spec
        here = [open_houses("builtin").digest, open_objects("builtin").digest]
        return here == [spec.houses.digest, spec.objects.digest]

    @property
    def is_made_so_here(self) -> bool:
        """Whether this machine and program make it again bit for bit."""
        run = Run.open(self.run)
        return self.has_its_world and not any(what_differs_here(run, c.shard) for c in run.commits())


def test_the_present_formats_have_a_golden_store() -> None:
    assert f"run-format-{FORMAT_VERSION}-schema-{SCHEMA_VERSION}" in STORES, (
        "run: python -m tests.golden.make"
    )
    assert f"run-format-{FORMAT_VERSION}-schema-{OLDEST_SCHEMA_VERSION}" in STORES


def test_its_records_are_read(golden: Golden) -> None:
    run, expected = Run.open(golden.run), golden.expected
    assert run.manifest.spec_hash == run.manifest.spec.hash() == expected["spec_hash"]
    assert (run.manifest.format_version, run.schema.version) == (
        expected["format_version"],
        expected["schema_version"],
    )
    assert run.n == expected["n"] and run.missing() == [] and run.quarantined() == set()
    assert {str(c.shard): [c.attempt, c.samples, c.positives] for c in run.commits()} == expected["commits"]
    for commit in run.commits():
        check_digests(run, commit)
    ends = list(run.ledger.ends())
    assert len(ends) == expected["attempts"] and {end.outcome for end in ends} == {"committed"}
    assert len(list((golden.run / "plans").iterdir())) == expected["plans"]
    assert [part.n for part in open_runs(golden.merged)] and len(open_runs(golden.merged)) == 2


@pytest.mark.parametrize("name", ["run", "merged"])
def test_every_array_is_what_it_was(name: str, golden: Golden) -> None:
    assert digests_of(getattr(golden, name) / "data.zarr") == golden.expected[name]


def test_rows_are_read_without_the_sealed_store(golden: Golden) -> None:
    """The reader for training and the reader of single scenes."""
    run = Run.open(golden.run)
    names = [f.name for f in run.schema.sample_fields]
    reader = SampleReader([golden.run], sample_fields=names)
    shards = list(reader.shards())
    for field in run.schema.sample_fields:
        values = np.concatenate([shard[field.name] for shard in shards]).astype(
            field.dtype if not field.is_text else object
        )
        assert digest_of(values) == golden.expected["run"][field.name], field.name
    assert len(SampleReader([golden.merged])) == golden.expected["merged_labels"]
    first = [read_scene(run, k).record["house_id"] for k in range(2)]
    assert first == [str(h) for h in whole_column(golden.run, "house_id")]


def whole_column(run: Path, name: str) -> np.ndarray[Any, Any]:
    """An array of the sealed store."""
    return np.concatenate([shard[name] for shard in SampleReader([run / "data.zarr"], [name]).shards()])


@pytest.mark.parametrize("name", ["run", "merged"])
def test_verbs_that_read_take_it(
    name: str, golden: Golden, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place, expected = getattr(golden, name), golden.expected
    labels = expected["n" if name == "run" else "merged_labels"]
    status = json_of(capsys, ["status", str(place)])
    assert status["labels"] == labels and status["complete"] and status["sealed"]
    assert json_of(capsys, ["audit", str(place)])
    assert json_of(capsys, ["verify", str(place)])["clean"]
    if golden.has_its_world:
        assert cli.run(["show", str(place), "--out", str(tmp_path / "scene.png")]) == 0
        assert (tmp_path / "scene.png").stat().st_size > 10_000


def test_its_rows_still_follow_from_its_specification(golden: Golden) -> None:
    """Bit for bit where machine and engines are those that made it, else within the tolerances."""
    if not golden.has_its_world:
        pytest.skip("the built-in world is another one since: docs/explanation/determinism.md")
    for run in open_runs(golden.merged):
        origin = open_sources(run, needs_scenes=False)
        assert list(deep_findings(run, 6, origin, np.random.default_rng(0))) == []


def test_a_sample_of_it_is_replayed(golden: Golden, capsys: pytest.CaptureFixture[str]) -> None:
    if not golden.is_made_so_here:
        pytest.skip("made on another machine or by other engines: a replay may differ")
    sample = read_scene(Run.open(golden.run), 1).samples["sample_id"][2].tobytes().hex()
    for place in (golden.run, golden.merged):
        told = json_of(capsys, ["replay", str(place), sample])
        assert told["equal"] and told["scene"] == 1 and told["differs_here"] == []


def test_it_is_relabelled_and_merged(golden: Golden, tmp_path: Path) -> None:
    parts = [str(part.storage.url) for part in open_runs(golden.merged)]
    assert cli.run(["merge", *reversed(parts), "--out", str(tmp_path / "again")]) == 0
    assert digests_of(tmp_path / "again/data.zarr") == golden.expected["merged"]
    made = Run.open(golden.run).manifest.spec.engines["labels"]
    if made == str(load_label_source("heuristic").version):
        assert cli.run(["relabel", str(golden.run), "--out", str(tmp_path / "other"), "--mu", "0.7"]) == 0
        changed = {
            name
            for name, digest in digests_of(tmp_path / "other/data.zarr").items()
            if digest != golden.expected["run"][name]
        }
        assert changed <= {"label", "heuristic_score", "sample_id"} and "heuristic_score" in changed
