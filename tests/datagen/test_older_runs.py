"""Runs whose stored specification lacks what the program's has by now."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from datagen import cli
from datagen.schemas.identity import digest_of
from datagen.schemas.record_files import signed_json
from datagen.schemas.run import Run
from tests.refusals import refused
from tests.small_runs import HERE, PER_SCENE, arrays_of, assert_equal_runs, make_small_run


def test_a_run_that_lacks_a_later_field_with_a_default_goes_on(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a run of a program that did not know `scene.drop_height_m` yet, nor the section `heuristic`."""
    fields = json.loads((finished / "manifest.json").read_text())
    del fields["sha256"], fields["spec"]["scene"]["drop_height_m"], fields["spec"]["heuristic"]
    fields["spec_hash"] = digest_of(without_none(fields["spec"]))
    old = tmp_path / "run"
    for key in ("manifest.json", "copies/manifest.json"):
        (old / key).parent.mkdir(parents=True, exist_ok=True)
        (old / key).write_bytes(signed_json(fields))
    Run.open(old).grow(PER_SCENE)
    assert cli.run(["resume", str(old), *HERE]) == 0
    assert cli.run(["resume", str(old), "--n", str(2 * PER_SCENE), *HERE]) == 0
    make_small_run(old, 3 * PER_SCENE)  # the command that began it: the defaults are what it has
    assert cli.run(["verify", str(old), "--deep", "3"]) == 0
    assert cli.run(["merge", str(old), "--out", str(tmp_path / "merged")]) == 0
    assert cli.run(["verify", str(tmp_path / "merged")]) == 0
    for place in (old, tmp_path / "merged"):
        assert json.loads((place / "manifest.json").read_text())["spec"] == fields["spec"]
    arrays, whole = arrays_of(old), arrays_of(finished)
    del arrays["sample_id"], whole["sample_id"]  # they name the specification
    assert_equal_runs(arrays, whole)
    for changed in ({"scene": {**fields["spec"]["scene"], "drop_height_m": 0.01}}, {"seed": 7}):
        (old / "manifest.json").write_bytes(signed_json(fields | {"spec": fields["spec"] | changed}))
        refused(["status", str(old)], capsys, "spec_hash", "edited")


def without_none(value: Any) -> Any:
    """Nested dictionaries without what is None."""
    if not isinstance(value, dict):
        return value
    return {name: without_none(below) for name, below in value.items() if below is not None}
