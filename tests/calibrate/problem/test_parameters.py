"""Parameters fixed, tied, freed and known beforehand, against a dense solution of the same problem."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, observe, pixels_of
from torch import Tensor

from kcal.calibrate.camera.calibrate import CalibrationOptions, CameraCalibrationResult, calibrate_camera
from kcal.errors import InputError
from kcal.lens.pose import rotation_from_vector
from kcal.lens.projection import project_components

VIEWS = 10
# What is said -> the unknowns as groups of names that move together; every other parameter stays.
LENS = [["k1"], ["k2"], ["p1"], ["p2"], ["k3"]]
CASES: list[tuple[dict[str, Any], list[list[str]]]] = [
    ({"fixed": {"cx": 325.0, "k3": None}}, [["fx"], ["fy"], ["cy"], *LENS[:4]]),
    ({"tied": (("fx", "fy"),)}, [["fx", "fy"], ["cx"], ["cy"], *LENS]),
    ({"free": ("skew",)}, [["fx"], ["fy"], ["cx"], ["cy"], ["skew"], *LENS]),
    ({"priors": {"fx": (502.0, 0.5), "p1": (0.0, 1e-4)}}, [["fx"], ["fy"], ["cx"], ["cy"], *LENS]),
    ({"tied": (("fx", "fy"), ("p1", "p2")), "priors": {"fy": (500.0, 1.0)}, "fixed": {"skew": 0.4}},
     [["fx", "fy"], ["cx"], ["cy"], ["k1"], ["k2"], ["p1", "p2"], ["k3"]]),
]  # fmt: skip


def scene(views: int = VIEWS) -> Tensor:
    truth = camera()
    return pixels_of(truth, motions(truth, views, 5), noise=0.1, seed=2)


def values(result: CameraCalibrationResult) -> dict[str, float]:
    return dict(zip(result.camera.names, result.camera.params.tolist(), strict=True))


@pytest.mark.parametrize(("options", "groups"), CASES)
def test_the_end_is_the_dense_optimum_and_sigma_its_inverse(options: dict[str, Any], groups: list[list[str]]) -> None:
    """A dense Gauss-Newton step from the result, by autograd and lstsq over the unknowns and all poses, is nothing."""
    pixels = scene()
    result = calibrate_camera(observe(pixels), CalibrationOptions(**{"model": "opencv5", **options}))
    names, model = result.camera.names, result.camera.model
    base, count = result.camera.params, len(groups)
    spread = torch.zeros(count, len(base), dtype=torch.float64)
    for k, group in enumerate(groups):
        spread[k, [names.index(name) for name in group]] = 1.0
    noise = result.rms / math.sqrt(2.0)
    priors = options.get("priors", {})

    def residuals(unknowns: Tensor) -> Tensor:
        parameters = base + unknowns[:count] @ spread
        turn, shift = unknowns[count:].reshape(VIEWS, 2, 3).unbind(1)
        rotation = rotation_from_vector(turn) @ result.cam_from_board_rotation
        points = rotation @ BOARD.points.T + (result.cam_from_board_translation + shift)[..., None]
        seen = project_components(points, parameters, model).pixels.transpose(-1, -2)
        known = [(parameters[names.index(n)] - mean) * noise / sigma for n, (mean, sigma) in priors.items()]
        return torch.cat([(seen - pixels).flatten(), *(value[None] for value in known)])

    zero = torch.zeros(count + 6 * VIEWS, dtype=torch.float64)
    r = residuals(zero)
    jacobian = torch.autograd.functional.jacobian(residuals, zero)
    scale = jacobian.norm(dim=0)
    step = torch.linalg.lstsq(jacobian / scale, -r[:, None]).solution[:, 0] / scale
    variance = torch.linalg.inv((jacobian / scale).T @ (jacobian / scale)).diagonal() / scale**2
    sigma = torch.sqrt(variance * (r @ r) / (len(r) - len(zero)))
    for k, group in enumerate(groups):
        assert abs(float(step[k])) < 1e-3 * float(sigma[k]), group
        for name in group:
            assert result.sigma[name] == pytest.approx(float(sigma[k]), rel=1e-4), name
    moving = {name for group in groups for name in group}
    assert {name for name, found in result.sigma.items() if found is not None} == moving
    for name, value in options.get("fixed", {}).items():
        assert values(result)[name] == (value or 0.0)
        assert name in result.fixed


def test_rules_hold_through_richer_models() -> None:
    """Over the ladder, on folded views (more than a thousand corners), with values of the last model's coefficients."""
    fixed = {"k6": 0.004, "s2": 0.0}
    options = CalibrationOptions(weak_prior=None, model="opencv12", fixed=fixed, tied=(("fx", "fy"), ("s1", "s3")))
    result = calibrate_camera(observe(scene(25)), options)
    found = values(result)
    assert (found["k6"], found["s2"]) == (0.004, 0.0)
    assert found["fx"] == pytest.approx(found["fy"], rel=1e-14)
    assert found["s1"] == pytest.approx(found["s3"], rel=1e-12)
    assert result.sigma["s1"] == result.sigma["s3"]
    assert (result.sigma["k6"], result.sigma["s2"]) == (None, None)
    whole = calibrate_camera(observe(scene(25)), CalibrationOptions(weak_prior=None, model="opencv12"))
    assert whole.rms < result.rms


def test_a_narrow_prior_fixes_and_a_wide_one_does_nothing() -> None:
    seen = observe(scene())
    plain, narrow, wide = (
        calibrate_camera(seen, CalibrationOptions(model="opencv5", priors=priors))
        for priors in ({}, {"cx": (330.0, 1e-6)}, {"cx": (330.0, 1e6)})
    )
    fixed = calibrate_camera(seen, CalibrationOptions(model="opencv5", fixed={"cx": 330.0}))
    for name, value in values(plain).items():
        assert values(wide)[name] == pytest.approx(value, rel=1e-6, abs=1e-6)
        assert values(narrow)[name] == pytest.approx(values(fixed)[name], rel=1e-5, abs=1e-6)


def test_a_field_of_view_is_a_start() -> None:
    truth = camera()
    degrees = 2.0 * math.degrees(math.atan(0.5 * SIZE[0] / float(truth.focal[0])))
    options = CalibrationOptions(model="opencv5", field_of_view=degrees)
    assert options.start_focal(SIZE) == pytest.approx(float(truth.focal[0]))
    hinted, plain = (
        calibrate_camera(observe(scene()), options),
        calibrate_camera(observe(scene()), CalibrationOptions(model="opencv5")),
    )
    assert values(hinted) == pytest.approx(values(plain), rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("model", ["hybrid", "fisheye4"])
def test_a_wide_field_of_view_begins_equidistant(model: str) -> None:
    """A perspective image has none of 180 degrees; below 90 degrees it is as good a start."""
    for degrees in (90.0, 150.0, 180.0, 230.0):
        options = CalibrationOptions(model=model, field_of_view=degrees)
        assert options.start_focal(SIZE) == pytest.approx(SIZE[0] / math.radians(degrees))
    narrow = CalibrationOptions(model=model, field_of_view=60.0).start_focal(SIZE)
    assert narrow == pytest.approx(0.5 * SIZE[0] / math.tan(math.radians(30.0)))
    assert CalibrationOptions(model="opencv5", field_of_view=150.0).start_focal(SIZE) == pytest.approx(
        0.5 * SIZE[0] / math.tan(math.radians(75.0))
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fixed": {"f": 1.0}}, "unknown parameter 'f'"),
        ({"fixed": {"k4": 0.0}}, "opencv5 has no parameter 'k4'"),
        ({"fixed": {"cx": math.nan}}, "cannot be fixed at nan"),
        ({"fixed": {"fx": -3.0}}, "cannot be fixed at -3"),
        ({"fixed": {"cx": 3.0}, "tied": (("cx", "cy"),)}, "cx is fixed and tied"),
        ({"fixed": {"cx": 3.0}, "priors": {"cx": (3.0, 1.0)}}, "cx is fixed and given a prior"),
        ({"fixed": {"skew": 3.0}, "free": ("skew",)}, "skew is fixed and freed"),
        ({"priors": {"skew": (3.0, 1.0)}}, "skew is held at 0"),
        ({"priors": {"fx": (3.0, 0.0)}}, "positive standard deviation"),
        ({"tied": (("fx",),)}, "two parameters"),
        ({"tied": (("fx", "fy"), ("fy", "cx"))}, "fy is tied twice"),
        ({"field_of_view": 180.0}, "opencv5 has less than 180; use the hybrid lens"),
        ({"field_of_view": 360.0, "model": "hybrid"}, "field_of_view must be"),
        ({"field_of_view": 60.0, "focal": 500.0}, "give one"),
    ],
)
def test_refusals(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        CalibrationOptions(**{"model": "opencv5", **options})


def test_a_focal_length_has_no_natural_value() -> None:
    with pytest.raises(InputError, match="fx has no natural value"):
        calibrate_camera(observe(scene()), CalibrationOptions(model="opencv5", fixed={"fx": None}))


@pytest.mark.parametrize("views", [1, 6])
def test_a_known_camera_leaves_only_the_poses(views: int) -> None:
    """Each pose is the dense optimum of its own view, and nothing of the camera moves."""
    truth = camera("opencv14")
    rotation, translation = motions(truth, views, 5)
    pixels = pixels_of(truth, (rotation, translation), noise=0.1, seed=2)
    result = calibrate_camera(observe(pixels), CalibrationOptions(camera=truth))
    assert torch.equal(result.camera.params, truth.params)
    assert set(result.sigma.values()) == {None}
    assert set(result.fixed) == set(truth.names)
    assert result.rms == pytest.approx(0.1 * math.sqrt(2.0), rel=0.2)
    for i in range(views):

        def residuals(pose: Tensor, i: int = i) -> Tensor:
            turned = rotation_from_vector(pose[:3]) @ result.cam_from_board_rotation[i] @ BOARD.points.T
            points = turned + (result.cam_from_board_translation[i] + pose[3:])[:, None]
            found = project_components(points, truth.params, truth.model).pixels
            return (found.T - pixels[i]).flatten()

        zero = torch.zeros(6, dtype=torch.float64)
        jacobian = torch.autograd.functional.jacobian(residuals, zero)
        step = torch.linalg.lstsq(jacobian, -residuals(zero)[:, None]).solution[:, 0]
        sigma = 0.1 * torch.linalg.inv(jacobian.T @ jacobian).diagonal().sqrt()
        assert bool((step.abs() < 1e-3 * sigma).all())


def test_a_known_camera_with_a_bent_board_and_a_freed_focal_length() -> None:
    truth = camera()
    poses = motions(truth, 8, 5)
    pixels = pixels_of(truth, poses, noise=0.05, seed=2)
    result = calibrate_camera(observe(pixels), CalibrationOptions(camera=truth, free=("fx", "fy"), board_warp=True))
    sigma = result.sigma["fx"]
    assert sigma is not None
    assert 0 < abs(values(result)["fx"] - float(truth.focal[0])) < 4 * sigma
    assert values(result)["cx"] == float(truth.center[0])
    assert result.board_warp is not None
    assert float(result.board_warp.abs().max()) < 1e-3


def test_a_known_camera_refuses_what_contradicts_it() -> None:
    truth = camera()
    for options in ({"fixed": {"cx": 3.0}}, {"focal": 500.0}, {"field_of_view": 60.0}):
        with pytest.raises(InputError, match="a known camera fixes all"):
            CalibrationOptions(camera=truth, **options)
    with pytest.raises(InputError, match="fx is fixed and tied"):
        CalibrationOptions(camera=truth, tied=(("fx", "fy"),))
    with pytest.raises(InputError, match="known camera is of"):
        calibrate_camera(observe(scene(), size=(641, 480)), CalibrationOptions(camera=truth))
