import dataclasses
import math

import numpy as np
import pytest
import torch
from kornia.feature import DescriptorMatcher, LocalFeatureMatcher, SIFTFeature, get_laf_center, match_smnn
from kornia.filters import gaussian_blur2d
from torch import Tensor

from kcal import Localizer, Origin, Rig
from kcal.errors import InputError
from kcal.pipeline.pairing import ObjectViews, matched_pixels
from kcal.rig import planned_rig
from kcal.track import AssociationOptions, Detections, pair_objects
from scripts.shared.marking_scene import exposed, paint_plate, plate, true_box


def pairs(**changes: object) -> ObjectViews:
    given = {
        "left": torch.rand(3, 2),
        "right": torch.rand(3, 2),
        "covariance": torch.eye(4).expand(3, 4, 4),
        "time": torch.zeros(3, 2, dtype=torch.float64),
        "score": torch.ones(3),
        "category": ("ship", "buoy", "ship"),
        "track": (None, "7", None),
        "ambiguous": torch.zeros(3, dtype=torch.bool),
    }
    return ObjectViews.of_pairs(**(given | changes))  # type: ignore[arg-type]


def test_everything_becomes_float64() -> None:
    numbers = [value for value in vars(pairs()).values() if isinstance(value, torch.Tensor)]
    assert {value.dtype for value in numbers} == {torch.float64, torch.bool}


def test_no_objects() -> None:
    none = torch.zeros(0, 2, dtype=torch.float64)
    empty = ObjectViews.of_pairs(
        none, none, covariance=none.new_zeros(0, 4, 4), time=none, score=none[:, 0], category=()
    )
    assert len(empty) == 0
    assert dataclasses.replace(empty).left.shape == (0, 2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"left": torch.rand(2, 2)}, r"left: shape \(3, 2\)"),
        ({"left": torch.ones(3, 2, dtype=torch.int64)}, "floating point is needed"),
        ({"right": torch.full((3, 2), torch.nan)}, "right: 6 of 6 values are not finite"),
        ({"time": torch.zeros(3, 2)}, "time: float64 is needed"),
        ({"score": torch.ones(2)}, "score"),
        ({"track": (None,)}, "track: 3 names"),
        ({"ambiguous": torch.zeros(3)}, "ambiguous: bool"),
        ({"covariance": -torch.eye(4).expand(3, 4, 4)}, "3 of 3 are not symmetric or have a negative"),
        ({"covariance": torch.eye(4).index_put((torch.tensor(0), torch.tensor(1)), torch.tensor(0.5)).expand(3, 4, 4)},
         "3 of 3 are not symmetric"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        pairs(**changes)


def test_what_kornia_matched() -> None:
    """SIFT and mutual nearest neighbors, which need no weights; the right image is the left one, shifted."""
    noise = torch.rand(1, 1, 60, 80, generator=torch.Generator().manual_seed(3))
    image = gaussian_blur2d(noise.repeat_interleave(2, 2).repeat_interleave(2, 3), 7, (2.0, 2.0))
    matcher = LocalFeatureMatcher(SIFTFeature(60), DescriptorMatcher("smnn", 0.9))
    found = matcher({"image0": image, "image1": image.roll(-12, 3)})
    points = ObjectViews.from_matches(found, pixel_sigma=0.5, time=(1.0, 1.1))
    assert len(points) > 10
    shift = (points.left - points.right).median(0).values
    assert torch.allclose(shift, torch.tensor([12.0, 0.0], dtype=torch.float64), atol=0.2)
    assert points.covariance[0].diagonal().tolist() == [0.25] * 4
    assert points.time[0].tolist() == [1.0, 1.1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"confidence": None}, "confidence is missing"),
        ({"batch_indexes": torch.tensor([0, 1])}, "one pair of images"),
        ({"keypoints0": torch.ones(2, 3)}, "left: shape"),
    ],
)
def test_what_is_no_match_is_refused(change: dict, message: str) -> None:
    given = {"keypoints0": torch.ones(2, 2), "keypoints1": torch.ones(2, 2), "confidence": torch.ones(2)} | change
    with pytest.raises(InputError, match=message):
        ObjectViews.from_matches({key: value for key, value in given.items() if value is not None})


def test_batched_matches_of_kornia_reach_the_localizer() -> None:
    """Of a real matcher's dictionaries, and of descriptors; in the graph of the keypoints."""
    g = torch.Generator().manual_seed(0)
    image = torch.tensor([1, 0, 1, 1, 0])
    points = torch.rand(5, 2, generator=g).requires_grad_(True)
    found = matched_pixels(
        {"keypoints0": points, "keypoints1": points - 3, "confidence": torch.arange(5.0), "batch_indexes": image}, 3
    )
    assert found.mask.tolist() == [[True, True, False], [True] * 3, [False] * 3]
    assert found.score.tolist() == [[1, 4, 0], [0, 2, 3], [0, 0, 0]]
    assert torch.equal(found.left[1], points[[0, 2, 3]].double())
    assert torch.equal(found.right[found.mask], found.left[found.mask].float().sub(3).double())
    found.left.sum().backward()
    assert points.grad is not None
    assert bool((points.grad == 1).all())
    lafs = torch.rand(2, 1, 6, 2, 3, generator=g)
    _, numbers = match_smnn(torch.eye(6), torch.eye(6).flip(0), 0.9)
    found = matched_pixels({"lafs0": lafs[0], "lafs1": lafs[1], "idxs": numbers}, 1)
    assert torch.equal(found.left[0].float(), get_laf_center(lafs[0])[0, numbers[:, 0]])
    assert torch.equal(found.right[0].float(), get_laf_center(lafs[1])[0].flip(0)[numbers[:, 0]])
    with pytest.raises(InputError, match="batch has 1 pairs"):
        matched_pixels(
            {"keypoints0": points, "keypoints1": points, "confidence": points[:, 0], "batch_indexes": image}, 1
        )
    with pytest.raises(InputError, match="batch_indexes is missing"):
        matched_pixels({"keypoints0": points, "keypoints1": points, "confidence": points[:, 0]}, 1)


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
