"""`datagen relabel`: the run that `submit --scenes-from` would make, from stored numbers and shared files."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from datagen import cli
from datagen.schemas.errors import InputError
from datagen.schemas.record_files import commit_key, encode_record
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_shard
from datagen.train.run_parts import open_parts
from tests.datagen.forged import forge
from tests.made_runs import flip, give_up, lose, object_of
from tests.refusals import refused
from tests.small_runs import HERE, PER_SCENE, arrays_of, assert_equal_runs, files_of, json_of, make_small_run
from tests.train.conftest import sim_run

__all__ = ["sim_run"]
SCENES = 6
N = SCENES * PER_SCENE
OWN = {"label", "heuristic_score", "sample_id"}  # what another rule changes
RULE = ("--mu", "0.7", "--distance", "mount-over-reach")
TOML = "[heuristic]\nmu = 0.7\ndistance = 'mount-over-reach'\n"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six scenes, one a shard. Tests only read it."""
    return make_small_run(tmp_path_factory.mktemp("source") / "run", N)


@pytest.fixture(scope="module")
def relabelled(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same scenes by another rule. Tests only read it."""
    out = tmp_path_factory.mktemp("relabelled") / "run"
    assert cli.run(["relabel", str(source), "--out", str(out), *RULE]) == 0
    return out


def test_only_labels_scores_and_ids_are_new(source: Path, relabelled: Path) -> None:
    before, after = Run.open(source), Run.open(relabelled)
    for shard in range(SCENES):
        old, new = read_shard(before, shard), read_shard(after, shard)
        changed = {name for name in old if not np.array_equal(old[name], new[name])}
        assert {"sample_id", "heuristic_score"} <= changed <= set(OWN)


def test_every_attempt_is_accounted_for(relabelled: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = Run.open(relabelled)
    commits = list(run.commits())
    assert len(commits) == SCENES and list(run.ledger.ends()) == []
    assert run.ledger.unfinished({commit.attempt for commit in commits}) == []
    for cost in (commit.cost for commit in commits):
        assert cost.wall_s >= sum(cost.stage_wall_s.values()) > 0
    report = json_of(capsys, ["status", str(relabelled)])
    assert report["complete"] and report["sealed"] and report["labels"] == N
    assert report["positives"] == arrays_of(relabelled)["label"].sum()
    assert report["attempts"] == {"committed": SCENES} and report["attempts_without_end"] == 0


def test_the_cost_of_the_labels_it_came_from_is_carried_on(
    source: Path, relabelled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again = tmp_path / "again"
    assert cli.run(["relabel", str(relabelled), "--out", str(again), "--tau", "0.3"]) == 0
    first, second, third = (list(Run.open(place).commits()) for place in (source, relabelled, again))
    for drawn, once, twice in zip(first, second, third, strict=True):
        assert drawn.cost.source_s == {}
        assert once.cost.source_s == {"wall": drawn.cost.wall_s, "cpu": drawn.cost.cpu_s}
        assert twice.cost.source_s["cpu"] == pytest.approx(drawn.cost.cpu_s + once.cost.cpu_s)
    assert b"source_s" not in (source / commit_key(0)).read_bytes()  # as before there was such a field
    capsys.readouterr()
    (told,) = json_of(capsys, ["audit", str(again)])["sources"]
    before = {f"{clock}_s": sum(c.cost.source_s[clock] for c in third) for clock in ("wall", "cpu")}
    own = {f"{clock}_s": sum(getattr(c.cost, f"{clock}_s") for c in third) for clock in ("wall", "cpu")}
    assert told["core_s"]["relabelled files"] == pytest.approx(before["cpu_s"])
    assert told["wall_s"] == pytest.approx(own["wall_s"])
    assert told["core_s_per"]["label"] == pytest.approx((own["cpu_s"] + before["cpu_s"]) / N)
    assert cli.run(["audit", str(again), "--full"]) == 0
    assert "relabelled files" in capsys.readouterr().out
    (part,) = open_parts([again], ())
    assert part.cost == pytest.approx({k: v + own[k] for k, v in before.items()})


def test_a_file_says_the_rule_and_an_option_wins_over_it(
    source: Path, relabelled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rule.toml").write_text(TOML.replace("0.7", "0.9") + "tau = 0.4546\n")
    out, held = tmp_path / "run", files_of(source)
    rule = ["--config", str(tmp_path / "rule.toml"), "--mu", "0.7"]
    told = json_of(capsys, ["relabel", str(source), "--out", str(out), *rule])
    assert files_of(source) == held
    assert told["end"] == "complete" and told["labels"] == N
    assert told["positives"] == arrays_of(out)["label"].sum()
    assert_equal_runs(arrays_of(out), arrays_of(relabelled))
    assert Run.open(out).manifest.spec_hash == Run.open(relabelled).manifest.spec_hash


def test_it_resumes_where_it_was_ended(source: Path, relabelled: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert cli.run(["relabel", str(source), "--out", str(out), *RULE]) == 0
    kept = (out / "commits/000000.json").read_bytes()
    for shard in (1, 4):
        (out / f"commits/{shard:06d}.json").unlink()
    assert cli.run(["relabel", str(source), "--out", str(out), *RULE]) == 0
    assert (out / "commits/000000.json").read_bytes() == kept
    assert_equal_runs(arrays_of(out), arrays_of(relabelled))


def test_it_follows_a_source_that_is_not_finished_and_grows(
    source: Path, relabelled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    part = tmp_path / "part"
    shutil.copytree(source, part)
    (part / "commits/000002.json").unlink()
    out = tmp_path / "run"
    told = json_of(capsys, ["relabel", str(part), "--out", str(out), *RULE])
    assert told["labels"] == N - PER_SCENE and told["remaining"] == 1
    assert json_of(capsys, ["status", str(out)])["shards"]["missing"] == 1
    make_small_run(part, N + 2 * PER_SCENE)  # resumes and extends
    told = json_of(capsys, ["relabel", str(part), "--out", str(out), *RULE])
    assert told["labels"] == 3 * PER_SCENE and told["remaining"] == 0
    longer, shorter = arrays_of(out), arrays_of(relabelled)
    np.testing.assert_array_equal(longer["label"][:N], shorter["label"])
    assert json_of(capsys, ["status", str(out)])["complete"]


def test_a_relabelled_run_is_relabelled_from_the_same_scenes(
    source: Path, relabelled: Path, tmp_path: Path
) -> None:
    back = tmp_path / "back"
    assert (
        cli.run(["relabel", str(relabelled), "--out", str(back), "--mu", "0.53", "--distance", "planar"]) == 0
    )
    assert Run.open(back).manifest.spec.scenes_hash == Run.open(source).manifest.spec_hash
    before, after = arrays_of(source), arrays_of(back)
    assert_equal_runs(
        {k: v for k, v in before.items() if k != "sample_id"},
        {k: v for k, v in after.items() if k != "sample_id"},
    )


@pytest.mark.parametrize(
    ("text", "more", "words"),
    [
        ("", (), ("heuristic", "has these parameters already", "--tau")),
        ("", ("--mu", "0.53", "--tau", "0.4546"), ("has these parameters already",)),
        ("", ("--mu", "nan"), ("heuristic.mu", "finite")),
        ("", ("--sigma-l", "0"), ("heuristic.sigma_l", "greater than 0")),
        ("", ("--d-min", "0.95"), ("heuristic", "d_max 0.92 must be above d_min 0.95")),
        ("", ("--distance", "far"), ("--distance",)),
        ("", ("--config", "missing.toml"), ("missing.toml", "cannot be read")),
        ("[visibility]\nwindow_px = 32\n", RULE, ("visibilities, which are stored", "--scenes-from")),
        ("[scene]\nn_clutter = 3\n", RULE, ("scene",)),
        ("[arm]\nrobot = 'panda'\n", RULE, ("arm", "heuristic has no arm")),
        ("[heuristic]\nnu = 1\n", RULE, ("heuristic.nu",)),
        ("heuristic = 3\n", RULE, ("heuristic",)),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_is_written(
    text: str,
    more: tuple[str, ...],
    words: tuple[str, ...],
    source: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "rule.toml").write_text(text)
    config = ("--config", str(tmp_path / "rule.toml")) if text else ()
    refused(["relabel", str(source), "--out", str(tmp_path / "run"), *config, *more], capsys, *words)
    assert not (tmp_path / "run").exists()


def test_an_audit_of_both_counts_each_second_once(
    source: Path, relabelled: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spent = 0.0
    for path in (source, relabelled):
        spent += sum(commit.cost.cpu_s for commit in Run.open(path).commits())
    (both,) = json_of(capsys, ["audit", str(source), str(relabelled)])["sources"]
    assert both["total_core_s"] == pytest.approx(spent, rel=0.01)


def test_it_is_not_written_over_something_else(
    source: Path, relabelled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    held = files_of(relabelled)
    refused(["relabel", str(source), "--out", str(relabelled), "--mu", "0.8"], capsys, "heuristic.mu", "0.7")
    refused(["relabel", str(source), "--out", str(source), "--mu", "0.8"], capsys, "another specification")
    (tmp_path / "thesis.tex").write_text("text")
    refused(["relabel", str(source), "--out", str(tmp_path), "--mu", "0.8"], capsys, "other files")
    assert files_of(relabelled) == held


def test_a_damaged_shard_is_given_up_and_the_others_are_labelled(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(source, broken)
    flip(object_of(broken, 3))
    out = tmp_path / "run"
    capsys.readouterr()
    assert cli.run(["relabel", str(broken), "--out", str(out), *RULE]) == 1
    assert "too many shards are quarantined" in capsys.readouterr().err
    run = Run.open(out)
    assert run.committed() == set(range(SCENES)) - {3} and run.quarantined() == {3}
    assert "another sha256" in run.quarantine_records()[0].causes[-1]


def test_a_run_whose_source_lacks_shards_grows_with_it(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    part, out = tmp_path / "part", tmp_path / "run"
    shutil.copytree(source, part)
    lose(part, 4, 5)
    assert cli.run(["relabel", str(part), "--out", str(out), *RULE]) == 0
    refused(["resume", str(out), *HERE], capsys, f"candidates of {part}", f"datagen resume {part}")
    give_up(Run.open(out), 4, "failed: an older version tried it")
    for shard in (4, 5):
        for name in ("commits", "shards"):
            for file in (source / name).glob(f"*{shard:06d}*"):
                shutil.copy(file, part / name / file.name)
    assert cli.run(["relabel", str(part), "--out", str(out), *RULE]) == 0
    assert Run.open(out).committed() == set(range(SCENES)) and not Run.open(out).quarantined()


def test_what_is_quarantined_is_made_by_the_command_that_is_named(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    part = tmp_path / "part"
    shutil.copytree(source, part)
    lose(part, 2)
    give_up(Run.open(part), 2, "failed: no luck")
    named = f"datagen resume {part} --quarantined"
    refused(["export", str(part), "--to", "parquet", "--out", str(tmp_path / "parquet")], capsys, named)
    again = [
        "submit",
        "heuristic",
        "--scenes-from",
        str(part),
        "--n",
        str(N),
        "--out",
        str(tmp_path / "again"),
    ]
    refused([*again, *HERE], capsys, named)
    with pytest.raises(InputError, match="--quarantined"):
        open_parts([str(part)], ["label"])


def test_labels_of_another_version_of_the_code_are_not_mixed(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = forge(source, tmp_path / "older", 0, lambda arrays: None)
    spec = run.manifest.spec
    older = spec.model_copy(update={"engines": {**spec.engines, "labels": "0"}})
    manifest = run.manifest.model_copy(update={"spec": older, "spec_hash": older.hash()})
    run.storage.put("manifest.json", encode_record(manifest))
    arguments = ["relabel", str(tmp_path / "older"), "--out", str(tmp_path / "run"), *RULE]
    refused(arguments, capsys, "engines.labels", "version 0", "--scenes-from")


def test_labels_of_trials_do_not_follow_from_the_rule(
    sim_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("label_source", "cannot be computed from distance", "submit heuristic --scenes-from")
    refused(["relabel", str(sim_run), "--out", str(tmp_path / "run"), *RULE], capsys, *words)


def test_runs_on_s3_are_relabelled_and_replayed_there(
    bucket: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = make_small_run(tmp_path / "run", 2 * PER_SCENE)
    assert cli.run(["relabel", str(source), "--out", str(tmp_path / "here"), *RULE]) == 0
    here = Run.open(tmp_path / "here")
    first, second = f"{bucket}/first", f"{bucket}/second"
    assert cli.run(["relabel", str(source), "--out", first, "--tau", "0.5"]) == 0
    assert cli.run(["relabel", first, "--out", second, *RULE, "--tau", "0.4546"]) == 0
    there = Run.open(second)
    assert there.manifest.spec == here.manifest.spec
    for mine, other in zip(there.commits(), here.commits(), strict=True):
        assert there.read_object(mine) == here.read_object(other)
    assert json_of(capsys, ["verify", second, "--replay", "2"])["replay"]["done"]


def test_a_damaged_shard_of_a_relabelled_run_is_made_again(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert cli.run(["relabel", str(source), "--out", str(out), *RULE]) == 0
    held = arrays_of(out)
    flip(object_of(out, 2))
    assert cli.run(["verify", str(out)]) == 1
    assert cli.run(["verify", str(out), "--repair"]) == 1  # what is left is to resume
    assert Run.open(out).missing() == [2]
    assert cli.run(["resume", str(out), *HERE]) == 0
    assert cli.run(["verify", str(out), "--replay", "3"]) == 0
    assert_equal_runs(arrays_of(out), held)
