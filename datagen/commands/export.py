"""`datagen export`: write a run in the format of another program."""

from __future__ import annotations

import sys
from dataclasses import KW_ONLY, dataclass
from typing import Annotated, Any

from datagen.console.command_lines import options_of, prints
from datagen.console.options import RUN, AsJson, AssetSources, PathOrAddress
from datagen.console.printing import counted, print_json, print_rows, seconds, size
from datagen.display.progress import counting
from datagen.exports.export_run import export_run, open_source

_FRAME_BYTES, _FRAME_S = 0.42, 1.3e-6  # of a pixel: docs/guides/export.md says how this was measured


def print_export(report: dict[str, Any], json: bool, **_: Any) -> int:
    """Print the report of an export."""
    if json:
        print_json(report)
        return 0
    files = f"{counted(report['files'], 'file')}, {size(report['bytes'])}"
    rows = [("scenes", f"{report['scenes']:,}"), ("files", files), ("licences", report["license"])]
    print_rows(f"{report['format']}: {report['out']}", rows)
    return 0


@dataclass(frozen=True)
class ExportOptions(AssetSources):
    """Options of `export`.

    Args:
        to: Format: frames, glb, huggingface, lerobot, parquet, rerun or webdataset.
        out: Folder or s3:// address of the export, new or of an interrupted one.
        scenes: Scenes to export: one index, or FIRST:PAST. [default: all]
    """

    run: Annotated[PathOrAddress, RUN]
    _: KW_ONLY
    to: str
    out: PathOrAddress
    scenes: str | None = None
    json: AsJson = False


@prints(print_export)
@options_of(ExportOptions)
def export(given: ExportOptions) -> dict[str, Any]:
    """Export a run for another program: tables, data sets, pictures, recordings or a mesh.

    After an interruption, run the same command again: finished files are kept. Equal runs give equal bytes.
    `datagen verify OUT` checks the files, and that the run has not changed since. The formats frames,
    lerobot, rerun and glb rebuild scenes, from the houses and objects of the run.

    For example: datagen export runs/first --to parquet --out export

    Returns:
        Format, address, number of scenes, files and bytes, licences and acknowledgement.

    Raises:
        InputError: The format is unknown, the run is incomplete or damaged, or `out` has other files.

    Examples:
        >>> exported = datagen.export(run, to="parquet", out=folder / "parquet")
        >>> exported["files"], exported["scenes"]
        (1, 2)
    """
    source = open_source(str(given.run), None if given.scenes is None else str(given.scenes), given)
    if given.to == "frames" and not given.json:
        image = source.runs[0].manifest.spec.observation
        pixels = (source.past - source.first) * image.width_px * image.height_px
        cost = f"{size(_FRAME_BYTES * pixels)}, {seconds(_FRAME_S * pixels)} of a core"
        sys.stderr.write(f"frames: about {cost}; fewer --scenes cost less\n")
    with counting("steps", as_json=given.json) as seen:
        storage, record = export_run(source, given.to, given.out, seen)
    sizes = {"files": len(record.files), "bytes": sum(file.size for file in record.files)}
    stated = {name: getattr(record, name) for name in ("format", "license", "acknowledgement")}
    return {"out": storage.url, "scenes": source.past - source.first, **sizes, **stated}
