"""Any history of commits, crashes, resumes, merges and repairs leaves what a plain dictionary says.

After every step each place says what the model (state_model.py) says. Here a sample of histories;
`python -m benchmarks.faults.histories` tries many more.
"""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import zarr
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from datagen.jobs.relabelling import relabel_run, relabelled_specification
from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.checking.repair import clean_runs, repair_runs
from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.merging import merge_runs, plan_merge
from datagen.schemas.quarantine import lift_quarantine
from datagen.schemas.record_files import commit_key, object_key, utc_now
from datagen.schemas.run import Run, open_runs
from datagen.schemas.run_records import QuarantineRecord
from datagen.schemas.sealing import seal, store_record
from datagen.schemas.specification import HeuristicParams
from datagen.schemas.storage import open_storage
from tests.made_runs import attempt, manifest_of, write
from tests.properties.state_model import (
    LAYOUT,
    PER_SHARD,
    RULES,
    SMALL,
    SPECS,
    Part,
    Place,
    expected_rows,
    hash_of,
    specification,
    united,
)

SHARDS_AT_MOST = 5
PLACES_AT_MOST = 5
EXAMPLES, STEPS = 15, 40


def findings(place: Place) -> list[Any]:
    """What `verify` calls damage."""
    storage = open_storage(place.folder, probe=False)
    return [finding for finding in check_runs(storage, Checked()) if finding.kind != "stale"]


def close_all(place: Place) -> None:
    for run in open_runs(place.folder):
        run.close_lost_attempts()


def store_name(folder: Path) -> str | None:
    record = store_record(open_storage(folder, probe=False))
    return record.name if record else None


def changed_fields(params: HeuristicParams) -> dict[str, Any]:
    return params.model_dump(exclude_defaults=True)


class AnyHistory(RuleBasedStateMachine):
    """Places that are made, broken off, joined and repaired in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.schema = mock.patch.dict(SCHEMAS, heuristic=SMALL)
        self.schema.start()
        memory = Path("/dev/shm")
        self.root = Path(tempfile.mkdtemp(dir=memory if memory.is_dir() else None))
        self.places: list[Place] = []
        self.touched: Place | None = None
        self.numbered = 0

    def teardown(self) -> None:
        try:
            for place in self.places:
                close_all(place)
                assert [finding.kind for finding in findings(place)] == ["lost"] * place.has_lost
        finally:
            self.schema.stop()
            shutil.rmtree(self.root, ignore_errors=True)

    # Steps ---------------------------------------------------------------------------------

    @initialize(seed=st.integers(0, 2))
    def first(self, seed: int) -> None:
        self.create(seed, 3)

    @precondition(lambda self: len(self.places) < PLACES_AT_MOST)
    @rule(seed=st.integers(0, 2), shards=st.integers(1, SHARDS_AT_MOST))
    def create(self, seed: int, shards: int) -> None:
        folder = self.new_folder()
        n = shards * PER_SHARD - seed % 2  # the last shard is sometimes cut
        Run.create_or_open(open_storage(folder), manifest_of(specification(seed, ""), LAYOUT), n)
        self.touched = Place(folder, {(seed, ""): Part(n)})
        self.places.append(self.touched)

    @rule(data=st.data())
    def commit(self, data: st.DataObject) -> None:
        """One shard that is wanted, by an attempt that may come too late."""
        place, key, run = self.draw_part(data)
        part = place.parts[key]
        shards = sorted(set(part.planned) - part.quarantined)
        if not shards:
            return
        shard = data.draw(st.sampled_from(shards))
        if key[1]:
            return  # its rows come from its source: see relabel
        assert attempt(run, shard, self.attempt_name()) == (shard not in part.committed)
        place.parts[key] = replace(part, committed=part.committed | {shard})

    @rule(data=st.data(), how=st.sampled_from(["begun", "half written", "written", "committed", "draft"]))
    def crash(self, data: st.DataObject, how: str) -> None:
        """An attempt whose process dies; only its commit would count."""
        place, key, run = self.draw_part(data)
        part = place.parts[key]
        if key[1] or not part.missing:
            return
        shard, name = data.draw(st.sampled_from(part.missing)), self.attempt_name()
        run.ledger.start(name, shard)
        if how in ("half written", "draft"):
            key = object_key(name) if how == "half written" else commit_key(shard)
            run.storage.put(f"{key}.0123456789abcdef.part", b"{")
        elif how in ("written", "committed"):
            made = write(run, shard, name)
            if how == "committed":
                assert run.commit(made)
                place.parts[key] = replace(part, committed=part.committed | {shard})

    @rule(data=st.data())
    def resume(self, data: st.DataObject) -> None:
        """Everything that is missing is made, and what was left open is closed."""
        place = self.draw_place(data)
        for key, run in self.runs(place).items():
            part = place.parts[key]
            if not key[1]:
                for shard in part.missing:
                    assert attempt(run, shard, self.attempt_name())
                place.parts[key] = replace(part, committed=part.committed | set(part.missing))
            run.close_lost_attempts()

    @rule(data=st.data(), shards=st.integers(1, SHARDS_AT_MOST))
    def extend(self, data: st.DataObject, shards: int) -> None:
        """A larger n is wanted; a smaller one changes nothing."""
        place, key, run = self.draw_part(data)
        run.grow(shards * PER_SHARD)
        place.parts[key] = replace(place.parts[key], n=max(place.parts[key].n, shards * PER_SHARD))

    @rule(data=st.data())
    def quarantine(self, data: st.DataObject) -> None:
        place, key, run = self.draw_part(data)
        part = place.parts[key]
        if not part.missing:
            return
        shard = data.draw(st.sampled_from(part.missing))
        assert run.quarantine(
            QuarantineRecord(
                shard=shard, seed=key[0], first_scene=shard, scenes=1,
                attempts=(), causes=("failed: a test",), stacks=("",), created=utc_now(),
            )
        )  # fmt: skip
        place.parts[key] = replace(part, quarantined=part.quarantined | {shard})

    @rule(data=st.data())
    def lift(self, data: st.DataObject) -> None:
        place, key, run = self.draw_part(data)
        assert set(lift_quarantine(run)) == place.parts[key].quarantined
        place.parts[key] = replace(place.parts[key], quarantined=frozenset())

    @rule(data=st.data())
    def seal(self, data: st.DataObject) -> None:
        place = self.draw_place(data)
        storage = open_storage(place.folder, probe=False)
        if any(part.committed & set(part.planned) for part in place.parts.values()):
            seal(storage)
            place.sealed = dict(place.parts)
        else:
            with pytest.raises(InputError, match="no shard is committed"):
                seal(storage)

    @rule(data=st.data())
    def collect_garbage(self, data: st.DataObject) -> None:
        """What nobody committed goes, whatever its age; what counts stays."""
        place = self.draw_place(data)
        clean_runs(open_storage(place.folder, probe=False), kept_s=-60)
        for key, run in self.runs(place).items():
            assert len(list(run.storage.list("shards"))) == len(place.parts[key].committed)
        stores = [path.name for path in place.folder.glob("data*.zarr")]
        assert stores == [store for store in (store_name(place.folder),) if store]

    @precondition(lambda self: len(self.places) < PLACES_AT_MOST)
    @rule(data=st.data())
    def merge(self, data: st.DataObject) -> None:
        """Two or three places become one; those of different rules are refused."""
        chosen = data.draw(st.lists(st.sampled_from(range(len(self.places))), min_size=1, max_size=3))
        places = [self.places[i] for i in chosen]
        folder = self.new_folder()
        named = [str(place.folder) for place in places]
        if len({place.rule for place in places}) > 1:
            with pytest.raises(InputError):
                merge_runs(plan_merge(named, str(folder)))
            assert not folder.exists() or not any(folder.iterdir())
            return
        merge_runs(plan_merge(named, str(folder)))
        parts: dict[tuple[int, str], Part] = {}
        for place in places:
            for key, part in place.parts.items():
                parts[key] = united(parts[key], part) if key in parts else part
        merged = Place(folder, parts)
        if any(part.committed & set(part.planned) for part in parts.values()):
            merged.sealed = dict(parts)
        self.places.append(merged)
        self.touched = merged

    @precondition(lambda self: len(self.places) < PLACES_AT_MOST)
    @rule(data=st.data(), rule_name=st.sampled_from(["near", "far"]))
    def relabel(self, data: st.DataObject, rule_name: str) -> None:
        """The stored scenes by another rule, in a place of their own."""
        place = self.draw_place(data)
        if place.rule or len(place.parts) > 1 or not all(part.committed for part in place.parts.values()):
            return
        folder = self.new_folder()
        run = Run.open(place.folder)
        options = {f"heuristic.{k}": v for k, v in changed_fields(RULES[rule_name]).items()}
        spec = relabelled_specification(run, options)
        SPECS[run.manifest.spec.seed, rule_name] = spec
        relabel_run(open_storage(folder), run, spec)
        parts = {
            (seed, rule_name): Part(part.n, part.committed & set(part.planned))
            for (seed, _), part in place.parts.items()
        }
        made = Place(folder, parts)
        if any(part.committed for part in parts.values()):
            made.sealed = dict(parts)
        self.places.append(made)
        self.touched = made

    @rule(data=st.data())
    def damage_and_repair(self, data: st.DataObject) -> None:
        """One bit of a committed object flips: it is found, its shard set aside, and made again."""
        place, key, run = self.draw_part(data)
        if not place.parts[key].committed:
            return
        shard = data.draw(st.sampled_from(sorted(place.parts[key].committed)))
        commit = run.commit_of(shard)
        file, before = object_key(commit.attempt), run.read_object(commit)
        bit = data.draw(st.integers(0, 8 * len(before) - 1))
        broken = bytearray(before)
        broken[bit // 8] ^= 1 << bit % 8
        run.storage.put(file, bytes(broken))
        assert any(finding.key.endswith(file) for finding in findings(place))
        repaired = repair_runs(open_storage(place.folder, probe=False))
        part = place.parts[key]
        place.parts[key] = replace(part, committed=part.committed - {shard})
        assert [finding.kind for finding in repaired.left] == ["lost"] * place.has_lost
        assert len(repaired.set_aside) == 1 and shard not in run.committed()
        if not place.has_lost:
            self.take_sealed(place)
        if not key[1]:
            assert attempt(run, shard, self.attempt_name())
            place.parts[key] = part
            assert run.read_object(run.commit_of(shard)) == before

    # What must hold ------------------------------------------------------------------------

    @invariant()
    def the_place_says_what_the_model_says(self) -> None:
        place, self.touched = self.touched, None
        if place is None:
            return
        for key, run in self.runs(place).items():
            part = place.parts[key]
            assert (run.n, run.committed(), run.quarantined()) == (part.n, part.committed, part.quarantined)
            assert list(run.missing()) == part.missing
        store = store_name(place.folder)
        assert (store is not None) == (place.sealed is not None)
        if place.sealed is not None:
            group = zarr.open_group(place.folder / str(store), mode="r")
            ids, labels = expected_rows(place.sealed)
            np.testing.assert_array_equal(np.asarray(group["sample_id"][...]), ids)  # type: ignore[index]
            np.testing.assert_array_equal(np.asarray(group["label"][...]), labels)  # type: ignore[index]

    # Help ----------------------------------------------------------------------------------

    def new_folder(self) -> Path:
        self.numbered += 1
        return self.root / f"place-{self.numbered}"

    def attempt_name(self) -> str:
        self.numbered += 1
        return f"t{self.numbered:05d}"

    def take_sealed(self, place: Place) -> None:
        """The store holds what is committed and planned now; there is none without any."""
        held = any(part.committed & set(part.planned) for part in place.parts.values())
        place.sealed = dict(place.parts) if held else None

    def draw_place(self, data: st.DataObject) -> Place:
        self.touched = data.draw(st.sampled_from(self.places))
        return self.touched

    def draw_part(self, data: st.DataObject) -> tuple[Place, tuple[int, str], Run]:
        place = self.draw_place(data)
        runs = self.runs(place)
        key = data.draw(st.sampled_from(sorted(runs)))
        return place, key, runs[key]

    def runs(self, place: Place) -> dict[tuple[int, str], Run]:
        """The runs of a place by seed and rule; these are those of the model."""
        names = {hash_of(*key): key for key in place.parts}
        found = {names[run.manifest.spec_hash]: run for run in open_runs(place.folder)}
        assert found.keys() == place.parts.keys()
        return found


def many_histories(examples: int, steps: int) -> settings:
    """Settings for that many histories of at most that many steps."""
    return settings(
        max_examples=examples,
        stateful_step_count=steps,
        deadline=None,
        # Tracing every line of a failure takes longer than finding it.
        phases=[Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink],
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
    )


TestAnyHistory = AnyHistory.TestCase
TestAnyHistory.settings = many_histories(EXAMPLES, STEPS)
