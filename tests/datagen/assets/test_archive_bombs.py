"""Archives whose lists and headers, not their members, are made to use up memory or disk."""

from __future__ import annotations

import io
import struct
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from datagen.assets.unpack import Limits, unpack
from datagen.schemas.errors import InputError


def long_list() -> bytes:
    """A zip whose end states a list of members of 100 MB."""
    return (
        b"PK\x01\x02"
        + bytes(100_000_000)
        + struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 9, 9, 100_000_004, 0, 0)
    )


def honest_bomb() -> bytes:
    """A zip of members that state that they are far beyond the limit together."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as packed:
        for number in range(20):
            packed.writestr(f"{number}", bytes(100_000))
    return buffer.getvalue()


def nested_headers() -> bytes:
    """A tar of long names that are each the name of another long name."""
    info = tarfile.TarInfo("././@LongLink")
    info.type, info.size = tarfile.GNUTYPE_LONGNAME, 512
    return (info.tobuf(tarfile.GNU_FORMAT) + b"a" * 511 + b"\0") * 5000


@pytest.mark.parametrize(
    ("make", "said"),
    [(long_list, "too large"), (honest_bomb, "2,000,000 bytes"), (nested_headers, "damaged")],
)
def test_a_bomb_in_the_description_is_refused(make: Callable[[], bytes], said: str, tmp_path: Path) -> None:
    (tmp_path / "archive").write_bytes(make())
    with pytest.raises(InputError, match=said):
        unpack(tmp_path / "archive", tmp_path / "out", Limits(1_000_000))
    assert list((tmp_path / "out").iterdir()) == []
