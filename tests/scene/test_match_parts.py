"""What is kept of matches, shifts by whole pixels and patches, against values worked out by hand."""

import math

import pytest
import torch
from torch import Tensor

from kcal import Camera, Rig
from kcal.corners.patches import object_planes, plane_pixels
from kcal.scene import match, refine
from kcal.scene.match import ImagePair, MatchedPair, PairCounts
from kcal.scene.refine import HALF, SWAY, RefinedMatches, Stillness, _patch, refine_matches, still_there, whole_shifts
from tests.helpers.scene_pairs import small_rig

RIG = small_rig()


def found(left: list[list[float]], variance: list[float]) -> MatchedPair:
    """Matches with variances of the right pixel along both axes."""
    pixels = torch.tensor(left).double()
    counts = PairCounts(name="pair", matched=9, untextured=1, off_line=1, moved=0, thinned=0, used=len(left))
    covariance = torch.tensor(variance).double()[:, None, None] * torch.eye(2).double()
    share = torch.arange(len(left)).double()
    return MatchedPair(torch.stack([pixels, pixels - 5.0], 1), covariance, share, counts, RIG)


def test_the_best_of_each_cell_come_first() -> None:
    """Cells of 10 x 10 px: the best of all cells before the second best of any, and among these the better ones."""
    places = [[5, 5], [6, 6], [7, 7], [9.9, 9.9], [10, 5], [15, 5], [5, 15], [315, 175]]
    variance = [4.0, 1.0, 3.0, 2.0, 9.0, 8.0, 7.0, 10.0]
    # First of each cell: 1 (1), 5 (8), 6 (7), 7 (10); second: 3 (2), 4 (9); third: 2 (3); fourth: 0 (4).
    order = [1, 6, 5, 7, 3, 4, 2, 0]
    for most in range(1, 9):
        kept = match._thinned(found(places, variance), (320, 180), most)
        assert kept.share.tolist() == sorted(order[:most])
        assert (kept.counts.thinned, kept.counts.used) == (8 - most, most)
        assert kept.pixels[:, 0].tolist() == [pytest.approx(places[i]) for i in sorted(order[:most])]
    assert match._thinned(found(places, variance), (320, 180), 20).counts.thinned == 0
    # Half a pixel beyond the edges belongs to the outer cells.
    outside = match._thinned(
        found([[-0.4, 5], [5, -0.4], [320.4, 175], [315, 180.4]], [1.0, 2.0, 3.0, 4.0]), (320, 180), 2
    )
    assert outside.share.tolist() == [0.0, 2.0]


def test_counted_features() -> None:
    """Names, half of the covariance for each pixel, no range; a limit of all pairs together is shared."""
    one, two = found([[5, 5], [100, 100]], [1.0, 2.0]), found([[200, 100], [300, 20], [60, 150]], [3.0, 1.0, 2.0])
    two = two._replace(counts=PairCounts(name="later", matched=9, untextured=0, off_line=0, moved=0, thinned=0, used=3))
    every = match.counted([one, two], (320, 180), 5)
    assert every.features.names == ("pair 0", "pair 1", "later 0", "later 1", "later 2")
    assert every.features.pixels.shape == (5, 2, 2)
    assert every.features.inverse_range.tolist() == [0.0] * 5
    assert every.features.inverse_range_sigma.tolist() == [math.inf] * 5
    assert every.features.covariance[:, 0].tolist() == every.features.covariance[:, 1].tolist()
    assert every.features.covariance[:, 1, 0, 0] == pytest.approx([0.5, 1.0, 1.5, 0.5, 1.0])
    # Three of two pairs: two of each.
    few = match.counted([one, two], (320, 180), 3)
    assert few.features.names == ("pair 0", "pair 1", "later 0", "later 1")
    assert [one.used for one in few.counts] == [2, 2]


def test_which_other_pairs_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first and the last of the others; still in one of them and elsewhere in none."""
    stays, gone, elsewhere = map(int, (Stillness.STILL, Stillness.NOT_THERE, Stillness.ELSEWHERE))
    says = {
        0: [stays, stays, gone, stays, gone, elsewhere],
        1: [elsewhere] * 6,
        2: [stays, gone, stays, elsewhere, gone, gone],
    }
    asked = []

    def verdict(_rig: object, image: Tensor, others: tuple[Tensor, Tensor], *_: Tensor) -> Tensor:
        asked.append((float(image[0, 0]), float(others[0][0, 0]), float(others[1][0, 0])))
        return torch.tensor(says[int(others[0][0, 0])])

    monkeypatch.setattr(match, "still_there", verdict)
    own = found([[k, k] for k in range(6)], [1.0] * 6)
    level = torch.ones(2, 2).numpy()
    pairs = [ImagePair(str(k), k * level, (k + 10) * level) for k in range(4)]
    kept = match._still(pairs, [own] * 4, 3)
    assert asked == [(3.0, 0.0, 10.0), (3.0, 2.0, 12.0)]
    assert kept.share.tolist() == [0.0, 1.0, 2.0]
    assert (kept.counts.moved, kept.counts.used) == (3, 3)
    asked.clear()
    assert match._still(pairs[:2], [own] * 2, 1).share.tolist() == [0.0, 1.0, 3.0]
    assert asked == [(1.0, 0.0, 10.0)]
    # One pair alone has nothing to be compared with.
    assert match.still_matches(pairs[:1], [own])[0] is own
    assert len(match.still_matches(pairs[:3], [own] * 3)) == 3


def noise(height: int = 120, width: int = 160) -> Tensor:
    return 255.0 * torch.rand(height, width, generator=torch.Generator().manual_seed(1))


def test_whole_shifts() -> None:
    """A picture that moved right by three and up by two; not farther than masts sway."""
    before = noise()
    here = torch.tensor([[60.0, 50.0], [100.0, 70.0]]).double()
    for move in ((3, -2), (-SWAY, SWAY), (SWAY, 0)):
        after = torch.roll(before, (move[1], move[0]), (0, 1))
        moved, score = whole_shifts(before, after, here, here)
        assert moved.tolist() == [list(map(float, move))] * 2
        assert score == pytest.approx([1.0, 1.0], abs=1e-6)
        # Looked for elsewhere.
        moved, _ = whole_shifts(before, after, here, here + torch.tensor([1.0, 2.0]))
        if move == (3, -2):
            assert moved.tolist() == [[2.0, -4.0]] * 2
    after = torch.roll(before, SWAY + 1, 1)
    assert float(whole_shifts(before, after, here, here)[1].max()) < 0.9
    assert float(whole_shifts(before, after, here, here, sway=SWAY + 1)[1].min()) > 0.99
    # As the brightness changes, nothing else does; and more than a thousand are compared in parts.
    many = here.repeat(501, 1)
    moved, score = whole_shifts(before, 0.3 * torch.roll(before, 1, 1) + 20.0, many, many, sway=1)
    assert moved.tolist() == [[1.0, 0.0]] * 1002
    assert score == pytest.approx([1.0] * 1002, abs=1e-6)


def test_patches_are_those_of_the_lens() -> None:
    """Nine places and a parabola against the projection of all; slopes against differences."""
    left = torch.tensor([[300.0, 200.0], [60.0, 40.0]]).double()
    planes = object_planes(RIG, left, RIG(80.0 * RIG.left.unproject(left)[0])[0][:, 1], torch.zeros(2).double())
    for camera, middle, turn in (
        (RIG.left, planes.left, None),
        (RIG.right, planes.right, RIG.right_from_left_rotation),
    ):
        pixels, slopes, seen = _patch(camera, planes, middle, turn)
        assert seen.tolist() == [True, True]
        assert pixels.shape == (2, 2 * HALF + 1, 2 * HALF + 1, 2)

        def at(x: float, y: float) -> Tensor:
            step = planes.step[:, None] * torch.tensor([x, y]).double()
            return plane_pixels(camera, planes, (middle + step)[:, None], turn)[0][:, 0]  # noqa: B023

        for i in (-HALF, -4, 0, 3, HALF):
            for j in (-HALF, 0, 5):
                assert pixels[:, j + HALF, i + HALF] == pytest.approx(at(i, j), abs=2e-3)
                across, down = at(i + 0.5, j) - at(i - 0.5, j), at(i, j + 0.5) - at(i, j - 0.5)
                assert slopes[:, j + HALF, i + HALF, :, 0] == pytest.approx(across, abs=2e-3)
                assert slopes[:, j + HALF, i + HALF, :, 1] == pytest.approx(down, abs=2e-3)


def test_still_is_what_lies_between_both_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against the median of all: within five sigmas of both times and .15 px along both axes."""
    count = 9
    left = torch.tensor([[100.0 + 20.0 * k, 90.0] for k in range(count)]).double()
    pixels = torch.stack([left, left - 30.0], 1)
    sway = torch.tensor([2.0, -1.0]).double()
    # By 5 sqrt(.03² + .04²) + .15 = .4 px at most.
    off = torch.zeros(count, 2).double()
    off[1], off[2] = torch.tensor([0.39, -0.39]), torch.tensor([0.0, 0.41])
    off[3], off[4] = torch.tensor([-0.41, 0.0]), torch.tensor([7.0, 0.0])
    good = torch.ones(count, dtype=torch.bool)
    good[4] = False
    scores = torch.full((count,), 0.9).double()
    scores[5], scores[6] = 0.6, 0.61

    def shifts(before: Tensor, after: Tensor, here: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
        assert (float(before), float(after)) == (1.0, 2.0)
        assert here.tolist() == there.tolist() == left.tolist()
        return sway.expand(count, 2), scores

    def refined(_rig: object, images: tuple[Tensor, Tensor], first: Tensor, second: Tensor) -> RefinedMatches:
        assert [float(image) for image in images] == [2.0, 3.0]
        there = scores > 0.6
        assert first.tolist() == (left + sway)[there].tolist()
        assert second.tolist() == (pixels[:, 1] + sway)[there].tolist()
        both_turned = torch.tensor([1.5, 0.25]).double()
        covariance = (0.03**2 * torch.eye(2).double()).expand(len(first), 2, 2)
        return RefinedMatches(second + both_turned + off[there], covariance, good[there], torch.zeros(len(first)))

    monkeypatch.setattr(refine, "whole_shifts", shifts)
    monkeypatch.setattr(refine, "refine_matches", refined)
    covariance = (0.04**2 * torch.eye(2).double()).expand(count, 2, 2)
    images = [torch.tensor(float(k)) for k in (1, 2, 3)]
    verdicts = still_there(RIG, images[0], (images[1], images[2]), pixels, covariance)
    assert verdicts.tolist() == [0, 0, 2, 2, 1, 1, 0, 0, 0]
    # Without one that was found again, nothing is there; and where nothing is alike, nothing is looked for.
    good[:] = False
    assert still_there(RIG, images[0], (images[1], images[2]), pixels, covariance).tolist() == [1] * count
    scores[:] = 0.1
    assert still_there(RIG, images[0], (images[1], images[2]), pixels, covariance).tolist() == [1] * count


def test_refined_from_a_plane_at_a_known_range() -> None:
    """A textured plane far away through two equal pinholes side by side: the right image is the left one, moved."""
    camera = Camera.build(focal=(500, 500), center=(240, 160), size=(480, 320), model="pinhole")
    rig = Rig.pair(camera, camera, torch.eye(3).double(), torch.tensor([-1.0, 0.0, 0.0]).double())
    picture = torch.nn.functional.avg_pool2d(noise(320, 480)[None, None], 5, 1, 2)[0, 0]
    left = torch.tensor([[250.0, 150.0], [120.0, 200.0], [5.0, 100.0], [300.0, 12.0], [8.0, 100.0]]).double()
    truth = left + torch.tensor([-4.0, 0.0]).double()
    images = picture, torch.roll(picture, -4, 1)
    for start in ((0.0, 0.0), (0.8, -0.6), (-1.0, 0.5)):
        found = refine_matches(rig, images, left, truth + torch.tensor(start).double())
        # Of the patch at the edge 8 of 15 columns are there: less than .55.
        assert found.good.tolist() == [True, True, False, True, True]
        assert found.right[found.good] == pytest.approx(truth[found.good], abs=0.01)
        assert float(found.share[found.good].min()) > 0.65
    # Parts of a thousand at a time are the whole.
    many = refine_matches(rig, images, left[:2].repeat(501, 1), truth[:2].repeat(501, 1))
    assert many.right.shape == (1002, 2)
    assert many.right == pytest.approx(truth[:2].repeat(501, 1), abs=0.01)
    # Farther than three pixels from where it began is something else.
    away = refine_matches(rig, images, left[:2], truth[:2] + torch.tensor([[2.0, 0.0], [0.0, 3.5]]).double())
    assert not bool(away.good[1])
    # Noise that stays: the covariance tells it.
    draw = torch.Generator().manual_seed(3)
    noisy = (
        images[0] + 2.0 * torch.randn(picture.shape, generator=draw),
        images[1] + 2.0 * torch.randn(picture.shape, generator=draw),
    )
    some = torch.tensor([[60.0 + 24.0 * i, 40.0 + 24.0 * j] for i in range(14) for j in range(9)]).double()
    found = refine_matches(rig, noisy, some, some + torch.tensor([-4.0, 0.0]).double())
    assert bool(found.good.all())
    off = (found.right - some - torch.tensor([-4.0, 0.0])) / found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert off.square().mean(0).sqrt() == pytest.approx([1.0, 1.0], abs=0.25)
