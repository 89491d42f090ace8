"""How a rig begins and whether its cameras were synchronous: poses of few points, boards of pairs, places by hand."""

import functools
import itertools
import math

import pytest
import torch
from rig_scenes import (
    BOARD,
    CAMERAS,
    CENTER,
    NAMES,
    ROTATION,
    boards,
    features,
    generator,
    landmarks,
    normal,
    spread_points,
    tensor,
)
from torch import Tensor

from kcal import Baseline, Camera, Features, MeasuredPosition, Rig, RigData, RigOptions, solve_rig
from kcal.calibrate.rig.initial_poses import _baseline, _in_all_places, _into_frame, _level_starts, _starts
from kcal.calibrate.rig.pairs import _median_rms, _view_rms, consensus, evenly, half_turn
from kcal.calibrate.rig.resection import (
    _real_roots,
    _samples,
    _score,
    consensus_pose,
    consensus_rotation,
    distinct_poses,
    poses_from_three,
)
from kcal.calibrate.rig.source import Start
from kcal.lens.pose import Pose, rotation_between, rotation_from_vector, vector_from_rotation
from kcal.report.judge_rig import synchrony


def rays_to(points: Tensor, camera: int = 0) -> Tensor:
    rays = (points - CENTER[camera]) @ ROTATION[camera].T
    return rays / rays.norm(dim=-1, keepdim=True)


class TestFewPoints:
    def test_all_poses_of_three_points_see_them(self) -> None:
        """Up to four, each of which has the points where the rays are, in front of the camera."""
        several = 0
        for seed in range(12):
            points = spread_points(3, 100.0, 900.0, seed)
            rays = rays_to(points)
            rotation, center = poses_from_three(rays, points)
            real = center.isfinite().all(-1)
            several += int(real.sum()) > 1
            for turn, place in zip(rotation[real], center[real], strict=True):
                seen = (points - place) @ turn.T
                torch.testing.assert_close(seen / seen.norm(dim=-1, keepdim=True), rays, rtol=0, atol=1e-6)
            assert bool(rotation[~real].isnan().all())
            best = int((center - CENTER[0]).norm(dim=-1).nan_to_num(math.inf).argmin())
            torch.testing.assert_close(center[best], CENTER[0], rtol=0, atol=1e-6)
            torch.testing.assert_close(rotation[best], ROTATION[0], rtol=0, atol=1e-8)
        assert several > 3

    def test_roots_that_are_real(self) -> None:
        """(x - 1) (x + 2) (x² + 1), and (x - 3)² (x² + 4) with a little noise."""
        roots = _real_roots(tensor([2.0, 2.0, -2.0, 2.0, -4.0], [1.0, -6.0, 13.0, -24.0, 36.0 + 1e-6]))
        for found, wanted in zip(roots, ([-2.0, 1.0], [3.0, 3.0]), strict=True):
            assert sorted(found[found.isfinite()].tolist()) == pytest.approx(wanted, abs=1e-3)

    def test_subsets(self) -> None:
        assert _samples(4, 3).tolist() == [list(some) for some in itertools.combinations(range(4), 3)]
        assert len(_samples(14, 3)) == 364
        many = _samples(15, 3)
        assert many.shape == (400, 3)
        assert int(many.max()) == 14
        assert all(len(set(row)) == 3 for row in many.tolist())
        assert torch.equal(many, _samples(15, 3))

    def test_scores_by_hand(self) -> None:
        """Squared angles, each 5 mrad at most; nothing is worse than no number."""
        rays = tensor([0.0, 0.0, 1.0], [0.0, 0.0, 1.0])
        off = 7.0 * tensor([math.sin(3e-3), 0.0, math.cos(3e-3)], [0.0, math.sin(0.1), math.cos(0.1)])
        turn = rotation_from_vector(tensor(0.3, -0.2, 0.1))
        assert float(_score(rays @ turn.T, turn, off)) == pytest.approx(9e-6 + 25e-6, rel=1e-5)
        assert float(_score(rays, torch.full((3, 3), torch.nan).double(), off)) == math.inf

    def test_rotations_of_least_squares(self) -> None:
        turn = rotation_from_vector(tensor(0.3, -0.2, 0.1))
        directions = torch.nn.functional.normalize(normal((6, 3), 1), dim=-1)
        torch.testing.assert_close(rotation_between(directions, directions @ turn.T), turn)
        wrong = directions @ turn.T
        wrong[4] = -wrong[4]
        found, score = consensus_rotation(wrong, directions)
        torch.testing.assert_close(found, turn)
        assert score == pytest.approx(25e-6, rel=1e-6)

    def test_a_measured_place_counts_where_it_fits_best(self) -> None:
        points = spread_points(6, 60.0, 900.0, 2)
        rays = rays_to(points)
        two = consensus_pose(rays[:2], points[:2], CENTER[0])
        torch.testing.assert_close(two[0], ROTATION[0], rtol=0, atol=1e-9)
        assert torch.equal(two[1], CENTER[0])
        assert consensus_pose(rays[:2], points[:2]) is None
        assert consensus_pose(rays[:1], points[:1], CENTER[0]) is None
        # A place that is wrong by 10 m.
        moved = consensus_pose(rays, points, CENTER[0] + tensor(10.0, 0.0, 0.0))
        torch.testing.assert_close(moved[1], CENTER[0], rtol=0, atol=1e-6)
        assert moved[2] < 1e-12
        # A minority of wrong points does no harm.
        points, rays = spread_points(9, 60.0, 900.0, 2), rays_to(spread_points(9, 60.0, 900.0, 2))
        points[[1, 4, 6]] += tensor([30.0, 0, 9], [0, -50, 20], [9, 9, -40])
        torch.testing.assert_close(consensus_pose(rays, points)[1], CENTER[0], rtol=0, atol=1e-6)

    def test_other_places(self) -> None:
        """Not the known one or one within a hundredth of the distance; the best first, as many as asked for."""
        for seed in range(30):
            points = spread_points(3, 100.0, 900.0, seed)
            center = poses_from_three(rays_to(points), points)[1]
            center = center[center.isfinite().all(-1)]
            away = (center - CENTER[0]).norm(dim=-1)
            distance = float((points.mean(0) - CENTER[0]).norm())
            if len(center) == 2 and float(away.max()) > 0.05 * distance:
                break
        other = center[away.argmax()]
        found = distinct_poses(rays_to(points), points, CENTER[0], 3)
        assert len(found) == 1
        torch.testing.assert_close(found[0][1], other)
        near = CENTER[0] + 0.009 * distance * torch.nn.functional.normalize(tensor(1.0, 1.0, 0.0), dim=0)
        assert len(distinct_poses(rays_to(points), points, near, 3)) == 1
        beside = CENTER[0] + 1.2 * (near - CENTER[0])
        both = distinct_poses(rays_to(points), points, beside, 3)
        off = [float((rays_to(points) @ turn - torch.nn.functional.normalize(points - place, dim=-1)).norm())
               for turn, place in both]  # fmt: skip
        assert len(off) == 2
        assert off == sorted(off)
        assert max(off) < 1e-6
        assert len(distinct_poses(rays_to(points), points, beside, 1)) == 1
        # A fourth point that is off by 2 mrad.
        four = torch.cat([points, points.mean(0, keepdim=True) + 5.0])
        rays = rays_to(four)
        rays[3] = rays[3] @ rotation_from_vector(tensor(0.0, 2e-3, 0.0)).T
        assert distinct_poses(rays, four, other, 9, 3e-3) != []
        assert distinct_poses(rays, four, other, 9, 1e-4) == []


class TestPoses:
    def test_motions(self) -> None:
        turns = rotation_from_vector(normal((3, 3), 4))
        one, two = Pose(turns[0], normal((3,), 5)), Pose(turns[1], normal((3,), 6))
        x = normal((3,), 7)
        there = two.rotation @ x + two.translation
        both = one.after(two)
        torch.testing.assert_close(both.rotation @ x + both.translation, one.rotation @ there + one.translation)
        back = two.inverse()
        torch.testing.assert_close(back.rotation @ there + back.translation, x)
        at = Pose.at(turns[2], x)
        torch.testing.assert_close(at.center, x)
        torch.testing.assert_close(at.rotation @ x + at.translation, torch.zeros(3).double())
        several = Pose(turns, normal((3, 3), 8))
        torch.testing.assert_close(several.inverse().after(several).rotation, torch.eye(3).double().expand(3, 3, 3))
        assert torch.equal(several.some(1).translation, several.translation[1])

    def test_a_board_from_its_other_end(self) -> None:
        turn = half_turn(BOARD.points)
        torch.testing.assert_close(BOARD.points @ turn.rotation.T + turn.translation, BOARD.points.flip(0))

    def test_some_of_many(self) -> None:
        assert evenly(10, 4).tolist() == [0, 3, 6, 9]
        assert evenly(3, 16).tolist() == [0, 1, 2]
        assert evenly(1, 4).tolist() == [0]

    def test_residuals_of_views(self) -> None:
        """A cost is half the sum of squares: 12 px² over three corners are 2 px, root mean square."""
        pixels = torch.zeros(2, 5, 2).double()
        pixels[0, 3:] = torch.nan
        assert _view_rms(pixels, tensor(6.0, 10.0)).tolist() == [2.0, 2.0]
        assert _median_rms(tensor(3.0, 1.0, 2.0)) == 2.0
        assert _median_rms(tensor()) == 0.0
        assert _median_rms(tensor(torch.nan)) == math.inf

    @pytest.mark.parametrize("turned", [(), (2,), (0, 5)])
    def test_the_relative_pose_of_most_pairs(self, turned: tuple[int, ...]) -> None:
        """Some boards read from the other end, one that moved between both exposures by 0.2 m across."""
        relative = Pose(ROTATION[1] @ ROTATION[0].T, ROTATION[1] @ (CENTER[0] - CENTER[1]))
        left = Pose(rotation_from_vector(0.3 * normal((8, 3), 3)), tensor(-1.0, -1.0, 20.0) + normal((8, 3), 4))
        right = relative.after(left)
        right.translation[3] += tensor(0.2, 0.0, 0.0)
        pixels = torch.stack([
            torch.stack([
                CAMERAS[c].project(BOARD.points @ pose.rotation[k].T + pose.translation[k])[0]
                for c, pose in enumerate((left, right))
            ])
            for k in range(8)
        ])  # fmt: skip
        other = right
        for k in turned:
            pixels[k, 1] = pixels[k, 1].flip(0)
            new = right.some(k).after(half_turn(BOARD.points))
            other.rotation[k], other.translation[k] = new.rotation, new.translation
        found, which, error = consensus(BOARD.points, pixels, (CAMERAS[0], CAMERAS[1]), left, other)
        torch.testing.assert_close(found.rotation, relative.rotation, rtol=0, atol=1e-9)
        torch.testing.assert_close(found.translation, relative.translation, rtol=0, atol=1e-8)
        assert which.nonzero()[:, 0].tolist() == list(turned)
        assert error[[0, 1, 2, 4, 5, 6, 7]].max() < 1e-5
        away = float((left.translation[3] @ relative.rotation.T + relative.translation)[2])
        assert float(error[3]) == pytest.approx(1611.0 * 0.2 / away, rel=0.15)


def data(count: int = 3, **sources: object) -> RigData:
    return RigData(cameras=CAMERAS[:count], names=NAMES[:count], **sources)  # type: ignore[arg-type]


def positions(*cameras: int) -> tuple[MeasuredPosition, ...]:
    return tuple(MeasuredPosition(camera=c, point=CENTER[c], sigma=torch.full((3,), 0.02).double()) for c in cameras)


@pytest.mark.slow
def test_many_cameras_of_features_and_baselines_alone() -> None:
    """Directions are tried camera by camera: of five cameras in all combinations they would be 1,296 starts.

    In this draw all cameras but one had come to stand on the wrong side of the first, from where no single one leaves.
    """
    draw, count = generator(1), 4
    noise = functools.partial(torch.randn, dtype=torch.float64, generator=draw)
    camera = Camera.build(focal=(2000, 2000), center=(959.5, 539.5), size=(1920, 1080))
    level = tensor([1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0])
    rotation = torch.stack([rotation_from_vector(0.1 * noise(3)) @ level for _ in range(count)])
    center = noise(count, 3) * tensor(10.0, 10.0, 3.0)
    share = torch.rand(60, 3, dtype=torch.float64, generator=draw)
    far, turn, rise = 100.0 * 20.0 ** share[:, 0], 0.7 * (share[:, 1] - 0.5), 0.4 * (share[:, 2] - 0.5)
    points = torch.stack([far * turn.sin(), far * turn.cos(), far * rise], -1)
    seen = []
    for turned, place in zip(rotation, center, strict=True):
        pixels, valid = camera.project((points - place) @ turned.T)
        seen.append(torch.where((valid & camera.inside(pixels))[:, None], pixels + 0.1 * noise(60, 2), torch.nan))
    far_points = Features(
        names=tuple(f"peak {i}" for i in range(60)),
        pixels=torch.stack(seen, 1),
        inverse_range=torch.full((60,), 1e-3, dtype=torch.float64),
        inverse_range_sigma=torch.full((60,), math.inf, dtype=torch.float64),
        pixel_sigma=0.1,
    )
    away = (center - center[0]) @ rotation[0].T
    tapes = [Baseline(first=0, second=c, length=float(away[c].norm()), sigma=0.01) for c in range(1, count)]
    rig = RigData(cameras=(camera,) * count, names=tuple("abcd"), features=far_points, baselines=tuple(tapes))
    found = solve_rig(rig, RigOptions(refraction=0.0, refraction_sigma=0.0))
    assert float((found.center - away).abs().max()) < 0.1
    turned = found.rotation @ (rotation @ rotation[0].T).transpose(-1, -2)
    assert float(vector_from_rotation(turned).abs().max()) < 1e-3


def matches(seed: int, near: int, far: int, heading: float, count: int = 2) -> tuple[Features, Tensor, Tensor]:
    """Of level cameras 10 m apart, 50 to 1500 m away and of unknown range, or at 20 ± 2 km; rotations and centers."""
    draw = generator(seed)
    uniform = functools.partial(torch.rand, dtype=torch.float64, generator=draw)
    sine, cosine = math.sin(heading), math.cos(heading)
    level = tensor([cosine, -sine, 0.0], [0.0, 0.0, -1.0], [sine, cosine, 0.0])
    rotation = torch.stack([rotation_from_vector(0.02 * (uniform(3) - 0.5)) @ level for _ in range(count)])
    center = 10.0 * torch.arange(count).double()[:, None] * level[0] + uniform(count, 3)
    turn, rise = 0.7 * (uniform(near + far) - 0.5), 0.3 * (uniform(near + far) - 0.5)
    away = torch.cat([50.0 * 30.0 ** uniform(near), torch.full((far,), 2e4).double()])
    points = torch.stack([away * turn.sin(), away * rise, away * turn.cos()], -1) @ level
    camera = CAMERAS[0]
    seen = [camera.project((points - c) @ r.T)[0] for r, c in zip(rotation, center, strict=True)]
    noise = 0.2 * torch.randn(near + far, count, 2, dtype=torch.float64, generator=draw)
    known = torch.arange(near + far) >= near
    found = Features(
        names=tuple(f"match {i}" for i in range(near + far)),
        pixels=torch.stack(seen, 1) + noise,
        inverse_range=torch.where(known, 1.0 / away, 1e-3),
        inverse_range_sigma=torch.where(known, 0.1 / away, math.inf),
        pixel_sigma=0.2,
    )
    return found, rotation, center


def check_attitudes(found: Tensor, truth: Tensor) -> None:
    """Of the second camera to the first one."""
    turned = found[1] @ found[0].T @ truth[0] @ truth[1].T
    assert math.degrees(float(vector_from_rotation(turned).norm())) < 0.1


@pytest.mark.parametrize("seed", range(4))
def test_a_far_point_of_known_range_leaves_no_mirror_image(seed: int) -> None:
    """It fixes the yaw, towards which steps are slow: after few of them, the mirror image had the lower cost."""
    seen, rotation, center = matches(seed, 30, 1, 0.0)
    tape = Baseline(first=0, second=1, length=float((center[1] - center[0]).norm()), sigma=0.005)
    rig = RigData(cameras=CAMERAS[:1] * 2, names=NAMES[:2], features=seen, baselines=(tape,))
    found = solve_rig(rig, RigOptions(refraction=0.0, refraction_sigma=0.0))
    assert found.left_out == ()
    check_attitudes(found.rotation, rotation)
    assert float(found.rotation[0, 0] @ (found.center[1] - found.center[0])) > 9.0


@pytest.mark.parametrize("heading", [20.0, 35.0, 200.0])
@pytest.mark.parametrize("count", [2, 3])
def test_measured_positions_and_matches_in_any_heading(heading: float, count: int) -> None:
    seen, rotation, center = matches(1, 30, 0, math.radians(heading), count)
    sigma = torch.full((3,), 0.02).double()
    measured = tuple(MeasuredPosition(camera=c, point=center[c], sigma=sigma) for c in range(count))
    rig = RigData(cameras=CAMERAS[:1] * count, names=NAMES[:count], features=seen, positions=measured)
    found = solve_rig(rig, RigOptions(refraction=0.0, refraction_sigma=0.0))
    assert found.left_out == ()
    check_attitudes(found.rotation, rotation)


class TestPlaces:
    def test_lengths_between_cameras(self) -> None:
        measured = (Baseline(first=0, second=1, length=10.5, sigma=0.01),)
        some = data(baselines=measured, positions=positions(1, 2))
        assert _baseline(some, 1, 0) == _baseline(some, 0, 1) == 10.5
        assert _baseline(some, 1, 2) == pytest.approx(float((CENTER[1] - CENTER[2]).norm()))
        assert _baseline(some, 0, 2) is None

    def test_six_directions_are_tried(self) -> None:
        known = {0: Pose.at(ROTATION[0], CENTER[0]), 1: Pose.at(ROTATION[1], CENTER[0] + 2.0 * ROTATION[0, 0])}
        starts = _starts(known, [1])
        places = torch.stack([start.center[1] - CENTER[0] for start in starts])
        torch.testing.assert_close(places, 2.0 * torch.cat([ROTATION[0], -ROTATION[0]]))
        assert all(torch.allclose(start.center[0], CENTER[0]) for start in starts)
        assert len(_starts(known, [])) == 1
        assert len(_starts(known, [1, 0])) == 36
        first = _starts(known, [0])
        torch.testing.assert_close(first[0].center[0] - first[0].center[1], 2.0 * ROTATION[1, 0], rtol=0, atol=1e-9)

    @pytest.mark.parametrize("count", [2, 3])
    def test_a_rig_comes_where_it_was_measured(self, count: int) -> None:
        """Of two cameras the turn about their line is that which holds them upright on average."""
        some = data(positions=positions(*range(count)))
        own = ROTATION @ ROTATION[0].T, (CENTER - CENTER[0]) @ ROTATION[0].T
        start = Start(rotation=own[0].clone(), center=own[1].clone())
        start = _into_frame(some, start)
        torch.testing.assert_close(start.center[:count], CENTER[:count], rtol=0, atol=1e-6)
        down = start.rotation[:, 1].mean(0)
        if count == 3:
            torch.testing.assert_close(start.rotation, ROTATION, rtol=0, atol=1e-4)
        line = torch.nn.functional.normalize(CENTER[1] - CENTER[0], dim=0)
        assert abs(float(down @ torch.linalg.cross(line, tensor(0.0, 0.0, 1.0)))) < 0.02
        assert float(down[2]) < -0.99
        # It moves as a whole.
        torch.testing.assert_close(start.rotation @ start.rotation[0].T, own[0])

    def test_level_in_eight_headings(self) -> None:
        starts = _level_starts(data(features=features(cameras=3), positions=positions(0, 1, 2)))
        assert starts is not None
        assert len(starts) == 8
        headings = []
        for start in starts:
            assert torch.equal(start.center, CENTER)
            torch.testing.assert_close(start.rotation[0, 1], tensor(0.0, 0.0, -1.0))
            headings.append(
                math.degrees(math.atan2(float(start.rotation[0, 2, 0]), float(start.rotation[0, 2, 1]))) % 360
            )
            torch.testing.assert_close(
                start.rotation[1] @ start.rotation[0].T, ROTATION[1] @ ROTATION[0].T, rtol=0, atol=1e-3
            )
            assert float(torch.linalg.det(start.rotation[0])) == pytest.approx(1.0)
        assert sorted(headings) == pytest.approx([45.0 * k for k in range(8)])
        assert _level_starts(data(features=features(cameras=3), positions=positions(0, 1))) is None
        assert (
            _level_starts(data(boards=boards(cameras=3), features=features(cameras=3), positions=positions(0, 1, 2)))
            is None
        )
        assert _level_starts(data(positions=positions(0, 1, 2))) is None

    def test_all_places_of_three_landmarks(self) -> None:
        marks = landmarks(count=3, cameras=2)
        start = Start(rotation=ROTATION[:2].clone(), center=CENTER[:2].clone())
        starts = _in_all_places(data(2, landmarks=marks), [start])
        centers = [poses_from_three(rays_to(marks.points, c), marks.points)[1] for c in (0, 1)]
        assert len(starts) == math.prod(int(center.isfinite().all(-1).sum()) for center in centers)
        for one in starts:
            for c in (0, 1):
                seen = (marks.points - one.center[c]) @ one.rotation[c].T
                torch.testing.assert_close(
                    seen / seen.norm(dim=-1, keepdim=True), rays_to(marks.points, c), rtol=0, atol=1e-5
                )
        assert len(_in_all_places(data(2, landmarks=landmarks(count=4)), [start])) == 1
        assert len(_in_all_places(data(2, landmarks=marks, positions=positions(0, 1)), [start])) == 1


class TestSynchrony:
    CAMERA = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
    RIG = Rig.pair(CAMERA, CAMERA, rotation_from_vector(tensor(0.01, -0.02, 0.03)), tensor(-0.1, 0.0, 0.01))
    POINTS = torch.cartesian_prod(torch.arange(5.0), torch.arange(4.0), torch.zeros(1)).double() * 0.05

    def seen(self, count: int, late: float, noise: float = 0.0, seed: int = 1) -> Tensor:
        """Boards that move on a curve, seen by the right camera `late` steps later."""

        def places(at: Tensor) -> Tensor:
            where = torch.stack([0.03 * at - 0.15, 0.1 * (0.5 * at).sin() - 0.1, 1.0 + 0.02 * at], -1)
            return self.POINTS @ rotation_from_vector(tensor(0.3, -0.2, 0.1)).T + where[:, None]

        at = torch.arange(count).double()
        pixels = torch.stack([self.RIG(places(at))[0][..., 0, :], self.RIG(places(at + late))[0][..., 1, :]], 1)
        return pixels + noise * normal(tuple(pixels.shape), seed)

    @pytest.mark.parametrize("late", [0.3, -0.2])
    def test_a_delay_is_found_with_its_sign(self, late: float) -> None:
        found = synchrony(self.RIG, self.POINTS, self.seen(12, late))
        assert found.pairs == 12
        assert found.delay == pytest.approx(late, abs=0.03)
        assert found.delay_sigma is not None
        assert found.delay_sigma < 0.03
        at = torch.arange(12).double()
        speed = torch.stack([torch.full_like(at, 0.03), 0.05 * (0.5 * at).cos()], -1).norm(dim=-1)
        assert found.shift == pytest.approx(abs(late) * float(speed.square().median().sqrt()), rel=0.25)
        assert found.ratio > 10.0

    def test_noise_alone_is_no_disagreement(self) -> None:
        ratios = [synchrony(self.RIG, self.POINTS, self.seen(12, 0.0, 0.2, seed)) for seed in range(4)]
        assert sum(one.ratio for one in ratios) / 4 == pytest.approx(1.0, abs=0.15)
        for one in ratios:
            assert one.delay is not None
            assert one.delay_sigma is not None
            assert abs(one.delay) < 4.0 * one.delay_sigma
            assert one.shift < 1e-3

    def test_few_pairs_tell_no_delay(self) -> None:
        for count, told in ((8, True), (7, False)):
            found = synchrony(self.RIG, self.POINTS, self.seen(count, 0.3))
            assert (found.delay is not None) is told
            assert (found.delay_sigma is not None) is told
        pixels = self.seen(9, 0.3)
        pixels[0, 1, 6:] = torch.nan
        pixels[1, 1, 5:] = torch.nan
        assert synchrony(self.RIG, self.POINTS, pixels).pairs == 8
        nothing = synchrony(self.RIG, self.POINTS, pixels[1:2])
        assert (nothing.pairs, nothing.ratio, nothing.shift, nothing.delay) == (0, 1.0, 0.0, None)

    def test_exact_and_still(self) -> None:
        found = synchrony(self.RIG, self.POINTS, self.seen(1, 0.0).expand(9, 2, 20, 2))
        assert found.ratio < 0.1
        assert found.shift < 1e-6
