import dataclasses

import pytest
import torch
from kornia.feature import DescriptorMatcher, LocalFeatureMatcher, SIFTFeature, get_laf_center, match_smnn
from kornia.filters import gaussian_blur2d

from kcal.errors import InputError
from kcal.pipeline.pairing import ObjectViews, matched_pixels


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
