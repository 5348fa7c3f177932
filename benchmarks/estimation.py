"""Estimates from mixed labels against the truth of whole runs: bias, coverage and width of intervals.

    python -m benchmarks.estimation CHEAP --with DEAR [--scenes 400] [--dear 25 50 100] [--draws 400]

DEAR must have labelled every candidate of CHEAP. A draw is a population of scenes, drawn from the runs with
replacement, of which some keep their dear labels: whole scenes, or a few candidates of each, chosen as
`submit --select` does. The truth is the rate of all dear labels.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from datagen.estimation.mixed_labels import MixedLabels, read_mixed
from datagen.estimation.rates import Interval, Population, estimate_rate
from datagen.estimation.two_stage_sampling import draw_sample, in_proportion
from datagen.train.inputs import F64, I64, Bools

Chosen = tuple[Bools, F64]  # which of the N candidates, and the probability of each
Design = Callable[[Population, int, np.random.Generator], Chosen]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("cheap", nargs="+", metavar="CHEAP", help="runs of cheap labels")
    parser.add_argument(
        "--with", dest="dear", nargs="+", required=True, metavar="DEAR", help="runs of dear ones"
    )
    parser.add_argument("--scenes", type=int, default=400, help="scenes of a drawn population [400]")
    parser.add_argument("--dear", dest="sizes", type=int, nargs="+", default=[25, 50, 100], metavar="N",
                        help="scenes with dear labels [25 50 100]")  # fmt: skip
    parser.add_argument("--draws", type=int, default=400, help="populations drawn [400]")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    labels = read_mixed(options.cheap, options.dear)
    population = labels.population
    if not population.is_dear.all():
        raise SystemExit(f"{(~population.is_dear).sum():,} candidates of CHEAP have no label in DEAR")
    print(f"{len(population.label):,} candidates of {population.n_scenes} scenes, {options.draws} draws of "
          f"populations of {options.scenes} scenes")  # fmt: skip
    for design in DESIGNS:
        for size in options.sizes:
            print_draws(labels, design, size, options.scenes, options.draws, options.seed)


def print_draws(labels: MixedLabels, design: str, size: int, scenes: int, draws: int, seed: int) -> None:
    """One table: a row a candidate set."""
    rng = np.random.default_rng([seed, size])
    rows = rows_by_scene(labels.population)
    tallies = {name: Tally() for name in labels.sets}
    for _ in range(draws):
        drawn = resampled(labels, rows, rng.integers(0, labels.population.n_scenes, scenes))
        chosen, probability = DESIGNS[design](drawn.population, size, rng)
        population = replace(drawn.population, is_dear=chosen, probability=probability)
        fitted = replace(drawn, population=population).fitted()
        for name, tally in tallies.items():
            found = estimate_rate(fitted.population, drawn.member(name))
            if found is not None:
                tally.add(found.mixed, found.dear_alone)
    print(f"\n{design}: {size} of {scenes} scenes with dear labels")
    heads = ("95% holds", 12), ("alone", 9), ("half width", 12), ("alone", 9), ("worth", 8)
    print(f"{'':10}{'truth':>8}{'bias':>14}" + "".join(f"{head:>{width}}" for head, width in heads))
    for name, tally in tallies.items():
        truth = float(labels.population.label[labels.member(name) > 0].mean())
        print(f"{name:10}{100 * truth:7.1f}%{tally.line(truth)}")


@dataclass
class Tally:
    """Intervals of the draws, by all labels and by the dear ones alone."""

    intervals: list[tuple[Interval, Interval]] = field(default_factory=list)

    def add(self, mixed: Interval, alone: Interval) -> None:
        self.intervals.append((mixed, alone))

    def line(self, truth: float) -> str:
        """Bias with its standard error, coverage, mean half widths, and labels that one label is worth."""
        if not self.intervals:
            return "  too few scenes"
        held = np.array([[i.low <= truth <= i.high for i in both] for both in self.intervals]).mean(axis=0)
        widths = np.array([[i.half_width for i in both] for both in self.intervals]).mean(axis=0)
        rates = np.array([[i.rate for i in both] for both in self.intervals])
        bias, worth = rates[:, 0] - truth, rates[:, 1].var() / rates[:, 0].var()
        error = bias.std() / np.sqrt(len(bias))
        return (
            f"{100 * bias.mean():7.2f}±{100 * error:.2f}%{100 * held[0]:11.1f}%{100 * held[1]:8.1f}%"
            f"{100 * widths[0]:11.1f}%{100 * widths[1]:8.1f}%{worth:8.2f}"
        )


def rows_by_scene(population: Population) -> list[I64]:
    """The rows of each scene's candidates."""
    order = np.argsort(population.scene, kind="stable")
    return np.split(order, np.cumsum(np.bincount(population.scene))[:-1])


def resampled(labels: MixedLabels, rows: list[I64], scenes: I64) -> MixedLabels:
    """A population of these scenes, each counted as one of its own."""
    taken = np.concatenate([rows[scene] for scene in scenes])
    scene = np.repeat(np.arange(len(scenes)), [len(rows[scene]) for scene in scenes])
    whole = labels.population
    population = Population(
        n_scenes=len(scenes),
        scene=scene,
        cheap=whole.cheap[taken],
        is_dear=whole.is_dear[taken],
        label=whole.label[taken],
        probability=whole.probability[taken],
    )
    return replace(
        labels,
        population=population,
        is_clear=labels.is_clear[taken],
        numbers=labels.numbers[taken],
        robot=labels.robot[taken],
        sample_id=labels.sample_id[taken],
    )


def whole_scenes(population: Population, size: int, rng: np.random.Generator) -> Chosen:
    """All candidates of random scenes."""
    chosen = np.zeros(population.n_scenes, np.bool_)
    chosen[rng.choice(population.n_scenes, size, replace=False)] = True
    n = len(population.scene)
    return chosen[population.scene], np.full(n, size / population.n_scenes)


def selected_candidates(population: Population, size: int, rng: np.random.Generator) -> Chosen:
    """A quarter of the candidates of selected scenes: more where cheap labels differ, a fifth at random."""
    label = population.cheap[:, 0].reshape(population.n_scenes, -1)
    mean = label.mean(axis=1, keepdims=True)
    wanted = np.broadcast_to(0.05 + mean * (1 - mean), label.shape)
    each = max(1, label.shape[1] // 4)
    sample = draw_sample(in_proportion(wanted, size, each), size, each, 0.2, rng)
    chosen, probability = np.zeros(label.shape, np.bool_), np.ones(label.shape)
    at = sample.scene[:, None], sample.candidate
    chosen[at], probability[at] = True, sample.probability
    return chosen.ravel(), probability.ravel()


DESIGNS: dict[str, Design] = {"whole scenes": whole_scenes, "selected candidates": selected_candidates}


if __name__ == "__main__":
    main()
