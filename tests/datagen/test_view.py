"""`datagen view`: the scenes that filters choose, in one file for Rerun."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from datagen import cli
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_scene
from tests.datagen.conftest import FEW_GRASPS, PAIRED
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import arrays_of

needs_rerun = pytest.mark.skipif(
    find_spec("rerun") is None, reason="the extra `rerun` is not installed: 500 MB"
)


@pytest.mark.skipif(find_spec("rerun") is not None, reason="Rerun is installed")
def test_without_rerun_one_line_names_the_extra(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused(["view", str(finished)], capsys, "rerun", "is not installed", "Install the extra rerun")


@needs_rerun
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_the_chosen_scenes_are_in_one_file(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from rerun.chunk import RrdReader

    names = [str(read_scene(Run.open(finished), k).record["object_name"][0]) for k in range(3)]
    out, words = tmp_path / "scenes.rrd", ["view", str(finished), "--out", str(tmp_path / "scenes.rrd")]
    for more, wanted in (
        ([], [0, 1, 2]),
        (["--place", "top"], [0, 1, 2]),
        (["--object", names[1][2:]], [k for k in range(3) if names[k] == names[1]]),
        (["--scene", "2"], [2]),
    ):
        capsys.readouterr()
        assert cli.run([*words, *more]) == 0
        assert [int(line.split()[0]) for line in capsys.readouterr().out.splitlines()[1:]] == wanted
        reader = RrdReader(str(out))
        stores = reader.recordings()
        assert len(stores) == len(wanted)
        for k, store in zip(wanted, stores, strict=True):
            batches = {c.entity_path: c.to_record_batch() for c in reader.stream(store=store)}
            assert "/cloud" in batches
            centre_m = read_scene(Run.open(finished), k).record["target_center_m"]
            ((shown_m,),) = batches["/focus"]["Transform3D:translation"].to_pylist()
            np.testing.assert_allclose(shown_m, centre_m, atol=1e-5)
        assert len(reader.blueprints()) == 1  # the viewer begins near the target
    refused([*words, "--place", "roof"], capsys, "--place: roof", "Choose one of: floor, inside")
    refused([*words, "--disagreement", "heuristic"], capsys, "--disagreement: heuristic", "beside its own")
    refused([*words, "--outcome", "success"], capsys, "--outcome: success", "the run has none")
    refused([*words, "--scene", "3"], capsys, "--scene: 3 is not in this run", "Give one from 0 to 2")
    refused([*words, "--object", "piano"], capsys, "no scene has all of these", "Give fewer filters")
    refused([*words[:-1], str(tmp_path / "scenes.png")], capsys, "is not a .rrd file")


@needs_rerun
@needs_sim
def test_scenes_are_chosen_by_what_their_labels_disagree_with(
    paired: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, slippery = tmp_path / "arm.toml", tmp_path / "slippery"
    slips = "[arm.trial]\nobject_friction = 0\nfinger_friction = 0\n"
    config.write_text(f"{FEW_GRASPS}{slips}[heuristic]\ntau = 0\n")
    source = ["--scenes-from", str(paired["heuristic"]), "--config", str(config), "--workers", "0"]
    assert cli.run(["submit", "sim", "--n", str(PAIRED), "--out", str(slippery), *source]) == 0
    planned, seen = arrays_of(paired["plan"])["label"], set[bool]()
    for run in (paired["sim"], slippery):
        labels = arrays_of(run)
        for other, values in (("heuristic", labels["heuristic_label"]), ("plan", planned)):
            words = ["view", str(run), "--out", str(tmp_path / "a.rrd"), "--disagreement", other]
            seen.add(differs := bool((values != labels["label"]).any()))
            if differs:
                assert cli.run(words) == 0
            else:
                refused(words, capsys, "no scene has all of these")
    assert seen == {False, True}
    words = ["view", str(paired["plan"]), "--out", str(tmp_path / "a.rrd"), "--disagreement", "plan"]
    refused(words, capsys, "--disagreement: plan", "the run has no labels of plan beside")
