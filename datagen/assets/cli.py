"""`datagen assets`: list, fetch, check and split houses and objects."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from cyclopts import App

from datagen.assets.catalogue import CATALOGUE, select
from datagen.assets.fetch import Fetched, fetch
from datagen.assets.object_split import split_objects
from datagen.console.options import AsJson, refuse_output
from datagen.console.printing import print_json, print_lines, print_rows, size
from datagen.display.progress import Progress, Seen
from datagen.schemas.errors import InputError, choices
from datagen.workers.content_cache import cache_folder

app = App(name="assets", help="List, fetch, check and split houses and objects.")


@app.command(name="list")
def list_assets(*, json: AsJson = False) -> int:
    """List the assets that can be fetched."""
    if json:
        assets = [asdict(asset) for asset in CATALOGUE.values()]
        print_json({"assets": assets})
        return 0
    scans = [name for name in CATALOGUE if name.startswith("ycb-scans/")]
    rows = [
        (
            asset.name,
            size(asset.size) if asset.size else "?",
            "published digest" if asset.sha256 else "first use",
            asset.licence,
            asset.about,
        )
        for asset in CATALOGUE.values()
        if asset.name not in scans[1:]  # one stands for all
    ]
    print_rows("assets for `datagen assets fetch`", rows)
    return 0


@app.command
def check(source: str, /, *, picture: Path | None = None, json: AsJson = False) -> int:
    """Read a folder of houses or objects as a job would: what is used, what is not and why, and its licences.

    The result is cached, so that a job that uses the folder starts at once.

    For example: datagen assets check my-objects --picture my-objects.png

    Args:
        source: Folder of houses or objects, or KIND:DIR as for --houses and --objects.
        picture: Contact sheet of the objects to write, FILE.png.
    """
    # Imported here: the other verbs of assets need no libraries of meshes.
    from datagen.assets.check import check_source, draw_objects, object_rows

    if picture is not None:
        refuse_output(picture, "--picture", ".png")
    with Progress(json) as shown:
        ref, survey, licences, objects = check_source(source, shown)
    if picture is not None and objects is None:
        raise InputError("--picture", str(picture), "is of objects, not of houses", "Omit it")
    rows = [] if objects is None else object_rows(objects)
    if json:
        print_json({"source": ref, **asdict(survey), "objects": rows, "licences": licences})
    else:
        table = [
            (
                *(row["name"], " x ".join(f"{100 * side:.1f}" for side in row["size_m"])),
                *(f"{row['mass_kg']:.3f}", str(row["parts"]), "yes" if row["can_be_target"] else ""),
                "; ".join(f"{cause}: {detail}".removesuffix(": ") for cause, detail in row["notes"].items()),
            )
            for row in rows
        ]
        print_rows(ref, table, ("object", "size in cm", "kg", "parts", "target", "remarks"))
        print_lines("\n".join(survey.lines(ref, with_reasons=True)))
        print_lines(f"licences: {', '.join(licences) or 'none found'}")
    if picture is not None and objects is not None:
        draw_objects(objects, picture)
    return 0


@app.command
def split(folder: Path, out: Path, *, json: AsJson = False) -> int:
    """Divide a folder of YCB objects: every fifth to OUT/test, the others to OUT/train.

    Args:
        folder: Folder of objects.
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
    *names: str, out: Path = Path("assets"), mirror: str | None = None, json: AsJson = False
) -> int:
    """Download, check and unpack assets, and record their digests and licences in OUT/assets.lock.json.

    An interrupted download continues where it stopped; finished ones are kept below DATAGEN_CACHE. Files
    without a published digest are trusted on first use, and later downloads must match them.

    Args:
        names: Assets or groups of `datagen assets list`.
        out: Folder for the assets.
        mirror: http(s) address of a folder with the same files.
    """
    if not names:
        fix = choices({name.split("/")[0] for name in CATALOGUE})
        raise InputError("datagen assets fetch", "NAME", "is missing", fix)
    chosen = select(names)
    results: list[Fetched] = []
    with Progress(json) as shown:
        for asset in chosen:
            seen = shown.counter(f"MB of {asset.name}")

            def progress(here: int, total: int | None, seen: Seen = seen) -> None:
                seen(here // 10**6, (total or 0) // 10**6)

            done = fetch(asset, out, cache=cache_folder() / "downloads", mirror=mirror, progress=progress)
            results.append(done)
            how = "from the cache" if done.from_cache else "downloaded"
            trust = "digest as published" if done.trust == "published" else "trusted on first use"
            line = f"{done.name}: {how}, {size(done.size)}, {trust}, {done.files} files"
            shown.say("fetched", {"name": done.name, "bytes": done.size}, line)
    if json:
        print_json({"folder": str(out), "fetched": [asdict(result) for result in results]})
    return 0
