"""The monitor of a rig's attitude: turns found to their sigmas, moving things named, statistics as stated.

What a rig forgets by day.
"""

import dataclasses
import math

import pytest
import torch
from locate_rigs import pinhole_rig
from rig_scenes import CAMERAS, CENTER, ROTATION, landmarks, normal, spread_points, tensor
from torch import Tensor

from kcal import DegenerateError, Features, InputError, Landmarks, Rig
from kcal.gaussian import half_of_covariance
from kcal.lens import rotation_from_vector, vector_from_rotation
from kcal.watch.turned import forgotten_yaw, measure_drift, parse_aging

RELATIVE = ROTATION[1] @ ROTATION[0].T
RIG = Rig.pair(CAMERAS[0], CAMERAS[1], RELATIVE, ROTATION[1] @ (CENTER[0] - CENTER[1]))
TURN = tensor([4e-5, -6e-5, 9e-5], [-2e-5, math.radians(0.01), 5e-5])


def seen(points: Tensor, turns: Tensor) -> Tensor:
    """(N, 2, 2) pixels in cameras that have turned."""
    sides = []
    for c, turn in enumerate(turns):
        pixels, valid = CAMERAS[c].project((points - CENTER[c]) @ (rotation_from_vector(turn) @ ROTATION[c]).T)
        assert bool(valid.all())
        sides.append(pixels)
    return torch.stack(sides, 1)


def static(count: int, noise: float = 0.0, seed: int = 0, turns: Tensor = TURN) -> Features:
    points = spread_points(count, 300.0, 8000.0, 11)
    pixels = torch.cat([seen(points, torch.zeros(2, 3).double()), seen(points, turns)], 1)
    return Features(
        names=tuple(f"s{i}" for i in range(count)),
        pixels=pixels + noise * normal(pixels.shape, 600 + seed),
        inverse_range=torch.zeros(count, dtype=torch.float64),
        inverse_range_sigma=torch.full((count,), math.inf, dtype=torch.float64),
        pixel_sigma=max(noise, 0.1),
    )


# The same cameras, the right one rolled by 70°: what is transposed, or in the other camera's axes, shows.
ROLLED = torch.stack([ROTATION[0], rotation_from_vector(tensor(0.0, 0.0, math.radians(70.0))) @ ROTATION[1]])
ROLLED_RIG = Rig.pair(*CAMERAS[:2], ROLLED[1] @ ROLLED[0].T, ROLLED[1] @ (CENTER[0] - CENTER[1]))


def seen_rolled(points: Tensor, turns: Tensor) -> Tensor:
    """(N, 2, 2) pixels in the cameras of `ROLLED_RIG` after they have turned; also outside the image."""
    local = [(points - CENTER[c]) @ (rotation_from_vector(turns[c]) @ ROLLED[c]).T for c in (0, 1)]
    return torch.stack([CAMERAS[c].project(local[c])[0] for c in (0, 1)], 1)


def relative_turn(turns: Tensor = TURN) -> Tensor:
    left, right = rotation_from_vector(turns)
    return vector_from_rotation(right @ RELATIVE @ left.T @ RELATIVE.T)


def turned_left() -> Tensor:
    return rotation_from_vector(TURN[0]) @ ROTATION[0]


class TestFeatures:
    def test_exact_marks_give_the_turn(self) -> None:
        found = measure_drift(RIG, features=static(12), pose=(ROTATION[0], CENTER[0]))
        assert found.cam_from_local is not None
        torch.testing.assert_close(found.cam_from_local, turned_left(), rtol=0, atol=1e-10)
        assert found.left is not None
        assert found.right is not None
        torch.testing.assert_close(torch.stack([found.left, found.right]), TURN, rtol=0, atol=1e-10)
        torch.testing.assert_close(found.relative, relative_turn(), rtol=0, atol=1e-10)
        turned = rotation_from_vector(TURN[1]) @ ROTATION[1]
        torch.testing.assert_close(
            found.rig.right_from_left_translation, turned @ (CENTER[0] - CENTER[1]), rtol=0, atol=1e-8
        )
        assert found.significant

    def test_sigmas_are_the_spread(self) -> None:
        """16 checks of 15 features: χ² of the relative turn, three numbers, and of the pose, ± 4 of its deviations.

        The pose has five: the right camera turns about its center, which stays on a sphere.
        """
        relative, pose = 0.0, 0.0
        onto, shift = rotation_from_vector(relative_turn()), rotation_from_vector(TURN[1])
        for seed in range(0, 16_000, 1000):
            found = measure_drift(RIG, features=static(15, 0.1, seed))
            error = vector_from_rotation(rotation_from_vector(found.relative) @ onto.T)
            relative += float(error @ torch.linalg.solve(found.relative_covariance, error))
            turn = vector_from_rotation(found.rig.right_from_left_rotation @ (onto @ RELATIVE).T)
            moved = found.rig.right_from_left_translation - shift @ RIG.right_from_left_translation
            error = torch.cat([turn, moved])
            pose += float(error @ torch.linalg.pinv(found.pose_covariance, rtol=1e-9, hermitian=True) @ error)
        assert abs(relative - 48) < 4 * (2 * 48) ** 0.5
        assert abs(pose - 80) < 4 * (2 * 80) ** 0.5

    def test_no_drift_is_not_significant_and_a_tenth_of_a_pixel_is(self) -> None:
        still = measure_drift(RIG, features=static(40, 0.1, turns=torch.zeros(2, 3).double()))
        assert not still.significant
        assert measure_drift(RIG, features=static(40, 0.1)).significant

    def test_equal_marks_give_exactly_no_drift_whatever_errors_the_rig_has(self) -> None:
        wrong = rotation_from_vector(tensor(3e-4, -2e-4, 1e-4))
        rig = Rig.pair(
            RIG.left, RIG.right, wrong @ RIG.right_from_left_rotation, wrong @ RIG.right_from_left_translation
        )
        features = static(20, 0.1)
        features.pixels[:, 2:] = features.pixels[:, :2]
        found = measure_drift(rig, features=features)
        assert found.left is not None
        assert found.right is not None
        assert not torch.stack([found.left, found.right, found.relative]).any()
        assert torch.equal(found.rig.right_from_left_rotation, rig.right_from_left_rotation)
        assert torch.equal(found.rig.right_from_left_translation, rig.right_from_left_translation)
        assert (found.chi2, found.variance, found.left_out) == (0.0, 1.0, ())
        assert not found.significant
        assert not found.left_significant
        # And a turn is found as with the true rig.
        turned = measure_drift(rig, features=static(20))
        assert turned.left is not None
        assert turned.right is not None
        torch.testing.assert_close(torch.stack([turned.left, turned.right]), TURN, rtol=0, atol=1e-10)

    def test_the_rig_that_turns_as_a_whole(self) -> None:
        """Both cameras turn about the vertical: ranges stay, directions do not."""
        up = tensor(0.0, 0.0, 2e-4)
        found = measure_drift(RIG, features=static(40, 0.1, turns=torch.stack([side @ up for side in ROTATION[:2]])))
        assert not found.significant
        assert found.left_significant

    def test_covariances_are_those_of_the_cameras_turns(self) -> None:
        """By autograd through the relative pose that two small turns leave, of cameras that look unlike."""
        points = spread_points(15, 300.0, 8000.0, 11)
        pixels = torch.cat([seen_rolled(points, turns) for turns in (0 * TURN, TURN)], 1)
        found = measure_drift(ROLLED_RIG, features=dataclasses.replace(static(15), pixels=pixels))
        assert found.left is not None
        assert found.right is not None
        torch.testing.assert_close(torch.stack([found.left, found.right]), TURN, rtol=0, atol=1e-10)
        now = found.rig.right_from_left_rotation

        def pose(both: Tensor) -> tuple[Tensor, Tensor]:
            left, right = rotation_from_vector(both.unflatten(0, (2, 3)))
            turned = right @ ROLLED_RIG.right_from_left_rotation @ left.T
            return vector_from_rotation(turned @ now.T), right @ ROLLED_RIG.right_from_left_translation

        rows = torch.cat(torch.autograd.functional.jacobian(pose, torch.cat([found.left, found.right])))
        own = torch.block_diag(found.left_covariance, found.right_covariance)
        scale = own.diagonal().mean() * torch.tensor([1.0] * 3 + [10.0] * 3).double()
        off = (rows @ own @ rows.T - found.pose_covariance) / (scale[:, None] * scale).sqrt()
        assert float(off.abs().max()) < 5e-3  # turns of 1e-4 rad, to first order; the largest entry is 30
        torch.testing.assert_close(found.relative_covariance, found.pose_covariance[:3, :3], rtol=0, atol=0)

    def test_what_moved_is_named(self) -> None:
        features = static(20, 0.1)
        features.pixels[3, 2:] += tensor([6.0, 1.0], [5.0, 1.0])
        features.pixels[8, 3] += tensor(0.0, 4.0)
        found = measure_drift(RIG, features=features)
        assert {item.name for item in found.left_out} == {"s3", "s8"}
        first = found.left_out[0]
        assert first.pixels == pytest.approx((37**0.5, 26**0.5), abs=0.5)
        assert first.reason.startswith(f"it has moved by {first.pixels[0]:.1f} px (left), ")
        error = found.relative - relative_turn()
        assert bool((error.abs() < 4.5 * found.relative_covariance.diagonal().sqrt()).all())

    def test_features_of_known_range_tell_the_relative_turn_without_a_history(self) -> None:
        turns = TURN * tensor([0.0], [1.0])
        features = static(15, turns=turns)
        inverse = 1.0 / torch.linalg.vector_norm(spread_points(15, 300.0, 8000.0, 11) - CENTER[:2].mean(0), dim=-1)
        pixels = features.pixels.clone()
        pixels[:, :2] = math.nan
        known = dataclasses.replace(features, pixels=pixels, inverse_range=inverse, inverse_range_sigma=1e-3 * inverse)
        found = measure_drift(RIG, features=known)
        assert found.left is None
        torch.testing.assert_close(found.relative, relative_turn(turns), rtol=0, atol=1e-9)


def turned_root(rig: Rig, relative: Tensor, left: Tensor) -> Tensor:
    """`Rig.root` of cameras in exact places, from covariances (3, 3) of the relative turn and of the left one."""
    root = torch.zeros(6, rig.quantities, dtype=torch.float64)
    first, second = (root[:, rig.pose_columns(c)][:, 3:] for c in (0, 1))
    first[3:] = second[3:] = -half_of_covariance(left)
    second[:3] = -half_of_covariance(relative) @ rig.right_from_left_rotation
    return root


class TestLandmarks:
    def test_turns_and_their_covariances_about_the_cameras_own_axes(self) -> None:
        marks = landmarks()
        marks = dataclasses.replace(marks, pixels=seen_rolled(marks.points, TURN))
        pose = (ROLLED[0], CENTER[0])
        found = measure_drift(ROLLED_RIG, landmarks=marks, pose=pose, refraction=(0.0, 0.0))
        assert found.left is not None
        assert found.right is not None
        torch.testing.assert_close(torch.stack([found.left, found.right]), TURN, rtol=0, atol=1e-9)
        shift = rotation_from_vector(TURN[1]) @ ROLLED_RIG.right_from_left_translation
        torch.testing.assert_close(found.rig.right_from_left_translation, shift, rtol=0, atol=1e-7)
        # What was not known of the relative turn and of the left camera's attitude comes on top.
        relative, left = (torch.diag(tensor(*values)) for values in ((1e-9, 4e-9, 9e-9), (2e-9, 5e-9, 1e-8)))
        root = turned_root(ROLLED_RIG, relative, left)
        wider = measure_drift(ROLLED_RIG, landmarks=marks, pose=pose, root=root, refraction=(0.0, 0.0))
        onto = ROLLED_RIG.right_from_left_rotation
        for name, more in (
            ("relative_covariance", relative),
            ("left_covariance", left),
            ("right_covariance", relative + onto @ left @ onto.T),
            ("pose_covariance", torch.zeros(6, 6).double()),
        ):
            torch.testing.assert_close(getattr(wider, name) - getattr(found, name), more, rtol=1e-6, atol=1e-18)

    def test_sigmas_are_the_spread(self) -> None:
        """16 checks by exact landmarks: χ² of both cameras' turns and of the relative one, ± 4 of its deviations."""
        marks, total = landmarks(survey=1e-4), torch.zeros(3).double()
        exact = seen_rolled(marks.points, TURN)
        onto = rotation_from_vector(TURN[1]) @ ROLLED_RIG.right_from_left_rotation @ rotation_from_vector(-TURN[0])
        for seed in range(16):
            noisy = dataclasses.replace(marks, pixels=exact + 0.1 * normal(exact.shape, 900 + seed))
            found = measure_drift(ROLLED_RIG, landmarks=noisy, pose=(ROLLED[0], CENTER[0]), refraction=(0.0, 0.0))
            relative = vector_from_rotation(found.rig.right_from_left_rotation @ onto.T)
            errors = found.left - TURN[0], found.right - TURN[1], relative
            spreads = found.left_covariance, found.right_covariance, found.relative_covariance
            for k, (error, spread) in enumerate(zip(errors, spreads, strict=True)):
                total[k] += float(error @ torch.linalg.solve(spread, error))
        assert bool(((total - 48).abs() < 4 * (2 * 48) ** 0.5).all())

    def test_two_landmarks_are_enough(self) -> None:
        """Four pixels in each camera for the three numbers of its turn."""
        every = landmarks()
        pixels = seen(every.points, TURN)
        two = torch.tensor([0, int((pixels[:, 0] - pixels[0, 0]).norm(dim=-1).argmax())])
        marks = Landmarks(names=("a", "b"), points=every.points[two], sigma=every.sigma[two], pixels=pixels[two])
        found = measure_drift(RIG, landmarks=marks, pose=(ROTATION[0], CENTER[0]), refraction=(0.0, 0.0))
        torch.testing.assert_close(found.relative, relative_turn(), rtol=0, atol=1e-9)
        torch.testing.assert_close(found.cam_from_local, turned_left(), rtol=0, atol=1e-9)

    def test_how_well_the_rig_was_known_counts(self) -> None:
        marks = landmarks()
        marks = dataclasses.replace(marks, pixels=seen(marks.points, TURN))
        pose = (ROTATION[0], CENTER[0])
        rough = 1e-6 * torch.eye(3, dtype=torch.float64)
        assert measure_drift(RIG, landmarks=marks, pose=pose).significant
        assert not measure_drift(RIG, landmarks=marks, pose=pose, root=turned_root(RIG, rough, rough)).significant


class TestRefusals:
    def test_too_little(self) -> None:
        with pytest.raises(InputError, match="features or landmarks are needed"):
            measure_drift(RIG)
        with pytest.raises(InputError, match="need the left camera's pose"):
            measure_drift(RIG, landmarks=landmarks())
        with pytest.raises(DegenerateError, match="two features or landmarks"):
            measure_drift(RIG, features=static(1))
        with pytest.raises(InputError, match="give either"):
            measure_drift(RIG, features=static(9), landmarks=landmarks(), pose=(ROTATION[0], CENTER[0]))

    def test_marks_of_other_things(self) -> None:
        features = static(20, 0.1)
        features.pixels[:9, 2:] += 30.0 * normal((9, 2, 2), 7)
        with pytest.raises(InputError, match="9 of 20 features have moved against the rest"):
            measure_drift(RIG, features=features)
        features.pixels[:, 2:] = features.pixels[torch.arange(20).flip(0), 2:]
        with pytest.raises(InputError, match=r"no turn explains the marks: typically they are \d+ times"):
            measure_drift(RIG, features=features)

    def test_marks_that_tell_nothing(self) -> None:
        one = static(4)
        one.pixels[:] = one.pixels[:1].clone()
        with pytest.raises(DegenerateError, match="marks in one place"):
            measure_drift(RIG, features=one)
        blind = static(4)
        blind.pixels[1:, 3] = math.nan
        with pytest.raises(DegenerateError, match="right has 1 with marks then and now"):
            measure_drift(RIG, features=blind)

    def test_features_that_have_no_mark_of_then_are_named(self) -> None:
        features = static(6)
        features.pixels[2, :2] = math.nan
        (item,) = measure_drift(RIG, features=features).left_out
        assert (item.name, item.reason) == ("s2", "no camera has a mark of it both then and now")


def seen_later(seed: int, shift: float, gone: int = 0) -> Features:
    """40 points 50 to 2000 m away, the right camera shifted to its right and turned; some points moved by a meter."""
    draw = torch.Generator().manual_seed(seed)
    uniform, noise = torch.rand(3, 40, generator=draw).double(), torch.randn(40, 4, 2, generator=draw).double()
    rig, far = pinhole_rig(1600.0, 10.0), 50.0 * 40.0 ** uniform[0]
    points = torch.stack([(uniform[1] - 0.4) * far, 0.5 * (uniform[2] - 0.5) * far, far], -1)
    turn = rotation_from_vector(tensor(1e-4, -2e-4, 3e-4))
    later = Rig.pair(rig.left, rig.right, turn, turn @ (rig.right_from_left_translation - tensor(shift, 0.0, 0.0)))
    now = points.clone()
    now[:gone] += 1.0
    pixels = torch.stack([*rig(points)[0].unbind(-2), *later(now)[0].unbind(-2)], 1) + 0.2 * noise
    unknown = torch.zeros(40).double(), torch.full((40,), math.inf).double()
    return Features(names=tuple(map(str, range(40))), pixels=pixels, inverse_range=unknown[0],
                    inverse_range_sigma=unknown[1], pixel_sigma=0.2)  # fmt: skip


def test_a_camera_that_slid_is_no_camera_that_turned() -> None:
    """Near points move more than far ones: 10 cm are told, and do not become a turn of the rig."""
    drift = measure_drift(pinhole_rig(1600.0, 10.0), features=seen_later(1, 0.1))
    (said,) = drift.moved
    assert "the right camera has moved by some " in said
    assert 80.0 < float(said.split()[-2]) < 120.0
    assert said.endswith(" mm")
    with pytest.raises(InputError, match="turns alone do not correct the rig"):
        drift.relocked("Monday")


@pytest.mark.parametrize(("gone", "stated"), [(0, 0.2), (5, 0.2), (0, 0.07)])
def test_turns_points_that_moved_and_noise_are_no_shift(gone: int, stated: float) -> None:
    """Marks may be noisier than stated."""
    for seed in range(8):
        marks = dataclasses.replace(seen_later(seed, 0.0, gone), pixel_sigma=stated)
        assert measure_drift(pinhole_rig(1600.0, 10.0), features=marks).moved == ()


def test_time_is_a_random_walk_and_temperature_is_not() -> None:
    assert forgotten_yaw(hours=4, per_hour=0.001) == pytest.approx(0.002)
    assert forgotten_yaw(kelvin=4, per_kelvin=0.001) == pytest.approx(0.004)
    assert parse_aging("4h:0.001, 4K:0.001", "--aged") == pytest.approx(math.hypot(0.002, 0.004))


@pytest.mark.parametrize("text", ["4h", "4:0.001", "4h:", "4h:-0.001", "4h:1e999", "x", "9h:0.1,4h:0.2"])
def test_what_is_no_aging(text: str) -> None:
    with pytest.raises(InputError, match=r"write hours|from 0 on"):
        parse_aging(text, "--aged")
