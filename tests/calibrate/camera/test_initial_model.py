"""Where parametric cameras begin, and that this decides nothing: narrow and wide lenses, without any guess."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, observe, pixels_of

from kcal import Board, Camera, Observations, View
from kcal.calibrate.camera.calibrate import CalibrationOptions, CameraCalibrationResult, calibrate_camera
from kcal.calibrate.camera.solve import first_states, follow_base
from kcal.calibrate.problem.views import CameraViews
from kcal.lens import LensModel
from kcal.lens.model import radius_over_angle
from scripts.shared.distorted import distort

TRUTH = camera("opencv14")
# Of a standard deviation: the noise that priors count against is settled to 1e-4.
SAME = 1e-3


def apart(one: CameraCalibrationResult, other: CameraCalibrationResult) -> float:
    """Largest difference of fx, fy, cx, cy in standard deviations."""
    return max(
        abs(float(a) - float(b)) / float(one.sigma[name] or math.nan)
        for name, a, b in zip(one.camera.names[:4], one.camera.params, other.camera.params, strict=False)
    )


@pytest.mark.parametrize("shape", [0.0, 0.25, 1.0])
@pytest.mark.parametrize(
    ("model", "degrees", "error"), [("opencv8", 80, 5e-3), ("ext22", 80, 5e-3), ("opencv5", 40, 2e-3)]
)
def test_a_lens_follows_the_base_projection(shape: float, model: str, degrees: float, error: float) -> None:
    lens = follow_base(shape, math.radians(degrees), LensModel.named(model), {})
    angle = torch.linspace(0.01, math.radians(degrees), 50, dtype=torch.float64)
    point = torch.stack([torch.tan(angle), torch.zeros_like(angle)], -1)
    wanted = angle * radius_over_angle(shape * angle**2)
    # Three orders each way: a start, good to a few thousandths of the focal length.
    assert float((distort(point, lens, model)[:, 0] - wanted).abs().max()) < error
    assert LensModel.named(model).size == len(lens)


def test_a_fisheye_follows_exactly_what_it_contains() -> None:
    model = LensModel.named("fisheye4")
    torch.testing.assert_close(follow_base(0.0, 1.6, model, {}), torch.zeros(4).double(), rtol=0, atol=1e-12)


def test_coefficients_that_are_held_stay() -> None:
    model = LensModel.named("opencv8")
    lens = follow_base(0.25, 0.8, model, {"k3": 0.0, "k6": 0.01, "p1": 0.002})
    assert [float(lens[model.names.index(name)]) for name in ("k3", "k6", "p1")] == [0.0, 0.01, 0.002]
    angle = torch.linspace(0.01, 0.8, 50, dtype=torch.float64)
    found = distort(torch.stack([torch.tan(angle), torch.zeros_like(angle)], -1), lens * (lens != 0.002), model)[:, 0]
    assert float((found - 2.0 * torch.tan(0.5 * angle)).abs().max()) < 1e-3


def test_the_first_state_is_near_the_truth() -> None:
    """The closed forms, the base projection and its curve: within two pixels of a lens with all 14 coefficients."""
    pixels = pixels_of(TRUTH, motions(TRUTH, 15, 7), noise=0.2)
    views = CameraViews(board_points=BOARD.points, pixels=pixels, size=SIZE)
    starts, noise, steps = first_states(views, TRUTH.model, None, barrier=True)
    assert views.noise(starts[0].state, TRUTH.model) < 2.0
    assert 0.2 < noise < 2.0
    assert steps > 0
    assert len(starts) == 2
    assert not bool(starts[1].state.parameters[5:].any())
    assert [len(start.terms) for start in starts] == [1, 1]


def wide_views(count: int) -> Observations:
    lens = follow_base(0.0, math.radians(84), LensModel.named("opencv8"), {})
    truth = Camera.build(
        focal=(330, 331), center=(318, 243), size=(640, 480), coefficients=lens.tolist(), model="opencv8"
    )
    return observe(pixels_of(truth, motions(truth, count, 3, fill=0.7), noise=0.1, seed=3), board=BOARD)


@pytest.mark.parametrize("weak_prior", [None, 0.3])
def test_a_simulated_wide_lens_without_a_guess(weak_prior: float | None) -> None:
    result = calibrate_camera(wide_views(20), CalibrationOptions(model="opencv8", weak_prior=weak_prior))
    # 0.1 px an axis is 0.141 px as RMS over points.
    assert result.rms < 0.15
    assert float(result.camera.focal[0]) == pytest.approx(330, rel=0.01)


@pytest.mark.parametrize("model", ["hybrid", "opencv8"])
def test_a_wrong_focal_length_of_a_wide_lens_is_not_believed(model: str) -> None:
    guesses = None, 165.0, 660.0
    alone, *told = (calibrate_camera(wide_views(8), CalibrationOptions(model=model, focal=f)) for f in guesses)
    for other in told:
        assert other.rms == pytest.approx(alone.rms, rel=1e-3)
        assert float(other.camera.focal[0]) == pytest.approx(float(alone.camera.focal[0]), rel=1e-3)


@pytest.mark.slow
def test_a_real_lens_of_150_degrees(kcal_data: Path) -> None:
    data = np.load(kcal_data / "wide_lens_corners.npz")
    views = []
    for number in range(0, 93, 3):
        corners, weight = data["corners"][number], data["weight"][number]
        pixels = tuple((float(u), float(v)) if w > 0 else None for (u, v), w in zip(corners, weight, strict=True))
        views.append(View(name=str(number), pixels=pixels))
    seen = Observations(board=Board(columns=10, rows=10, square=0.077), image_size=(6016, 4016), views=tuple(views))
    result = calibrate_camera(seen, CalibrationOptions(weak_prior=None, model="opencv8", board_warp=True))
    known = data["seed_intrinsics_fx_fy_cx_cy"]
    # Another program's solution of twice the views; the data's own spread is a few tenths of a percent.
    assert result.camera.focal.tolist() == pytest.approx(known[:2].tolist(), rel=5e-3)
    # Other programs end at 0.77 to 1.6 px, with all views and corners weighted by their quality.
    assert result.rms < 1.2


@pytest.mark.slow
def test_the_start_does_not_matter() -> None:
    seen = observe(pixels_of(TRUTH, motions(TRUTH, 15, 7), noise=0.2))
    ends = [
        calibrate_camera(seen, CalibrationOptions(model="ext20", weak_prior=0.3, focal=focal))
        for focal in (None, 250.0, 1100.0)
    ]
    assert max(apart(ends[0], end) for end in ends[1:]) < SAME


def test_what_priors_know_better_than_the_views_is_named() -> None:
    seen = observe(pixels_of(TRUTH, motions(TRUTH, 8, 7), noise=0.2))
    weak = calibrate_camera(seen, CalibrationOptions(model="opencv14", weak_prior=0.3))
    assert {"k1", "k4"} <= set(weak.led_by_prior), "these can hardly be told apart"
    assert not {"fx", "fy", "cx", "cy"} & set(weak.led_by_prior)
    sigma = calibrate_camera(seen, CalibrationOptions(model="opencv5")).sigma["fx"]
    assert sigma is not None
    for share, led in ((0.1, ("fx",)), (10.0, ())):
        known = CalibrationOptions(model="opencv5", priors={"fx": (float(TRUTH.focal[0]), share * sigma)})
        assert calibrate_camera(seen, known).led_by_prior == led


def test_exact_corners_are_hardly_moved() -> None:
    """Priors count as beside corners of a thousandth of a pixel at least."""
    seen = observe(pixels_of(TRUTH, motions(TRUTH, 25, 3)))
    assert calibrate_camera(seen, CalibrationOptions(model="opencv14", weak_prior=0.3)).rms < 5e-4


@pytest.mark.slow
def test_a_prior_that_the_views_contradict_is_told_of() -> None:
    seen = observe(pixels_of(TRUTH, motions(TRUTH, 20, 5), noise=0.05))
    contradicted = [
        any("contradict" in text for text in calibrate_camera(seen, options).warnings)
        for options in (
            CalibrationOptions(model="opencv14", weak_prior=0.3),
            CalibrationOptions(model="opencv14", weak_prior=0.002),
            CalibrationOptions(model="opencv5", priors={"fx": (500.0, 5.0)}),
            CalibrationOptions(model="opencv5", priors={"fx": (520.0, 5.0)}),
        )
    ]
    assert contradicted == [False, True, False, True]
