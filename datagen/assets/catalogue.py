"""The catalogue of `datagen assets fetch`.

Digests are those of the publisher, where there is one: ProcTHOR-10K's are the object ids of its Git LFS
pointers at the pinned commit, and the YCB archive's is the one that ManiSkill 3.0.1 checks. The others are
trusted on first use and recorded in the folder's lock file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from datagen.schemas.errors import InputError, choices

_PROCTHOR_10K = "439193522244720b86d8c81cde2e51e3a4d150cf"
_PROCTHOR = "53d5bd4c8c96a699e6a615dc390abb670cc9d353"
_YCB_SCANS = "https://ycb-benchmarks.s3.amazonaws.com/data/google"
_DEITKE = "Deitke et al., ProcTHOR: Large-Scale Embodied AI Using Procedural Generation, arXiv:2206.06994"
_KOLVE = "Kolve et al., AI2-THOR: An Interactive 3D Environment for Visual AI, 2017, arXiv:1712.05474"
_CALLI = (
    "Calli et al., Benchmarking in Manipulation Research: Using the Yale-CMU-Berkeley Object and Model Set, "
    "2015, doi:10.1109/MRA.2015.2448951"
)
_MANISKILL = "https://huggingface.co/datasets/haosulab"


@dataclass(frozen=True)
class CatalogueEntry:
    """One download. `file` is its name in caches and on mirrors, unique in the catalogue."""

    name: str
    file: str
    url: str
    licence: str
    into: str  # subfolder of the target, "" for the target itself
    about: str
    sha256: str | None = None
    size: int | None = None
    title: str = ""  # with `attribution` and `licence`, what the folder `holds` states of itself
    attribution: str = ""
    holds: str = ""  # subfolder of the target; "" for `into`


def _houses(split: str, sha256: str, size: int) -> CatalogueEntry:
    return CatalogueEntry(
        name=f"procthor-10k/{split}",
        file=f"procthor-10k-{split}.jsonl.gz",
        url=f"https://media.githubusercontent.com/media/allenai/procthor-10k/{_PROCTHOR_10K}/{split}.jsonl.gz",
        licence="Apache-2.0",
        into="procthor",
        about=f"ProcTHOR-10K houses, {split} split",
        title="ProcTHOR houses",
        attribution=_DEITKE,
        sha256=sha256,
        size=size,
    )


# Objects with a scan of 16k triangles.
_SCANNED = [
    "001_chips_can", "002_master_chef_can", "003_cracker_box", "004_sugar_box", "005_tomato_soup_can",
    "006_mustard_bottle", "007_tuna_fish_can", "008_pudding_box", "009_gelatin_box", "010_potted_meat_can",
    "011_banana", "012_strawberry", "013_apple", "014_lemon", "015_peach", "016_pear", "017_orange",
    "018_plum", "019_pitcher_base", "021_bleach_cleanser", "022_windex_bottle", "024_bowl", "025_mug",
    "026_sponge", "027_skillet", "028_skillet_lid", "029_plate", "030_fork", "031_spoon", "032_knife",
    "033_spatula", "035_power_drill", "036_wood_block", "037_scissors", "038_padlock", "040_large_marker",
    "042_adjustable_wrench", "043_phillips_screwdriver", "044_flat_screwdriver", "048_hammer",
    "050_medium_clamp", "051_large_clamp", "052_extra_large_clamp", "053_mini_soccer_ball", "054_softball",
    "055_baseball", "056_tennis_ball", "057_racquetball", "058_golf_ball", "061_foam_brick", "062_dice",
    "065-a_cups", "065-b_cups", "065-c_cups", "065-d_cups", "065-e_cups", "065-f_cups", "065-g_cups",
    "065-h_cups", "065-i_cups", "065-j_cups", "070-b_colored_wood_blocks", "077_rubiks_cube",
]  # fmt: skip

_ALL = (
    CatalogueEntry(
        name="ycb",
        file="mani_skill2_ycb.zip",
        url=f"{_MANISKILL}/ManiSkill2/resolve/main/data/mani_skill2_ycb.zip",
        licence="CC-BY-4.0",
        into="",
        about="YCB objects with convex parts, from ManiSkill; use: --objects ycb:DIR/mani_skill2_ycb",
        title="YCB objects",
        attribution=_CALLI,
        holds="mani_skill2_ycb",
        sha256="1551724fd1ac7bad9807ebcf46dd4a788caed5c9499c1225b9bfa080ffbefcb3",
    ),
    _houses("train", "ee3c4aa14b4d8f0895fecfb5fdaca59395427ca1018b2f9aeeedbc61e5824587", 53_314_510),
    _houses("val", "d808540514e26b6726cd2790490e669b572eeb94febb5188a2f403591dd21721", 5_094_681),
    _houses("test", "9a9fa6f134e76fe87f3fd92c00883651cf9fadf4e9ad4072d6d73be229f001dc", 5_022_093),
    CatalogueEntry(
        name="procthor-10k/asset-sizes",
        file="asset-database.json",
        url=f"https://raw.githubusercontent.com/allenai/procthor/{_PROCTHOR}/procthor/databases/asset-database.json",
        licence="Apache-2.0",
        into="procthor",
        about="sizes of the AI2-THOR furniture in ProcTHOR houses",
    ),
    CatalogueEntry(
        name="ai2thor",
        file="ai2thor.zip",
        url=f"{_MANISKILL}/AI2THOR/resolve/main/ai2thor.zip",
        licence="Apache-2.0",
        into="",
        about="AI2-THOR scenes and furniture meshes, from ManiSkill; use: --houses ai2thor:DIR/ai2thor",
        title="AI2-THOR scenes",
        attribution=_KOLVE,
        holds="ai2thor",
    ),
    *(
        CatalogueEntry(
            name=f"ycb-scans/{key}",
            file=f"{key}_google_16k.tgz",
            url=f"{_YCB_SCANS}/{key}_google_16k.tgz",
            licence="CC-BY-4.0",
            into="ycb-scans",
            about="YCB laser scan (16k triangles), without convex parts",
            title="YCB objects",
            attribution=_CALLI,
        )
        for key in _SCANNED
    ),
)

CATALOGUE: dict[str, CatalogueEntry] = {asset.name: asset for asset in _ALL}


def select(names: Sequence[str]) -> list[CatalogueEntry]:
    """Assets by name or group, in catalogue order, each once. InputError for an unknown one."""
    chosen: set[str] = set()
    for name in names:
        matches = {key for key in CATALOGUE if key == name or key.startswith(f"{name}/")}
        if not matches:
            groups = {key.split("/")[0] for key in CATALOGUE}
            raise InputError("datagen assets fetch", name, "is not an asset", choices(groups, name))
        chosen |= matches
    return [asset for key, asset in CATALOGUE.items() if key in chosen]
