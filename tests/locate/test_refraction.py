"""Light that bends, from landmarks to heights: the coefficient of refraction as one of a rig's unknowns."""

import dataclasses
from pathlib import Path

import pytest
import torch
from rig_scenes import CAMERAS, CENTER, NAMES, ROTATION, normal, posts, spread_points
from torch import Tensor

from kcal import InputError, Landmarks, Localizer, Origin, RigData, RigOptions, load_rig, save_rig, solve_rig
from kcal.calibrate.rig.result import RigResult
from kcal.locate import enu_to_geodetic
from kcal.rig import Mounting, check_rig, placed_rig

ORIGIN = Origin(lat=19.07, lon=72.87, height=14.0)
EARTH = 6_371_008.8  # meters, mean radius
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def bent(points: Tensor, camera: int, k: float) -> Tensor:
    """Pixels of points in light that bends: they are seen k d² / 2R too high."""
    away = points - CENTER[camera]
    lift = k * away[:, :2].square().sum(-1, keepdim=True) / (2.0 * EARTH)
    return CAMERAS[camera].project((away + lift * UP) @ ROTATION[camera].T)[0]


def lifted(
    k: float, *, far: float = 5000.0, noise: float = 0.0, seed: int = 0, sigma: float = 0.1, survey: float = 0.02
) -> Landmarks:
    """Twenty of them from 60 m on, with `noise` times their sigmas in survey and marks."""
    truth = spread_points(20, 60.0, far, 5)
    pixels = torch.stack([bent(truth, c, k) for c in (0, 1)], 1)
    seeds = (100 + seed, 200 + seed)
    return posts(truth, pixels, noise=noise * sigma, error=noise * survey, survey=survey, sigma=sigma, seeds=seeds)


def solved(marks: Landmarks, **options: float) -> RigResult:
    data = RigData(cameras=CAMERAS[:2], names=NAMES[:2], landmarks=marks)
    return solve_rig(data, RigOptions(intrinsics="fixed", **options))


def test_the_true_coefficient_gives_the_true_rig() -> None:
    found = solved(lifted(0.31), refraction=0.31, refraction_sigma=0.0)
    assert found.refraction == 0.31
    assert float((found.center - CENTER[:2]).abs().max()) < 1e-8
    assert float((found.rotation - ROTATION[:2]).abs().max()) < 1e-11
    # Straight lines bend the rig instead: 0.31 is a fifth of a pixel at 5 km.
    assert float((solved(lifted(0.31), refraction=0.0, refraction_sigma=0.0).center - CENTER[:2]).abs().max()) > 1e-3


def test_landmarks_that_tell_it_tell_it() -> None:
    found = solved(lifted(0.31, sigma=1e-3, survey=1e-3))
    sigma = float(found.mounting_covariance()[6, 6].sqrt())
    assert sigma < 0.02
    assert abs(found.refraction - 0.31) < 0.2 * sigma + 0.18 * (sigma / 0.1) ** 2
    near = solved(lifted(0.31, far=300.0))
    assert abs(near.refraction - 0.13) < 1e-3
    assert float(near.mounting_covariance()[6, 6].sqrt()) == pytest.approx(0.1, rel=1e-3)


@pytest.mark.slow
def test_heights_have_the_errors_that_are_stated() -> None:
    """χ² of errors across the line of sight at 5 km, over draws of k, survey and marks; all parts of it are needed."""
    target = spread_points(1, 5000.0, 5000.0, 12)
    level = torch.nn.functional.normalize((target - CENTER[0])[0, :2], dim=-1)
    sight = torch.nn.functional.normalize(target - CENTER[0], dim=-1)[0]
    upward = torch.cat([-sight[2] * level, (sight[:2] * level).sum()[None]])
    whole, apart, draws = 0.0, 0.0, 40
    for seed in range(draws):
        k = 0.13 + 0.1 * float(normal((), 900 + seed))
        rig = placed_rig(solved(lifted(k, noise=1.0, seed=1000 * seed)), ORIGIN)
        pixels = [bent(target, c, k) for c in (0, 1)]
        assert rig.mounting is not None
        for linked in (True, False):
            mounting = rig.mounting
            if not linked:
                covariance = torch.block_diag(mounting.covariance[:6, :6], mounting.covariance[6:, 6:])
                rig.mounting = dataclasses.replace(mounting, covariance=covariance)
            # Marks without noise: what is left is the rig's and the light's.
            found = Localizer(rig, pixel_sigma=1e-3)(*pixels)
            error = float((found.geodetic - enu_to_geodetic(target, ORIGIN))[0, 2])
            ratio = float((target - CENTER[0]).norm() / found.enu.norm())
            # The height where the range is the true one.
            error = float(((found.enu[0] * ratio - (target - CENTER[0])[0]) * upward).sum())
            square = error**2 / (ratio**2 * float(upward @ found.covariance[0] @ upward))
            if linked:
                whole += square
            else:
                apart += square
    spread = 4.0 * (2.0 * draws) ** 0.5
    assert draws - spread < whole < draws + spread
    # Taken apart, what the mounting makes up for is counted twice.
    assert apart < 0.7 * whole


def test_a_file_keeps_it_and_the_localizer_takes_it(tmp_path: Path) -> None:
    rig = placed_rig(solved(lifted(0.31)), ORIGIN)
    again = load_rig(save_rig(rig, tmp_path / "rig.json"))
    assert rig.mounting is not None
    assert again.mounting is not None
    assert again.mounting.refraction == rig.mounting.refraction
    assert torch.equal(again.mounting.covariance, rig.mounting.covariance)
    target = spread_points(1, 5000.0, 5000.0, 12)
    pixels = [bent(target, c, 0.31) for c in (0, 1)]
    own, loaded = (Localizer(one, pixel_sigma=0.1)(*pixels) for one in (rig, again))
    assert torch.equal(own.enu, loaded.enu)
    assert torch.equal(own.covariance, loaded.covariance)
    # Given anew, it replaces the rig's: here with the usual sigma, which is larger than what the landmarks left.
    same = Localizer(rig.placed(refraction=rig.mounting.refraction), pixel_sigma=0.1)(*pixels)
    assert torch.equal(same.enu, own.enu)
    assert float(same.covariance[0, 2, 2]) > float(own.covariance[0, 2, 2])
    # Nothing found of it: the usual one.
    rig.mounting = Mounting(origin=ORIGIN, heading_deg=16.0)
    usual, stated = Localizer(rig), Localizer(rig.placed(refraction=0.13, refraction_sigma=0.1))
    assert torch.equal(usual(*pixels).enu, stated(*pixels).enu)
    assert torch.equal(usual(*pixels).covariance, stated(*pixels).covariance)


def test_light_of_another_day_is_no_drift() -> None:
    """Landmarks at 2 to 5 km rise by 0.06 to 0.16 px when k grows by 0.25: what is not known of it explains that."""
    rig = placed_rig(solved(lifted(0.13, sigma=0.01, survey=1e-3)), ORIGIN)
    assert rig.mounting is not None
    now = lifted(0.38, sigma=0.01, survey=1e-3)
    place = rig.mounting.origin
    marks = dataclasses.replace(now, points=now.points - CENTER[0])
    assert abs(place.height - (ORIGIN.height + float(CENTER[0, 2]))) < 0.1
    assert not check_rig(rig, landmarks=marks).left_significant
    held = dataclasses.replace(
        rig.mounting, covariance=rig.mounting.covariance.clone().index_fill(0, torch.tensor(6), 0.0)
    )
    rig.mounting = dataclasses.replace(held, covariance=held.covariance.index_fill(1, torch.tensor(6), 0.0))
    assert check_rig(rig, landmarks=marks).left_significant


def test_coefficients_that_cannot_be() -> None:
    for name, values in {"refraction": (2.01, -2.01), "refraction_sigma": (2.01, -0.01, float("nan"))}.items():
        for value in values:
            with pytest.raises(InputError, match="refraction"):
                RigOptions(**{name: value})
    assert RigOptions(refraction=-2.0, refraction_sigma=2.0).refraction == -2.0
