"""The description of a folder of Parquet files in Croissant 1.0 (docs.mlcommons.org/croissant)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from datagen.exports.export_record import ExportedFile
from datagen.schemas.fields import Field

# The standard's own context; readers warn of another one.
_TERMS = (
    "citeAs column equivalentProperty extract field fileObject fileProperty fileSet format includes "
    "isLiveDataset jsonPath key md5 parentField path recordSet references regex repeated replace "
    "samplingRate separator source subField transform"
)
_CONTEXT = {term: f"cr:{term}" for term in _TERMS.split()} | {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
}
_TYPES = {"s": "Text", "b": "Boolean", "i": "Integer", "u": "Integer", "f": "Float"}


def croissant(
    about: Mapping[str, Any],
    licences: Sequence[str],
    created: str,
    tables: Mapping[str, Sequence[tuple[Field, str]]],
    files: Sequence[ExportedFile],
) -> bytes:
    """The bytes of croissant.json.

    `tables` have, by the name of their folder, columns of one value a row with their types; `files` are those
    in these folders.
    """
    parquet = {"encodingFormat": "application/x-parquet"}
    objects = [
        {"@type": "cr:FileObject", "@id": file.path, "name": file.path.replace("/", "-"), **parquet}
        | {"contentUrl": file.path, "contentSize": f"{file.size} B", "sha256": file.sha256}
        for file in files
    ]
    sets = [
        {"@type": "cr:FileSet", "@id": table, "name": table, "includes": f"{table}/*.parquet", **parquet}
        for table in tables
    ]
    document = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": "robot-base-poses",
        "description": f"{about['title']}. {about['summary']}",
        "license": list(licences),
        "citeAs": about["acknowledgement"],
        "creator": {"@type": "sc:Organization", "name": "datagen"},
        "datePublished": created[:10],
        "version": "1.0.0",
        "distribution": [*objects, *sets],
        "recordSet": [_records(table, fields) for table, fields in tables.items()],
    }
    return json.dumps(document, indent=1).encode() + b"\n"


def _records(table: str, fields: Sequence[tuple[Field, str]]) -> dict[str, Any]:
    name = f"{table}-records"
    columns = [
        {"@type": "cr:Field", "@id": f"{name}/{field.name}", "name": field.name}
        | {"description": f"{field.doc} ({field.unit})" if field.unit not in ("", "1") else field.doc}
        | {"dataType": f"sc:{_TYPES[dtype[0]]}"}
        | {"source": {"fileSet": {"@id": table}, "extract": {"column": field.name}}}
        for field, dtype in fields
    ]
    return {"@type": "cr:RecordSet", "@id": name, "name": name, "field": columns}
