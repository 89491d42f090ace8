"""Keypoints along epipolar lines against a search by hand, and matches refined from where they roughly are.

Limits of matches along epipolar lines on both sides: parallax, band, what is no match; which image is refused.
"""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from kcal import Camera, Rig
from kcal.corners.match import Keypoints
from kcal.corners.patches import ImageWindows
from kcal.errors import InputError
from kcal.scene import refine
from kcal.scene.match import BAND, ImagePair, _both_ways, guided_matches, match_scene, rough_rig
from kcal.scene.refine import refine_matches
from tests.helpers.scene_pairs import pair, small_rig, true_right

RIG = small_rig()
FOCAL = float(RIG.left.focal[0])


def descriptors(count: int, seed: int) -> Tensor:
    draw = torch.rand(count, 128, generator=torch.Generator().manual_seed(seed)) ** 4
    return torch.nn.functional.normalize(draw, dim=1)


def scene(count: int = 400) -> tuple[Keypoints, Keypoints]:
    """Keypoints of things at 4 to 600 m, with noise, others that have no partner, and gaps."""
    generator = torch.Generator().manual_seed(3)
    share = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    points = 4.0 * 150.0 ** share[:, :1] * torch.cat([share[:, 1:] - 0.5, torch.ones(count, 1)], 1)
    left, right = RIG(points)[0].unbind(-2)
    noise = torch.randn(2, count, 2, generator=generator, dtype=torch.float64)
    kinds = descriptors(count, 1)
    other = torch.nn.functional.normalize(kinds + 0.03 * torch.randn(kinds.shape, generator=generator).abs(), dim=1)
    # A third of the right ones are something else; some look like two things at once.
    other[::3] = descriptors(len(other[::3]), 2)
    other[1::30] = other[2::30][: len(other[1::30])]
    left, right = left + noise[0], right + noise[1]
    left[5], right[7] = math.nan, math.nan
    order = torch.randperm(count, generator=generator)
    return Keypoints(left, kinds), Keypoints(right[order], other[order])


def by_hand(points: tuple[Keypoints, Keypoints]) -> set[tuple[int, int]]:
    """Every left keypoint against every right one: near its epipolar line, not nearer than a third of a baseline."""
    turn, shift = RIG.right_from_left_rotation, RIG.right_from_left_translation
    axis = -(turn.T @ shift) / shift.norm()
    rays = [RIG.left.unproject(points[0].pixels), RIG.right.unproject(points[1].pixels)]
    first, second = rays[0][0], rays[1][0] @ turn
    normals = [torch.nn.functional.normalize(torch.linalg.cross(axis.expand_as(r), r), dim=1) for r in (first, second)]
    apart = torch.acos((normals[0] @ normals[1].T).clamp(-1, 1))
    along = [torch.acos(r @ axis) for r in (first, second)]
    parallax = along[1] - along[0][:, None]
    band = BAND / FOCAL
    near = (apart < band) & (parallax > -band) & (parallax < 1 / 3) & rays[0][1][:, None] & rays[1][1]
    score = torch.where(near, points[0].descriptors @ points[1].descriptors.T, -1.0)
    best = score.topk(2, dim=1)
    distance = (2.0 - 2.0 * best.values).clamp_min(0).sqrt()
    back = score.argmax(0)
    return {
        (i, int(best.indices[i, 0]))
        for i in range(len(score))
        if best.values[i, 0] > -0.5 and distance[i, 0] < 0.9 * distance[i, 1] and int(back[best.indices[i, 0]]) == i
    }


def test_matches_are_those_of_a_search_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    points = scene()
    wanted = by_hand(points)
    assert len(wanted) > 100
    for size in (1024, 37):
        monkeypatch.setattr("kcal.scene.match._AT_ONCE", size)
        found = {(int(i), int(j)) for i, j in guided_matches(RIG, points)}
        assert found == wanted
    none = Keypoints(torch.zeros(0, 2, dtype=torch.float64), torch.zeros(0, 128))
    assert guided_matches(RIG, (points[0], none)).shape == (0, 2)
    assert guided_matches(RIG, (none, points[1])).shape == (0, 2)


def test_the_pose_comes_from_keypoints_with_gaps() -> None:
    points = scene(600)
    found = rough_rig((RIG.left, RIG.right), points, "pair")
    turn = found.right_from_left_rotation @ RIG.right_from_left_rotation.T
    # A pixel of noise.
    assert math.degrees(math.acos(min(1.0, (float(turn.trace()) - 1) / 2))) < 0.5
    shift = torch.nn.functional.normalize(RIG.right_from_left_translation, dim=0)
    assert float(found.right_from_left_translation @ shift) > 0.99
    few = tuple(Keypoints(one.pixels[:25], one.descriptors[:25]) for one in points)
    with pytest.raises(InputError, match="pair: both images have only"):
        rough_rig((RIG.left, RIG.right), few, "pair")  # type: ignore[arg-type]


def grays() -> tuple[Tensor, Tensor]:
    one = pair(1)
    return torch.from_numpy(one.left).float(), torch.from_numpy(one.right).float()


class TestRefine:
    LEFT = torch.tensor([[300.0, 200.0], [345.0, 215.0], [280.0, 190.0]], dtype=torch.float64)

    def test_from_two_pixels_away(self) -> None:
        truth, _ = true_right(self.LEFT)
        found = refine_matches(RIG, grays(), self.LEFT, truth + torch.tensor([1.5, -0.8]))
        assert found.good.tolist() == [True] * 3
        off = found.right - truth
        assert float(off.abs().max()) < 0.25
        sigma = found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        assert bool(((off / sigma).abs() < 5.0).all())
        assert bool((sigma > 0.005).all())

    def test_what_is_no_match_is_not_good(self) -> None:
        """Too far away, at the edge of either image, without texture, without a ray: each alone."""
        truth, _ = true_right(self.LEFT)
        images = grays()
        assert not bool(refine_matches(RIG, images, self.LEFT, truth + torch.tensor([25.0, 0.0])).good.any())
        edge = torch.tensor([[-3.0, 160.0], [240.0, -3.0]], dtype=torch.float64)
        assert not bool(refine_matches(RIG, images, edge, true_right(edge)[0]).good.any())
        inside = self.LEFT[:1].expand(2, 2)
        assert not bool(
            refine_matches(RIG, images, inside, torch.tensor([[-3.0, 150.0], [479.0, 3.0]]).double()).good.any()
        )
        flat = torch.full_like(images[0], 90.0)
        assert not bool(refine_matches(RIG, (flat, flat), self.LEFT, truth).good.any())
        lost = self.LEFT.clone()
        lost[1] = math.nan
        assert refine_matches(RIG, images, lost, truth).good.tolist() == [True, False, True]
        lost = truth.clone()
        lost[0] = math.nan
        assert refine_matches(RIG, images, self.LEFT, lost).good.tolist() == [False, True, True]


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
