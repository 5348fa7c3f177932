"""The data-format page, written from the schemas: `python -m schemas.data_format`."""

from __future__ import annotations

import sys

from datagen.schemas.fields import SCHEMA_VERSION, SCHEMAS, Field, RecordSchema
from datagen.schemas.outcomes import OUTCOMES, REDRAW_CAUSES
from datagen.schemas.run_records import FORMAT_VERSION
from datagen.schemas.shard_files import MAX_CHUNK_BYTES, ZSTD_LEVEL, fill_value

_HEAD = f"""# Data format

This page is generated: `python -m schemas.data_format > docs/data-format.md`.

## A run

Run format {FORMAT_VERSION}. A run is a folder (or an object-store prefix):

```
RUN/
  manifest.json                  specification, its hash, schema version, layout, versions; written once
  plans/<k>.json                 samples wanted; the highest k counts, a run only grows
  shards/<shard>/<attempt>/      an immutable, flat Zarr v3 group with the rows of one shard
  commits/<shard>.json           written last, create-only: the attempt, every file's size and sha256, cost
  copies/...                     second copies of the root's records; a commit's is in its attempt's folder
  ledger/<attempt>.start.json    an attempt began
  ledger/<attempt>.json          how it ended: outcome, cause, stack, cost
  quarantine/<shard>.json        a shard given up: seeds, causes, stacks
  quarantine/<shard>.lifted-<k>.json  one that was given up, and then tried again
  jobs/<job>.json                a driver that began; .state.json says how it is, .stop.json asks it to stop
  index/<digest>.json.gz         summaries of settled records: a cache, which may be removed at any time
  lineage.json                   of a merged run: the runs that made its shards
  data.zarr/                     after sealing: one flat Zarr v3 store over all committed shards
```

Runs of several specifications that were merged ([merging](merging.md)) lie in one place:

```
PLACE/
  merged.json                    the specification hashes of its parts, ascending: the order of their rows
  parts/<hash>/                  each part a whole run as above, named by 16 digits of its hash
  data.zarr/                     one store over all parts; its `parts` attribute says what is of whom
```

Every JSON record ends with the sha256 of all bytes before it: its last key, on a line of its own.

Only commits count: a shard's files mean nothing without one. Shards hold whole scenes and are all
equally long; the last one is computed whole and `data.zarr` is cut to n samples. Rows are sorted by
scene, and the samples of a scene lie together, in the order of their candidates.

## Arrays

Every array lies at the root of its group. The first dimension is `scene` or `sample`. Chunks hold
the rows of one shard, or an equal part of them where a shard's rows exceed {MAX_CHUNK_BYTES // 2**20} MiB.
Codecs: little-endian bytes (text: vlen-utf8), zstd level {ZSTD_LEVEL}, crc32c. Every chunk is written,
so a missing file is damage, and a fill value never stands for rows that were not stored.
Attributes: `units` (SI, `1` for numbers without one), `long_name`, `frame`, `valid_min`, `valid_max`,
and `flag_meanings`: the words that the codes 0, 1, ... stand for.

`data.zarr` has consolidated metadata, and the specification in its root's attributes:

```python
import xarray, zarr
zarr.open("RUN/data.zarr", mode="r")["label"][:]
xarray.open_zarr("RUN/data.zarr")
```

## Versions

Schema version {SCHEMA_VERSION}; a run keeps the one it was begun with, and goes on in it under newer
programs. A new array raises the version (`Field.since`); nothing that is stored is renamed, retyped,
re-ranged or taken out. The versions of what makes scenes and labels are in the specification's `engines`,
and so in its hash: code that gives the same input another sample needs a new `VERSION`, everything else
does not ([what needs what](relabel-and-replay.md)).
"""

_OUTCOME_HEAD = (
    "## Outcomes",
    "",
    "Codes of `outcome`, and the stage that decides each. Where several grasps failed, the one that came",
    "furthest counts.",
    "",
    "| code | outcome | stage |",
    "| --- | --- | --- |",
)
_OUTCOMES = tuple(enumerate(OUTCOMES.items()))

Fields = tuple[Field, ...]


def page() -> str:
    """The whole page as Markdown."""
    parts, seen = [_HEAD], list[RecordSchema]()
    for schema in SCHEMAS.values():
        parts.append(_section(schema, seen))
        seen.append(schema)
    parts.append(
        "## Redraw causes\n\nAxis `redraw_cause`, in order: " + ", ".join(f"`{c}`" for c in REDRAW_CAUSES)
    )
    parts.append("\n".join([*_OUTCOME_HEAD, *(f"| {k} | `{o}` | {s} |" for k, (o, s) in _OUTCOMES)]))
    return "\n".join(part.rstrip() + "\n" for part in parts)


def _section(schema: RecordSchema, seen: list[RecordSchema]) -> str:
    """A schema's tables; what an earlier one has just so is named and not repeated."""
    sizes = ", ".join(f"{name} {size}" for name, size in schema.sizes.items())
    return "\n".join(
        [
            f"## Schema `{schema.name}`, version {schema.version}",
            "",
            f"Axis lengths (points and objects follow the specification): {sizes}.",
            "",
            *_table("scene", schema.scene_fields, [(other.name, other.scene_fields) for other in seen]),
            "",
            *_table("sample", schema.sample_fields, [(other.name, other.sample_fields) for other in seen]),
        ]
    )


def _table(title: str, fields: Fields, earlier: list[tuple[str, Fields]]) -> list[str]:
    like, shared = max(
        ((name, len(known)) for name, known in earlier if fields[: len(known)] == known),
        key=lambda found: found[1],
        default=("", 0),
    )
    head = [f"### One row a {title}", ""]
    if shared == len(fields):
        return [*head, f"As in `{like}`."]
    if shared:
        head += [f"The arrays of `{like}`, and:", ""]
    head += [
        "| array | type | dimensions | unit | frame | range | fill | meaning |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    return head + [
        f"| `{f.name}` | {f.dtype} | {', '.join((title, *f.dims))} | {f.unit} | {f.frame} "
        f"| {_range(f)} | {fill_value(f)!r} | {f.doc} |"
        for f in fields[shared:]
    ]


def _range(field: Field) -> str:
    if field.low is None and field.high is None:
        return ""
    low = "" if field.low is None else f"{field.low:g}"
    high = "" if field.high is None else f"{field.high:g}"
    return f"{low} .. {high}"


if __name__ == "__main__":
    sys.stdout.write(page())
