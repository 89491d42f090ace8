"""Lines of sight of several cameras: pencils, points, groups, and matches as exhaustive search finds them."""

import itertools
import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from kcal import Localizer
from kcal.pipeline.assignment import Candidates, Scores, assigned
from kcal.pipeline.epipolar_pencil import (
    FARTHEST_BEND_M,
    Confirming,
    StationSights,
    _FittedGroups,
    meetings,
    near_in_angle,
    separate_pairs,
)
from kcal.pipeline.grouping import _Edges, _with_one_range, group_objects
from kcal.pipeline.measurements import Anchored
from kcal.track import AssociationOptions, Detections
from scripts.shared.station_scenes import drawn_errors, marks, ring

# Lines of sight of several cameras: pencils, points, who is nearest and which groups hold, against plain NumPy.


SIGMA, PLACE, AIR = 1e-4, 0.2, 2e-10

UP = np.array([[0.0, 0.0, 1.0], [0.02, 0.0, 1.0], [0.0, 0.02, 1.0], [-0.02, 0.0, 1.0], [0.0, -0.02, 1.0]])

CENTER = np.array([[0.0, 0, 0], [5000.0, 0, 50], [5200.0, 4800, -20], [100.0, 5100, 30], [2500.0, -900, 10]])

POINTS = np.array([[2500.0, 2500, 600], [2300.0, 2600, 500], [2900.0, 2200, 700]])


def sights(bending: float = 0.0, turned: float = 0.0, seed: int = 0) -> StationSights:
    """Of all points from all five cameras, camera by camera; turned by so many sigmas."""
    random = np.random.default_rng(seed)
    rays = []
    for center, up in zip(CENTER, UP, strict=True):
        away = POINTS - center
        away = away + bending * (away**2).sum(1)[:, None] * up
        ray = away / np.linalg.norm(away, axis=1, keepdims=True)
        ray = ray + turned * SIGMA * random.normal(size=ray.shape)
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    camera = np.repeat(np.arange(5), len(POINTS))
    return StationSights(
        camera, np.concatenate(rays), np.full(len(camera), SIGMA), np.full(5, PLACE), AIR, CENTER, UP, bending
    )


def two_sights(ray: NDArray[np.float64], center: NDArray[np.float64], sigma: float) -> StationSights:
    """One line of sight of each of two cameras."""
    up = np.array([[0.0, 0.0, 1.0]] * 2)
    return StationSights(np.array([0, 1]), ray, np.full(2, sigma), np.zeros(2), 0.0, center, up, 0.0)


def confirming(lines: StationSights, gate: float = 4.0, near: float = 2.0, inner: float = -1.0) -> Confirming:
    axis = np.array([2500.0, 2500.0, 300.0]) - CENTER
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    kind = np.zeros(len(lines.camera), dtype=np.int64)
    return Confirming(lines, kind, axis, np.full(5, inner), [0, 1, 2, 3, 4], gate, near, 100.0)


def marks_of(*points: int) -> NDArray[np.int64]:
    """All five marks of points."""
    return np.array([[c * len(POINTS) + p for c in range(5)] for p in points])


def width(away: float) -> float:
    return math.sqrt((SIGMA * away) ** 2 + PLACE**2 + (AIR * away**2) ** 2)


def best_point(lines: StationSights, marks: NDArray[np.int64]) -> tuple[NDArray, NDArray, float]:
    """Nearest to straight lines of sight, weighted by the widths there; its covariance and chi-squared."""
    point = POINTS.mean(0)
    for _ in range(20):
        normal, right, chi2 = np.zeros((3, 3)), np.zeros(3), 0.0
        for c, mark in enumerate(marks):
            if mark >= 0:
                ray = lines.ray[mark]
                side = (np.eye(3) - np.outer(ray, ray)) / width(float(np.linalg.norm(point - CENTER[c]))) ** 2
                normal, right = normal + side, right + side @ CENTER[c]
                chi2 += (point - CENTER[c]) @ side @ (point - CENTER[c])
        point = np.linalg.solve(normal, right)
    return point, np.linalg.inv(normal), chi2


class TestPencils:
    @pytest.mark.parametrize("gate", [4.0, 40.0])
    @pytest.mark.parametrize("pair", [(0, 1), (1, 3)])
    def test_planes_within_the_noise(self, pair: tuple[int, int], gate: float) -> None:
        """By the angle between normals; noise counts for more, the nearer a line of sight is to the base."""
        random = np.random.default_rng(1)
        ray = random.normal(size=(400, 3))
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        camera = np.repeat(np.array(pair), 200)
        sigma = random.uniform(1e-4, 1e-2, 400)
        lines = StationSights(camera, ray, sigma, np.arange(5.0) + 0.5, 1e-9, CENTER, UP, 2e-8)
        rows, others = np.arange(200), np.arange(200, 400)
        found = set(zip(*(part.tolist() for part in near_in_angle(lines, rows, others, gate, 2000.0)), strict=True))
        base = CENTER[pair[1]] - CENTER[pair[0]]
        base = base / np.linalg.norm(base)
        normal = np.cross(base, ray)
        flat = np.linalg.norm(normal, axis=1)
        wide = gate * np.hypot(sigma, (camera + 0.5) / 2000.0) + (2e-8 + gate * 1e-9) * FARTHEST_BEND_M
        # Within the noise of the base itself, any plane is possible.
        wide = np.where(wide < flat, np.arcsin(np.minimum(wide / flat, 1.0)), math.pi)
        cosine = (normal[rows, None] * normal[None, others]).sum(-1)
        angle = np.abs(np.arctan2(np.cross(normal[rows, None], normal[None, others]) @ base, cosine))
        limit = np.hypot(wide[rows, None], wide[None, others])
        wanted = {(int(i), int(j) + 200) for i, j in zip(*np.nonzero(angle <= limit), strict=True)}
        assert found == wanted
        assert 100 < len(wanted) < 40_000

    def test_how_well_a_meeting_is_known(self) -> None:
        """Both widths over the sine of the crossing; what is nearly parallel has no range."""
        lines = sights()
        found = meetings(lines, np.array([0]), np.array([3]), 4.0, 100.0)
        away = [float(np.linalg.norm(POINTS[0] - CENTER[c])) for c in (0, 1)]
        sine = float(np.linalg.norm(np.cross(lines.ray[0], lines.ray[3])))
        assert found.sigma.tolist() == pytest.approx([math.hypot(*map(width, away)) / sine], rel=1e-6)
        assert found.range.tolist() == pytest.approx(away[:1])
        np.testing.assert_allclose(found.point, POINTS[:1], atol=1e-6)
        # The crossing must be ten times the angles that both widths are seen at.
        for share, known in ((9.5, False), (10.5, True)):
            turn = share * math.hypot(0.01, 0.01)
            ray = np.array([[0.0, 1.0, 0.0], [-math.sin(turn), math.cos(turn), 0.0]])
            shift = np.array([[0.0, 0.0, 0.0], [100.0 * math.sin(turn), 100.0 * (1.0 - math.cos(turn)), 0.0]])
            two = two_sights(ray, shift, 0.01)
            assert (len(meetings(two, np.array([0]), np.array([1]), 4.0, 10.0).first) == 1) is known

    def test_behind_and_far_beyond_is_no_meeting(self) -> None:
        center = np.array([[0.0, 0.0, 0.0], [600.0, 0.0, 0.0]])

        def count(at: tuple[float, float], behind: int | None = None) -> int:
            ray = np.array([*at, 0.0]) - center
            ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
            if behind is not None:
                ray[behind] *= -1.0
            return len(meetings(two_sights(ray, center, 1e-6), np.array([0]), np.array([1]), 4.0, 100.0).first)

        assert count((200.0, 900.0)) == 1
        assert count((200.0, 900.0), 0) == count((200.0, 900.0), 1) == 0
        assert count((300.0, 9.9e4)) == 1
        assert count((300.0, 1.01e5)) == 0


class TestGroups:
    def test_points_are_those_of_least_squares(self) -> None:
        lines = sights(turned=1.0)
        marks = marks_of(0, 2)
        marks[1, 3] = -1
        done = confirming(lines)._fit(marks)
        for row in (0, 1):
            point, spread, chi2 = best_point(lines, marks[row])
            np.testing.assert_allclose(done.point[row], point, atol=1e-3)
            np.testing.assert_allclose(np.linalg.inv(done.normal[row]), spread, rtol=1e-3, atol=1e-5)
            assert done.squared[row].sum() == pytest.approx(chi2, rel=1e-2)
        assert done.squared[1, 3] == 0.0
        assert done.squared.sum() > 1.0

    def test_bent_light_leads_to_the_point(self) -> None:
        done = confirming(sights(bending=6e-8))._fit(marks_of(0, 1, 2))
        np.testing.assert_allclose(done.point, POINTS, atol=1e-2)
        assert float(done.squared.max()) < 1e-3

    @pytest.mark.parametrize("gate", [4.0, 1.5])
    def test_each_camera_has_what_is_nearest_to_the_others_point(self, gate: float) -> None:
        """Within the gate of both errors: those of the point and those of the camera's own marks."""
        lines = sights(turned=1.2, seed=3)
        trees = confirming(lines, gate)
        own, found = trees._trees(np.ones(15, dtype=bool))
        marks, near = trees._nearest(trees._fit(marks_of(0, 1, 2)), own, found)
        for c in range(5):
            for p in range(3):
                others = marks_of(p)[0].copy()
                others[c] = -1
                point, spread, _ = best_point(lines, others)
                away = point - CENTER[c]
                length = float(np.linalg.norm(away))
                at = away / length
                side = np.linalg.svd(at[None])[2][1:]  # two axes across
                rest = side @ (lines.ray[c * 3 + p] * (1.0 / (lines.ray[c * 3 + p] @ at)) - at)
                noise = (side @ spread @ side.T + width(length) ** 2 * np.eye(2)) / length**2
                squared = float(rest @ np.linalg.solve(noise, rest))
                number, value = near[c]
                listed = dict(zip(number[p].tolist(), value[p].tolist(), strict=True))
                if squared < 0.98 * gate**2:
                    assert listed[c * 3 + p] == pytest.approx(squared, rel=0.02, abs=1e-3)
                    assert marks[p, c] == c * 3 + p
                elif squared > 1.02 * gate**2:
                    assert listed.get(c * 3 + p, math.inf) == math.inf
                    assert marks[p, c] == -1
        assert gate > 2.0 or bool((marks < 0).any())

    def test_candidates_that_are_about_the_best_of_a_mark(self) -> None:
        """They may lose by `near` and sixteen squared sigmas; the same group counts once."""
        trees = confirming(sights(), near=2.0)
        first, second, third = marks_of(0)[0], marks_of(1)[0], marks_of(2)[0]
        mixed = np.where(np.arange(5) < 2, first, -1)
        some = np.stack([first, second, mixed, first, third])
        kept = trees._best(some, np.array([50.0, 30.0, 32.1, 49.0, 10.0]))
        assert {tuple(row) for row in kept.tolist()} == {tuple(row) for row in (first, second, mixed, third)}
        kept = trees._best(some, np.array([50.0, 30.0, 31.9, 49.0, 10.0]))
        assert {tuple(row) for row in kept.tolist()} == {tuple(row) for row in (first, second, third)}

    def groups(self, marks: NDArray[np.int64], squared: float = 0.5) -> _FittedGroups:
        count = len(marks)
        return _FittedGroups(
            marks, np.repeat(POINTS[:1], count, 0), np.repeat(np.eye(3)[None], count, 0), np.full(marks.shape, squared)
        )

    def test_views_that_do_not_contradict_each_other(self) -> None:
        """Four at least; chi-squared of 2 n - 3 degrees of freedom within four of its standard deviations."""
        trees = confirming(sights())
        whole, four, three = marks_of(0)[0], marks_of(0)[0].copy(), marks_of(0)[0].copy()
        four[1], three[1:3] = -1, -1
        some = np.stack([whole, four, three])
        assert trees._enough(self.groups(some), 2).tolist() == [True, True, False]
        assert trees._enough(self.groups(some), 0).tolist() == [True, False, False]
        # Cameras that do not have the point in their image have not missed it.
        assert confirming(sights(), inner=0.999999)._enough(self.groups(some), 0).tolist() == [True, True, False]
        limit = 7.0 + 4.0 * math.sqrt(14.0)
        for share, good in ((0.99, True), (1.01, False)):
            assert trees._enough(self.groups(whole[None], share * limit / 5.0), 0).tolist() == [good]

    def test_groups_of_their_own_marks(self) -> None:
        """The best first; one that shares several marks with it and saves about as much makes both unclear."""
        trees = confirming(sights(), near=2.0)
        first, second = marks_of(0)[0], marks_of(1)[0]
        mixed = np.where(np.arange(5) < 2, first, second)
        alone = trees._chosen(self.groups(np.stack([first, second])), 0)
        assert {tuple(row) for row in alone.marks.tolist()} == {tuple(first), tuple(second)}
        for behind, clear in ((3.0, True), (1.0, False)):
            some = self.groups(np.stack([first, mixed]))
            some.squared[1] += behind / 5.0
            assert trees._chosen(some, 0).marks.tolist() == ([first.tolist()] if clear else [])
        # One that differs in one mark only is no rival: marks are settled one by one.
        one_off = first.copy()
        one_off[4] = second[4]
        assert trees._chosen(self.groups(np.stack([first, one_off])), 0).marks.tolist() in (
            [first.tolist()], [one_off.tolist()]
        )  # fmt: skip

    def test_meetings_that_enough_cameras_confirm(self) -> None:
        lines = sights()
        trees = confirming(lines)
        own, found = trees._trees(np.ones(15, dtype=bool))
        meet = meetings(lines, own[0], own[1], 4.0, 100.0)
        marks, saved = trees._confirmed(meet, (0, 1), 0, own, found)
        assert {tuple(row) for row in marks.tolist()} >= {tuple(row) for row in marks_of(0, 1, 2).tolist()}
        # Two lines that meet and three cameras that agree save sixteen squared sigmas each.
        same = [row.tolist() in marks_of(0, 1, 2).tolist() for row in marks]
        assert saved[same].tolist() == pytest.approx([64.0] * sum(same), abs=0.01)
        # Without one of three marks of the third camera, one group has missed it.
        free = np.ones(15, dtype=bool)
        free[7] = False
        own, found = trees._trees(free)
        for misses, count in ((0, 2), (1, 3)):
            some, _ = trees._confirmed(meet, (0, 1), misses, own, found)
            whole = marks_of(0, 1, 2)
            whole[whole == 7] = -1
            assert len({tuple(row) for row in some.tolist()} & {tuple(row) for row in whole.tolist()}) == count

    def test_everything_at_once(self) -> None:
        for kinds in (1, 2):
            trees = confirming(sights(turned=0.5))
            if kinds == 2:
                # One camera says that the second thing is of another kind.
                trees.kind[1] = 1
                trees.place[1, 3] = 10.0
            found = trees.found((0, 2), 0, np.ones(15, dtype=bool))
            wanted = marks_of(0, 1, 2)
            assert sorted(map(tuple, found.tolist())) == [
                tuple(row) for row in (wanted if kinds == 1 else wanted[[0, 2]])
            ]


def test_pairs_with_one_range() -> None:
    """Inverse ranges from the same detection that agree within the gate, of other cameras; the nearest of each."""
    camera = np.array([0, 1, 1, 2, 3])

    def groups(inverse: list[float], sigma: float = 0.5, gate: float = 2.0) -> list[tuple[int, ...]]:
        numbers = np.array([1, 2, 3, 4])[: len(inverse)]
        edges = _Edges(
            np.zeros(len(inverse), dtype=np.int64), numbers, np.zeros(len(inverse)), np.array(inverse),
            np.full(len(inverse), sigma),
        )  # fmt: skip
        return _with_one_range(edges, camera, 4, gate)

    # 1.4 apart are two standard deviations of the difference.
    assert groups([1.0, 9.0, 2.40]) == [(0, 1, 3, -1)]
    assert groups([1.0, 9.0, 2.42]) == []
    assert groups([1.0, 1.2, 9.0]) == []  # both of one camera
    assert groups([1.0, 1.3, 1.1, 1.2]) == [(0, 1, 3, 4), (0, 2, 3, 4)]
    assert groups([1.0]) == []
    none, nothing = np.zeros(0, dtype=np.int64), np.zeros(0)
    assert _with_one_range(_Edges(none, none, nothing, nothing, nothing), camera, 2, 2.0) == []


# Who saw what of a crowd, against the truth: sorted pencils of planes, trees of lines of sight, one-to-one marks.


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
    points = 20_000.0 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0)).double()
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
    found = group_objects(Localizer(rig), seen, AssociationOptions(box_sigma=1.0))
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
    lines = two_sights(ray, np.array([[0.0, 0.0, 0.0], [600.0, 0.0, 0.0]]), 1e-3)
    found = meetings(lines, np.array([0]), np.array([1]), 4.0, 100.0)
    assert found.squared.tolist() == pytest.approx([9.0 / 1.64], rel=0.01)
    # Nearer to the line that is known better there.
    assert found.point[0].tolist() == pytest.approx([0.0, 800.0, 3.0 * 0.64 / 1.64], abs=0.02)
    assert len(meetings(lines, np.array([0]), np.array([1]), 2.0, 100.0).first) == 0


# Matches are accepted as exhaustive search would: as many as possible, and then the likeliest.


def candidates(track: list[int], pair: list[int], density: list[float]) -> Candidates:
    none = torch.zeros(0)
    scores = Scores(Anchored(*[none] * 5), *[none] * 4, torch.tensor(density, dtype=torch.float64))
    return Candidates(torch.tensor(track), torch.tensor(pair), scores)


@pytest.mark.parametrize("seed", range(20))
def test_the_best_of_all(seed: int) -> None:
    random = np.random.default_rng(seed)
    every = list(itertools.product(range(3), range(4)))
    chosen = [every[i] for i in random.choice(len(every), random.integers(1, 8), replace=False)]
    density = random.normal(0.0, 5.0, len(chosen)).tolist()
    possible = candidates(*(list(column) for column in zip(*chosen, strict=True)), density)
    # Every pair has marks of its own.
    found = assigned(possible, [{(0, i), (1, i)} for i in range(4)], [0.0] * 3, [0] * 3)

    def is_valid(rows: tuple[int, ...]) -> bool:
        return all(len({chosen[i][end] for i in rows}) == len(rows) for end in (0, 1))

    subsets = [rows for n in range(len(chosen) + 1) for rows in itertools.combinations(range(len(chosen)), n)]
    best = max(filter(is_valid, subsets), key=lambda rows: (len(rows), sum(density[i] for i in rows)))
    assert sorted(found) == sorted(best)


def test_a_mark_goes_to_the_track_of_more_evidence() -> None:
    """Two tracks, each with its own pair; the pairs share their left mark."""
    marks = [{(0, 0), (1, 0)}, {(0, 0), (1, 1)}]
    possible = candidates([0, 1], [0, 1], [-1.0, -2.0])
    assert assigned(possible, marks, [0.0, 0.0], [0, 0]) == [0]
    assert assigned(possible, marks, [0.0, 10.0], [0, 0]) == [1]


def test_confirmed_tracks_choose_first_and_lost_ones_not_at_all() -> None:
    marks = [{(0, 0), (1, 0)}]
    possible = candidates([0, 1, 2], [0, 0, 0], [-9.0, -1.0, 0.0])
    assert assigned(possible, marks, [0.0] * 3, [0, 1, -1]) == [0]
    assert assigned(possible, marks, [0.0] * 3, [1, 1, -1]) == [1]
    assert assigned(possible, marks, [0.0] * 3, [-1, -1, -1]) == []
