"""What a merge writes, refuses, adds to and leaves alone, case by case; its laws are in properties."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.lineage import LINEAGE, Lineage, lineage_summary
from datagen.schemas.merging import MergeResult, merge_runs, plan_merge
from datagen.schemas.merging.writing import GUESS_CAUSE, SPARE_CAUSE
from datagen.schemas.record_files import MERGED, part_folder, read_record
from datagen.schemas.run import Run, find_scene, label_counts, open_runs
from datagen.schemas.run_records import LedgerEntry, QuarantineRecord
from datagen.schemas.sealing import seal, sealed_root
from datagen.schemas.shard_files import encode_shard
from datagen.schemas.specification import Source
from datagen.schemas.storage import open_storage
from tests.faults.crash_points_operations import small_schema
from tests.made_runs import attempt, commit_of, files_of, make_run, manifest_of, rows_of, small_spec


@pytest.fixture(autouse=True)
def few_arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    """A merge of fifty arrays a shard takes the paths of one of few."""
    monkeypatch.setitem(SCHEMAS, "heuristic", small_schema())


def merge(folder: Path | str, names: Sequence[str], out: str = "out") -> MergeResult:
    return merge_runs(plan_merge([f"{folder}/{name}" for name in names], f"{folder}/{out}"))


def fill(folder: Path, shards: Sequence[int], who: str, n: int = 60, size: int = 2, seed: int = 0) -> Run:
    """A run whose attempts have names of their own."""
    run = make_run(folder / who, n, size, shards=[], spec=small_spec(seed))
    for shard in shards:
        assert attempt(run, shard, f"{shard:06d}-{who}")
    return run


def test_partial_runs_of_one_specification_become_an_ordinary_run(tmp_path: Path):
    fill(tmp_path, [0, 2], "a", n=40)
    fill(tmp_path, [1, 2, 5], "b", n=60)
    result = merge(tmp_path, "ab")
    run = Run.open(tmp_path / "out")
    assert run.committed() == {0, 1, 2, 5}
    assert run.n == 60
    assert list(run.missing()) == [3, 4]
    assert run.commit_of(2).attempt == "000002-a"  # the smaller name
    ends = {end.attempt: (end.outcome, end.cause) for end in run.ledger.ends()}
    assert ends["000002-b"] == ("superseded", SPARE_CAUSE)
    assert ends["000005-b"] == ("committed", "")
    assert len(ends) == 5
    assert not (tmp_path / "out" / MERGED).exists()
    root = sealed_root(run.storage)
    assert root is not None
    assert root.parts[0].missing_shards == [3, 4]
    (written,) = result.written
    assert (written.linked, written.cut, written.there, written.spare) == (4, 0, 0, 1)


def test_runs_of_several_specifications_become_a_place_of_parts(tmp_path: Path):
    fill(tmp_path, [0, 1], "a", n=20)
    fill(tmp_path, [0, 2], "b", n=30, seed=1)
    merge(tmp_path, "ab")
    runs = open_runs(tmp_path / "out")
    assert [run.manifest.spec_hash for run in runs] == sorted(small_spec(k).hash() for k in (0, 1))
    assert not (tmp_path / "out" / "manifest.json").exists()
    found = label_counts(runs)
    assert (found.n, found.labels, found.missing) == (50, 40, 1)
    first = runs[0]
    assert find_scene(runs, 1) == (first, 1)
    assert find_scene(runs, -(-first.n // 5)) == (runs[1], 0)
    for scene in (-1, 10):
        with pytest.raises(InputError, match=rf"--scene: {scene} is in none .* Give one from 0 to 9"):
            find_scene(runs, scene)
    with pytest.raises(InputError, match=r"holds 2 merged runs, .* Name one of its parts: .*/parts/"):
        Run.open(tmp_path / "out")


def test_lineage_names_the_runs_that_made_the_shards_through_merged_ones(tmp_path: Path):
    fill(tmp_path, [0, 1, 3], "a")
    fill(tmp_path, [1, 2], "b")
    fill(tmp_path, [2, 3], "c", size=1)
    merge(tmp_path, "ab", "ab")
    assert attempt(Run.open(tmp_path / "ab"), 4, "made-there")
    merge(tmp_path, ["ab", "c"])
    out = Run.open(tmp_path / "out")
    told = {source["address"]: source["ranges"] for source in lineage_summary(out)}
    assert told == {
        str(tmp_path / "a"): [[0, 3], [6, 7]],
        str(tmp_path / "ab"): [[8, 9]],
        str(tmp_path / "b"): [[4, 5]],
        str(tmp_path / "c"): [],  # its scenes were kept from a and b
    }
    assert lineage_summary(Run.open(tmp_path / "a")) == []
    record = read_record(out.storage, LINEAGE, Lineage)
    assert record is not None
    assert record.sources[0].platform == "test"


def test_a_merge_in_place_adds_and_keeps_what_is_committed(tmp_path: Path):
    fill(tmp_path, [0, 1], "b", n=20)
    fill(tmp_path, [1, 2], "a", n=30)
    merge(tmp_path, "b")
    before = files_of(tmp_path / "out" / "commits")
    (written,) = merge(tmp_path, "a").written
    run = Run.open(tmp_path / "out")
    assert files_of(tmp_path / "out" / "commits").items() >= before.items()
    assert (written.there, written.linked, written.spare) == (2, 1, 1)
    assert run.commit_of(1).attempt == "000001-b"  # though another name is smaller
    assert run.n == 30
    assert {e.attempt: e.outcome for e in run.ledger.ends()}["000001-a"] == "superseded"
    told = {source["address"]: source["ranges"] for source in lineage_summary(run)}
    assert told == {str(tmp_path / "a"): [[2, 2]], str(tmp_path / "b"): [[0, 1]]}
    assert list(merge(tmp_path, ["out"]).written) == []  # nothing to add to itself


def test_a_place_of_parts_takes_further_specifications(tmp_path: Path):
    for k, who in enumerate("abc"):
        fill(tmp_path, [0], who, seed=k)
    merge(tmp_path, "ab")
    merge(tmp_path, "c")
    merge(tmp_path, "abc", "at_once")
    assert files_of(tmp_path / "out") == files_of(tmp_path / "at_once")


def test_a_merge_that_was_cut_short_is_finished_by_the_same_command(tmp_path: Path):
    for seed, who in ((0, "a"), (0, "b"), (1, "c")):
        fill(tmp_path, [0, 1, 2], who, seed=seed)
    merge(tmp_path, "abc", "whole")
    wanted_files = files_of(tmp_path / "whole")

    class Killed(Exception): ...

    for after in range(0, 12, 2):
        out = f"0{after}"  # first by name, where it would be taken for the shards' origin
        left = after

        def step() -> None:
            nonlocal left
            left -= 1
            if left < 0:
                raise Killed

        with pytest.raises(Killed):
            merge_runs(plan_merge([f"{tmp_path}/{name}" for name in "abc"], f"{tmp_path}/{out}"), step)
        merge(tmp_path, "abc", out)
        assert files_of(tmp_path / out) == wanted_files, after


def test_a_merge_that_was_killed_while_it_named_its_parts_is_finished_by_the_same_command(tmp_path: Path):
    fill(tmp_path, [0, 1], "a")
    fill(tmp_path, [0, 1], "b", seed=1)
    merge(tmp_path, "ab", "done")
    planned = plan_merge([f"{tmp_path}/a", f"{tmp_path}/b"], f"{tmp_path}/out")
    merge_runs(planned)
    # Its copy was there, and its draft half written.
    named = (tmp_path / "out" / MERGED).read_bytes()
    (tmp_path / "out" / MERGED).unlink()
    (tmp_path / "out" / f"{MERGED}.0123456789abcdef.part").write_bytes(named[:20])
    shutil.rmtree(tmp_path / "out" / "data.zarr")
    merge(tmp_path, "ab")
    assert sealed_root(open_storage(tmp_path / "out")) == sealed_root(open_storage(tmp_path / "done"))


def test_what_was_known_of_an_attempt_grows_with_its_source(tmp_path: Path):
    run = fill(tmp_path, [0], "a")
    fill(tmp_path, [1], "b")
    run.ledger.start("late", 1)
    merge(tmp_path, "ab")
    out = Run.open(tmp_path / "out")
    late = out.ledger.end_of("late")
    assert late is not None
    assert (late.outcome, late.cause, late.cost) == ("lost", GUESS_CAUSE, None)
    cost = run.commit_of(0).cost
    run.ledger.end(LedgerEntry(attempt="late", shard=1, outcome="superseded", cost=cost))
    merge(tmp_path, "ab")
    late = out.ledger.end_of("late")
    assert late is not None
    assert (late.outcome, late.cost) == ("superseded", cost)


def test_an_end_that_no_ledger_has_is_taken_from_the_commit(tmp_path: Path):
    run = fill(tmp_path, [0], "a")
    (tmp_path / "a" / "ledger" / "000000-a.json").unlink()
    fill(tmp_path, [1], "b")
    merge(tmp_path, "ab")
    end = Run.open(tmp_path / "out").ledger.end_of("000000-a")
    assert end is not None
    assert (end.outcome, end.cost, end.ended) == (
        "committed",
        run.commit_of(0).cost,
        run.commit_of(0).created,
    )


def test_quarantine_comes_along_for_shards_that_nobody_has(tmp_path: Path):
    run = fill(tmp_path, [0], "a")
    fill(tmp_path, [2, 3], "b", size=1)
    for shard in (1, 2):
        record = QuarantineRecord(
            shard=shard, seed=0, first_scene=2 * shard, scenes=2, attempts=("x",), causes=("",), stacks=("",),
            created="",
        )  # fmt: skip
        run.quarantine(record)
    merge(tmp_path, "ab")
    out = Run.open(tmp_path / "out")
    assert out.quarantined() == {4, 5}
    assert [(r.first_scene, r.scenes) for r in out.quarantine_records()] == [(4, 1), (5, 1)]


def test_equal_rows_in_other_bytes_are_no_conflict(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    fill(tmp_path, [0], "a")
    run = fill(tmp_path, [], "b")
    monkeypatch.setattr(
        "datagen.schemas.shard_files.ZSTD_LEVEL", 19
    )  # as another version of the compressor might
    scenes, samples = rows_of(run, 0)
    files = encode_shard(run.schema, run.layout, run.manifest.spec_hash, scenes, samples)
    assert run.commit(commit_of(run, 0, "z", run.write_shard(0, "z", files), int(samples["label"].sum())))
    ours = {e.path: e.sha256 for e in Run.open(tmp_path / "a").commit_of(0).files}
    assert {e.path: e.sha256 for e in run.commit_of(0).files} != ours
    merge(tmp_path, "ab")
    assert Run.open(tmp_path / "out").commit_of(0).attempt == "000000-a"


def test_runs_of_another_kind_are_refused_naming_every_difference(tmp_path: Path):
    make_run(tmp_path / "a", 20, shards=[0], spec=small_spec(engines={"label": "1"}))
    make_run(tmp_path / "b", 20, shards=[0], spec=small_spec(n_points=65, engines={"label": "2"}))
    with pytest.raises(InputError) as refused:
        merge(tmp_path, "ab")
    told = str(refused.value)
    for word in (f"{tmp_path}/a", f"{tmp_path}/b", "engines.label: '1' and '2'", "n_points: 64 and 65"):
        assert word in told
    make_run(tmp_path / "c", 20, candidates_per_scene=4, shards=[0])
    make_run(tmp_path / "d", 20, shards=[0])
    with pytest.raises(InputError, match="candidates_per_scene: 4 and 5"):
        merge(tmp_path, "cd")
    assert not (tmp_path / "out").exists()


def test_other_seeds_splits_and_sources_are_other_samples_of_one_kind(tmp_path: Path):
    houses = Source(kind="procthor", digest="3" * 64)
    specs = [small_spec(), small_spec(1), small_spec(split="val")]
    specs.append(small_spec().model_copy(update={"houses": houses}))
    for k, spec in enumerate(specs):
        make_run(tmp_path / str(k), 10, shards=[0], spec=spec)
    merge(tmp_path, "0123")
    assert len(open_runs(tmp_path / "out")) == 4


def test_what_cannot_be_added_to_a_place_is_refused_before_anything_is_written(tmp_path: Path):
    fill(tmp_path, [0], "a")
    fill(tmp_path, [1], "b", seed=1)
    fill(tmp_path, [1], "c", size=3)
    make_run(tmp_path / "d", 20, shards=[0], spec=small_spec(n_points=65))
    before = files_of(tmp_path / "a")
    for other, problem in (("b", "runs of another specification"), ("c", "need 1"), ("d", "differs in kind")):
        with pytest.raises(InputError, match=problem):
            merge(tmp_path, [other], "a")
    assert files_of(tmp_path / "a") == before
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").write_text("")
    with pytest.raises(InputError, match=r"thesis\.tex: holds other files"):
        merge(tmp_path, "ab", "foreign")
    for out in ("a/shards", "a/deeper"):
        with pytest.raises(InputError, match=f"--out: is inside {tmp_path}/a"):
            merge(tmp_path, "ab", out)
    with pytest.raises(InputError, match="contains "):
        merge(tmp_path, ["a", "b"], "")
    assert files_of(tmp_path / "a") == before


def test_a_source_that_lacks_a_committed_file_is_refused(tmp_path: Path):
    fill(tmp_path, [0], "a")
    fill(tmp_path, [1], "b")
    (tmp_path / "a" / "shards" / "000000" / "000000-a" / "label" / "c.0").unlink()
    with pytest.raises(InputError, match=r"a/shards/000000/000000-a/label/c\.0: is missing"):
        merge(tmp_path, "ab")


def test_sealed_sources_stay_readable_and_linked(tmp_path: Path):
    run = fill(tmp_path, [0, 1], "a", n=20)
    fill(tmp_path, [2], "b")
    seal(run.storage)
    before = files_of(tmp_path / "a")
    merge(tmp_path, "ab")
    assert files_of(tmp_path / "a") == before
    chunk = "shards/000000/000000-a/label/c.0"
    assert (tmp_path / "a" / chunk).stat().st_ino == (tmp_path / "out" / chunk).stat().st_ino
    assert (tmp_path / "out" / chunk).stat().st_nlink == 4  # both runs and both stores


def test_merging_on_s3_gives_the_same_files(tmp_path: Path, bucket: str):
    manifest = manifest_of(small_spec(), Run.open(fill(tmp_path, [], "x").storage).layout)
    other = manifest_of(small_spec(1), manifest.layout)
    for name, kind, shards in (("a", manifest, [0, 1]), ("b", manifest, [1, 2]), ("c", other, [0])):
        run = Run.create_or_open(open_storage(f"{bucket}/{name}"), kind, 40)
        for shard in shards:
            assert attempt(run, shard, f"{shard:06d}-{name}")
    for _ in range(2):
        merge(bucket, "abc")
    merge(bucket, "ab", "ab")
    merge_runs(plan_merge([f"{bucket}/{name}" for name in ("ab", "c")], str(tmp_path / "here")))
    place = open_storage(f"{bucket}/out")
    there = {f.key: place.get(f.key, 2**30) for f in place.list("")}
    assert there.keys() >= {"merged.json", f"{part_folder(manifest.spec_hash)}/lineage.json"}
    here = files_of(tmp_path / "here")
    assert {k: v for k, v in there.items() if not k.startswith("data.zarr")} == {
        k: v for k, v in here.items() if not k.startswith("data.zarr")
    }
    assert label_counts(open_runs(place)) == label_counts(open_runs(tmp_path / "here"))
    assert sealed_root(place) == sealed_root(open_storage(tmp_path / "here"))
