"""Programs score as their models do, and other files are refused."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from datagen import released
from datagen.evaluation.benchmark import present_runs, read_benchmark, shipped_pack
from datagen.evaluation.runs import stream_of
from datagen.schemas.errors import InputError
from datagen.train.inputs import Array, Batch
from datagen.train.program_scorer import ProgramScorer, read_program
from datagen.train.scorers import ModelScorer
from datagen.train.training.checkpoints import load_model

PREDICT = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {names!r}:
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Blocked())
import datagen
from datagen import released
answer = datagen.predict(
    frame=[released.sample_frame()], map=[released.sample_frame() / released.MAP], base_height=0.7, reach=0.9,
)
print(answer.best, answer.score[answer.best])
"""
HEAVY = (
    "torch", "numba", "ray", "trimesh", "embreex", "sapien", "coal", "matplotlib", "plotly", "pandas",
    "zarr", "numcodecs", "obstore", "fastapi", "pyarrow", "cv2", "fontTools",
)  # fmt: skip


@pytest.mark.parametrize("scenes", [8, pytest.param(1000, marks=pytest.mark.slow)])
def test_the_released_program_scores_the_pack_as_its_model_does(scenes: int) -> None:
    runs = present_runs(str(shipped_pack()), read_benchmark(shipped_pack()))
    model = ModelScorer(load_model(released.released_checkpoint())[0], "model")
    program = ProgramScorer(released.released_program())
    seen = 0
    for path in runs.values():
        for batch in stream_of([path]).epoch(0):
            np.testing.assert_allclose(program.score(batch), model.score(batch), atol=1e-4)
            seen += len(batch.clouds)
            if seen >= scenes:
                return
            if scenes < 100:
                break
    assert seen > 90


def first_batch() -> Batch[Array]:
    runs = present_runs(str(shipped_pack()), read_benchmark(shipped_pack()))
    return next(iter(stream_of([next(iter(runs.values()))]).epoch(0)))


def test_only_clear_bases_are_scored_where_that_is_asked() -> None:
    batch = first_batch()
    clear = np.random.default_rng(0).random(len(batch)) < 0.5
    batch = replace(batch, extra={"base_is_clear": clear})
    full = ProgramScorer(released.released_program()).score(batch)
    score = ProgramScorer(released.released_program(), only_clear=True).score(batch)
    np.testing.assert_allclose(score, np.where(clear, full, 0.0), atol=1e-6)


def test_the_scores_of_equal_batches_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    batch, scorer = first_batch(), ProgramScorer(released.released_program())
    score = scorer.score(batch)
    score[0] = -1.0  # a caller's own
    turned = replace(batch.candidates, turn_rad=np.ones(len(batch), np.float32))
    monkeypatch.setattr(type(scorer), "_of_robot", lambda *_: 2.0)
    again = scorer.score(replace(batch, clouds=replace(batch.clouds)))
    assert again[0] >= 0 and (again[1:] == score[1:]).all() and again.max() <= 1
    assert (scorer.score(replace(batch, candidates=turned)) == 2.0).all()


def test_prediction_needs_neither_torch_nor_a_compiler() -> None:
    answers = {
        subprocess.run(
            [sys.executable, "-c", PREDICT.format(names=names)], check=True, capture_output=True, text=True
        ).stdout
        for names in ((), HEAVY)
    }
    assert len(answers) == 1 and "None" not in answers.pop()


@pytest.mark.parametrize(
    "document",
    [
        None,
        "{",
        "[]",
        json.dumps({"functions": {"f": {"inputs": [], "outputs": [], "steps": [["a", "system", [], {}]]}}}),
        json.dumps({"functions": {"f": {"inputs": [], "outputs": [], "steps": [["a"]]}}, "facts": {}}),
    ],
)
def test_other_files_are_refused(tmp_path: Path, document: str | None) -> None:
    path = tmp_path / "p.safetensors"
    save_file({"x": np.zeros(1)}, path, {} if document is None else {"program": document})
    with pytest.raises(InputError, match="is no program of a model"):
        read_program(path)
    path.write_bytes(b"no tensors")
    with pytest.raises(InputError, match="is no program of a model"):
        read_program(path)
