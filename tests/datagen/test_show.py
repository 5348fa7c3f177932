"""Pictures of `plan` and `sim` runs: the outcome map, a candidate tried again, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from PIL import Image, ImageColor, ImageSequence

from datagen import cli
from datagen.display.styles import OUTCOME_STYLES
from datagen.drawing.scene_picture import Shown, best_success, draw_scene_picture
from datagen.schemas.fields import OUTCOMES
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_scene
from datagen.workers.scenes.reconstruct import reconstruct_candidates, reconstruct_scene
from datagen.workers.world import open_world
from tests.datagen.conftest import PAIRED
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import arrays_of

pytestmark = needs_sim

NAMES = tuple(OUTCOMES)


def row_of(run: Path, success: bool) -> int:
    """A candidate of the run that the arm took, or one for which it had no plan."""
    arrays = arrays_of(run)
    good = arrays["outcome"] == NAMES.index("success")
    return int(np.flatnonzero(good if success else arrays["path_length_rad"] == 0)[0])


def show(run: Path, out: Path, *more: str) -> np.ndarray:
    """The picture that the command line writes, (height, width, 3)."""
    assert cli.run(["show", str(run), "--out", str(out), *more]) == 0
    with Image.open(out) as image:
        return np.asarray(image.convert("RGB"))


@pytest.mark.parametrize("name", ["plan", "sim"])
def test_a_scene_is_drawn_with_its_outcomes(name: str, paired: dict[str, Path], tmp_path: Path) -> None:
    pixels = show(paired[name], tmp_path / "scene.png")
    assert pixels.shape[1] == 1320
    outcome_map = pixels[40:460, 420:800]
    codes, counts = np.unique(arrays_of(paired[name])["outcome"], return_counts=True)
    for code in codes[counts > 2]:  # the stars of two picks may hide two
        colour = ImageColor.getrgb(OUTCOME_STYLES[NAMES[code]].colour)
        assert (outcome_map == colour).all(axis=2).sum() > 5, NAMES[code]


@pytest.mark.parametrize(("outcomes", "robots"), [(1, 1), (4, 4), (len(NAMES), 6)])
def test_no_text_of_a_picture_lies_on_another(
    outcomes: int, robots: int, paired: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Robots of some sizes, long names of objects, and up to all outcomes, with bases that fit or do not."""
    run = Run.open(str(paired["plan"]))
    rows = read_scene(run, 0)
    n, spec = 2 * len(NAMES), run.manifest.spec
    samples = {name: np.resize(values, (n, *values.shape[1:])) for name, values in rows.samples.items()}
    samples["outcome"] = (np.arange(n) // 2 % outcomes).astype(np.uint8)
    samples["base_is_clear"] = np.arange(n) % 2 == 0
    samples["robot_index"] = np.arange(n) % 6
    samples["arm_reach_m"] = 0.5 + 0.1 * (np.arange(n) % robots)
    scene = reconstruct_scene(open_world(spec, "builtin", "builtin"), rows.record)
    drawn: list[Figure] = []
    monkeypatch.setattr("datagen.drawing.scene_picture.save_sheet", lambda figure, out: drawn.append(figure))
    draw_scene_picture(Shown("run", spec, replace(rows, samples=samples), scene), tmp_path / "a.png")
    figure = drawn[0]
    figure.canvas.draw()
    lower = figure.subfigs[1]
    facts = Bbox.union([text.get_window_extent() for text in lower.axes[0].texts])
    assert sum(text.get_text().startswith("reach") for text in lower.axes[0].texts) == min(robots, 4)
    legend = lower.axes[1].get_legend().get_window_extent()
    plans = [axes.get_tightbbox() for axes in figure.subfigs[0].axes]
    for box in (facts, legend):
        assert box.y0 >= 0 and box.x0 >= 0 and box.x1 <= figure.bbox.x1
        assert not any(box.overlaps(plan) for plan in plans)
    assert not facts.overlaps(legend)
    left_px = min(facts.y0, legend.y0)
    assert left_px < 0.1 * figure.bbox.height  # no empty band below them


@pytest.mark.parametrize("name", ["plan", "sim", "disturbed"])
def test_a_candidate_tried_again_ends_as_it_is_stored(name: str, paired: dict[str, Path]) -> None:
    from datagen.drawing.trial_picture import try_again

    run = Run.open(str(paired[name]))
    spec, rows = run.manifest.spec, read_scene(run, 0)
    scene = reconstruct_scene(open_world(spec, "builtin", "builtin"), rows.record)
    for row in range(0, PAIRED, 2):
        again = try_again(scene, reconstruct_candidates(rows.samples, scene), row, spec)
        assert again.trial.outcome == NAMES[rows.samples["outcome"][row]]
        recording = again.recording
        moved = recording.time_s[-1] > recording.time_s[0]
        assert moved == (rows.samples["path_length_rad"][row] > 0)
        if name != "plan":
            assert again.trial.successes == rows.samples["successes"][row]
            assert (again.result is None) == (rows.samples["attempts"][row] == 0)
        assert recording.T_world_object.shape == (len(recording.phase), len(scene.models), 4, 4)


@pytest.mark.parametrize("success", [True, False])
def test_a_filmstrip_has_the_colour_of_its_outcome(
    success: bool, paired: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    row = row_of(paired["sim"], success)
    outcome = NAMES[arrays_of(paired["sim"])["outcome"][row]]
    pixels = show(paired["sim"], tmp_path / "trial.png", "--trial", str(row))
    told = capsys.readouterr().out
    assert f"candidate  {row} at" in told and outcome in told
    assert pixels.shape[1] == 10 + 4 * 470 or not success
    assert tuple(pixels[20, 15]) == ImageColor.getrgb(OUTCOME_STYLES[outcome].colour)


def test_a_film_of_the_best_success_moves(
    paired: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "trial.gif"
    for name, size in (("WIDE_PX", (160, 120)), ("NEAR_PX", (160, 96))):
        monkeypatch.setattr(f"datagen.drawing.film.{name}", size)  # a tenth of the rays
    show(paired["plan"], out)
    with Image.open(out) as image:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)]
    assert len(frames) > 5 and all((a != b).any() for a, b in pairwise(frames))


@pytest.mark.parametrize(
    ("name", "arguments", "words"),
    [
        ("heuristic", ["--trial", "0", "--out", "a.png"], ["--trial", "heuristic"]),
        ("heuristic", ["--out", "a.gif"], ["--out", "heuristic", "plan or sim"]),
        ("sim", ["--trial", str(PAIRED), "--out", "a.png"], ["--trial", f"0 to {PAIRED - 1}"]),
        ("sim", ["--trial", "-1", "--out", "a.png"], ["--trial", "-1"]),
        ("sim", ["--trial", "first", "--out", "a.png"], ["--trial", "first", "best"]),
        ("sim", ["--trial", "9" * 30, "--out", "a.png"], ["--trial"]),
        ("sim", ["--trial", "0", "--out", "a.mp4"], ["a.mp4", ".gif"]),
        ("sim", ["--trial", "{failed}", "--out", "a.gif"], ["--out", "before the arm moved", ".png"]),
        ("sim", ["--scene", "1", "--trial", "0", "--out", "a.png"], ["--scene", "1"]),
    ],
)
def test_what_cannot_be_shown(
    name: str, arguments: list[str], words: list[str], paired: dict[str, Path], tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    failed = str(row_of(paired["sim"], success=False))
    filled = [a.replace("{failed}", failed) if a != arguments[-1] else str(tmp_path / a) for a in arguments]
    refused(["show", str(paired[name]), *filled], capsys, *words)
    assert list(tmp_path.iterdir()) == []


def test_the_best_success_lifts_most_often_with_fewest_grasps() -> None:
    success = NAMES.index("success")
    samples = {
        "outcome": np.array([1, success, success, success, success]),
        "path_clearance_m": np.array([9.0, 0.3, 0.1, 0.2, 0.9]),
        "trials": np.array([5, 5, 5, 5, 5]),
        "successes": np.array([5, 4, 5, 5, 5]),
        "attempts": np.array([5, 5, 5, 5, 6]),
    }
    assert best_success(samples) == 3
    planned = {name: samples[name] for name in ("outcome", "path_clearance_m")}
    assert best_success(planned) == 4
    assert best_success(planned | {"outcome": np.ones(5)}) is None
