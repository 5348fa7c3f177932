"""How to get an extra, for each way in which the package can have been installed."""

from __future__ import annotations

import json
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import pytest

from datagen.schemas.errors import InputError
from datagen.workers.extras import DISTRIBUTION, how_to_get, missing_library, refuse_missing


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The metadata of an installation, found before that of the tests; torch and mani_skill are missing."""
    folder = tmp_path / "site" / f"{DISTRIBUTION.replace('-', '_')}-9.dist-info"
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {DISTRIBUTION}\nVersion: 9\n")
    monkeypatch.syspath_prepend(str(folder.parent))
    for name in ("torch", "safetensors", "mani_skill"):
        monkeypatch.setitem(sys.modules, name, None)
    return folder


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        ({"url": "file://{here}/a%20b", "dir_info": {}}, "pip install '{here}/a b[train]'"),
        (
            {"url": "file://{here}/a%20b", "dir_info": {"editable": True}},
            "pip install -e '{here}/a b[train]'",
        ),
        ({"url": "file://{here}/gone", "dir_info": {}}, "pip install torch safetensors"),
        (
            {"url": "https://h/x.git", "vcs_info": {"vcs": "git", "commit_id": "abc"}},
            "pip install 'base-placement-datagen[train] @ git+https://h/x.git@abc'",
        ),
        (
            {"url": "https://h/x-1.whl", "archive_info": {}},
            "pip install 'base-placement-datagen[train] @ https://h/x-1.whl'",
        ),
        ({"dir_info": {}}, "pip install torch safetensors"),
        ([], "pip install torch safetensors"),
        (None, "pip install torch safetensors"),
    ],
)
def test_the_command_names_the_origin_or_the_libraries(
    origin: Any, command: str, site: Path, tmp_path: Path
) -> None:
    (tmp_path / "a b").mkdir()
    if origin is not None:
        (site / "direct_url.json").write_text(json.dumps(origin).replace("{here}", str(tmp_path)))
    assert how_to_get("train") == "Install the extra train: " + command.replace("{here}", str(tmp_path))


@pytest.mark.usefixtures("site")
def test_a_missing_library_is_known_by_both_of_its_names() -> None:
    assert how_to_get("sim") == "Install it: pip install --no-deps mani-skill"
    assert missing_library(ModuleNotFoundError("", name="numpy")) is None
    assert missing_library(ImportError("libX11.so.6")) is None
    for error in (ModuleNotFoundError("", name="torch.nn"), PackageNotFoundError("torch")):
        wrapped = ImportError("cannot import the verb")
        wrapped.__cause__ = error
        for raised in (error, wrapped):
            found = missing_library(raised)
            assert found is not None and str(found).startswith(
                "torch: is not installed. Install the extra train"
            )
    both = ModuleNotFoundError("", name="scipy.ndimage")
    for preferred in ("labels", "train"):
        found = missing_library(both, preferred)
        assert found is not None and f"extra {preferred}" in found.fix
    with pytest.raises(InputError, match=r"torch, safetensors: is not installed.*, or stay"):
        refuse_missing("train", "or stay")
