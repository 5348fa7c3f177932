"""JSON on standard output: whole, or nothing of it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import datagen
from datagen.console.printing import print_json


def test_a_value_without_a_place_in_json_prints_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="JSON"):
        print_json({"good": [1, 2, 3], "bad": float("nan")})
    assert capsys.readouterr().out == ""
    print_json({"text": "\ud800"})
    assert capsys.readouterr().out == '{\n  "text": "\\ud800"\n}\n'


def test_no_other_module_prints_json_to_standard_output() -> None:
    folder = Path(datagen.__file__).parent
    writers = re.compile(r"stdout.*dumps|json\w*\.dump\(.*stdout|print\(.*dumps", re.IGNORECASE)
    found = [p.relative_to(folder) for p in sorted(folder.rglob("*.py")) if writers.search(p.read_text())]
    assert [str(p) for p in found] == ["console/printing.py"]
