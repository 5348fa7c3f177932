"""`datagen view`: scenes of a run in the viewer Rerun."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from cyclopts import Parameter

from datagen.console.options import AS_FOUND, AssetSources, RunPath, Whole, refuse_output
from datagen.console.printing import print_rows
from datagen.exports.export_run import open_source
from datagen.schemas.errors import InputError, choices
from datagen.schemas.run import find_scene
from datagen.workers.extras import refuse_missing

_MOST = 10  # scenes in a file


def view(
    run: RunPath, /, *, scene: Whole | None = None, place: str | None = None, outcome: str | None = None,
    disagreement: Literal["heuristic", "plan"] | None = None,
    target: Annotated[str, Parameter(name="--object")] = "",
    out: Path | None = None, given: AssetSources = AS_FOUND,
) -> int:  # fmt: skip
    """Open the first 10 scenes that all filters choose, as recordings of `datagen export --to rerun`.

    Needs the extra rerun. Where there is no display, `--out` writes a file for `rerun FILE.rrd`.

    For example: datagen view runs/first --object banana --place shelf --disagreement heuristic

    Args:
        scene: Index of a scene.
        place: Kind of place: top, shelf, inside, seat, floor or sink.
        outcome: Outcome of at least one candidate (plan, sim).
        disagreement: What the label of at least one candidate differs from: heuristic (plan, sim), or plan,
            where the trial of a plan failed (sim).
        target: Part of the target's name.
        out: File to write, FILE.rrd, in place of opening the viewer.
    """
    refuse_missing("rerun")
    from datagen.exports.rerun_recording import joined, layout, recording

    if out is not None:
        refuse_output(out, "--out", ".rrd")
    source = open_source(run, None, given)
    if scene is not None:
        find_scene(source.runs, scene)  # InputError where there are fewer
        source = replace(source, first=scene, past=scene + 1)
    wanted, codes = dict[str, int](), {field.name: field.codes for _, field in source.runs[0].schema.fields}
    for name, value in (("place", place), ("outcome", outcome)):
        if value is not None and value not in (valid := codes.get(name, ())):
            fix = choices(valid, value) if valid else f"Omit --{name}: the run has none"
            raise InputError(f"--{name}", value[:40], "is unknown", fix)
        wanted |= {} if value is None else {name: codes[name].index(value)}
    column = {"heuristic": "heuristic_label", "plan": "trials"}.get(disagreement or "", "label")
    if column not in codes or disagreement == source.runs[0].manifest.spec.label_source:
        fix = f"Omit --disagreement: the run has no labels of {disagreement} beside its own"
        raise InputError("--disagreement", str(disagreement), "is unknown", fix)
    every = enumerate(source.scenes(source.first, source.past), source.first)
    fitting = (
        (k, of, rows)
        for k, (of, rows) in every
        if target in str(rows.record["object_name"][0])
        and all(np.isin(code, {**rows.record, **rows.samples}[name]) for name, code in wanted.items())
        and (disagreement is None or ((rows.samples[column] > 0) != rows.samples["label"]).any())
    )
    scenes = list(islice(fitting, _MOST))
    if not scenes:
        raise InputError(run, "", "no scene has all of these", "Give fewer filters")
    print_rows(f"scenes of {run}", [(str(k), str(rows.record["object_name"][0])) for k, _, rows in scenes])
    with tempfile.TemporaryDirectory() as folder:
        file = out or Path(folder) / "scenes.rrd"
        shown = [recording(source, of, rows).data for _, of, rows in scenes]
        file.write_bytes(joined([*shown, layout("attempts" in codes)]))
        return 0 if out else min(subprocess.call([sys.executable, "-m", "rerun", str(file)]), 1)
