"""Limits of matches along epipolar lines on both sides: parallax, band, what is no match; which image is refused."""

import numpy as np
import pytest
import torch
from torch import Tensor

from kcal import Camera, InputError, Rig
from kcal.corners.match import Keypoints
from kcal.corners.patches import ImageWindows
from kcal.scene import refine
from kcal.scene.match import ImagePair, _both_ways, guided_matches, match_scene
from tests.helpers.scene_pairs import small_rig

CAMERA = Camera.build(focal=(500, 500), center=(240, 160), size=(481, 321), model="pinhole")
LEVEL = Rig.pair(CAMERA, CAMERA, torch.eye(3).double(), torch.tensor([-2.0, 0.0, 0.0]).double())


def seen(pixels: list[list[float]]) -> Keypoints:
    """Keypoints of which no two look alike."""
    return Keypoints(torch.tensor(pixels).double(), torch.eye(len(pixels), 128))


@pytest.mark.parametrize(
    ("off", "found"),
    [
        # In pixels from the middle, f 500: at infinity; nearer by a third of a radian at most; behind, by the band.
        ((0.0, 0.0), True),
        ((-160.0, 0.0), True),
        ((-180.0, 0.0), False),
        ((2.9, 0.0), True),
        ((3.1, 0.0), False),
        ((0.0, 2.9), True),
        ((0.0, -2.9), True),
        ((0.0, 3.1), False),
        ((-50.0, -3.1), False),
    ],
)
def test_near_the_line_and_not_too_near(off: tuple[float, float], found: bool) -> None:
    left, right = seen([[240.0, 160.0]]), seen([[240.0 + off[0], 160.0 + off[1]]])
    assert guided_matches(LEVEL, (left, right)).tolist() == ([[0, 0]] if found else [])


def test_the_best_on_the_line_if_clearly_better() -> None:
    """Distances 2 sin(angle / 2) of unit descriptors: .9 of the second best is no match, less is."""

    def kind(angle: float) -> list[float]:
        return [float(np.cos(angle)), float(np.sin(angle))]

    for first, second, good in ((0.5, 0.6, True), (0.5, 0.55, False), (0.5, -0.5, False), (0.0, 0.0, False)):
        left = Keypoints(torch.tensor([[240.0, 160.0]]).double(), torch.tensor([kind(0.0)]))
        right = Keypoints(
            torch.tensor([[200.0, 160.0], [220.0, 160.5], [220.0, 170.0]]).double(),
            torch.tensor([kind(first), kind(second), kind(0.0)]),
        )
        assert guided_matches(LEVEL, (left, right)).tolist() == ([[0, 0]] if good else [])
        # The other way round, two look like it: only the one that looks more so keeps it.
        two = Keypoints(torch.tensor([[260.0, 160.2], [260.0, 160.0]]).double(), right.descriptors[[1, 0]])
        if first < abs(second):
            assert guided_matches(LEVEL, (two, left)).tolist() == [[1, 0]]
    # Unlike by more than 120 degrees is no match, were it alone.
    for angle, good in ((2.0, True), (2.2, False)):
        one = Keypoints(torch.tensor([[240.0, 160.0]]).double(), torch.tensor([kind(0.0)]))
        other = Keypoints(torch.tensor([[230.0, 160.0]]).double(), torch.tensor([kind(angle)]))
        assert (guided_matches(LEVEL, (one, other)).tolist() == [[0, 0]]) is good


def test_everything_with_everything_without_a_band() -> None:
    """Each left keypoint's partner is where a permutation put it; three that look like two things are left out."""
    draw = torch.Generator().manual_seed(2)
    kinds = torch.nn.functional.normalize(torch.rand(60, 128, generator=draw) ** 4, dim=1)
    order = torch.randperm(60, generator=draw)
    other = kinds[order].clone()
    other[:3] = other[3:6]
    nowhere = torch.zeros(60, 2).double()
    pairs = _both_ways((Keypoints(nowhere, kinds), Keypoints(nowhere, other)), None, 0.75)
    assert {(int(i), int(j)) for i, j in pairs} == {(int(order[j]), j) for j in range(6, 60)}


def test_a_patch_that_is_not_seen_is_no_match(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a plane, without a part of it in the left image, or in the right one: each alone."""
    picture = torch.nn.functional.avg_pool2d(
        255.0 * torch.rand(1, 1, 321, 481, generator=torch.Generator().manual_seed(1)), 5, 1, 2
    )[0, 0]
    left = torch.tensor([[150.0, 100.0], [220.0, 120.0], [300.0, 160.0], [350.0, 200.0]]).double()
    planes, patch = refine.object_planes, refine._patch

    def without_one(rig: Rig, *arguments: Tensor) -> refine.ObjectPlanes:
        made = planes(rig, *arguments)
        return made._replace(valid=made.valid & torch.tensor([False, True, True, True]))

    def without_parts(
        camera: Camera, made: refine.ObjectPlanes, middle: Tensor, turn: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        pixels, slopes, whole = patch(camera, made, middle, turn)
        whole = whole.clone()
        whole[1 if turn is None else 2] = False
        return pixels, slopes, whole

    images = picture, torch.roll(picture, -3, 1)
    right = left + torch.tensor([-3.0, 0.0]).double()
    assert refine.refine_matches(LEVEL, images, left, right).good.tolist() == [True] * 4
    monkeypatch.setattr(refine, "object_planes", without_one)
    monkeypatch.setattr(refine, "_patch", without_parts)
    assert refine.refine_matches(LEVEL, images, left, right).good.tolist() == [False, False, False, True]


def test_a_patch_that_runs_away_takes_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """All windows are as large as the largest; one that spans two thousand pixels would ask for gigabytes."""
    picture, patch = 255.0 * torch.rand(321, 481, generator=torch.Generator().manual_seed(1)), refine._patch
    left = torch.tensor([[150.0, 100.0], [220.0, 120.0], [300.0, 160.0]]).double()

    def away(camera: Camera, *others: object) -> tuple[Tensor, Tensor, Tensor]:
        pixels, slopes, whole = patch(camera, *others)  # type: ignore[arg-type]
        pixels[0, 0, 0] += 2000.0
        return pixels, slopes, whole

    widest = []
    windows = refine.image_windows

    def cut(image: Tensor, pixels: Tensor, *others: float) -> ImageWindows:
        widest.append(float((pixels.flatten(1, -2).amax(1) - pixels.flatten(1, -2).amin(1)).max()))
        return windows(image, pixels, *others)  # type: ignore[arg-type]

    monkeypatch.setattr(refine, "_patch", away)
    monkeypatch.setattr(refine, "image_windows", cut)
    images = picture, torch.roll(picture, -3, 1)
    found = refine.refine_matches(LEVEL, images, left, left - torch.tensor([3.0, 0.0]).double())
    assert not bool(found.good[0])
    assert max(widest) < 400.0


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_image_of_another_size_is_named(side: str) -> None:
    rig = small_rig()
    images = {"left": np.zeros((320, 480), np.uint8), "right": np.zeros((320, 480), np.uint8)}
    images[side] = np.zeros((160, 240), np.uint8)
    with pytest.raises(InputError, match=f"pair: the {side} image has 240x160 pixels, its camera 480x320"):
        match_scene((rig.left, rig.right), ImagePair("pair", images["left"], images["right"]))
