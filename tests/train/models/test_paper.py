"""The paper's model: what is grouped once a robot is what grouping cloud and candidate together gives."""

from __future__ import annotations

import torch

from datagen.train.models.crop import ball_query, crop_clouds, take_rows
from datagen.train.models.paper import CANDIDATE_POINTS, PaperModel
from tests.train.models.made_batches import drawn_tables, small_model


@torch.no_grad()
def test_groups_equal_those_of_the_cloud_followed_by_fifty_points():
    model = small_model("paper", neighbours=(12, 6))
    assert isinstance(model, PaperModel)
    clouds, candidates, robots = drawn_tables(7, candidates=12)
    clouds.n_points[1] = 15  # fewer than there are centroids
    groups = take_rows(model._group(crop_clouds(clouds, robots, 96)), candidates.robot_row)
    clump = torch.nn.functional.pad(candidates.base_xy_m, (0, 1))[:, None]
    centres, rows = model._first_groups(groups, clump)
    assert torch.equal(centres[:, :1], clump)
    points = torch.cat([groups.crop.points_m, clump.expand(-1, CANDIDATE_POINTS, -1)], dim=1)
    valid = torch.nn.functional.pad(groups.crop.valid, (0, CANDIDATE_POINTS), value=True)
    literal, found = ball_query(points, valid, centres, 0.2, 12)
    assert (found > 0).all()
    assert torch.equal(rows, literal.clamp(max=96))
    assert (rows[:, 1:] == 96).any() and (rows[:, 1:] < 96).any()

    wide, rows = model._second_groups(groups, clump, centres)
    assert torch.equal(wide, centres[:, : wide.shape[1]])
    full = robots.cloud_row[candidates.robot_row] == 0
    literal, _ = ball_query(centres, torch.ones_like(centres[..., 0], dtype=torch.bool), wide, 0.4, 6)
    places = torch.arange(len(centres))[:, None, None]
    # Rows that were filled up may repeat another one: groups are the same as sets of places.
    for ours, theirs in zip(centres[places, rows][full], centres[places, literal][full], strict=True):
        for a, b in zip(ours, theirs, strict=True):
            assert torch.equal(a.unique(dim=0), b.unique(dim=0))
