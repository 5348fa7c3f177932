"""Files of another kind than their place asks for: one line that names the kind."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
import trimesh

from datagen.schemas.errors import InputError
from datagen.workers.houses import open_houses
from datagen.workers.objects import open_objects
from datagen.workers.objects.obj_file import read_obj, read_obj_header
from tests.workers.houses.house_files import two_rooms, write_houses
from tests.workers.objects.toy_set import write_bundle, write_maniskill

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 12345\n"


def binary_stl() -> bytes:
    return trimesh.creation.box((0.1, 0.1, 0.1)).export(file_type="stl")  # type: ignore[return-value]


KINDS: dict[str, tuple[Callable[[], object], str]] = {
    "binary STL": (binary_stl, "is a binary file"),
    "text STL": (lambda: trimesh.creation.box().export(file_type="stl_ascii"), "is an STL file"),
    "PLY": (lambda: trimesh.creation.box().export(file_type="ply"), "is a PLY file"),
    "glTF": (lambda: trimesh.Scene(trimesh.creation.box()).export(file_type="glb"), "is a binary glTF file"),
    "zip": (lambda: b"PK\x03\x04" + struct.pack("<20x"), "is a zip file"),
    "pointer": (lambda: POINTER, "is a Git LFS pointer, not the file itself. .*git lfs pull"),
}


@pytest.mark.parametrize("read", [read_obj, read_obj_header])
@pytest.mark.parametrize("kind", KINDS)
def test_other_files_in_place_of_an_obj_are_named(
    kind: str, read: Callable[[Path], object], tmp_path: Path
) -> None:
    make, named = KINDS[kind]
    data = make()
    path = tmp_path / "textured.obj"
    path.write_bytes(data if isinstance(data, bytes) else str(data).encode())
    with pytest.raises(InputError, match=named) as caught:
        read(path)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 300


@pytest.mark.parametrize("file", ["houses.jsonl.gz", "houses.jsonl", "asset_sizes.json"])
def test_pointers_in_place_of_houses_are_named_when_they_are_opened(file: str, tmp_path: Path) -> None:
    folder = write_houses(tmp_path, [two_rooms()], name=file if "houses" in file else "houses.jsonl.gz")
    (folder / file).write_bytes(POINTER)
    with pytest.raises(InputError, match=rf"{file}: is a Git LFS pointer.*git lfs pull"):
        open_houses(f"procthor:{folder}")


@pytest.mark.parametrize("file", ["textured.obj", "texture.png", "collision.ply", "textured.mtl"])
def test_pointers_in_place_of_objects_are_named(file: str, tmp_path: Path) -> None:
    folder = write_maniskill(tmp_path)
    (folder / "models/001_cube" / file).write_bytes(POINTER)
    with pytest.raises(InputError, match=rf"{file}: is a Git LFS pointer"):
        open_objects(f"ycb:{folder}")


def test_a_pointer_in_place_of_an_index_is_named(tmp_path: Path) -> None:
    folder = write_bundle(tmp_path)
    (folder / "objects.json").write_bytes(POINTER)
    with pytest.raises(InputError, match=r"objects\.json: is a Git LFS pointer"):
        open_objects(f"ycb:{folder}")
