"""Merges: each scene once, whatever the sizes of shards; conflicts refused; interrupted merges completed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.schemas.merging import SPARE_CAUSE, merge_runs, plan_merge
from datagen.schemas.merging.plan import refuse_different_rows
from datagen.schemas.record_files import MERGED, signed_json
from datagen.schemas.run import Run, find_scene, label_counts, open_runs
from datagen.schemas.run_records import FORMAT_VERSION, Layout, LedgerEntry
from datagen.schemas.specification import Source
from datagen.schemas.storage import Storage, open_storage
from datagen.train.run_parts import open_parts
from tests.faults.crash_points_operations import remake
from tests.made_runs import Tables, files_of, make_run, rows_of, small_spec, tables_of
from tests.schemas.checked import (
    Arrays,
    Changes,
    assert_rows,
    commit_object,
    dies_at,
    encoded,
    fill,
    found,
    merge,
    stored,
    tree,
)  # fmt: skip

pytestmark = pytest.mark.usefixtures("few_arrays")


# One specification ----------------------------------------------------------------------------


_OF = "sample_scene_index"


def of_scenes(run: Run, scenes: Iterable[int]) -> Arrays:
    """The rows that the specification has for these scenes."""
    layout = Layout(scenes_per_shard=1, candidates_per_scene=5)
    spec = run.manifest.spec
    each = [tables_of(run.schema, layout, spec.seed, scene, run.manifest.spec_hash) for scene in scenes]
    return {name: np.concatenate([tables[t][name] for tables in each]) for t in (0, 1) for name in each[0][t]}


def by_scene(run: Run, arrays: Arrays) -> Arrays:
    """The rows in order of their scenes."""
    orders = {t: np.argsort(arrays[k], kind="stable") for t, k in (("scene", "scene_index"), ("sample", _OF))}
    return {f.name: arrays[f.name][orders[table]] for table, f in run.schema.fields}


def assert_scenes(storage: Storage, scenes: Iterable[int]) -> None:
    """The store, and the runs as training reads them, have these scenes, each once, with their rows."""
    runs = open_runs(storage)
    wanted = of_scenes(runs[0], sorted(scenes))
    assert_rows(by_scene(runs[0], stored(storage)), wanted)
    counts = label_counts(runs)
    assert (counts.labels, counts.n) == (len(wanted["label"]), runs[0].n)
    parts = open_parts([storage.url], list(wanted), allow_incomplete=True)
    read = [place.read(part.arrays.values()) for part in parts for place in part.shards]
    found_ = {name: np.concatenate([each[name] for each in read]) for name in wanted}
    assert_rows(by_scene(runs[0], found_), wanted)
    assert found(storage.url) == []


# Sources, each as its scenes per shard, its shards, and its number of scenes.
SOURCES = st.lists(
    st.tuples(st.integers(1, 6), st.sets(st.integers(0, 11), min_size=1), st.integers(1, 24)),
    min_size=1,
    max_size=4,
)


@settings(max_examples=10, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(sources=SOURCES, more=st.integers(1, 9))
@example(sources=[(6, {0}, 12), (2, {4}, 12)], more=1)  # a scene in the middle of a shard that is missing
@example(sources=[(6, {0}, 24), (5, {1}, 24), (4, {1, 2, 4}, 24)], more=5)
@example(sources=[(2, {0}, 24), (6, {0}, 1), (5, {0, 1, 2, 3, 4}, 1)], more=1)
@example(sources=[(2, {0, 1}, 10), (2, {1, 3}, 12), (3, {1}, 9)], more=4)
def test_each_scene_counts_once_whatever_the_sizes_of_shards_and_the_order_of_sources(
    sources: list[tuple[int, set[int], int]], more: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder, held = tmp_path_factory.mktemp("runs"), set[int]()
    for k, (size, shards, scenes) in enumerate(sources):
        run = fill(
            folder, f"r{k}", [shard for shard in sorted(shards) if shard * size < 24], 5 * scenes, size
        )
        held |= {scene for shard in run.committed() for scene in range(shard * size, (shard + 1) * size)}
    names, end = [f"r{k}" for k in range(len(sources))], max(scenes for _, _, scenes in sources)
    merge(folder, names)
    storage = open_storage(folder / "out")
    if held & set(range(end)):
        assert_scenes(storage, held & set(range(end)))
    merge(folder, names[::-1], "other")
    assert whole(folder / "other") == whole(folder / "out")
    remake(folder / "out")  # parts lack shards
    assert_scenes(storage, range(end))
    for run in open_runs(storage):
        run.grow(5 * (end + more))
    remake(folder / "out")
    assert_scenes(storage, range(end + more))


def whole(place: Path | str) -> dict[str, bytes | None]:
    """Every file of a place but for claims, which are random."""
    return {key: data for key, data in tree(open_storage(place)).items() if not key.endswith(".claim")}


def test_a_merge_into_existing_runs_adds_and_keeps_what_is_committed(tmp_path: Path) -> None:
    fill(tmp_path, "b", [0, 1], n=20)
    fill(tmp_path, "a", [1, 2], n=30)
    merge(tmp_path, "b")
    (written,) = merge(tmp_path, "a").written
    run = Run.open(tmp_path / "out")
    assert (written.there, written.copied, written.spare, run.n) == (2, 1, 1, 30)
    assert run.commit_of(1).attempt == "000001-b-2"  # though another name is smaller
    (end,) = run.ledger.ends()
    assert (end.attempt, end.cause) == ("000001-a-2", SPARE_CAUSE)
    assert end.started == run.ledger.start_of(end.attempt).started  # type: ignore[union-attr]
    # Further specifications and sizes of shards, added one after the other.
    for who, size, seed in (("c", 2, 1), ("d", 3, 1), ("e", 2, 2)):
        fill(tmp_path, who, [0, 1], n=30, size=size, seed=seed)
    for names, out in (("cd", "parts"), ("ae", "parts"), ("acde", "at_once")):
        merge(tmp_path, names, out)
    one, other = (whole(tmp_path / name) for name in ("parts", "at_once"))
    assert all(one[key] == data for key, data in other.items() if not key.startswith("data"))
    assert_rows(stored(open_storage(tmp_path / "parts")), stored(open_storage(tmp_path / "at_once")))


def test_a_repaired_attempt_that_another_source_kept_has_one_account(tmp_path: Path) -> None:
    fill(tmp_path, "a", [0])
    run = fill(tmp_path, "b", [1])
    run.ledger.start("000000-a-2", 0)
    run.ledger.end(LedgerEntry(attempt="000000-a-2", shard=0, outcome="superseded", cause="set aside"))
    merge(tmp_path, "ab")
    assert found(tmp_path / "out") == []


def test_runs_of_several_specifications_become_parts(tmp_path: Path) -> None:
    houses = {"houses": Source(kind="procthor", digest="3" * 64)}
    for who, spec in (("c", small_spec(split="val")), ("d", small_spec().model_copy(update=houses))):
        make_run(tmp_path / who, 10, shards=[0], spec=spec)
    merge(tmp_path, "cd")
    runs = open_runs(tmp_path / "out")
    assert find_scene(runs, 1) == (runs[0], 1) and find_scene(runs, 2) == (runs[1], 0)
    for scene in (-1, 4):
        with pytest.raises(InputError, match=rf"--scene: {scene} is in none .* Give one from 0 to 3"):
            find_scene(runs, scene)
    with pytest.raises(InputError, match=r"holds 2 merged runs, .* Name one of its parts: .*/parts/"):
        Run.open(tmp_path / "out")


def test_hostile_records_of_merged_runs_are_refused(tmp_path: Path) -> None:
    storage, second = open_storage(tmp_path), {"folder": "parts/b", "spec_hash": "0" * 64, "scenes": []}
    for changes in (
        *({"scenes": odd} for odd in ([[5, 2]], [[0, 4], [2, 6]], [[3, 3]], [[0, 10**19]], [[-1, 2]], 3)),
        *({"folder": folder} for folder in ("../a", "/etc", "")),
        {"spec_hash": "x"},
    ):
        parts = [second | {"folder": "parts/a"} | changes, second]
        record = {"format_version": FORMAT_VERSION, "parts": parts}
        storage.put(MERGED, signed_json(record))
        with pytest.raises(InputError, match=r"merged\.json: parts\.0"):
            open_runs(storage)
    storage.put(MERGED, signed_json({"format_version": FORMAT_VERSION, "parts": [second]}))
    with pytest.raises(InputError, match=r"merged\.json: parts: "):
        open_runs(storage)


# Interruptions and places ---------------------------------------------------------------------


def test_an_interrupted_merge_is_completed_by_the_same_command(tmp_path: Path) -> None:
    for who, seed, size in (("a", 0, 2), ("b", 0, 2), ("c", 1, 2), ("d", 1, 3)):
        fill(tmp_path, who, [0, 1, 2], seed=seed, size=size)
    merge(tmp_path, "abcd", "undisturbed")
    plain, at, was_killed = whole(tmp_path / "undisturbed"), 1, True
    while was_killed:
        out = f"0{at}"  # first by name, where it would be taken for the shards' origin
        with Changes(dies_at(at)) as changes:
            merge(tmp_path, "abcd", out)
        was_killed, at = changes.made >= at, at + 5
        merge(tmp_path, "abcd", out)
        there = whole(tmp_path / out)
        assert all(there[key] == data for key, data in plain.items() if not key.startswith("data")), at
        assert_rows(stored(open_storage(tmp_path / out)), stored(open_storage(tmp_path / "undisturbed")))
        assert found(tmp_path / out) == []


def test_merges_on_s3_give_the_same_files(tmp_path: Path, bucket: str) -> None:
    for who, seed, shards in (("a", 0, [0, 1]), ("b", 0, [1, 2]), ("c", 1, [0])):
        fill(bucket, who, shards, 40, seed=seed)
    merge(bucket, "abc")
    merge(bucket, "ab", "ab")
    merge_runs(plan_merge([f"{bucket}/{name}" for name in ("ab", "c")], str(tmp_path / "here")))
    assert whole(f"{bucket}/out") == whole(tmp_path / "here")


def test_runs_that_cannot_be_merged_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    """test_merge.py tries other kinds of runs."""
    fill(tmp_path, "a", [0])
    fill(tmp_path, "c", [1], size=3)
    make_run(tmp_path / "e", 20, candidates_per_scene=4, shards=[0])
    open_storage(tmp_path / "foreign").put("thesis.tex", b"")
    before = files_of(tmp_path / "a")
    for names, out, problem in (
        ("c", "a", "cannot hold runs of another specification or size of shards"),
        ("ea", "out", "candidates_per_scene: 4 and 5"),
        ("a", "foreign", r"thesis\.tex: holds other files"),
        ("a", "a/shards", f"--out: is inside {tmp_path}/a"),
        ("ac", "", "contains "),
    ):
        with pytest.raises(InputError, match=problem):
            merge(tmp_path, names, out)
    assert not (tmp_path / "out").exists() and files_of(tmp_path / "a") == before


def test_a_damaged_object_and_another_attempt_of_its_name_are_refused(tmp_path: Path) -> None:
    run = fill(tmp_path, "a", [0])
    for place, problem in (("out", "is another attempt of that name"), ("a", r"has \d+ bytes with another")):
        open_storage(tmp_path / place).put("shards/000000-a-2.zip", b"of another attempt")
        with pytest.raises(InputError, match=rf"{place}/shards/000000-a-2\.zip: {problem}"):
            merge(tmp_path, "a", "out")
    assert Run.open(tmp_path / "out").committed() == set() and run.committed() == {0}


# Conflicts ------------------------------------------------------------------------------------

Change = Callable[[Tables], Any]


def changed(folder: Path, who: str, shard: int, change: Change | None = None, size: int = 2) -> Run:
    """A run that holds one shard, whose rows were changed before they were written."""
    run = make_run(folder / who, 40, size, shards=[])
    tables = rows_of(run, shard)
    if change is not None:
        change(tables)
    commit_object(run, shard, encoded(run, tables), who)
    return run


def sets(field: str, row: Any, value: Any) -> Change:
    return lambda tables: tables[field in tables[1]][field].__setitem__(row, value)


def flips(*rows: int) -> Change:
    return lambda tables: [sets("label", row, 1 - tables[1]["label"][row])(tables) for row in rows]


@pytest.mark.parametrize(
    ("ours", "theirs", "row", "field"),
    [
        (None, lambda t: (flips(6, 9)(t), sets("distance_m", 6, 0.5)(t)), 6, "distance_m"),  # the first
        (None, sets("house_id", 1, "another"), 5, "house_id"),
        (sets("distance_m", 3, 0.0), sets("distance_m", 3, -0.0), 3, "distance_m"),  # bit for bit
    ],
)
def test_other_rows_are_refused_naming_the_first_sample_and_field(
    ours: Change | None, theirs: Change, row: int, field: str, tmp_path: Path
) -> None:
    one = changed(tmp_path, "a", 0, ours)
    changed(tmp_path, "b", 0, theirs)
    sample = rows_of(one, 0)[1]["sample_id"][row].tobytes().hex()
    with pytest.raises(InputError) as refused:
        merge(tmp_path, "ab")
    told = f"a: shard 0: {tmp_path}/b has other rows, first in sample {sample}, in {field}. "
    assert told in str(refused.value) and not (tmp_path / "out").exists()


def test_equal_rows_in_other_bytes_are_no_conflict(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = changed(tmp_path, "a", 0)
    monkeypatch.setattr("datagen.schemas.shard_files.ZSTD_LEVEL", 19)  # as another version of the compressor
    assert changed(tmp_path, "b", 0).commit_of(0).object.sha256 != one.commit_of(0).object.sha256
    merge(tmp_path, "ab")
    assert Run.open(tmp_path / "out").commit_of(0).attempt == "a"


def test_every_common_scene_of_shards_of_other_sizes_is_compared_and_no_other(tmp_path: Path) -> None:
    small = changed(tmp_path, "small", 1)  # scenes 2 and 3
    for scene, size in ((1, 4), (0, 3)):
        large = changed(tmp_path, f"apart-{size}", 0, flips(5 * scene), size)
        refuse_different_rows(small, 1, large, 0)
        refuse_different_rows(large, 0, small, 1)
    # Of three sizes: scene 7 is in b and c, whose first common scene is in a too.
    changed(tmp_path, "a", 0, None, 6)
    changed(tmp_path, "b", 1, None, 5)
    changed(tmp_path, "c", 1, flips(15), 4)
    with pytest.raises(InputError, match=r"b: shard 1: .*c has other rows"):
        merge(tmp_path, "abc")
