"""A run: one winner, resume by commits, refusal of everything foreign or damaged."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMA_VERSION
from datagen.schemas.record_files import copy_key, publish
from datagen.schemas.run import Run
from datagen.schemas.run_records import FileEntry, Layout, LedgerEntry, QuarantineRecord
from datagen.schemas.storage import open_storage
from tests.made_runs import commit_of, files_of, make_run, manifest_of, small_spec, write
from tests.schemas.checked import edit

pytestmark = pytest.mark.usefixtures("few_arrays")


def test_resume_is_planned_minus_commits(tmp_path: Path):
    run = make_run(tmp_path, n=45, shards=[0, 3])
    assert run.missing() == [1, 2, 4]
    again = make_run(tmp_path, n=45, shards=[])
    assert again.missing() == [1, 2, 4]
    assert [c.shard for c in again.commits()] == [0, 3]
    assert again.layout.rows_wanted(4, again.n) == (1, 5)
    assert pickle.loads(pickle.dumps(again)).committed() == {0, 3}


def test_a_run_only_grows(tmp_path: Path):
    run = make_run(tmp_path, n=30, shards=[])
    make_run(tmp_path, n=10, shards=[])
    assert run.n == 30
    run.grow(101)
    assert (run.n, len(run.planned())) == (101, 11)
    for n in (0, -1, 10**13):
        with pytest.raises(InputError, match="is not between 1"):
            run.grow(n)


def test_racing_plans_end_at_the_largest(tmp_path: Path):
    run = make_run(tmp_path, n=1, shards=[])
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(run.grow, range(2, 22)))
    assert run.n == 21


def test_the_existing_layout_wins(tmp_path: Path):
    make_run(tmp_path, n=30, scenes_per_shard=3, shards=[])
    assert make_run(tmp_path, n=30, scenes_per_shard=7, shards=[]).layout.scenes_per_shard == 3


def test_another_specification_is_refused_with_every_differing_field(tmp_path: Path):
    make_run(tmp_path, shards=[])
    before = files_of(tmp_path)
    other = small_spec(seed=7, n_points=65, split="val")
    with pytest.raises(InputError) as e:
        make_run(tmp_path, n=500, spec=other, shards=[])
    text = str(e.value)
    for part in (
        "seed: 0, but 7 was given",
        "observation.n_points: 64, but 65 was given",
        "'all', but 'val' was given",
    ):
        assert part in text
    assert "\n" not in text
    assert files_of(tmp_path) == before


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match="holds other files"):
        make_run(tmp_path, shards=[])
    assert set(files_of(tmp_path)) == {"thesis.tex"}


def test_of_racing_committers_one_wins_and_the_run_holds_its_attempt(tmp_path: Path):
    run = make_run(tmp_path, shards=[])
    commits = [write(run, 0, f"attempt-{i}") for i in range(4)]
    with ThreadPoolExecutor(4) as pool:
        won = list(pool.map(run.commit, commits))
    assert sum(won) == 1
    assert Run.open(tmp_path).commit_of(0).attempt == f"attempt-{won.index(True)}"


def test_an_object_is_written_once_and_read_as_committed(tmp_path: Path):
    run = make_run(tmp_path, shards=[])
    commit = write(run, 0, "a")
    with pytest.raises(InputError, match=r"shards/a\.zip: exists already"):
        run.write_object("a", b"others")
    assert run.committed() == set() and run.commit(commit) and run.read_object(commit)
    path = tmp_path / "shards/a.zip"
    data = path.read_bytes()
    for changed in (data[:-1], data + b"x", bytes([data[0] ^ 1]) + data[1:]):
        path.write_bytes(changed)
        with pytest.raises(InputError, match=r"shards/a\.zip: has (other )?.*bytes"):
            run.read_object(commit)


def test_the_ledger_knows_who_began_and_who_never_ended(tmp_path: Path):
    run = make_run(tmp_path, shards=[])
    for name in ("a", "b", "c"):
        run.ledger.start(name, 1)
    with pytest.raises(InputError, match="exists already"):
        run.ledger.start("a", 1)
    end = LedgerEntry(attempt="a", shard=1, outcome="crashed", cause="x", stack="y" * 10**6)
    assert run.ledger.end(end)
    assert not run.ledger.end(end.model_copy(update={"outcome": "failed"}))
    (entry,) = run.ledger.ends()
    assert (entry.outcome, len(entry.stack)) == ("crashed", 20_000)
    assert [s.attempt for s in run.ledger.unfinished({"c"})] == ["b"]
    assert run.ledger.end(end.model_copy(update={"attempt": "d"})) and run.ledger.attempts() == set("abcd")


def test_quarantine_takes_a_shard_from_the_missing_until_it_is_committed(tmp_path: Path):
    run = make_run(tmp_path, n=30, shards=[0])
    record = QuarantineRecord(
        shard=2, seed=0, first_scene=4, scenes=2, attempts=("a",), causes=("c",), stacks=("s",), created="now"
    )
    assert run.quarantine(record)
    assert not run.quarantine(record.model_copy(update={"created": "later"}))
    assert (run.missing(), run.quarantined()) == ([1], {2})
    assert run.quarantine_records() == [record]
    assert run.commit(write(run, 2, "again"))
    assert (run.missing(), run.quarantined()) == ([1], set())


def test_other_names_in_commits_do_not_count(tmp_path: Path):
    run = make_run(tmp_path, n=30, shards=[0])
    for name in (
        "000001.json.0a1b.part",
        "2.json",
        "x.json",
        "000002.json~",
        "٠٠٠٠٠٢.json",
        "sub/000002.json",
    ):
        path = tmp_path / "commits" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("{}")
    assert run.committed() == {0}


OBJECT = {"path": "a-0.zip", "size": 1, "sha256": "0" * 64}


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"attempt": "../../../etc"}, "attempt"),
        ({"attempt": "/etc"}, "attempt"),
        ({"attempt": ""}, "attempt"),
        ({"attempt": "a\n"}, "attempt"),
        ({"attempt": "x" * 101}, "attempt"),
        ({"object": {**OBJECT, "path": "../../manifest.json"}}, "object.path"),
        ({"object": {**OBJECT, "path": "/etc/passwd"}}, "object.path"),
        ({"object": {**OBJECT, "path": "a-1.zip"}}, "path"),
        ({"object": {**OBJECT, "size": -1}}, "object.size"),
        ({"object": {**OBJECT, "size": 2**70}}, "object.size"),
        ({"object": {**OBJECT, "sha256": "xyz"}}, "object.sha256"),
        ({"object": None}, "object"),
        ({"shard": 1}, "shard"),
        ({"shard": -1}, "shard"),
        ({"shard": 10**18}, "shard"),
        ({"spec_hash": "0" * 64}, "spec_hash"),
        ({"scenes": 10**9}, "scenes"),
        ({"samples": 0}, "samples"),
        ({"surprise": 1}, "surprise"),
        ({"cost": {"wall_s": -1, "cpu_s": 0}}, "cost.wall_s"),
    ],
)
def test_hostile_commits_are_refused_with_file_and_field(tmp_path: Path, changes: dict[str, Any], field: str):
    make_run(tmp_path, shards=[0])
    edit(tmp_path / "commits/000000.json", **changes)
    with pytest.raises(InputError) as e:
        list(Run.open(tmp_path).commits())
    assert e.value.field == field
    assert e.value.place.endswith("commits/000000.json")
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '"x"', "[" * 100_000, "\xff\xfe", "{}"])
@pytest.mark.parametrize("key", ["manifest.json", "commits/000000.json", "plans/1.json"])
def test_broken_json_is_refused_with_its_file(tmp_path: Path, key: str, text: str):
    make_run(tmp_path, shards=[0])
    (tmp_path / key).write_text(text, encoding="latin-1")
    with pytest.raises(InputError) as e:
        run = Run.open(tmp_path)
        list(run.commits())
        _ = run.n
    assert e.value.place.endswith(key)
    assert len(str(e.value)) < 1000


def test_every_truncation_of_the_manifest_is_refused(tmp_path: Path):
    make_run(tmp_path, shards=[])
    path = tmp_path / "manifest.json"
    whole = path.read_bytes()
    for size in range(0, len(whole.rstrip()), 97):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"manifest\.json"):
            Run.open(tmp_path)


def test_a_gigantic_record_is_not_read(tmp_path: Path):
    make_run(tmp_path, shards=[0])
    with (tmp_path / "commits/000000.json").open("r+b") as f:
        f.truncate(2**35)
    with pytest.raises(InputError, match="34359738368 bytes, more than"):
        list(Run.open(tmp_path).commits())


def test_an_edited_specification_is_noticed(tmp_path: Path):
    make_run(tmp_path, shards=[])
    path = tmp_path / "manifest.json"
    path.write_text(path.read_text().replace('"seed": 0', '"seed": 1'))
    with pytest.raises(InputError, match="sha256"):
        Run.open(tmp_path)
    edit(path)  # signed anew
    with pytest.raises(InputError, match="spec_hash"):
        Run.open(tmp_path)


def test_runs_of_other_formats_and_versions_are_refused(tmp_path: Path):
    make_run(tmp_path, shards=[])
    edit(tmp_path / "manifest.json", format_version=99)
    with pytest.raises(InputError, match="format_version: is 99, but this program reads 3"):
        Run.open(tmp_path)
    edit(tmp_path / "manifest.json", format_version=3, schema_version=99)
    with pytest.raises(InputError, match="schema_version"):
        _ = Run.open(tmp_path).schema
    edit(tmp_path / "manifest.json", schema_version=SCHEMA_VERSION, schema_name="dreams")
    with pytest.raises(InputError, match="dreams"):
        _ = Run.open(tmp_path).schema


def test_what_is_not_a_run(tmp_path: Path):
    with pytest.raises(InputError, match=r"manifest\.json: not a run"):
        Run.open(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        Run.open(tmp_path / "none")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="not a folder"):
        Run.open(tmp_path / "file")


def test_attempts_with_bad_names_cannot_be_committed(tmp_path: Path):
    run = make_run(tmp_path, shards=[])
    with pytest.raises(ValueError, match="attempt"):
        commit_of(run, 0, "../x", FileEntry(path="a", size=0, sha256="0" * 64))


def test_what_a_killed_creator_began_is_completed_as_he_began_it(tmp_path: Path):
    place = open_storage(tmp_path)
    place.put(copy_key("plans/1.json"), b"first")
    publish(place, "plans/1.json", b"second")
    assert place.get("plans/1.json", 100) == b"first"


def test_two_creators_of_one_run_agree(tmp_path: Path):
    manifest = manifest_of(small_spec(), Layout(scenes_per_shard=2, candidates_per_scene=5))
    with ThreadPoolExecutor(4) as pool:
        runs = list(pool.map(lambda n: Run.create_or_open(open_storage(tmp_path), manifest, n), [5, 6, 7, 8]))
    assert {run.n for run in runs} == {8}
