"""Laws of merging, over random runs: partial, overlapping, cut otherwise, of several specifications."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from datagen.reports.audit import Spending, account_for
from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.merging import merge_runs, plan_merge
from datagen.schemas.run import MOST_SAMPLES, Run, open_runs
from datagen.schemas.run_records import Cost, LedgerEntry, QuarantineRecord
from datagen.schemas.sealing import CLAIM
from datagen.schemas.shard_files import encode_shard
from datagen.schemas.shard_reading import read_shard
from datagen.schemas.storage import open_storage
from tests.faults.crash_points_operations import small_schema
from tests.made_runs import commit_of, make_run, rows_of, small_spec, write
from tests.made_runs import files_of as all_files

PER_SCENE = 3
SCENES = 12  # in every run; its shards of 1 to 6 scenes divide them
# Every example writes whole runs durably: few examples, short runs.
# Shrinking one that fails would take an hour, so it is shown as it was found.
few = settings(
    max_examples=10,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    phases=[Phase.explicit, Phase.reuse, Phase.generate],
)
IN_MEMORY = Path("/dev/shm")  # where there is one: what is durable is for other tests


@pytest.fixture(autouse=True, scope="module")
def few_arrays() -> Iterator[None]:
    """A merge of fifty arrays a shard takes the paths of one of few."""
    with pytest.MonkeyPatch.context() as patch:
        fields = (
            "scene_index",
            "house_id",
            "redraws",
            "retry",
            "points_m",
            "sample_id",
            "sample_scene_index",
        )
        patch.setitem(SCHEMAS, "heuristic", small_schema((*fields, "candidate_index", "label", "distance_m")))
        yield


@dataclass(frozen=True)
class Source:
    """A run to be made: what it commits, and what else its ledger tells."""

    name: str
    seed: int
    scenes_per_shard: int
    n: int
    shards: tuple[int, ...]
    raced: tuple[int, ...]  # shards at which a second attempt came too late
    failed: tuple[int, ...]  # shards at which an attempt failed first
    open: tuple[int, ...]  # shards at which an attempt began and left no end
    given_up: tuple[int, ...]
    wall_s: float


@st.composite
def sources(draw: st.DrawFn, count: int, seeds: int, sizes: Sequence[int]) -> list[Source]:
    made: list[Source] = []
    for k in range(count):
        size = draw(st.sampled_from(sizes))
        shards = st.sets(st.integers(0, SCENES // size - 1), max_size=2).map(lambda s: tuple(sorted(s)))
        committed = draw(shards)
        made.append(
            Source(
                name="abc"[k],
                seed=draw(st.integers(0, seeds - 1)),
                scenes_per_shard=size,
                n=draw(st.integers(1, SCENES * PER_SCENE)),
                shards=committed,
                raced=tuple(s for s in committed if draw(st.booleans())),
                failed=draw(shards),
                open=draw(shards),
                given_up=draw(shards),
                wall_s=draw(st.floats(0.001, 1e5)),
            )
        )
    return made


def make(folder: Path, source: Source) -> Run:
    """The run on disk; every attempt has a name and a cost of its own, as in real runs."""
    spec = small_spec(source.seed)
    run = make_run(folder, source.n, source.scenes_per_shard, PER_SCENE, shards=[], spec=spec)
    for k, shard in enumerate(source.failed):
        end(run, source, shard, f"f{k}", "failed", cost(source, 3, 100 + k))
    for k, shard in enumerate(source.shards):
        name = attempt_name(source, shard, "c")
        paid = cost(source, k, 1000 + k)
        run.ledger.start(name, shard)
        assert run.commit(write(run, shard, name).model_copy(update={"cost": paid}))
    for k, shard in enumerate(source.raced):
        end(run, source, shard, "r", "superseded", cost(source, 7 + k, 77 + k))
    for shard in source.open:
        run.ledger.start(attempt_name(source, shard, "o"), shard)
    for shard in set(source.given_up) - set(source.shards):
        per = source.scenes_per_shard
        run.quarantine(
            QuarantineRecord(
                shard=shard,
                seed=source.seed,
                first_scene=shard * per,
                scenes=per,
                attempts=(attempt_name(source, shard, "q"),),
                causes=("crashed",),
                stacks=("",),
                created="",
            )
        )
    return run


def attempt_name(source: Source, shard: int, kind: str) -> str:
    # Names of another's attempts sort before and after those of this one.
    return f"{shard:06d}-{(hash((source.scenes_per_shard, shard)) % 7)}{source.name}-{kind}"


def cost(source: Source, k: int, written: int) -> Cost:
    wall_s = source.wall_s / (k + 3)
    stages = {"draw": wall_s / 3, "write": wall_s / 7}
    return Cost(wall_s=wall_s, cpu_s=wall_s / 2, stage_wall_s=stages, peak_rss_bytes=k, written_bytes=written)


def end(run: Run, source: Source, shard: int, kind: str, outcome: Any, paid: Cost) -> None:
    name = attempt_name(source, shard, kind)
    run.ledger.start(name, shard)
    run.ledger.end(LedgerEntry(attempt=name, shard=shard, outcome=outcome, cost=paid))


@contextmanager
def workplace() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir=IN_MEMORY if os.access(IN_MEMORY, os.W_OK) else None) as folder:
        yield Path(folder)


def merge(folder: Path, names: Sequence[str], out: str) -> Path:
    merge_runs(plan_merge([str(folder / name) for name in names], str(folder / out)))
    return folder / out


def files_of(folder: Path) -> dict[str, bytes]:
    """Every file but the claims of sealed stores, which are random."""
    return {key: data for key, data in all_files(folder).items() if not key.endswith(CLAIM)}


def state_of(folder: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of every file: what a second merge must leave alone."""
    files = (p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): (p.stat().st_ino, p.stat().st_mtime_ns) for p in files}


def rows_by_id(runs: Sequence[Run]) -> dict[bytes, tuple[bytes, ...]]:
    """Every committed row, with that of its scene, by sample id; an id that comes twice is refused."""
    found: dict[bytes, tuple[bytes, ...]] = {}
    for run in runs:
        for shard in sorted(run.committed()):
            arrays = read_shard(run, shard)
            rows, first = run.rows_of(shard, MOST_SAMPLES), int(arrays["scene_index"][0])
            for row, sample in enumerate(arrays["sample_id"]):
                scene = row // PER_SCENE
                if run.scenes is not None and first + scene not in run.scenes:
                    continue  # it counts in another part
                assert rows.first <= scene < rows.first + rows.scenes
                values = [arrays[f.name][scene] for f in run.schema.scene_fields]
                values += [arrays[f.name][row] for f in run.schema.sample_fields]
                bits = tuple(
                    np.asarray(v).astype(str).tobytes() if is_text(v) else v.tobytes() for v in values
                )
                assert sample.tobytes() not in found
                found[sample.tobytes()] = bits
    return found


def is_text(value: Any) -> bool:
    return isinstance(value, str) or value.dtype.kind == "O"


def sums(spending: Sequence[Spending]) -> Counter[str]:
    total: Counter[str] = Counter()
    for each in spending:
        for account in (each.useful, *each.waste.values()):
            total.update({"wall_s": account.wall_s, "core_s": account.core_s, "bytes": account.written_bytes})
            total.update({f"stage {name}": s for name, s in account.stage_s.items()})
    return total


@given(sources(3, seeds=2, sizes=(2,)), st.permutations("abc"))
@few
def test_laws_of_merging_runs_of_one_layout(made: list[Source], order: list[str]):
    with workplace() as folder:
        assert_laws(folder, made, order)


@given(sources(3, seeds=2, sizes=(1, 2, 3, 4, 6)), st.permutations("abc"))
@few
def test_laws_of_merging_where_shards_are_cut(made: list[Source], order: list[str]):
    with workplace() as folder:
        assert_laws(folder, made, order)


def assert_laws(folder: Path, made: Sequence[Source], order: Sequence[str]) -> None:
    runs = [make(folder / source.name, source) for source in made]
    before = {source.name: files_of(folder / source.name) for source in made}

    whole = merge(folder, "abc", "abc")
    files, state = files_of(whole), state_of(whole)
    assert merge(folder, "abc", "abc") == whole
    assert state_of(whole) == state, "merging twice changes nothing"
    assert files_of(merge(folder, order, "other")) == files, "order does not matter"
    merge(folder, "ab", "ab")
    assert files_of(merge(folder, ["ab", "c"], "ab_c")) == files, "nor in how many steps"
    shutil.rmtree(folder / "ab")
    merge(folder, "bc", "bc")
    assert files_of(merge(folder, ["a", "bc", "a"], "a_bc")) == files
    assert {source.name: files_of(folder / source.name) for source in made} == before, "sources stay"

    parts = open_runs(whole)
    expected: dict[bytes, tuple[bytes, ...]] = {}
    for run in runs:
        expected |= rows_by_id([run])
    assert rows_by_id(parts) == expected
    for part in parts:
        assert part.n == max(run.n for run in runs if run.manifest.spec_hash == part.manifest.spec_hash)

    paid, spent = sums([account_for([run]) for run in runs]), sums([account_for(parts)])
    assert spent["bytes"] == paid["bytes"]
    for name in paid.keys() | spent.keys():
        assert spent[name] == pytest.approx(paid[name], abs=1e-6), name
    assert list(check_runs(open_storage(whole), Checked())) == []


@given(st.data(), st.sampled_from([(2, 2), (2, 3), (4, 2)]))
@few
def test_other_rows_of_one_scene_are_refused_and_nothing_is_written(data: Any, sizes: tuple[int, int]):
    with workplace() as folder:
        ours = make_run(folder / "a", 36, sizes[0], PER_SCENE, shards=range(12 // sizes[0]))
        theirs = make_run(folder / "b", 36, sizes[1], PER_SCENE, shards=[])
        shard = data.draw(st.integers(0, 12 // sizes[1] - 1))
        scenes, samples = rows_of(theirs, shard)
        table, names = data.draw(st.sampled_from([(scenes, ["retry"]), (samples, ["label", "distance_m"])]))
        field = data.draw(st.sampled_from(names))
        row = data.draw(st.integers(0, len(table[field]) - 1))
        table[field][row] = 1 - table[field][row] if field == "label" else table[field][row] / 2 + 1
        files = encode_shard(theirs.schema, theirs.layout, theirs.manifest.spec_hash, scenes, samples)
        assert theirs.commit(commit_of(theirs, shard, "x", theirs.write_object("x", files)))
        sample = samples["sample_id"][row * PER_SCENE if table is scenes else row].tobytes().hex()
        for order in ("ab", "ba"):
            with pytest.raises(InputError) as refused:
                merge(folder, order, "out")
            told = str(refused.value)
            for word in (ours.storage.url, theirs.storage.url, f"sample {sample}", field):
                assert word in told, told
            assert not (folder / "out").exists()
