"""One camera that was moved from place to place: its lens is the same unknown at all of them."""

import dataclasses
import functools
import math

import pytest
import torch
from calibrate_scenes import observe
from rig_scenes import BOARD, CENTER, ROTATION, generator, normal, posts, spread_points, tensor
from torch import Tensor

from kcal import Camera, InputError, Landmarks, Localizer, Observations, RigData, RigOptions, calibrate_rig, solve_rig
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.rig.result import RigResult
from kcal.lens import rotation_from_vector

SIZE, NOISE, SURVEY = (1920, 1080), 0.1, 0.02
LENS = [-0.2, 0.06, 3e-4, -2e-4]
TRUE = Camera.build(focal=(1602, 1600), center=(968, 534), size=SIZE, coefficients=LENS, model="opencv4")
STRAIGHT = RigOptions(refraction=0.0, refraction_sigma=0.0)
# Off the middle of the images, where errors of the lens are large.
TARGET = CENTER[0] + 3000.0 * (ROTATION[0, 2] + 0.35 * ROTATION[0, 0] - 0.05 * ROTATION[0, 1])
DISTANCE = float((TARGET - CENTER[0]).norm())


def see(points: Tensor, place: int) -> Tensor:
    pixels, valid = TRUE.project((points - CENTER[place]) @ ROTATION[place].T)
    return torch.where((valid & TRUE.inside(pixels))[..., None], pixels, torch.nan)


def views(seed: int, count: int = 10) -> Observations:
    """Boards all round and all over the image."""
    draw = torch.rand(count, 3, dtype=torch.float64, generator=generator(seed))
    shots = []
    for i, (across, down, turn) in enumerate(draw.tolist()):
        angle = 2.0 * math.pi * i / count
        rotation = rotation_from_vector(tensor(0.5 * math.cos(angle), 0.5 * math.sin(angle), 0.2 * turn))
        place = tensor(5.0 * across - 2.5, 2.4 * down - 1.2, 6.0)
        shots.append(TRUE.project((BOARD.points - BOARD.points.mean(0)) @ rotation.T + place)[0])
    pixels = torch.stack(shots)
    inside = TRUE.inside(pixels)[..., None]
    return observe(
        torch.where(inside, pixels + NOISE * normal(pixels.shape, 50 + seed), torch.nan), board=BOARD, size=SIZE
    )


@functools.cache
def calibrated(seed: int) -> Camera:
    """The camera as boards determine it, with errors."""
    return calibrate_camera(views(seed), CalibrationOptions(model="opencv4", reject=None)).camera


def survey(seed: int) -> Landmarks:
    truth = spread_points(10, 60.0, 600.0, 5)
    pixels = torch.stack([see(truth, place) for place in (0, 1)], 1)
    seeds = (100 + seed, 200 + seed)
    return posts(truth, pixels, noise=NOISE, error=SURVEY, survey=SURVEY, sigma=NOISE, seeds=seeds)


def rig(cameras: tuple[Camera, Camera], landmarks: Landmarks, options: RigOptions = STRAIGHT) -> RigResult:
    return solve_rig(RigData(cameras=cameras, names=("left", "right"), landmarks=landmarks), options)


def located(found: RigResult, seed: int, noise: float) -> tuple[float, float, bool]:
    """Error of the target's inverse range, its sigma, and whether the 95 % interval contains the true range."""
    seen = [see(TARGET[None], place) + noise * normal((1, 2), 300 + seed + 5000 * place) for place in (0, 1)]
    there = Localizer(found.stereo(), pixel_sigma=max(noise, 1e-4))(*seen)
    error = float(there.inverse_range) - 1.0 / DISTANCE
    return error, float(there.inverse_range_sigma), bool(there.range_low <= DISTANCE <= there.range_high)


@pytest.mark.slow
def test_ranges_have_the_errors_that_the_rig_says() -> None:
    """Refits with new errors of calibration, survey and marks scatter as far as sigma says: less than for two."""
    once = [rig((calibrated(seed), calibrated(seed)), survey(seed)) for seed in range(8)]
    assert sum(located(found, seed, NOISE)[2] for seed, found in enumerate(once)) >= 7
    # Exact marks of the target: errors of the rig alone.
    errors = [located(found, 0, 0.0) for found in once]
    # 99 % of χ² of eight degrees of freedom.
    assert 1.34 < sum((error / sigma) ** 2 for error, sigma, _ in errors) < 21.95
    assert located(rig((calibrated(0), calibrated(100)), survey(0)), 0, 0.0)[1] > 1.8 * errors[0][1]


@pytest.mark.slow
def test_the_lens_is_one() -> None:
    """Both places have the same refined lens, whose errors are the same error; a copy of the camera is that camera."""
    camera = calibrated(0)
    copy = camera.with_parameters(camera.params.clone())
    copy.calibration = camera.calibration
    found = rig((camera, copy), survey(0))
    assert found.data.lenses == (0, 0)
    left, right = found.cameras
    assert torch.equal(left.params, right.params)
    assert not torch.equal(left.params, camera.params)
    covariance, size = found.joint_covariance(), len(TRUE.names)
    own, other = covariance[:size, :size], covariance[size : 2 * size, size : 2 * size]
    torch.testing.assert_close(own, other, rtol=1e-12, atol=0)
    torch.testing.assert_close(own, covariance[:size, size : 2 * size], rtol=1e-12, atol=0)
    assert float(own[0, 0]) > 0
    nominal = TRUE, TRUE.with_parameters(TRUE.params.clone())
    assert rig(nominal, survey(0)).data.lenses == rig((TRUE, TRUE), survey(0)).data.lenses == (0, 1)
    two = rig((camera, calibrated(100)), survey(0))
    assert two.data.lenses == (0, 1)
    assert float(two.joint_covariance()[0, size].abs()) < 0.5 * float(own[0, 0])


def standing(count: int, seed: int, moved: float = 0.0) -> tuple[Observations, Observations]:
    """Boards that stand still, seen from both places; they turn by `moved` radians in between."""
    draw = torch.rand(count, 3, dtype=torch.float64, generator=generator(seed))
    sides: tuple[list[Tensor], list[Tensor]] = ([], [])
    for i, (across, down, turn) in enumerate(draw.tolist()):
        angle = 2.0 * math.pi * i / count
        for place, side in enumerate(sides):
            wobble = moved * place * (-1) ** i
            tilt = tensor(0.6 * math.cos(angle), 0.6 * math.sin(angle) + wobble, 0.2 * turn)
            middle = tensor(5.0 + 3.0 * (2 * across - 1), 1.5 * (2 * down - 1) + wobble, 14.0)
            points = (BOARD.points - BOARD.points.mean(0)) @ rotation_from_vector(tilt).T + middle
            side.append(see(points @ ROTATION[0] + CENTER[0], place))
    left, right = (
        observe(pixels + NOISE * normal(pixels.shape, 50 + seed + k), board=BOARD, size=SIZE, names=names)
        for k, (pixels, names) in enumerate(
            (torch.stack(side), [f"{word}{i}" for i in range(count)])
            for word, side in zip(("a", "b"), sides, strict=True)
        )
    )
    return left, right


def boards_rig(seen: tuple[Observations, Observations], camera: Camera, **options: object) -> RigResult:
    pairs = list(zip(seen[0].names, seen[1].names, strict=True))
    return calibrate_rig(camera, camera, *seen, pairs, RigOptions(**options))  # type: ignore[arg-type]


def test_views_of_both_places_count_once() -> None:
    """A camera calibrated from the very boards of the rig, from both places, knows nothing more than they tell."""
    seen = standing(10, 4)
    together = seen[0].model_copy(update={"views": (*seen[0].views, *seen[1].views)})
    camera = calibrate_camera(together, CalibrationOptions(model="opencv4", reject=None)).camera
    prior, free = (boards_rig(seen, camera, intrinsics=how, motion=False) for how in ("prior", "free"))
    assert any("one camera at two places, and 10 boards were seen from both" in text for text in prior.warnings)
    torch.testing.assert_close(prior.cameras[0].params, free.cameras[0].params, rtol=1e-4, atol=1e-4)
    sigma = [found.joint_covariance().diagonal().sqrt() for found in (prior, free)]
    torch.testing.assert_close(sigma[0], sigma[1], rtol=1e-3, atol=0)
    assert free.freedom == prior.freedom


class TestRefused:
    def test_boards_that_moved_in_between(self) -> None:
        with pytest.raises(InputError, match="one camera saw the boards from two places: boards moved while the"):
            boards_rig(standing(10, 4, moved=0.02), calibrated(0))

    def test_one_view_given_as_two_places(self) -> None:
        """Marked twice in one image: there is no baseline."""
        once, again = survey(0), survey(1)
        same = dataclasses.replace(once, pixels=torch.stack([once.pixels[:, 0], again.pixels[:, 0]], 1))
        with pytest.raises(InputError, match="left and right are one camera at one place: they stand"):
            rig((calibrated(0),) * 2, same)
        same = dataclasses.replace(once, pixels=once.pixels[:, [0, 0]])
        with pytest.raises(InputError, match="the same camera twice"):
            rig((calibrated(0),) * 2, same)
