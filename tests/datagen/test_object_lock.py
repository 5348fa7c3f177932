"""Runs in a bucket with object lock: what is replaced or removed there stays as an older version."""

from __future__ import annotations

import secrets
from pathlib import Path

import pytest

from datagen import cli
from datagen.schemas.record_files import object_key
from datagen.schemas.run import Run
from tests.datagen.test_resume_s3 import arguments, digests_of
from tests.s3_servers import Faults, environment, faulty_proxy, make_locked_bucket
from tests.small_runs import HERE, PER_SCENE, make_small_run

N = 4 * PER_SCENE


def test_a_run_in_a_bucket_with_retention_is_made_repaired_and_resumed(
    s3_port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bucket = f"locked-{secrets.token_hex(6)}"
    make_locked_bucket(s3_port, bucket)
    path = f"s3://{bucket}/run"
    with faulty_proxy(s3_port, Faults()) as port:
        for name, value in environment(port).items():
            monkeypatch.setenv(name, value)
        assert cli.run(arguments(path, N, tmp_path)) == 2
        (line,) = [x for x in capsys.readouterr().err.splitlines() if x.startswith("error: ")]
        assert path in line and "Set AWS_CHECKSUM_ALGORITHM=SHA256" in line
        monkeypatch.setenv("AWS_CHECKSUM_ALGORITHM", "SHA256")
        assert cli.run(arguments(path, N, tmp_path)) == 0
        run = Run.open(path)
        run.storage.put(object_key(run.commit_of(0).attempt), b"damaged")
        run.storage.delete(["copies/manifest.json"])
        assert cli.run(["verify", path, "--repair"]) == 1
        assert cli.run(["resume", path, "--n", str(N + PER_SCENE), *HERE]) == 0
        assert cli.run(["verify", path, "--clean"]) == 0
        here = make_small_run(tmp_path / "run", N + PER_SCENE)
        assert digests_of(Run.open(path)) == digests_of(Run.open(here))
