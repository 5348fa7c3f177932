"""The digest of the code of this package, by which machines and shards are compared."""

from __future__ import annotations

from functools import cache
from hashlib import sha256
from pathlib import Path

import datagen


@cache
def code_digest() -> str:
    """sha256 over the names and bytes of the package's Python files, computed once per process."""
    root, whole = Path(datagen.__file__).parent, sha256()
    for path in sorted(root.rglob("*.py")):
        whole.update(f"{path.relative_to(root)}\0{path.stat().st_size}\0".encode())
        whole.update(path.read_bytes())
    return whole.hexdigest()
