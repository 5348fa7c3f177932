"""Which objects are targets, and how one is drawn."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from datagen.schemas.specification import GraspParams
from datagen.workers.grasps.targets import Targets, is_graspable
from datagen.workers.objects import open_objects
from datagen.workers.objects.model import ObjectModel
from datagen.workers.robots import gripper_of
from datagen.workers.robots.gripper import Gripper
from tests.workers.grasps.shapes import box_gripper
from tests.workers.worlds import box_model, cylinder_model

GRIPPER = box_gripper()
FEW = GraspParams(per_object=12)
MODELS = {
    m.name: m
    for m in (
        box_model("box", (0.05, 0.04, 0.1)),
        box_model("crate", (0.2, 0.2, 0.2)),
        box_model("lead", (0.05, 0.05, 0.1), mass_kg=5.0),
        box_model("slab", (0.15, 0.15, 0.02)),
        *(cylinder_model(f"065-{k}_cups", 0.02 + 0.002 * i, 0.06) for i, k in enumerate("abcde")),
        box_model("065_other", (0.03, 0.03, 0.05)),
    )
}


@pytest.fixture(autouse=True)
def own_cache(session_cache: Path) -> Path:
    """That of all tests: what an object's grasps are is not the question here."""
    return session_cache


def targets(models: dict[str, ObjectModel]) -> set[str]:
    found = Targets(list(models), models.__getitem__, GRIPPER, FEW)
    return {name for name in models if found.is_target(name)}


def test_wide_heavy_and_low_objects_and_most_of_a_family_are_no_targets() -> None:
    assert targets(MODELS) == {"065-a_cups", "065-e_cups", "065_other", "box"}


def test_where_the_largest_of_a_family_does_not_fit_the_next_one_is_a_target() -> None:
    pots = zip("abc", (0.02, 0.03, 0.06), strict=True)
    sizes = {f"7-{k}_pots": cylinder_model(f"7-{k}_pots", r, 0.06) for k, r in pots}
    assert targets(sizes) == {"7-a_pots", "7-b_pots"}


def test_drawing_gives_each_target_the_same_chance_and_asks_for_few() -> None:
    loaded: list[str] = []

    def load(name: str) -> ObjectModel:
        loaded.append(name)
        return MODELS[name]

    names = list(MODELS)
    first = Targets(names, load, GRIPPER, FEW)
    rng = np.random.default_rng(0)
    first_drawn = first.draw(rng)
    assert first_drawn in {"box", "065-a_cups", "065-e_cups", "065_other"}
    assert len(loaded) < len(names)
    drawn = [first.draw(rng) for _ in range(400)]
    counts = np.unique(np.array(drawn), return_counts=True)[1]
    assert len(counts) == 4 and counts.min() > 60
    again = np.random.default_rng(0)
    assert [Targets(names, load, GRIPPER, FEW).draw(again) for _ in range(3)] == [first_drawn, *drawn[:2]]
    assert Targets(["crate"], load, GRIPPER, FEW).draw(rng) is None


def franka_hand() -> Gripper:
    if find_spec("mani_skill") is None:
        pytest.skip("the robots' files come with mani_skill, which is not installed")
    return gripper_of("panda")


def test_flat_real_objects_are_targets(real_objects: str) -> None:
    ycb, gripper = open_objects(real_objects), franka_hand()
    for name in ("011_banana", "007_tuna_fish_can", "031_spoon", "026_sponge", "024_bowl"):
        assert is_graspable(ycb.load(name), gripper, GraspParams()), name


@pytest.mark.slow
def test_real_objects_have_thirty_varied_targets(real_objects: str) -> None:
    ycb = open_objects(real_objects)
    found = Targets(ycb.names(), ycb.load, franka_hand(), GraspParams())
    names = [name for name in ycb.names() if found.is_target(name)]
    assert len(names) >= 30
    assert sum("cups" in name for name in names) == 2
