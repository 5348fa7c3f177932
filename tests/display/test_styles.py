"""Whatever one figure shows differs in colour or marker, also for colour-blind readers."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import to_hex, to_rgb

from datagen.display.styles import (
    BEST,
    BEST_BY_SCORE,
    CAMERA,
    CLUTTER,
    LABEL_STYLES,
    OUTCOME_STYLES,
    PHASE_COLOURS,
    SCORE_COLOURS,
    TARGET,
)
from datagen.schemas.fields import OUTCOMES

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
# Colours that one figure shows without markers, and the least distance between any two of them. Distances
# are CIE76 (Euclidean in CIELAB): 2.3 is just noticeable, 10 is seen at a glance.
TOGETHER = {
    "labels": ([style.colour for style in LABEL_STYLES.values()], 60),
    "phases": (list(PHASE_COLOURS.values()), 25),
    "objects": ([TARGET.colour, CLUTTER.colour], 25),
    "scores": ([to_hex(colormaps[SCORE_COLOURS](x)) for x in (0.0, 0.5, 1.0)], 45),
}


def seen_as(colour: str, eye: str) -> np.ndarray:
    """CIELAB (3,) of a colour as an eye sees it."""
    c = np.array(to_rgb(colour))
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    xyz = _XYZ @ np.clip(np.array(EYES[eye]) @ linear, 0, 1) / _WHITE
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def distance(a: str, b: str, eye: str) -> float:
    return float(np.linalg.norm(seen_as(a, eye) - seen_as(b, eye)))


def test_every_outcome_has_a_style_of_its_own_and_one_stage_has_one_marker() -> None:
    assert tuple(OUTCOME_STYLES) == tuple(OUTCOMES)
    for key in ("colour", "words"):
        assert len({getattr(style, key) for style in OUTCOME_STYLES.values()}) == len(OUTCOME_STYLES)
    groups = [style.marker for style in OUTCOME_STYLES.values()]
    assert groups == sorted(groups, key=groups.index)  # members of a group follow each other
    of_stages = {
        (stage, OUTCOME_STYLES[name].marker) for name, stage in OUTCOMES.items() if name != "success"
    }
    assert len(of_stages) == len({stage for stage, _ in of_stages})


@pytest.mark.parametrize("eye", EYES)
def test_outcomes_of_one_marker_differ_to_every_eye_and_all_to_most(eye: str) -> None:
    for a, b in combinations(OUTCOME_STYLES.values(), 2):
        least = 20 if eye == "normal" else 15 if a.marker == b.marker else 0
        assert distance(a.colour, b.colour, eye) > least, (a.words, b.words)


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("name", TOGETHER)
def test_colours_of_one_figure_differ(name: str, eye: str) -> None:
    colours, least = TOGETHER[name]
    assert min(distance(a, b, eye) for a, b in combinations(colours, 2)) > least


def test_picks_and_labels_have_markers_of_their_own() -> None:
    marks = [style.marker for style in (CAMERA, BEST, BEST_BY_SCORE)]  # camera and picks
    drawn = {style.marker for style in (*OUTCOME_STYLES.values(), *LABEL_STYLES.values())}
    assert len(set(marks)) == len(marks) and not drawn & set(marks)
    assert LABEL_STYLES[0].marker != LABEL_STYLES[1].marker
    assert LABEL_STYLES[1].colour == OUTCOME_STYLES["success"].colour
