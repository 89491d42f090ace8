import math

import numpy as np
import pytest
import torch
from torch import Tensor

from kcal import InputError, Localizer, Origin, Rig
from kcal.rig import planned_rig
from kcal.track import AssociationOptions, Detections, pair_objects
from scripts.shared.object_scene import exposed, paint_plate, plate, true_box

SIZE = (1920, 1080)


class Site:
    """Four objects at known ranges, with boxes that err by 1.5 px."""

    def __init__(self, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self.rig: Rig = planned_rig()
        self.depths = torch.tensor([400.0, 900.0, 1800.0, 4000.0], dtype=torch.float64)
        columns, rows = torch.tensor([-0.2, -0.05, 0.1, 0.25]), torch.tensor([0.1, -0.1, 0.05, 0.0])
        self.points = self.depths[:, None] * torch.stack([columns, rows, torch.ones(4)], -1).double()
        images = [np.full(SIZE[::-1], 110.0) for _ in range(2)]
        items = [plate(point, (16.0, 14.0), 1600.0, 50.0, random) for point in self.points]
        boxes = [[true_box(self.rig, side, item) + random.normal(0, 1.5, 4) for item in items] for side in (0, 1)]
        for side in (0, 1):
            for item in items:
                paint_plate(images[side], self.rig, side, item)
        self.images: tuple[Tensor, Tensor] = tuple(exposed(image, 1.5, random) for image in images)  # type: ignore[assignment]
        self.left, self.right = (
            Detections.read(np.array(some), size=SIZE, first_pixel=0.0, time=time)
            for some, time in zip(boxes, (3.0, 3.04), strict=True)
        )


def test_from_boxes_to_ranges() -> None:
    site = Site()
    options = AssociationOptions(box_sigma=1.5)
    by_boxes = pair_objects(site.rig, site.left, site.right, options=options)
    matched = pair_objects(site.rig, site.left, site.right, site.images, options=options)
    assert matched.category == ("object",) * 4
    assert matched.time[0].tolist() == [3.0, 3.04]
    locate = Localizer(site.rig.placed(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0))
    truth = torch.linalg.vector_norm(site.points, dim=-1).reciprocal()
    sigmas = []
    for pairs in (by_boxes, matched):
        found = locate(pairs.left, pairs.right, pairs.covariance)
        sigmas.append(found.inverse_range_sigma)
        assert float(((found.inverse_range - truth) / found.inverse_range_sigma).abs().max()) < 3.5
    # Ranges gain what matching gains; the bearing keeps the error of the boxes.
    assert bool((sigmas[1] < 0.15 * sigmas[0]).all())
    sideways = locate(matched.left, matched.right, matched.covariance).covariance[:, 0, 0].sqrt()
    assert math.isclose(float(sideways[0]), 1.5 * 400.0 / 1600.0, rel_tol=0.15)


def test_bottom_anchors_are_the_same_distance_away() -> None:
    site = Site(1)
    pairs = pair_objects(site.rig, site.left, site.right, site.images, options=AssociationOptions(anchor="bottom"))
    assert torch.equal(pairs.left, site.left.anchors("bottom"))
    assert torch.allclose((pairs.left - pairs.right)[:, 0], 16000.0 / site.depths, atol=0.4)
    assert float((pairs.left - pairs.right)[:, 1].abs().max()) < 0.4


def test_what_is_refused_keeps_its_boxes() -> None:
    site = Site()
    flat = torch.full_like(site.images[0], 100.0)
    pairs = pair_objects(site.rig, site.left, site.right, (flat, flat), options=AssociationOptions(gate=20.0))
    assert torch.equal(pairs.right, site.right.anchors())
    assert torch.equal(pairs.covariance[0], 4.0 * torch.eye(4, dtype=torch.float64))


def test_one_time_only_is_refused() -> None:
    site = Site()
    with pytest.raises(InputError, match="one image has a time"):
        pair_objects(site.rig, site.left, Detections.read(site.right.boxes, size=SIZE))
