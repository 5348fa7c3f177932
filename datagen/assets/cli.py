"""`datagen assets`: list, lock, verify and fetch houses and objects."""

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
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from datagen.assets import lock as locks
from datagen.assets.catalogue import CATALOGUE, CatalogueEntry, select
from datagen.assets.fetch import Fetched, fetch, fetch_all, groups
from datagen.console.options import AsJson
from datagen.console.printing import print_json, print_rows, size
from datagen.schemas.errors import InputError, choices
from datagen.workers.content_cache import cache_folder

Folder = Annotated[Path, Parameter(help="The folder of assets.")]

app = App(name="assets", help="List, fetch, lock and verify houses and objects.")


@app.command(name="list")
def list_assets(
    folder: Annotated[Path | None, Parameter(help="List what this folder's lock file holds.")] = None,
    *,
    json: AsJson = False,
) -> int:
    """What can be fetched, or, with a folder, what its lock file lists."""
    if folder is None:
        rows = [{k: v for k, v in asdict(asset).items() if k != "archive"} for asset in CATALOGUE.values()]
        if json:
            print_json({"assets": rows})
        else:
            print_rows(
                "assets that `datagen assets fetch` knows",
                [(a.name, size(a.size) if a.size else "?", _trust(a), a.licence, a.about) for a in _shown()],
            )
        return 0
    locked = locks.read_lock(folder)
    if locked is None:
        raise InputError(
            folder, locks.LOCK_NAME, "there is no lock file", "Write one: datagen assets lock DIR"
        )
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
    folder: Folder,
    *,
    licence: Annotated[
        str | None, Parameter(help="Licence of all files; kept as it was if not given.")
    ] = None,
    source: Annotated[str | None, Parameter(help="Where all files come from; kept if not given.")] = None,
    json: AsJson = False,
) -> int:
    """Record every file's sha256, size, licence and source in assets.lock.json."""
    written = locks.lock(folder, licence, source)
    total = sum(entry.size for entry in written.files)
    if json:
        print_json({"folder": str(folder), "files": len(written.files), "bytes": total})
    else:
        print_rows(f"locked {folder}", [("files", str(len(written.files))), ("size", size(total))])
    return 0


@app.command
def verify(folder: Folder, *, json: AsJson = False) -> int:
    """Compare every file with assets.lock.json; exits with 2 if any is missing or changed."""
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
            "Fetch them again, or lock the folder anew if the change is wanted",
        )
    rows = [("files as locked", str(result.checked)), ("not in the lock", str(len(result.unlisted)))]
    print_rows(f"verified {folder}", rows)
    return 0


@app.command(name="fetch")
def fetch_assets(
    *names: Annotated[str, Parameter(help="Assets or groups, see `datagen assets list`.")],
    out: Annotated[Path, Parameter(help="Folder to put them in.")] = Path("assets"),
    mirror: Annotated[
        str | None, Parameter(help="http(s) address of a folder with the same file names.")
    ] = None,
    offline: Annotated[bool, Parameter(negative=(), help="Use the cache only.")] = False,
    cache: Annotated[Path | None, Parameter(help="Folder that keeps downloads.")] = None,
    json: AsJson = False,
) -> int:
    """Download, check and unpack assets, and record them in the folder's lock file.

    A broken download continues where it stopped. Files without a published digest are trusted on
    first use: their digest goes into the lock file, and later downloads must match it.
    """
    if not names:
        raise InputError("assets fetch", "", "no asset is named", choices(groups()))
    try:
        chosen = select(names)
    except KeyError as error:
        raise InputError(
            "assets fetch", str(error.args[0]), "there is no such asset", choices(groups())
        ) from None
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

    def one(asset: CatalogueEntry) -> Fetched:
        task = bar.add_task(asset.name, total=asset.size)
        return fetch(
            asset,
            out,
            cache=kept,
            mirror=mirror,
            offline=offline,
            progress=lambda here, total: bar.update(task, completed=here, total=total),
        )

    def report(done: Fetched) -> None:
        how = "from the cache" if done.from_cache else "downloaded"
        trust = "digest as published" if done.trust == "published" else "trusted on first use"
        console.print(f"{done.name}: {how}, {size(done.size)}, {trust}, {done.files} files", highlight=False)

    with bar if not json else nullcontext():
        results = fetch_all(chosen, out, one, report)
    if json:
        print_json({"folder": str(out), "fetched": [asdict(result) for result in results]})
    return 0


def _trust(asset: CatalogueEntry) -> str:
    return "published digest" if asset.sha256 else "first use"


def _shown() -> list[CatalogueEntry]:
    """The catalogue with only the first of the many scans, to keep the table short."""
    scans = [asset for asset in CATALOGUE.values() if asset.name.startswith("ycb-scans/")]
    return [asset for asset in CATALOGUE.values() if asset not in scans[1:]]
