"""Files that hold something else than their place asks for, told by their first bytes."""

from __future__ import annotations

from pathlib import Path

from datagen.schemas.errors import InputError

START_BYTES = 64
_LFS = "a Git LFS pointer, not the file itself"
_KINDS = (
    (b"version https://git-lfs.github.com/spec/", _LFS),
    (b"ply\n", "a PLY file"),
    (b"ply\r", "a PLY file"),
    (b"solid", "an STL file"),
    (b"glTF", "a binary glTF file"),
    (b"\x1f\x8b", "a gzip file"),
    (b"PK\x03\x04", "a zip file"),
    (b"\x89PNG", "a PNG image"),
    (b"\xff\xd8\xff", "a JPEG image"),
    (b"<!DOCTYPE", "a web page"),
    (b"<html", "a web page"),
)


def refuse_other_kind(path: Path | str, start: bytes, expected: str, fix: str) -> None:
    """Raise InputError where a file that starts so is of a known kind other than `expected`, or binary.

    `expected` is one of the kinds ("a PLY file"), or "text" for files without zero bytes.
    """
    kind = next((kind for first, kind in _KINDS if start.startswith(first)), "")
    if not kind and expected == "text" and b"\0" in start:
        kind = "a binary file, as STL often is"
    if kind and kind != expected:
        fix = "Fetch the file itself, with `git lfs pull` in its repository" if kind == _LFS else fix
        raise InputError(path, "", f"is {kind}", fix)
