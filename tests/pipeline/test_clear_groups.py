"""Who saw what of a crowd, against the truth: sorted pencils of planes, trees of lines of sight, one-to-one marks."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kcal.locate.multi_localizer import MultiViewLocalizer
from kcal.pipeline.association import AssociationOptions
from kcal.pipeline.detections import Detections
from kcal.pipeline.epipolar_pencil import StationSights, meetings, separate_pairs
from kcal.pipeline.grouping import group_objects
from scripts.shared.station_scenes import drawn_errors, marks, ring

SIZE = (1920, 1080)


def lines(points: torch.Tensor, center: torch.Tensor, bending: float = 0.0, turned: float = 0.0) -> StationSights:
    """Of points (N, 3) from two places, the second one's turned upward by `turned` radians."""
    rays = []
    for c in range(2):
        away = points - center[c]
        away[:, 2] += bending * away.square().sum(-1)
        away[:, 2] += c * turned * away.norm(dim=-1)
        rays.append(torch.nn.functional.normalize(away, dim=-1))
    count = len(points)
    up = np.array([[0.0, 0.0, 1.0]] * 2)
    return StationSights(
        np.repeat([0, 1], count), torch.cat(rays).numpy(), np.full(2 * count, 1e-4), np.zeros(2), 0.0, center.numpy(),
        up, bending,
    )  # fmt: skip


@pytest.mark.parametrize("bending", [0.0, 1e-8])
def test_lines_of_sight_meet_where_the_thing_is(bending: float) -> None:
    """On all sides of the cameras, also where angles of the pencil pass a half turn; bent light is straightened."""
    g = torch.Generator().manual_seed(0)
    points = 20_000.0 * torch.randn(200, 3, generator=g).double()
    center = torch.tensor([[0.0, 0.0, 0.0], [4000.0, 3000.0, 100.0]]).double()
    seen, every = lines(points, center, bending), np.arange(200)
    found = meetings(seen, every, every + 200, 4.0, 1000.0)
    same = found.second - 200 == found.first
    # Those that are nearly on the line of both cameras cross too flat.
    assert same.sum() > 190
    apart = np.linalg.norm(found.point[same] - points.numpy()[found.first[same]], axis=1)
    # Straightened at the range of straight lines: what is left is of second order.
    assert (apart < 0.05 * found.sigma[same] + 1e-6).all()
    assert same.sum() < len(found.first) < 20 * len(points)
    # Lines of sight that pass by further than the gate do not meet.
    assert not len(meetings(lines(points[:1], center, bending, 0.01), every[:1], every[1:2], 4.0, 1000.0).first)


def test_no_base_no_meeting() -> None:
    seen, every = lines(torch.ones(3, 3).double(), torch.zeros(2, 3).double()), np.arange(3)
    assert not len(meetings(seen, every, every + 3, 4.0, 1000.0).first)
    assert not len(meetings(seen, every, every[:0], 4.0, 1000.0).first)


def test_pairs_of_cameras_share_none() -> None:
    axis = np.eye(3)[[0, 0, 1, 1, 2]]
    center = np.arange(15.0).reshape(5, 3)
    assert separate_pairs(center, axis, [0, 1, 2, 3, 4]) == [(0, 2), (1, 3)]
    assert separate_pairs(center, axis, [0, 1]) == [(0, 1)]
    # Cameras in one place see nothing from two sides.
    assert separate_pairs(0.0 * center, axis, [0, 1, 2]) == []


@pytest.mark.parametrize(("missed", "false"), [(0.0, 0), (0.15, 5)])
def test_a_crowd_is_grouped_as_it_is(missed: float, false: int) -> None:
    count, cameras = 100, 8
    rig, g = ring(cameras, 8000.0), torch.Generator().manual_seed(1)
    rig.root = rig.with_errors(position_m=0.5, attitude_deg=(0.004, 0.004, 0.01), refraction=0.05)
    points = (torch.rand(count, 3, generator=g).double() - 0.5) * torch.tensor([5e3, 5e3, 800.0])
    points[:, 2] += 700.0
    pixels = marks(rig, points, drawn_errors(rig.root, 1, g).expand(count, -1))
    pixels = pixels + torch.randn(pixels.shape, generator=g).double()
    seen: list[Detections | None] = []
    owners = []
    for c, camera in enumerate(rig.each):
        there = (camera.inside(pixels[:, c]) & (torch.rand(count, generator=g) >= missed)).nonzero()[:, 0]
        wrong = torch.rand(false, 2, generator=g).double() * torch.tensor([1000.0, 200.0]) + 430.0
        middle = torch.cat([pixels[there, c], wrong])
        seen.append(Detections.read(torch.cat([middle - 6, middle + 6], -1), size=SIZE, time=0.0, first_pixel=0.0))
        numbers = [*there.tolist(), *[-1] * false]
        assert seen[-1] is not None
        owners.append({tuple(p): number for p, number in zip(seen[-1].anchors().tolist(), numbers, strict=True)})
    found = group_objects(MultiViewLocalizer(rig), seen, AssociationOptions(box_sigma=1.0))
    right = wrong_ones = 0
    complete = set()
    for p, s, doubt in zip(found.pixels.tolist(), found.seen.tolist(), found.ambiguous.tolist(), strict=True):
        whose = {owners[c][tuple(p[c])] for c in range(cameras) if s[c]}
        if sum(s) > 1 and not doubt:
            good = len(whose) == 1 and -1 not in whose
            right, wrong_ones = right + good, wrong_ones + (not good)
            complete |= whose if good else set()
    # Leftovers of chance are in pairs of two, as ever.
    assert right >= 97
    assert wrong_ones <= 2 * false
    assert len(complete) == right
    # Each detection is in a row.
    for c in range(cameras):
        assert {tuple(p) for p in found.pixels[found.seen[:, c], c].tolist()} == set(owners[c])


def test_how_far_two_lines_pass() -> None:
    """Rays of σ 1 mrad from two stations pass 3 m apart at 800 and 1000 m: 9 / (.8² + 1²) variances."""
    ray = np.array([[0.0, 1.0, 0.0], [-0.6, 0.8, 0.003]])
    center = np.array([[0.0, 0.0, 0.0], [600.0, 0.0, 0.0]])
    lines = StationSights(
        np.array([0, 1]), ray, np.full(2, 1e-3), np.zeros(2), 0.0, center, np.array([[0.0, 0.0, 1.0]] * 2), 0.0
    )
    found = meetings(lines, np.array([0]), np.array([1]), 4.0, 100.0)
    assert found.squared.tolist() == pytest.approx([9.0 / 1.64], rel=0.01)
    # Nearer to the line that is known better there.
    assert found.point[0].tolist() == pytest.approx([0.0, 800.0, 3.0 * 0.64 / 1.64], abs=0.02)
    assert len(meetings(lines, np.array([0]), np.array([1]), 2.0, 100.0).first) == 0
