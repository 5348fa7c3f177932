"""Download assets of the catalogue into a folder with a lock file."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from datagen.assets.catalogue import CatalogueEntry
from datagen.assets.download import DownloadPolicy, Progress, download
from datagen.assets.lock import Lock, LockedDownload, locked_file, read_lock, sha256_of, write_lock
from datagen.assets.unpack import Limits, unpack
from datagen.schemas.errors import InputError
from datagen.schemas.whole_files import whole_file


@dataclass(frozen=True)
class Fetched:
    """The result for one asset."""

    name: str
    sha256: str
    size: int
    trust: str  # "published" or "first-use"
    from_cache: bool
    files: int


def fetch(
    asset: CatalogueEntry,
    folder: Path,
    *,
    cache: Path,
    mirror: str | None = None,
    offline: bool = False,
    progress: Progress = lambda here, total: None,
    policy: DownloadPolicy | None = None,
) -> Fetched:
    """Download one asset, or take it from the cache, unpack it and record it in the lock file.

    Where the publisher states no digest, the first download is trusted and its digest recorded; later ones
    must match it. `mirror` replaces the address before the file name. Raises InputError as `download` and
    `unpack` do and, with `offline`, where the cache lacks the file.
    """
    lock = (read_lock(folder) if folder.is_dir() else None) or Lock()
    recorded = next((d.sha256 for d in lock.downloads if d.name == asset.name), None)
    expected = asset.sha256 or recorded
    url = f"{mirror.rstrip('/')}/{asset.file}" if mirror else asset.url
    kept = cache / asset.file
    digest = sha256_of(kept) if kept.is_file() else None
    from_cache = digest is not None and expected in (None, digest)
    if digest is None or not from_cache:
        if offline:
            problem = "is not in the cache" if digest is None else f"has sha256 {digest}, not {expected}"
            raise InputError(kept, "", problem, f"Put the file of {url} there, or omit --offline")
        digest = download(
            url,
            kept,
            sha256=expected,
            size=asset.size,
            max_bytes=asset.max_bytes,
            progress=progress,
            policy=policy,
        )
    size = kept.stat().st_size
    files = _install(asset, kept, folder)
    trust = "published" if asset.sha256 else "first-use"
    entry = LockedDownload(name=asset.name, url=asset.url, sha256=digest, size=size, trust=trust)
    _record(folder, lock, entry, asset, files)
    return Fetched(asset.name, digest, size, trust, from_cache, len(files))


def refuse_full_disk(assets: Sequence[CatalogueEntry], folder: Path) -> None:
    """Raise InputError where the disk has no room for the known sizes."""
    known = sum(asset.size or 0 for asset in assets)
    existing = next(p for p in (folder, *folder.absolute().parents) if p.is_dir())
    free = shutil.disk_usage(existing).free
    if known > free:
        raise InputError(
            folder,
            "",
            f"{known:,} bytes are needed and {free:,} are free",
            "Free some space, or use another disk",
        )


def _install(asset: CatalogueEntry, kept: Path, folder: Path) -> list[str]:
    """Move or unpack the download; return its files relative to `folder`."""
    home = folder / asset.into
    if asset.archive:
        unpacked = unpack(kept, home, Limits(asset.max_unpacked_bytes))
        return [(PurePosixPath(asset.into) / path).as_posix() for path in unpacked]
    with kept.open("rb") as source, whole_file(home / asset.file, alone=True) as file:
        shutil.copyfileobj(source, file)
    return [(PurePosixPath(asset.into) / asset.file).as_posix()]


def _record(folder: Path, lock: Lock, entry: LockedDownload, asset: CatalogueEntry, files: list[str]) -> None:
    table = {old.path: old for old in lock.files}
    for relative in files:
        table[relative] = locked_file(folder, relative, asset.licence, asset.url)
    downloads = {old.name: old for old in lock.downloads} | {entry.name: entry}
    write_lock(
        folder,
        Lock(
            files=tuple(table[key] for key in sorted(table)),
            downloads=tuple(downloads[key] for key in sorted(downloads)),
        ),
    )
