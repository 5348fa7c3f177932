"""From one noisy frame to a base pose: how often the arm finds a plan from there, as a table.

    python -m benchmarks.frame_to_pose RUN [--scenes 100] [--checkpoint CKPT] \
        [--houses procthor:DIR] [--objects ycb:DIR]

Scenes of a run of whole grids in which some clear cell is good. Each is rendered again as the camera of its
cloud saw it, with the noise of a stereo camera, depth in whole millimetres, and the true mask and pose.
`predict` answers from that frame alone, from it with floor out of sight allowed, from up to three frames of
which each further one looks where the answer before advises (`look_next`), then with floor out of sight
allowed where there is no answer, and with a map of the house:
"lidar" has what stands in a plane 0.2 m above the floor, "full" all that stands below the arm's mount; in
turn the answer's alternatives follow a bad pose. Plans are then made from the very pose, as many draws as the
run has. "answered": there was a best pose; "good": most draws found a plan, of all scenes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from datagen.console.options import Sources
from datagen.evaluation.arrival_outcomes import Arrived
from datagen.evaluation.runs import draws_of
from datagen.replaying import places_of
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.run_records import StageClock
from datagen.schemas.shard_reading import SceneRows, read_scenes
from datagen.schemas.specification import NoiseParams
from datagen.train.baselines.rules import Proximity, ReachShare
from datagen.train.prediction import KnownFloor, OccupancyMap, RobotSize, load_scorer, predict, read_footprint
from datagen.train.prediction.answer import Prediction
from datagen.train.prediction.frames import Pinhole, RgbdImage, SensorFrame, image_frame
from datagen.train.prediction.goals import alternatives
from datagen.train.prediction.pictures import draw_prediction
from datagen.train.scorers import Scorer
from datagen.workers.bases.clearance import STEP_M, HouseObstacles
from datagen.workers.geometry.planar import inside_polygon, signed_distances_to_convex
from datagen.workers.geometry.transforms import look_at
from datagen.workers.houses.house import House
from datagen.workers.labels.arm_labelling import arm_in_scene
from datagen.workers.labels.arrival_trial import try_arrival
from datagen.workers.occupancy_map import FREE, OCCUPIED, UNKNOWN
from datagen.workers.rendering import Camera
from datagen.workers.rendering.embree import render_rays
from datagen.workers.rendering.noise import add_noise
from datagen.workers.scenes.reconstruct import ReconstructedScene, reconstruct_candidates, reconstruct_scene
from datagen.workers.world import open_world

_RESOLUTION_M = 0.05
_LIDAR_M = 0.2
_SEED = 0
_ALONE, _ADVISED, _MAPPED = "1 frame alone", "3 up to three frames, as advised", "5 full map"
_AT_LAST = "3b the same, unseen allowed where none is good"
_IN_TURN, _TURNS = "6 full map, up to three poses in turn", 3


def main() -> None:
    """Ask, plan and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("--houses")
    parser.add_argument("--objects")
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--checkpoint")
    parser.add_argument("--pictures", type=Path, help="folder for the model's answers with a full map")
    options = parser.parse_args()
    run = Run.open(options.run)
    places = places_of(run, Sources(houses=options.houses, objects=options.objects))
    world = open_world(run.manifest.spec, *places)
    draws = draws_of(options.run, [run.manifest.spec]) or 1
    scorers: list[Scorer] = [load_scorer(options.checkpoint), ReachShare(), Proximity()]
    good: dict[tuple[str, str], list[bool | None]] = {}
    names = tuple(scorer.name for scorer in scorers)
    levels: dict[str, list[bool]] = {}
    asked = refused = 0
    for k, stored in enumerate(read_scenes(run, range(run.n // run.layout.candidates_per_scene))):
        clear = stored.samples["base_clearance_m"] > 0
        found = stored.samples["successes"][clear]
        if asked == options.scenes or not (2 * found > draws).any():
            continue
        asked += 1
        scene = reconstruct_scene(world, stored.record)
        try:
            frame, robot = _frame(scene, k), _robot(run, stored)
            predict(scorers[1], [frame], robot)
        except InputError:  # too little of the target has depth
            refused += 1
            continue
        answers = {
            (scorer.name, setting): predict(
                scorer, [frame], robot, known=known, allow_unseen=unseen, grid=_grid(scorer)
            )
            for setting, known, unseen in _settings(scene.house.house, robot)
            for scorer in scorers
        }
        for scorer in scorers:
            first = answers[scorer.name, _ALONE]
            answers[scorer.name, _ADVISED] = at_last = _advised(scorer, scene, first, robot, k)
            if at_last.best is None:
                at_last = predict(scorer, at_last.frames, robot, allow_unseen=True, grid=_grid(scorer))
            answers[scorer.name, _AT_LAST] = at_last
        arrived = {key: _arrived(answer, answer.best, stored) for key, answer in answers.items()}
        mapped = answers[names[0], _MAPPED]
        rows = () if mapped.best is None else (mapped.best, *alternatives(mapped))[:_TURNS]
        turns = [_arrived(mapped, row, stored) for row in rows]
        candidates, spec = reconstruct_candidates(stored.samples, scene), run.manifest.spec
        arms = [arm_in_scene(scene, candidates, 0, spec, StageClock(), draw) for draw in range(draws)]
        planned: dict[Arrived | None, bool | None] = {None: None}
        for at in dict.fromkeys(each for each in (*arrived.values(), *turns) if each is not None):
            offset = at.x_m, at.y_m, at.yaw_rad
            outcomes = [try_arrival(arm, candidates, at.candidate, offset, None, spec) for arm in arms]
            planned[at] = 2 * outcomes.count("success") > draws
        for key, at in arrived.items():
            good.setdefault(key, []).append(planned[at])
        one = any(planned[at] for at in turns) if turns else None
        good.setdefault((names[0], _IN_TURN), []).append(one)
        levels.setdefault(answers[names[0], _MAPPED].level, []).append(bool(good[names[0], _MAPPED][-1]))
        if options.pictures is not None:
            said = [good[name, _MAPPED][-1] for name in (names[0], names[-1])]
            own, nearest = ("none" if each is None else "good" if each else "bad" for each in said)
            file = options.pictures / f"scene{k}-{own}-nearest-{nearest}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            with file.open("wb") as drawn:
                draw_prediction(answers[names[0], _MAPPED], drawn)
    print(f"{asked} scenes, percent of them; frames of {refused} are refused. 95% by scene.\n")
    print("| floor | method | answered | good |\n| --- | --- | --- | --- |")
    for (name, setting), found in sorted(good.items(), key=lambda row: (row[0][1], names.index(row[0][0]))):
        found += [None] * refused
        answered = 100 * np.mean([each is not None for each in found])
        rate = np.array([bool(each) for each in found])
        drawn = np.random.default_rng(_SEED).choice(rate, (2000, len(rate))).mean(axis=1)
        low, high = 100 * np.quantile(drawn, (0.025, 0.975))
        print(f"| {setting} | {name} | {answered:.0f} | {100 * rate.mean():.1f} [{low:.0f}, {high:.0f}] |")
    told = ", ".join(f"{sum(found)} of {len(found)} {level}" for level, found in sorted(levels.items()))
    print(f"\nOf the model's answers with a full map these are good: {told}.")


def _frame(scene: ReconstructedScene, index: int, camera: Camera | None = None, view: int = 0) -> SensorFrame:
    exact = render_rays(scene.rays, scene.camera if camera is None else camera)
    seen = add_noise(exact, NoiseParams(enabled=True), np.random.default_rng([_SEED, index, view]))
    c = seen.camera
    depth_m = (np.round(1000 * seen.depth_m) / 1000).astype(np.float32)
    pinhole = Pinhole(c.fx_px, c.fy_px, c.cx_px - 0.5, c.cy_px - 0.5)
    mask = exact.body == 1 if camera is None else None  # where the first frame's target is, is known
    return image_frame(RgbdImage(seen.rgb, depth_m, pinhole, mask), c.T_world_camera, {})


def _grid(scorer: Scorer) -> int | None:
    """Rules have the fine grid everywhere, the model where few base poses of a coarse one are good."""
    return 51 if isinstance(scorer, ReachShare | Proximity) else None


def _advised(
    scorer: Scorer, scene: ReconstructedScene, answer: Prediction, robot: RobotSize, index: int
) -> Prediction:
    """The answer after up to two more frames of the same camera, turned as each answer advises."""
    eye = scene.camera.T_world_camera[:3, 3]
    for view in (1, 2):
        if answer.level == "good" or (look := answer.look_next) is None:
            break
        T = scene.camera.T_world_camera
        yaw, tilt = np.arctan2(T[1, 2], T[0, 2]) + look[0], look[1]
        ahead = np.array([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), -np.sin(tilt)])
        camera = replace(scene.camera, T_world_camera=look_at(eye, eye + ahead))
        frames = [*answer.frames, _frame(scene, index, camera, view)]
        answer = predict(scorer, frames, robot, grid=_grid(scorer))
    return answer


def _robot(run: Run, stored: SceneRows) -> RobotSize:
    spec, one = run.manifest.spec, {name: column[0] for name, column in stored.samples.items()}
    assert spec.arm is not None
    outline = spec.candidates.footprint_m
    return RobotSize(
        float(one["camera_height_m"]),
        float(one["base_height_m"]),
        float(one["arm_reach_m"]),
        None if outline is None else read_footprint(outline),
        0.0 if spec.candidates.yaw_rad is None else spec.candidates.yaw_rad.low,
        spec.arm.robot,
    )


def _settings(house: House, robot: RobotSize) -> Iterator[tuple[str, KnownFloor | None, bool]]:
    yield _ALONE, None, False
    yield "2 unseen allowed", None, True
    yield "4 lidar map", KnownFloor((house_map(house, _LIDAR_M, _LIDAR_M),)), False
    yield _MAPPED, KnownFloor((house_map(house, STEP_M, robot.base_height_m),)), False


def house_map(house: House, low_m: float, high_m: float) -> OccupancyMap:
    """The map of a house: occupied where something stands between two heights, free elsewhere in rooms."""
    obstacles = HouseObstacles(house).near(np.zeros((1, 2)), np.inf, np.inf)
    corners = np.concatenate(obstacles.floors_m)
    low, high = corners.min(axis=0) - 0.5, corners.max(axis=0) + 0.5
    size = np.ceil((high - low) / _RESOLUTION_M).astype(int)
    cells = np.full((size[1], size[0]), UNKNOWN, np.int8)
    stands = (obstacles.low_m <= high_m) & (obstacles.high_m >= low_m)
    for state, polygons in ((FREE, obstacles.floors_m), (OCCUPIED, obstacles.polygons_m[stands])):
        for polygon in polygons:
            first, last = (
                np.clip(np.floor((end - low) / _RESOLUTION_M).astype(int) + more, 0, size - 1)
                for end, more in ((polygon.min(axis=0), -1), (polygon.max(axis=0), 1))
            )
            column, row = np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(first, last, strict=True)))
            xy = low + _RESOLUTION_M * (np.stack([column, row], axis=-1).reshape(-1, 2) + 0.5)
            if state == FREE:
                inside = inside_polygon(xy, polygon)
            else:  # walls are thinner than cells
                inside = signed_distances_to_convex(xy, polygon[None])[:, 0] < _RESOLUTION_M / 2
            inside = inside.reshape(column.shape)
            cells[row[inside], column[inside]] = state
    origin = float(low[0]), float(low[1]), 0.0
    return OccupancyMap(house.house_id, cells, _RESOLUTION_M, origin)


def _arrived(answer: Prediction, row: int | None, stored: SceneRows) -> Arrived | None:
    """A pose of the answer as an arrival off the candidate next to it."""
    if row is None:
        return None
    xy, yaw = answer.base_xy_m[row], float(answer.yaw_rad[row])
    near = int(np.argmin(np.linalg.norm(stored.samples["base_xy_m"] - xy, axis=1)))
    goal = float(stored.samples["base_yaw_rad"][near])
    off, c, s = xy - stored.samples["base_xy_m"][near], np.cos(goal), np.sin(goal)
    turn = (yaw - goal + np.pi) % (2 * np.pi) - np.pi
    return Arrived(near, *(float(v) for v in (c * off[0] + s * off[1], c * off[1] - s * off[0], turn)))


if __name__ == "__main__":
    main()
