"""Every outcome can be told from every other one, also by colour-blind eyes."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from datagen.drawing.outcome_colours import LOOKS
from datagen.schemas.outcomes import OUTCOMES

# What dichromats see, on linear RGB, at full severity (Machado, Oliveira, Fernandes 2009).
EYES = {
    "normal": np.eye(3),
    "protan": [
        [0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998],
    ],
    "deutan": [
        [0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881],
    ],
    "tritan": [
        [1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900],
    ],
}  # fmt: skip
_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
_WHITE = np.array([0.9505, 1.0, 1.089])


def seen_as(colour: str, eye: str) -> np.ndarray:
    """CIELAB (3,) of a colour as an eye sees it."""
    c = np.array(to_rgb(colour))
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    xyz = _XYZ @ np.clip(np.array(EYES[eye]) @ linear, 0, 1) / _WHITE
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_every_outcome_has_a_look_of_its_own() -> None:
    assert tuple(LOOKS) == tuple(OUTCOMES)
    for key in ("colour", "words"):
        assert len({getattr(look, key) for look in LOOKS.values()}) == len(LOOKS)
    groups = [look.group for look in LOOKS.values()]
    assert groups == sorted(groups, key=groups.index)  # members of a group follow each other


def test_stages_are_not_torn_apart() -> None:
    """What one stage decided is drawn as one group."""
    of_stage: dict[str, set[str]] = {}
    for name, stage in OUTCOMES.items():
        if name != "success":
            of_stage.setdefault(stage, set()).add(LOOKS[name].group)
    assert all(len(groups) == 1 for groups in of_stage.values())


@pytest.mark.parametrize("eye", EYES)
def test_colours_of_one_marker_differ(eye: str) -> None:
    for a, b in combinations(LOOKS.values(), 2):
        if a.marker == b.marker:
            assert np.linalg.norm(seen_as(a.colour, eye) - seen_as(b.colour, eye)) > 12, (a.words, b.words)


def test_all_colours_differ() -> None:
    for a, b in combinations(LOOKS.values(), 2):
        assert np.linalg.norm(seen_as(a.colour, "normal") - seen_as(b.colour, "normal")) > 20
