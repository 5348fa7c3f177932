"""The same command lines with an s3:// address: runs made, grown, labelled again and read.

`test_runs_page.py` resumes, merges, verifies, damages and repairs runs there.
"""

from __future__ import annotations

import socket
from pathlib import Path

import numpy as np
import pytest

from datagen import cli
from datagen.schemas.run import Run
from datagen.schemas.storage import open_storage
from datagen.train.dataset import SampleStream
from tests.columns import columns_of
from tests.refusals import refused
from tests.schemas.checked import stored
from tests.small_runs import CONFIG, PER_SCENE, arrays_of, assert_equal_runs, json_of, make_small_run


@pytest.fixture
def config(tmp_path: Path) -> list[str]:
    """Options of a small run."""
    file = tmp_path / "small.toml"
    file.write_text(CONFIG)
    return ["--candidates-per-scene", str(PER_SCENE), "--config", str(file)]


def submit(out: str, n: int, *more: str, workers: int = 0) -> None:
    arguments = ["submit", "heuristic", "--n", str(n), "--out", out, "--workers", str(workers), *more]
    assert cli.run(arguments) == 0


def test_a_run_on_s3_is_the_run_on_a_disk(
    bucket: str, config: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = f"{bucket}/runs/a"
    submit(out, 8, *config)
    submit(out, 16, *config)
    local = arrays_of(make_small_run(tmp_path / "local", 16))
    run = Run.open(out)
    assert_equal_runs(stored(run.storage), local)

    state = json_of(capsys, ["status", out])
    assert (state["run"], state["labels"], state["complete"], state["sealed"]) == (out, 16, True, True)
    assert cli.run(["audit", out]) == 0
    assert cli.run(["show", out, "--out", str(tmp_path / "scene.png")]) == 0
    assert (tmp_path / "scene.png").stat().st_size > 10_000
    again = f"{bucket}/runs/again"
    submit(again, 8, "--scenes-from", out)
    assert stored(Run.open(again).storage)["scene_index"].tolist() == [0]
    arguments = ["submit", "heuristic", "--n", "32", "--out", f"{bucket}/more", "--scenes-from", out]
    refused([*arguments, "--workers", "0"], capsys, "--n: 32", f"is more than the 16 candidates of {out}")


def test_worker_processes_write_to_s3_and_a_reader_reads_it(
    bucket: str, config: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = f"{bucket}/runs/a"
    capsys.readouterr()
    submit(out, 16, *config, "--json", workers=2)
    told = capsys.readouterr()
    assert '"shards_done": 2' in told.out + told.err
    local = make_small_run(tmp_path / "local", 16)
    assert_equal_runs(stored(Run.open(out).storage), arrays_of(local))
    whole = columns_of(local)
    for place in (out, f"{out}/data.zarr"):
        for ours, theirs in zip(columns_of(place), whole, strict=True):
            assert ours.keys() == theirs.keys()
            for name in ours:
                np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
    streams = [SampleStream([place], scenes_per_batch=1) for place in (local, out, f"{out}/data.zarr")]
    here, *there = ([(b.sample_id, b.clouds.points_m) for b in s.epoch(1, 1)] for s in streams)
    assert len(here) == 1
    for batches in there:
        np.testing.assert_equal(batches, here)


def test_places_on_s3_that_cannot_be_used(
    bucket: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    words = ["submit", "heuristic", "--n", "8", "--workers", "0", "--out"]
    refused([*words, "s3://no-such-bucket/run"], capsys, "s3://no-such-bucket/run", "no such bucket")
    refused(["status", f"{bucket}/none"], capsys, f"{bucket}/none", "not a run")
    refused([*words, "s3://k:secret@bucket/run"], capsys, "has more than a bucket and a prefix")
    open_storage(bucket).put("mine/thesis.txt", b"x")
    refused([*words, f"{bucket}/mine"], capsys, "holds other files")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
    monkeypatch.setenv("DATAGEN_STORE_TIMEOUT_S", "0.3")
    for arguments in ([*words, f"{bucket}/run"], ["status", f"{bucket}/run"], ["audit", f"{bucket}/run"]):
        refused(arguments, capsys, f"{bucket}/run", "cannot be reached", "Check AWS_ENDPOINT_URL")
