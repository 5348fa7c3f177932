"""Maps of a floor: read as Nav2 writes them, and what they change in an answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from datagen.schemas.errors import InputError
from datagen.train.prediction import KnownFloor, OccupancyMap, RobotSize, predict, read_map
from datagen.train.prediction.answer import Prediction
from datagen.train.prediction.base_cells import STATES, crowded_bases
from datagen.train.prediction.footprints import Footprint
from datagen.train.prediction.frames import SensorFrame
from datagen.train.scorers import ModelScorer
from datagen.workers.occupancy_map import FREE, OCCUPIED, UNKNOWN
from tests.train.prediction.seen_scenes import Seen, sensor_frame

GREY = {FREE: 254, OCCUPIED: 0, UNKNOWN: 205}  # as map_saver writes them
YAML = "image: map.pgm\nmode: trinary\nresolution: 0.05\norigin: [-1.5, 2.0, 0.3]\nnegate: 0\n"
YAML += "occupied_thresh: 0.65\nfree_thresh: 0.25\n"


def write_map(folder: Path, cells: np.ndarray, text: str = YAML) -> Path:
    """A map of Nav2's map_saver; the first row of `cells` is the lowest."""
    grey = np.vectorize(GREY.get)(cells).astype(np.uint8)
    Image.fromarray(grey[::-1]).save(folder / "map.pgm")
    (folder / "map.yaml").write_text(text)
    return folder / "map.yaml"


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 9))
def test_each_cell_is_found_where_it_lies(
    tmp_path_factory: pytest.TempPathFactory, seed: int, height: int, width: int
) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.choice([FREE, OCCUPIED, UNKNOWN], (height, width))
    read = read_map(write_map(tmp_path_factory.mktemp("map"), cells))
    row, column = np.mgrid[:height, :width].reshape(2, -1)
    x, y = 0.05 * (np.stack([column, row]) + rng.uniform(0.01, 0.99, (2, len(row))))
    c, s = np.cos(0.3), np.sin(0.3)
    xy = np.column_stack([-1.5 + c * x - s * y, 2.0 + s * x + c * y])
    np.testing.assert_array_equal(read.states(xy), cells.ravel())
    assert (read.states(xy + [20.0, 0.0]) == UNKNOWN).all()


def test_negated_and_transparent_maps(tmp_path: Path) -> None:
    path = write_map(tmp_path, np.array([[FREE, OCCUPIED]]), YAML.replace("negate: 0", "negate: 1"))
    assert read_map(path).cells.tolist() == [[OCCUPIED, FREE]]
    Image.fromarray(np.array([[[255, 255], [255, 0], [0, 255]]], np.uint8)).save(tmp_path / "map.png")
    path.write_text(YAML.replace("map.pgm", "map.png").replace("trinary", "scale"))
    assert read_map(path).cells.tolist() == [[FREE, UNKNOWN, OCCUPIED]]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "image"),
        ("image: [1", "YAML"),
        ("[" * 20_000, "YAML"),
        (YAML.replace("0.05", "0"), "resolution"),
        (YAML.replace("0.05", ".nan"), "resolution"),
        (YAML.replace(", 0.3", ""), "origin"),
        (YAML.replace("trinary", "raw"), "mode"),
        (YAML.replace("negate: 0", "negate: '0'"), "negate"),
        (YAML.replace("map.pgm", "/dev/zero"), "/dev/zero"),
        (YAML.replace("map.pgm", "map.yaml"), "map.yaml"),
        (YAML.replace("image: map.pgm\n", ""), "image"),
    ],
)
def test_other_files_are_refused_in_a_line(tmp_path: Path, text: str, named: str) -> None:
    path = write_map(tmp_path, np.zeros((2, 2), np.int8), text)
    with pytest.raises(InputError, match=named) as refused:
        read_map(path)
    assert "\n" not in str(refused.value)


@pytest.fixture(scope="module")
def table(seen: Seen) -> SensorFrame:
    """A frame that shows nothing of the floor."""
    frame = sensor_frame(seen)
    T = seen.camera.T_world_camera
    high = np.flatnonzero((frame.points_m @ T[:3, :3].T)[:, 2] + T[2, 3] > 0.3)
    assert frame.on_target is not None
    on_target = frame.on_target[high]
    return replace(frame, points_m=frame.points_m[high], rgb=frame.rgb[high], on_target=on_target, image=None)


def mapped(state: int, around: SensorFrame) -> OccupancyMap:
    """A square of 12 m in one state."""
    T = around.T_world_camera
    assert T is not None
    return OccupancyMap("map", np.full((240, 240), state, np.int8), 0.05, (T[0, 3] - 6, T[1, 3] - 6, 0.0))


def of(scorer: ModelScorer, frame: SensorFrame, *maps: OccupancyMap, **more: object) -> Prediction:
    robot = RobotSize(1.2, 0.7, 0.9)
    known = KnownFloor(maps, **more)  # type: ignore[arg-type]
    return predict(scorer, [frame], robot, known=known, grid=9)


def count(answer: Prediction) -> dict[str, int]:
    return {state: len(answer.rows(state)) for state in STATES}


def test_a_map_decides_what_is_free(table: SensorFrame, scorer: ModelScorer) -> None:
    bare, free, occupied, unknown = (
        count(of(scorer, table, *maps))
        for maps in ([], *([mapped(state, table)] for state in (FREE, OCCUPIED, UNKNOWN)))
    )
    assert bare["clear"] == 0 and unknown == bare
    assert free["clear"] > 20 and free["unseen"] == 0
    # What the camera saw above the floor stays in the way.
    assert free["blocked"] == bare["blocked"] > 0
    assert occupied["blocked"] == 81


def test_a_way_over_known_floor_must_lead_there(table: SensorFrame, scorer: ModelScorer) -> None:
    free = of(scorer, table, mapped(FREE, table))
    clear, camera = free.rows("clear"), free.grounds[0].T_world_camera[:2, 3]
    far = clear[np.linalg.norm(free.base_xy_m[clear] - camera, axis=1) > 1.05]
    walled = mapped(FREE, table)
    x, y = np.moveaxis(np.stack(np.meshgrid(*[np.arange(240)] * 2)) * 0.05 + 0.025, 0, 0)
    xy = np.stack([x, y], axis=-1) + walled.origin[:2]
    away = xy - camera
    ring = (np.linalg.norm(away, axis=-1) > 0.6) & (np.linalg.norm(away, axis=-1) < 0.75)
    cells = np.where(ring, np.int8(OCCUPIED), walled.cells)
    closed = of(scorer, table, replace(walled, cells=cells))
    assert len(far) and (closed.cells.state[far] == STATES.index("unreachable")).all()


def test_no_base_stands_where_it_shall_keep_out(table: SensorFrame, scorer: ModelScorer) -> None:
    free = of(scorer, table, mapped(FREE, table))
    assert free.best is not None
    zone = mapped(FREE, table)
    column, row = np.floor((free.base_xy_m[free.best] - zone.origin[:2]) / 0.05).astype(int)
    zone.cells[row, column] = OCCUPIED
    kept = of(scorer, table, mapped(FREE, table), keep_out=(zone,))
    assert kept.cells.state[free.best] == STATES.index("blocked")
    # A zone tells nothing of free floor.
    assert count(of(scorer, table, keep_out=(zone,)))["clear"] == 0


def test_a_map_needs_frames_with_poses(table: SensorFrame, scorer: ModelScorer) -> None:
    with pytest.raises(InputError, match="without a pose"):
        of(scorer, replace(table, T_world_camera=None), mapped(FREE, table))


@given(st.sampled_from([0.05, 0.03, 0.025, 0.02, 0.01]), st.integers(0, 2**32 - 1))
def test_a_lone_occupied_cell_under_a_base_blocks_it(resolution_m: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    origin = (*rng.uniform(-0.6, -0.5, 2), float(rng.uniform(-0.2, 0.2)))
    cells = np.full((round(2 / resolution_m),) * 2, FREE, np.int8)
    leg = OccupancyMap("legs", cells, resolution_m, origin)
    middle = tuple(np.floor(_local(leg, np.zeros(2)) / resolution_m).astype(int))
    cells[middle[::-1]] = OCCUPIED
    free, occupied = KnownFloor((leg,)).points(np.full(2, -0.4), np.full(2, 0.4))
    base, around = Footprint(0.25), np.insert(occupied, 2, 0.0, axis=1).astype(np.float32)
    assert crowded_bases(around, np.zeros((1, 2)), np.zeros(1), base).all()
    assert len(free) > 100 * len(occupied)


def _local(of: OccupancyMap, xy: np.ndarray) -> np.ndarray:
    (x, y, turn), c, s = of.origin, np.cos(of.origin[2]), np.sin(of.origin[2])
    return np.array([[c, s], [-s, c]]) @ (xy - [x, y]) if turn else xy - [x, y]
