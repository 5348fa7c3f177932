"""The picture of a frontier can be read."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from datagen.frontier.figure import frontier_figure
from datagen.frontier.mixtures import Mixture, Stage
from datagen.frontier.points import METRICS, Point
from datagen.train.evaluation.bootstrap import Estimate


@pytest.mark.parametrize("dearest_cpu_h", [0.02, 0.7, 3.0, 40.0, 1e5])
def test_costs_are_plain_numbers_that_do_not_overlap(dearest_cpu_h: float) -> None:
    values = dict.fromkeys(METRICS, Estimate(0.8, np.array([0.78, 0.82])))
    points = [
        Point(Mixture((Stage("plan", share),)), 1, {"plan": 100.0}, cpu_h, 0.1, 1.0, values)
        for share, cpu_h in ((0.5, 0.012), (1.0, dearest_cpu_h))
    ]
    figure = frontier_figure(points, "USD")
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    for ax in figure.axes:
        low, high = ax.get_xlim()
        both = (*ax.xaxis.get_major_ticks(), *ax.xaxis.get_minor_ticks())
        texts = [tick.label1 for tick in both if low <= tick.get_loc() <= high and tick.label1.get_text()]
        assert all(float(text.get_text()) > 0 for text in texts)
        boxes = sorted((text.get_window_extent(renderer) for text in texts), key=lambda box: box.x0)
        assert boxes and all(a.x1 < b.x0 for a, b in pairwise(boxes))
