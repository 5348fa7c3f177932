"""`datagen assets`: list, lock, verify, split and fetch houses and objects."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from datagen.assets import lock as locks
from datagen.assets.catalogue import CATALOGUE, CatalogueEntry, select
from datagen.assets.fetch import Fetched, fetch, refuse_full_disk
from datagen.assets.object_split import split_objects
from datagen.console.options import AsJson
from datagen.console.printing import print_json, print_rows, size
from datagen.schemas.errors import InputError, choices
from datagen.workers.content_cache import cache_folder

Folder = Annotated[Path, Parameter(help="Folder of assets.")]

app = App(name="assets", help="List, fetch, lock, verify and split houses and objects.")


@app.command(name="list")
def list_assets(folder: Path | None = None, *, json: AsJson = False) -> int:
    """List the assets that can be fetched or, with a folder, the files in its lock file.

    Args:
        folder: List the files in the lock file of this folder.
    """
    if folder is None:
        rows = [{k: v for k, v in asdict(asset).items() if k != "archive"} for asset in CATALOGUE.values()]
        if json:
            print_json({"assets": rows})
        else:
            rows = [
                (
                    a.name,
                    size(a.size) if a.size else "?",
                    "published digest" if a.sha256 else "first use",
                    a.licence,
                    a.about,
                )
                for a in _shown()
            ]
            print_rows("assets for `datagen assets fetch`", rows)
        return 0
    locked = locks.read_lock(folder)
    if locked is None:
        raise InputError(folder, locks.LOCK_NAME, "does not exist", "Write it: datagen assets lock DIR")
    if json:
        print_json(locked.model_dump())
        return 0
    by_licence: dict[tuple[str, str], list[int]] = {}
    for entry in locked.files:
        by_licence.setdefault((entry.path.split("/")[0], entry.licence), []).append(entry.size)
    rows = [
        (top, f"{len(s)} files", size(sum(s)), licence) for (top, licence), s in sorted(by_licence.items())
    ]
    print_rows(str(folder), rows)
    return 0


@app.command
def lock(
    folder: Folder, *, licence: str | None = None, source: str | None = None, json: AsJson = False
) -> int:
    """Write the sha256, size, licence and source of every file to assets.lock.json.

    Args:
        licence: Licence of all files. [default: unchanged]
        source: Origin of all files. [default: unchanged]
    """
    written = locks.lock(folder, licence, source)
    total = sum(entry.size for entry in written.files)
    if json:
        print_json({"folder": str(folder), "files": len(written.files), "bytes": total})
    else:
        print_rows(f"locked {folder}", [("files", str(len(written.files))), ("size", size(total))])
    return 0


@app.command
def verify(folder: Folder, *, json: AsJson = False) -> int:
    """Compare every file with assets.lock.json. Exit code 2 when a file is missing or changed."""
    result = locks.verify(folder)
    if json:
        print_json({"folder": str(folder), "good": result.good, **asdict(result)})
        return 0 if result.good else 2
    if not result.good:
        first = (*result.missing, *result.changed)[0]
        raise InputError(
            folder,
            first,
            f"{len(result.missing)} files missing and {len(result.changed)} changed of {result.checked}",
            "Fetch them again, or lock the folder again if the change is intended",
        )
    rows = [("files as locked", str(result.checked)), ("not in the lock", str(len(result.unlisted)))]
    print_rows(f"verified {folder}", rows)
    return 0


@app.command
def split(folder: Folder, out: Path, *, json: AsJson = False) -> int:
    """Divide a folder of YCB objects: every fifth to OUT/test, the others to OUT/train.

    Args:
        out: Folder for the two parts.
    """
    sizes = split_objects(folder, out)
    if json:
        print_json({"folder": str(out), **sizes})
    else:
        print_rows(f"objects of {folder}", [(str(out / name), str(n)) for name, n in sizes.items()])
    return 0


@app.command(name="fetch")
def fetch_assets(
    *names: str,
    out: Path = Path("assets"),
    mirror: str | None = None,
    offline: bool = False,
    cache: Path | None = None,
    json: AsJson = False,
) -> int:
    """Download, check and unpack assets, and record them in the folder's lock file.

    An interrupted download continues where it stopped. Files without a published digest are trusted on first
    use: their digest is recorded in the lock file, and later downloads must match it.

    Args:
        names: Assets or groups of `datagen assets list`.
        out: Folder for the assets.
        mirror: http(s) address of a folder with the same files.
        offline: Use only the cache.
        cache: Folder of kept downloads.
    """
    if not names:
        fix = choices({name.split("/")[0] for name in CATALOGUE})
        raise InputError("datagen assets fetch", "NAME", "is missing", fix)
    chosen = select(names)
    refuse_full_disk(chosen, out)
    kept = cache or cache_folder() / "downloads"
    console = Console(stderr=True, quiet=json)
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=json or not console.is_terminal,
    )

    results: list[Fetched] = []
    with bar if not json else nullcontext():
        for asset in chosen:
            task = bar.add_task(asset.name, total=asset.size)

            def progress(here: int, total: int | None, task: TaskID = task) -> None:
                bar.update(task, completed=here, total=total)

            done = fetch(asset, out, cache=kept, mirror=mirror, offline=offline, progress=progress)
            results.append(done)
            how = "from the cache" if done.from_cache else "downloaded"
            trust = "digest as published" if done.trust == "published" else "trusted on first use"
            line = f"{done.name}: {how}, {size(done.size)}, {trust}, {done.files} files"
            console.print(line, highlight=False)
    if json:
        print_json({"folder": str(out), "fetched": [asdict(result) for result in results]})
    return 0


def _shown() -> list[CatalogueEntry]:
    """The catalogue with only the first of its many scans."""
    scans = [asset for asset in CATALOGUE.values() if asset.name.startswith("ycb-scans/")]
    return [asset for asset in CATALOGUE.values() if asset not in scans[1:]]
