"""Objects of the YCB set, as laser scans with convex collision parts, from a folder in either of two layouts.

    DIR/objects.json                          DIR/info_pick_v0.json (or info_raw.json)
    DIR/<key>/textured.obj, collision.obj ..  DIR/models/<key>/textured.obj, collision.ply|obj ..

The right-hand one is ManiSkill's `mani_skill2_ycb`, as its asset download unpacks it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.schemas.safe_files import is_inside, read_regular
from datagen.workers.json_document import parse_json
from datagen.workers.objects import MANISKILL_INDEXES, YCB_INDEXES
from datagen.workers.objects.model import LoadedOnce, ObjectModel
from datagen.workers.objects.obj_file import read_obj_header
from datagen.workers.objects.scan import (
    READER_VERSION,
    ScanFiles,
    load_scan,
    model_of,
    scan_files,
    volumes_m3,
)
from datagen.workers.objects.texture import texture_of_materials
from datagen.workers.objects.ycb_masses import PUBLISHED_MASS_KG, reason_to_exclude
from datagen.workers.source_statement import read_statement


class YcbObjects(LoadedOnce):
    """The usable objects of one folder (see `ycb_layouts` for the layouts).

    Opening it hashes every object and reads each content once, so that damaged or implausible data
    is reported before a job starts. The content is cached; later openings take a fraction of a second.
    Masses above 50 kg are refused by the index's schema.
    """

    kind = "ycb"

    def __init__(self, folder: Path) -> None:
        """Raises InputError that names the file, the object and the field."""
        index, entries = read_layout(folder)
        self.statement = read_statement(folder)
        excluded: dict[str, str] = {}
        self._entries: dict[str, tuple[Entry, float]] = {}
        self._models: dict[str, ObjectModel] = {}
        volumes = volumes_m3([entry.files for entry in entries])
        for entry, volume_m3 in zip(entries, volumes, strict=True):
            measured = entry.mass_kg is not None
            mass_kg = entry.density_kg_m3 * volume_m3 if entry.mass_kg is None else entry.mass_kg
            reason = reason_to_exclude(entry.name, mass_kg, volume_m3, measured)
            if reason is not None:
                excluded[entry.name] = reason
            else:
                self._entries[entry.name] = (entry, mass_kg)
        self.excluded: Mapping[str, str] = excluded
        if not self._entries:
            raise InputError(
                index,
                "",
                "has no usable object: all were excluded",
                f"First reason: {next(iter(excluded.values()))}",
            )
        self._digests = {
            name: digest_of([entry.files.digest, float(mass_kg).hex(), READER_VERSION])
            for name, (entry, mass_kg) in self._entries.items()
        }
        self.digest = digest_of(self._digests)

    def _model(self, name: str) -> ObjectModel:
        entry, mass_kg = self._entries[name]
        return model_of(name, self._digests[name], mass_kg, load_scan(entry.files))


def open_ycb(folder: str) -> YcbObjects:
    """The objects of a folder. Raises InputError if no folder is given, and as `YcbObjects` does."""
    if not folder:
        raise InputError("ycb", "", "has no folder", "Write `ycb:DIR`")
    return YcbObjects(Path(folder).expanduser())


MAX_INDEX_BYTES = 16 * 2**20
MAX_OBJECTS = 10_000

_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]{0,99}$")]
_Mass = Annotated[float, Field(gt=0, le=50, allow_inf_nan=False)]
_Density = Annotated[float, Field(gt=0, le=25_000, allow_inf_nan=False)]


class _Files(BaseModel):
    model_config = ConfigDict(extra="ignore")
    visual: str
    texture: str
    collision: str


class _Object(BaseModel):
    model_config = ConfigDict(extra="ignore")
    key: _Name
    mass_kg: _Mass
    files: _Files


class _ManiSkillModel(BaseModel):
    model_config = ConfigDict(extra="ignore")
    density: _Density = 1000.0


_OBJECTS = TypeAdapter(Annotated[list[_Object], Field(min_length=1, max_length=MAX_OBJECTS)])
_MODELS = TypeAdapter(Annotated[dict[_Name, _ManiSkillModel], Field(min_length=1, max_length=MAX_OBJECTS)])


@dataclass(frozen=True)
class Entry:
    """One object of a folder: its files and its mass, or a density if the mass is unknown."""

    name: str
    files: ScanFiles
    mass_kg: float | None
    density_kg_m3: float


def read_layout(folder: Path) -> tuple[Path, list[Entry]]:
    """The index file and its objects, in order of name, with their files hashed.

    Raises InputError that names the folder, or the index and the field, or the missing file.
    """
    if not folder.is_dir():
        raise InputError(folder, "", "does not exist", "Give the folder with objects.json")
    index = folder / "objects.json"
    if index.is_file():
        return index, _bundle(folder, index)
    for name in MANISKILL_INDEXES:
        index = folder / name
        if index.is_file():
            return index, _maniskill(folder, index)
    wanted = ", ".join(YCB_INDEXES)
    raise InputError(
        folder,
        "",
        f"has no YCB objects: none of {wanted}",
        "Run `datagen assets fetch` or give another folder",
    )


def _bundle(folder: Path, index: Path) -> list[Entry]:
    entries: dict[str, Entry] = {}
    for number, item in enumerate(_validated(index, _OBJECTS)):
        field = f"[{number}]"
        if item.key in entries:
            raise InputError(
                index, f"{field}.key", f"{item.key} occurs twice", "Give every object its own key"
            )
        files = scan_files(
            _inside(folder, index, f"{field}.files.visual", item.files.visual),
            _inside(folder, index, f"{field}.files.texture", item.files.texture),
            _inside(folder, index, f"{field}.files.collision", item.files.collision),
        )
        entries[item.key] = Entry(item.key, files, item.mass_kg, 0.0)
    return [entries[name] for name in sorted(entries)]


def _maniskill(folder: Path, index: Path) -> list[Entry]:
    """Objects at their true size: ManiSkill's `scales` shrink some for one of its tasks.

    Its densities are rough (1000 or 50 kg/m3 for most), so published masses are used where known.
    """
    entries: list[Entry] = []
    for name, model in sorted(_validated(index, _MODELS).items()):
        home = _inside(folder, index, name, f"models/{name}")
        visual = home / "textured.obj"
        header = read_obj_header(visual)
        library = _inside(home, visual, "mtllib", header.material_library or "textured.mtl")
        image = texture_of_materials(library, header.materials)
        collision = next((c for c in (home / "collision.ply", home / "collision.obj") if c.is_file()), None)
        if collision is None:
            raise InputError(
                home, "", "neither collision.ply nor collision.obj is here", "Fetch the asset again"
            )
        files = scan_files(visual, _inside(home, library, "map_Kd", image), collision)
        entries.append(Entry(name, files, PUBLISHED_MASS_KG.get(name), model.density))
    return entries


def _validated(index: Path, adapter: TypeAdapter[Any]) -> Any:
    value = parse_json(read_regular(index, MAX_INDEX_BYTES, "Give the set's own index"), str(index)).value
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        first = error.errors()[0]
        field = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in first["loc"])
        given = repr(first["input"])[:60]
        raise InputError(
            index, field.lstrip("."), f"{first['msg']}, got {given}", "Correct it or fetch the index again"
        ) from error


def _inside(folder: Path, place: Path, field: str, relative: str) -> Path:
    """`folder / relative`. Raises InputError if it leaves the folder, also through a link."""
    if not relative or "\0" in relative or not is_inside(folder, folder / relative):
        raise InputError(
            place,
            field,
            f"{relative[:80]!r} is not a path inside {folder}",
            "Give a path relative to the folder",
        )
    return folder / relative
