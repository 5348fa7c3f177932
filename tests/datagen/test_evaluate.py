"""`datagen evaluate` over real trials, with checkpoints of tiny models that learned nothing."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from datagen import cli
from datagen.evaluation_report.methods import open_models
from datagen.train.models import build_model
from datagen.train.training.checkpoints import Checkpoint, CheckpointHead, write_checkpoint
from tests.made_runs import make_run
from tests.sim_extra import needs_sim
from tests.small_runs import CONFIG, arrays_of, json_of

pytestmark = needs_sim

SIDE, SCENES = 5, 6
CELLS = SIDE * SIDE
GRID = f"[candidates]\ngrid_cells = {SIDE}\narm_reach_m = {{low = 0.9, high = 1.0}}\n"
FEW_GRASPS = "[arm.grasps]\nper_object = 40\nper_scene = 10\n"
TINY = {
    "n_points": 64, "tokens": [4, 4, 4], "scales_m": [0.1], "width": 4, "embedding": 8, "head": [8],
}  # fmt: skip
QUICK = ("--bootstrap", "50", "--baselines", "none")


@pytest.fixture(scope="module")
def grids(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Whole grids, planned and executed; sealed, to be read by other means too."""
    folder = tmp_path_factory.mktemp("grids")
    (folder / "grid.toml").write_text(CONFIG + GRID + FEW_GRASPS)
    where = ["--out", str(folder / "run"), "--config", str(folder / "grid.toml"), "--workers", "0"]
    n = str(SCENES * CELLS)
    assert cli.run(["submit", "sim", "--n", n, "--candidates-per-scene", "grid", *where]) == 0
    return folder / "run"


def checkpoint(path: Path, stage: str = "stage2", seed: int = 0, **said: Any) -> str:
    torch.manual_seed(seed)
    model = build_model("shared", TINY)
    plain: dict[str, Any] = {
        "options": {}, "data": (), "val_data": (), "house_ids": ("elsewhere",), "object_digests": (),
        "val_house_ids": (), "cost": {}, "versions": {}, "history": (),
    }  # fmt: skip
    head = CheckpointHead(model="shared", model_config=model.config, stage=stage, **{**plain, **said})
    write_checkpoint(path, Checkpoint(head, dict(model.state_dict())))
    return str(path)


class Page(HTMLParser):
    """The tags of a page, and the addresses that it asks for."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [v for k, v in attrs if k in ("src", "href", "xlink:href", "srcset") and v]


def test_tables_are_of_what_the_run_holds(
    grids: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = {"stage1": "a.pt", "sim-only": "b.pt", "stage2": "c.pt"}
    files = [checkpoint(tmp_path / f, stage, seed) for seed, (stage, f) in enumerate(names.items())]
    page = tmp_path / "page.html"
    report = json_of(capsys, ["evaluate", *files, str(grids), *QUICK, "--html", str(page)])
    stored = arrays_of(grids)
    label, clear = stored["label"] == 1, stored["base_is_clear"]
    (part,) = report["parts"]
    assert part["houses"] == "unseen" and report["seen_houses"] == []
    assert {m["name"]: m["regime"] for m in report["methods"]} == {
        "stage1": "stage1", "sim-only": "sim-only", "two-stage": "two-stage",
    }  # fmt: skip
    assert all(len(m["checkpoint"]["sha256"]) == 64 for m in report["methods"])
    counts = {name: (told["count"], told["positives"]) for name, told in part["sets"].items()}
    in_range = clear & (stored["mount_distance_m"] <= stored["arm_reach_m"])
    expected = {"in-range": in_range, "clear": clear, "grid": np.ones(len(label), np.bool_)}
    assert counts == {k: (int(rows.sum()), int(label[rows].sum())) for k, rows in expected.items()}
    # Every method is told where the base fits, and calls no other place good.
    rows = [
        r for r in part["sets"]["grid"]["breakdown"] if (r["by"], r["group"]) == ("outcome", "base_collision")
    ]
    assert [row["count"] for row in rows] == [int((~clear).sum())] and (~clear).any()
    assert all(told["accuracy"] == 1 for row in rows for told in row["methods"].values())
    regimes = [("two-stage", "sim-only"), ("sim-only", "stage1")]
    for told in (*part["sets"].values(), part["grids"]):
        assert list(dict.fromkeys((d["first"], d["second"]) for d in told["comparisons"])) == regimes
    with_good = {int(s) for s in stored["sample_scene_index"][label]}
    assert part["grids"]["scenes"] == SCENES
    assert part["grids"]["scenes_without_positive"] == SCENES - len(with_good)
    assert report["runs"][0]["parts"][0]["label_source"] == "sim"
    assert page.stat().st_size < 3_000_000
    _check_page(page.read_text(), n_sets=3)


def test_a_set_is_told_over_the_runs_that_hold_it(
    grids: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    near, file = tmp_path / "near", checkpoint(tmp_path / "c.pt")
    drawn = ["--candidates", "in-range", "--candidates-per-scene", "4", "--n", "8", "--seed", "2"]
    where = ["--out", str(near), "--config", str(grids.parent / "grid.toml"), "--workers", "0"]
    assert cli.run(["submit", "sim", *drawn, *where]) == 0
    (part,) = json_of(capsys, ["evaluate", file, str(near), str(grids), *QUICK])["parts"]
    stored = arrays_of(grids)
    clear = stored["base_is_clear"]
    in_range = clear & (stored["mount_distance_m"] <= stored["arm_reach_m"])
    told = {name: (said["runs"], said["count"], said["scenes"]) for name, said in part["sets"].items()}
    scenes = {name: len(set(stored["sample_scene_index"][rows])) for name, rows in
              (("in-range", in_range), ("clear", clear))}  # fmt: skip
    assert told == {
        "in-range": ([0, 1], int(in_range.sum()) + 8, scenes["in-range"] + 2),
        "clear": ([1], int(clear.sum()), scenes["clear"]),
        "grid": ([1], len(clear), SCENES),
    }
    assert cli.run(["evaluate", file, str(near), *QUICK, "--candidates", "clear"]) == 2
    assert "no run covers clear candidates, only in-range" in capsys.readouterr().err


def _check_page(text: str, n_sets: int) -> None:
    page = Page(text)
    # Each set has intervals and curves, and there is one picture of grids; nothing lies elsewhere.
    pictures = re.findall(r"<svg.*?</svg>", text, re.DOTALL)
    assert len(pictures) == 2 * n_sets + 1
    for picture in pictures:
        ET.fromstring(picture)
    assert not {"script", "link", "iframe", "img"} & set(page.tags)
    assert page.addresses and all(a.startswith(("#", "data:")) for a in page.addresses)
    assert '<html lang="en">' in text and 'name="viewport"' in text and "prefers-color-scheme: dark" in text
    assert "<title>Evaluation of base placement</title>" in text
    assert (
        text.count("<table") == text.count('<div class="scroll" tabindex="0"><table') > 0
    )  # scroll on phones
    for words in ("84.1", "94.7", "arXiv:2509.11594", "Table II:", "Table III:", "two-stage", "sha256"):
        assert words in text, words


def test_the_same_words_give_the_same_numbers_and_people_read_them(
    grids: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = checkpoint(tmp_path / "c.pt")
    words = ["evaluate", str(grids), file, *QUICK, "--candidates", "clear", "--seed", "3"]
    first, second = json_of(capsys, words), json_of(capsys, words)
    for report in (first, second):
        for method in report["methods"]:
            assert method.pop("seconds") > 0 and method.pop("seconds_per_600") > 0
    assert first == second
    assert list(first["parts"][0]["sets"]) == ["clear"]
    assert cli.run(words) == 0
    said = capsys.readouterr().out
    accuracy = first["parts"][0]["sets"]["clear"]["methods"]["two-stage"]["accuracy"]
    assert f"{100 * accuracy['value']:.1f} [{100 * accuracy['low']:.1f}, " in said
    for line in (
        "Table I:",
        "Table II:",
        "Table III:",
        "mAP",
        "accuracy by outcome",
        "Brier",
        "arXiv:2509.11594",
    ):
        assert line in said, line


def test_houses_that_were_trained_on_are_refused_or_told_apart(
    grids: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    houses, digests = arrays_of(grids)["house_id"], arrays_of(grids)["object_digest"]
    house, count = str(houses[0]), int((houses == houses[0]).sum())
    assert 0 < count < SCENES
    clean = checkpoint(tmp_path / "clean.pt", "stage1", 1)
    for k, field in enumerate(("house_ids", "val_house_ids")):
        leaky = checkpoint(tmp_path / f"{k}.pt", **{field: (house,)})
        assert cli.run(["evaluate", clean, leaky, str(grids), *QUICK]) == 2
        error = capsys.readouterr().err
        assert f"house_id: '{house}': two-stage ({leaky})" in error and "--allow-seen-houses" in error
    leaky = checkpoint(tmp_path / "leaky.pt", house_ids=(house,), object_digests=(str(digests[0, 0]),))
    words = ["evaluate", leaky, str(grids), *QUICK, "--candidates", "grid", "--allow-seen-houses"]
    report = json_of(capsys, words)
    assert [(part["houses"], part["scenes"]) for part in report["parts"]] == [
        ("unseen", SCENES - count), ("seen", count),
    ]  # fmt: skip
    assert report["seen_houses"] == [house]
    label = arrays_of(grids)["label"].reshape(SCENES, CELLS)
    for part, scenes in zip(report["parts"], (houses != house, houses == house), strict=True):
        if label[scenes].any():
            rows = part["sets"]["grid"]["breakdown"]
            known = sum(r["count"] for r in rows if (r["by"], r["group"]) == ("object trained on", "yes"))
            assert known == CELLS * int((digests[scenes, 0] == digests[0, 0]).sum())
        else:
            assert part["left_out"] == {"grid": part["left_out"]["grid"]} and part["grids"] is None


def test_baselines_stand_beside_models_and_are_fitted_in_other_houses_alone(
    grids: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["evaluate", str(grids), "--bootstrap", "20", "--candidates", "grid"]
    report = json_of(capsys, words)
    names = [method["name"] for method in report["methods"]]
    assert names == ["proximity", "threshold", "threshold-visibility", "analytic", "reachability"]
    assert set(report["left_out"]) == {"distance", "scalars"}
    assert all("--fit" in why for why in report["left_out"].values())
    stored = arrays_of(grids)
    feasible = stored["base_is_clear"] & (stored["mount_distance_m"] <= stored["arm_reach_m"])
    told = report["parts"][0]["sets"]["grid"]["methods"]
    right = (feasible == (stored["label"] == 1)).mean()
    assert told["threshold"]["accuracy"]["value"] == pytest.approx(right)
    assert report["methods"][0]["threshold"] is None and report["methods"][2]["note"]
    assert report["parts"][0]["sets"]["grid"]["comparisons"] == []  # without models there is nothing to ask
    assert cli.run([*words, "--fit", str(grids)]) == 2
    assert "is also in the training data" in capsys.readouterr().err
    rule = tmp_path / "rule.toml"
    rule.write_text("[heuristic]\nmu = 0.5\ntau = 0.4\n")
    chosen = ["--baselines", "distance", "--baselines", "analytic", "--heuristic", str(rule)]
    report = json_of(capsys, [*words, "--fit", str(grids), "--allow-seen-houses", *chosen])
    assert [part["houses"] for part in report["parts"]] == ["seen"]
    distance, analytic = report["methods"]
    rule.write_text(f"# run {report['runs'][0]['parts'][0]['spec_hash']}: sim\n[heuristic]\nmu = 0.5\n")
    assert cli.run([*words, "--baselines", "analytic", "--heuristic", str(rule)]) == 2
    assert "was fitted on the labels of" in capsys.readouterr().err
    assert distance["state"] and analytic["state"]["params"]["mu"] == 0.5 and analytic["threshold"] < 0.45


def test_models_of_one_regime_are_told_apart_by_number(tmp_path: Path) -> None:
    files = [checkpoint(tmp_path / f"{k}.pt", stage, k) for k, stage in enumerate(("stage2", "stage2", "x"))]
    assert [c.scorer.name for c in open_models(files)] == ["two-stage shared 1", "two-stage shared 2", "x"]


def test_what_cannot_be_evaluated_is_refused_in_one_line(
    grids: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, run = checkpoint(tmp_path / "c.pt"), str(grids)
    (tmp_path / "thesis.tex").write_text("text")
    odd = tmp_path / "odd.toml"
    odd.write_text('[heuristic]\nmu = "far"\n')
    heuristic = make_run(tmp_path / "heuristic").storage.url
    cases: list[tuple[list[str], list[str]]] = [
        ([file], ["PATH", "no run is given"]),
        ([file, str(tmp_path / "none")], ["none", "neither a checkpoint file nor a run folder"]),
        ([str(tmp_path / "thesis.tex"), run], ["thesis.tex", "not a datagen checkpoint"]),
        ([file, heuristic], ["label_source: is heuristic", "datagen submit sim"]),
        ([run, "--baselines", "none"], ["PATH", "no model or baseline given"]),
        ([file, file, run], ["the same checkpoint as"]),
        ([file, run, run], ["sample_id", "occurs twice"]),
        ([file, run, "--bootstrap", "0"], ["--bootstrap"]),
        ([file, run, "--seed", "-1"], ["--seed"]),
        ([file, run, "--baselines", "luck"], ["--baselines: luck: is not a baseline"]),
        ([file, run, "--baselines", "scalars"], ["--baselines: scalars", "--fit"]),
        ([file, run, "--fit", heuristic, "--baselines", "distance"], ["label_source: is heuristic"]),
        ([file, run, "--heuristic", str(tmp_path / "thesis.tex"), *QUICK], ["thesis.tex", "is not TOML"]),
        ([file, run, "--heuristic", str(odd), *QUICK], ["odd.toml: heuristic.mu", "given: far"]),
        ([file, run, "--threads", "0"], ["--threads"]),
        ([file, run, "--html", "page.pdf"], ["--html", "not a .html or .htm file"]),
        ([file, run, "--html", str(tmp_path / "no" / "page.html")], ["--html", "folder does not exist"]),
    ]
    for words, expected in cases:
        more = [] if "--baselines" in words else ["--baselines", "none"]
        assert cli.run(["evaluate", *words, *more]) == 2, words
        said = capsys.readouterr().err.strip().splitlines()[-1]
        assert said.startswith("error: ") and all(part in said for part in expected), (words, said)
