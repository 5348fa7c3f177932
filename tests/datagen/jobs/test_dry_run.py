"""`--dry-run` and `--budget` through the command line, as a user gives them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from datagen import cli
from datagen.jobs.budget_option import budget_cpu_h, parse_budget
from datagen.jobs.evidence import made_here
from datagen.jobs.pilot import pilot_layout
from datagen.reports.prices import read_prices
from datagen.schemas.run import Run
from datagen.schemas.run_records import Layout
from tests.refusals import refused
from tests.small_runs import PER_SCENE, files_of, make_small_run, submit_arguments

N = 12 * PER_SCENE


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_small_run(tmp_path_factory.mktemp("finished") / "run", N)


def forecast_of(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> dict[str, Any]:
    capsys.readouterr()
    assert cli.run([*arguments, "--dry-run", "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_dry_run_of_a_new_run_writes_nothing_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.setattr("tempfile.tempdir", None)
    (tmp_path / "temporary").mkdir()
    forecast = forecast_of(capsys, submit_arguments(tmp_path / "run", N))
    assert not (tmp_path / "run").exists() and not list((tmp_path / "temporary").glob("datagen-pilot-*"))
    assert (forecast["shards"], forecast["scenes"], forecast["labels"]) == (12, 12, N)
    assert forecast["evidence"] == "a pilot of 4 scenes, not kept"
    for name in ("wall_s", "cpu_s", "stored_bytes", "money"):
        interval = forecast[name]
        assert 0 < interval["low"] < interval["middle"] < interval["high"], name
    prices, months = forecast["prices"], forecast["prices"]["months_kept"]
    computing = prices["core_hour"]["price"] * forecast["cpu_s"]["middle"] / 3600
    storage = prices["gb_month"]["price"] * months * forecast["stored_bytes"]["middle"] / 1e9
    assert forecast["money"]["middle"] == pytest.approx(computing + storage, rel=0.05)


def test_more_of_a_run_is_forecast_from_its_own_shards(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files_of(finished)
    extend = ["extend", str(finished), "--n", str(4 * N), "--workers", "0"]
    forecast = forecast_of(capsys, extend)
    assert files_of(finished) == before
    assert forecast["evidence"] == "12 shards of this run, made on this machine"
    assert (forecast["shards"], forecast["labels"]) == (36, 3 * N)
    made = sum(shard.cost.written_bytes for shard in made_here(Run.open(finished)))
    # Three times as many scenes of the same kind.
    assert (
        forecast["stored_bytes"]["low"] < 3 * made * 1.1 and forecast["stored_bytes"]["high"] > 3 * made * 0.9
    )


def test_a_run_of_the_same_kind_next_to_it_saves_the_pilot(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again = submit_arguments(finished.parent / "other", 2 * N, "--seed", "9")
    assert forecast_of(capsys, again)["evidence"] == "12 shards of run, made on this machine"
    clear = submit_arguments(finished.parent / "other", N, "--candidates", "clear")
    assert forecast_of(capsys, clear)["evidence"].startswith("a pilot of")


def test_nothing_to_make_is_said(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["resume", str(finished), "--workers", "0", "--dry-run"]) == 0
    assert "nothing to do" in capsys.readouterr().out


def test_the_table_names_every_quantity(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    extend = ["extend", str(finished), "--n", str(4 * N), "--workers", "0", "--dry-run", "--budget", "1h"]
    assert cli.run(extend) == 0
    out = capsys.readouterr().out
    for text in ("36 (36 scenes)", "80% interval", "CPU time", "stored", "USD", "1h: enough with 100%"):
        assert text in out


def test_a_budget_ends_between_shards_and_resume_makes_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert cli.run([*submit_arguments(run, N), "--budget", "0.001cpu-s"]) == 3
    said = capsys.readouterr()
    # The first shard shows what one costs: no other fits.
    assert len(Run.open(run).committed()) == 1 and not Run.open(run).ledger.unfinished()
    last = said.err.splitlines()[-2:]
    assert last[0] == "budget of 0.001cpu-s spent; 11 shards left. Resume with:"
    assert last[1] == f"  datagen resume {run} --workers 0 --budget 0.001cpu-s"
    assert cli.run(["status", str(run)]) == 0
    assert "ended budget, exit code 3" in capsys.readouterr().out
    assert cli.run(["resume", str(run), "--workers", "0", "--budget", "0.001cpu-s", "--json"]) == 3
    event = json.loads(capsys.readouterr().err.splitlines()[-1])
    assert (event["event"], event["remaining"], event["exit_code"]) == ("budget", 11, 3)
    assert event["resume"][:2] == ["resume", str(run)]
    assert cli.run(["resume", str(run), "--workers", "0", "--budget", "1h"]) == 0
    assert (run / "data.zarr").is_dir()


def test_budgets_are_times_cpu_times_or_money() -> None:
    assert parse_budget("2h").wall_s == 7200 and parse_budget("90 min").wall_s == 5400
    assert parse_budget("5cpu-h").spending == 18_000
    money = parse_budget("3usd")
    assert money.spending == 3 and 0 < money.per_cpu_s < 1e-3 and 0 < money.per_byte < 1e-9
    assert budget_cpu_h("90cpu-min") == 1.5
    assert budget_cpu_h("3usd") == pytest.approx(3 / read_prices().core_hour.price)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("2", "neither a time"),
        ("-2h", "neither a time"),
        ("0h", "allows nothing"),
        ("2cpu-usd", "unknown unit"),
        ("2weeks", "unknown unit"),
        ("3eur", "in EUR, but the prices are in USD"),
        ("x" * 500, "neither a time"),
    ],
)
def test_other_budgets_are_refused(
    tmp_path: Path, text: str, problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    refused([*submit_arguments(tmp_path / "run", N), f"--budget={text}"], capsys, problem)
    assert not (tmp_path / "run").exists()


def test_a_dry_run_is_not_detached(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    detached = [*submit_arguments(tmp_path / "run", N), "--dry-run", "--detach"]
    refused(detached, capsys, "a forecast is made in this shell")


@pytest.mark.parametrize(
    ("per_scene", "scenes", "workers", "expected"),
    [
        (60, 3000, 2, (4, 8)),
        (60, 10, 2, (1, 3)),
        (625, 300, 2, (1, 8)),
        (15, 6400, 1, (16, 4)),
        (60, 1, 4, (1, 2)),
    ],
)
def test_a_pilot_is_small(per_scene: int, scenes: int, workers: int, expected: tuple[int, int]) -> None:
    layout = Layout(scenes_per_shard=32, candidates_per_scene=per_scene)
    pilot, shards = pilot_layout(layout, scenes, workers)
    assert (pilot.scenes_per_shard, shards) == expected


def test_shards_of_another_machine_are_no_evidence(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(made_here(Run.open(finished))) == 12
    here = type("Elsewhere", (), {"name": "elsewhere"})()
    monkeypatch.setattr("datagen.jobs.evidence.this_host", lambda: here)
    assert made_here(Run.open(finished)) == []
