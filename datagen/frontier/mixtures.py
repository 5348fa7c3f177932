"""The models that a frontier trains: label sources one after the other, each on a share of its houses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

from datagen.train.training.options import STAGES, Options

# In ascending fidelity, the order in which a model is trained on them.
FIDELITY = ("heuristic", "plan", "sim")
CHEAP = "heuristic"
# Small and fast: half the width of `datagen train`'s default, and half the tokens.
MODEL_CONFIG = {"width": 32, "embedding": 64, "tokens": (8, 16, 16)}
# Epochs show this number of labels in all, within bounds: a small set would have few steps otherwise, a large
# one few epochs, and the curve would measure these. 100,020 plan labels gave 1.1 points of balanced accuracy
# more in 6 epochs than in 3.
_LABELS_SHOWN, _LEAST_EPOCHS, _MOST_EPOCHS = 200_000, 6, 40


@dataclass(frozen=True)
class Stage:
    """Training on the first `share` of a source's houses."""

    source: str
    share: float


@dataclass(frozen=True)
class Mixture:
    """Stages in the order of training."""

    stages: tuple[Stage, ...]

    @property
    def before(self) -> Mixture | None:
        """The mixture whose model the last stage begins from."""
        return Mixture(self.stages[:-1]) if len(self.stages) > 1 else None

    @property
    def name(self) -> str:
        """For example "plan" or "25% heuristic, plan"; the share of the last stage is not in it."""
        first = [s.source if s.share == 1 else f"{s.share:.0%} {s.source}" for s in self.stages[:-1]]
        return ", ".join([*first, self.stages[-1].source])


def mixtures_of(sources: Sequence[str], shares: Sequence[float]) -> list[Mixture]:
    """Every source alone, and every source after a cheaper one, at each share of the last one's houses.

    A quarter (or the next larger share) of the cheaper source is tried too, at the ends of the curve: how
    much its labels count follows from that.
    """
    ordered = [source for source in FIDELITY if source in sources]
    found = [Mixture((Stage(source, share),)) for source in ordered for share in shares]
    whole, part = shares[-1], next(share for share in shares if share >= min(0.25, shares[-1]))
    for cheaper, dearer in combinations(ordered, 2):
        found += [Mixture((Stage(cheaper, whole), Stage(dearer, share))) for share in shares]
        if part != whole:
            ends = dict.fromkeys((shares[0], whole))
            found += [Mixture((Stage(cheaper, part), Stage(dearer, share))) for share in ends]
    return found


def options_of(mixture: Mixture, n_labels: int, seed: int, batch_scenes: int) -> Options:
    """Options of `datagen train` for the last stage, with epochs by the number of labels."""
    if mixture.stages[-1].source == CHEAP:
        name = "stage1"
    else:
        name = "stage2" if mixture.before else "sim-only"
    stage = STAGES[name]
    return Options(
        stage=name,
        model="shared",
        model_config=MODEL_CONFIG,
        epochs=min(_MOST_EPOCHS, max(_LEAST_EPOCHS, -(-_LABELS_SHOWN // n_labels))),
        batch_scenes=batch_scenes,
        lr=stage.lr,
        weight_decay=stage.weight_decay,
        seed=seed,
    )
