"""A run: one winner, resume by commits, refusal of everything foreign or damaged."""

from __future__ import annotations

import json
import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.schemas import run_records
from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMA_VERSION
from datagen.schemas.record_files import copy_key, publish
from datagen.schemas.run import Run
from datagen.schemas.run_records import Layout, LedgerEntry, QuarantineRecord, StageClock
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.storage import open_storage
from tests.made_runs import attempts_of, files_of, make_run, manifest_of, small_spec, write
from tests.schemas.checked import edit

pytestmark = pytest.mark.usefixtures("few_arrays")


def test_resume_is_planned_minus_commits_in_the_existing_layout(tmp_path: Path) -> None:
    run = make_run(tmp_path, n=45, shards=[0, 3])
    again = make_run(tmp_path, n=45, scenes_per_shard=7, shards=[])
    assert run.missing() == again.missing() == [1, 2, 4] and again.layout.scenes_per_shard == 2
    assert [c.shard for c in again.commits()] == [0, 3]
    assert again.layout.rows_wanted(4, again.n) == (1, 5)
    assert pickle.loads(pickle.dumps(again)).committed() == {0, 3}


def test_a_run_only_grows_and_racing_plans_end_at_the_largest(tmp_path: Path) -> None:
    run = make_run(tmp_path, n=30, shards=[])
    make_run(tmp_path, n=10, shards=[])
    assert run.n == 30
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(run.grow, range(82, 102)))
    assert (run.n, len(run.planned())) == (101, 11)
    for n in (0, -1, 10**13):
        with pytest.raises(InputError, match="is not between 1"):
            run.grow(n)


def test_two_creators_of_one_run_agree_and_complete_what_a_killed_one_began(tmp_path: Path) -> None:
    manifest = manifest_of(small_spec(), Layout(scenes_per_shard=2, candidates_per_scene=5))
    place = open_storage(tmp_path)
    place.put(copy_key("other.json"), b"first")
    publish(place, "other.json", b"second")
    assert place.get("other.json", 100) == b"first"
    place.delete(["other.json", copy_key("other.json")])
    with ThreadPoolExecutor(4) as pool:
        runs = list(pool.map(lambda n: Run.create_or_open(open_storage(tmp_path), manifest, n), [5, 6, 7, 8]))
    assert {run.n for run in runs} == {8}


def test_another_specification_is_refused_with_every_differing_field(tmp_path: Path) -> None:
    make_run(tmp_path, shards=[])
    before = files_of(tmp_path)
    told = r"observation.n_points: 64, but 65 .* seed: 0, but 7 .*'all', but 'val' was given"
    with pytest.raises(InputError, match=told):
        make_run(tmp_path, n=500, spec=small_spec(seed=7, n_points=65, split="val"), shards=[])
    assert files_of(tmp_path) == before


def test_of_racing_committers_one_wins_and_the_run_holds_its_attempt(tmp_path: Path) -> None:
    run = make_run(tmp_path, shards=[])
    commits = [write(run, 0, f"attempt-{i}") for i in range(4)]
    with ThreadPoolExecutor(4) as pool:
        won = list(pool.map(run.commit, commits))
    assert sum(won) == 1 and Run.open(tmp_path).commit_of(0).attempt == f"attempt-{won.index(True)}"


def test_brief_commits_are_all_in_order_with_and_without_those_remembered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path, 50, shards=[4, 0, 2, 1])
    expected = list(run.brief_commits())
    assert [commit.shard for commit in expected] == [0, 1, 2, 4] and not any(c.redraws for c in expected)
    monkeypatch.setattr("datagen.schemas.run._MOST_REMEMBERED", 2)
    for commit in [*run.commits()][1:]:
        run.remember(commit)
    assert list(run.brief_commits()) == expected
    for shard in (1, 2):  # the first two are not read again
        (tmp_path / f"commits/{shard:06d}.json").write_bytes(b"")
    assert list(run.brief_commits()) == expected
    run.storage.delete(["commits/000001.json"])  # by a repair
    assert [commit.shard for commit in run.brief_commits()] == [0, 2, 4]
    (tmp_path / "commits/000004.json").write_bytes(b"")  # the third
    with pytest.raises(InputError, match=r"000004\.json"):
        list(run.brief_commits())


def test_quarantine_takes_a_shard_from_the_missing_until_it_is_committed(tmp_path: Path) -> None:
    run = make_run(tmp_path, n=30, shards=[0])
    record = QuarantineRecord(
        shard=2, seed=0, first_scene=4, scenes=2, attempts=("a",), causes=("c",), stacks=("s",), created="now"
    )
    assert run.quarantine(record) and not run.quarantine(record.model_copy(update={"created": "later"}))
    assert (run.missing(), run.quarantined(), run.quarantine_records()) == ([1], {2}, [record])
    assert run.commit(write(run, 2, "again"))
    assert (run.missing(), run.quarantined()) == ([1], set())


def test_an_object_is_written_once(tmp_path: Path) -> None:
    run = make_run(tmp_path, shards=[])
    commit = write(run, 0, "a")
    with pytest.raises(InputError, match=r"shards/a\.zip: exists already"):
        run.write_object("a", b"others")
    assert run.committed() == set() and run.commit(commit) and run.read_object(commit)


def test_the_ledger_knows_who_began_and_who_never_ended(tmp_path: Path) -> None:
    run = make_run(tmp_path, shards=[])
    for name in ("a", "b", "c"):
        run.ledger.start(name, 1)
    with pytest.raises(InputError, match="exists already"):
        run.ledger.start("a", 1)
    end = LedgerEntry(attempt="a", shard=1, outcome="crashed", cause="x", stack="y" * 10**6)
    assert run.ledger.end(end) and not run.ledger.end(end.model_copy(update={"outcome": "failed"}))
    (entry,) = run.ledger.ends()
    assert (entry.outcome, len(entry.stack)) == ("crashed", 20_000)
    assert [s.attempt for s in run.ledger.unfinished({"c"})] == ["b"]
    assert run.ledger.end(end.model_copy(update={"attempt": "d"})) and attempts_of(run) == set("abcd")


def test_other_names_in_commits_do_not_count(tmp_path: Path) -> None:
    run = make_run(tmp_path, n=30, shards=[0])
    for name in (
        "000001.json.0a1b.part",
        "2.json",
        "x.json",
        "000002.json~",
        "٠٠٠٠٠٢.json",
        "sub/000002.json",
    ):
        run.storage.put(f"commits/{name}", b"{}")
    assert run.committed() == {0}


OBJECT = {"path": "a-0.zip", "size": 1, "sha256": "0" * 64}
HOSTILE: list[tuple[str, dict[str, Any]]] = [
    *(("attempt", {"attempt": name}) for name in ("../../../etc", "/etc", "", "a\n", "x" * 101)),
    *(
        ("object.path", {"object": OBJECT | {"path": path}})
        for path in ("../../manifest.json", "/etc", "a//b")
    ),
    ("path", {"object": OBJECT | {"path": "a-1.zip"}}),
    *(("object.size", {"object": OBJECT | {"size": size}}) for size in (-1, 2**70)),
    ("object.sha256", {"object": OBJECT | {"sha256": "xyz"}}),
    ("object", {"object": None}),
    *(("shard", {"shard": shard}) for shard in (1, -1, 10**18)),
    ("spec_hash", {"spec_hash": "0" * 64}),
    ("scenes", {"scenes": 10**9}),
    ("samples", {"samples": 0}),
    ("surprise", {"surprise": 1}),
    ("cost.wall_s", {"cost": {"wall_s": -1, "cpu_s": 0}}),
]


def test_hostile_commits_are_refused_with_file_and_field(tmp_path: Path) -> None:
    make_run(tmp_path, shards=[0])
    path = tmp_path / "commits/000000.json"
    whole = path.read_bytes()
    for field, changes in HOSTILE:
        edit(path, **changes)
        with pytest.raises(InputError) as e:
            list(Run.open(tmp_path).commits())
        assert e.value.field == field and e.value.place.endswith("commits/000000.json")
        path.write_bytes(whole)
    with path.open("r+b") as file:
        file.truncate(2**35)
    with pytest.raises(InputError, match="34359738368 bytes, more than"):
        list(Run.open(tmp_path).commits())


def test_edited_manifests_and_other_formats_and_versions_are_refused(tmp_path: Path) -> None:
    make_run(tmp_path, shards=[])
    path = tmp_path / "manifest.json"
    spec = json.loads(path.read_text())["spec"]
    for changes, problem in (
        ({"spec": spec | {"seed": 1}}, "spec_hash"),
        ({"spec": spec, "format_version": 99}, "format_version: is 99, but this program reads 3"),
        ({"format_version": 3, "schema_version": 99}, "schema_version"),
        ({"schema_version": SCHEMA_VERSION, "schema_name": "dreams"}, "dreams"),
    ):
        edit(path, **changes)
        with pytest.raises(InputError, match=problem):
            _ = Run.open(tmp_path).schema


def test_nested_and_failing_stages_are_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, clock = [0.0], StageClock()
    monkeypatch.setattr(run_records.time, "perf_counter", lambda: now_s[0])
    monkeypatch.setattr(run_records.time, "process_time", lambda: now_s[0] / 2)
    with clock.stage("draw"):
        now_s[0] += 1
        with pytest.raises(ValueError), clock.stage("grasps"):
            now_s[0] += 10
            with clock.stage("execute"):
                now_s[0] += 100
                raise ValueError
        with clock.stage("grasps"):
            now_s[0] += 20
        now_s[0] += 2
    assert clock.wall_s == {"draw": 3, "grasps": 30, "execute": 100}
    assert clock.cpu_s == {"draw": 1.5, "grasps": 15, "execute": 50}
    with pytest.raises(KeyError, match="unknown stage"), clock.stage("lunch"):
        pass


SETS = st.sets(st.integers(0, 60), max_size=40)


@given(SETS, SETS)
def test_they_are_sets_of_numbers(a: set[int], b: set[int]) -> None:
    ours, theirs = ShardRanges.of(sorted(a, reverse=True)), ShardRanges.of(b)
    assert ours == sorted(a) and list(ours) == sorted(a) and len(ours) == len(a)
    assert [ours[i] for i in range(-len(a), len(a))] == sorted(a) * 2
    assert ours[1:7:2] == sorted(a)[1:7:2]
    assert ours.without(theirs) == sorted(a - b)
    assert ours.within(theirs) == sorted(a & b)
    assert {shard for shard in range(-1, 62) if shard in ours} == a
    assert (ours == theirs) == (a == b) and (a != b or hash(ours) == hash(theirs))


def test_a_planned_trillion_costs_nothing() -> None:
    planned = ShardRanges.of(range(10**12))
    open_ = planned.without(ShardRanges.of([0, 1, 5 * 10**11]))
    assert len(open_) == 10**12 - 3 and open_[0] == 2 and open_[-1] == 10**12 - 1
    assert open_.bounds.nbytes == 32
    with pytest.raises(IndexError):
        open_[len(open_)]
    assert ShardRanges.of(range(5, 5)) == [] and "x" not in planned
