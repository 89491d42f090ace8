"""Under a weak prior a rich model is solved directly: to the same minimum as by the model ladder."""

from __future__ import annotations

import math

import pytest
from calibrate_scenes import camera, motions, observe, pixels_of

import kcal.calibrate.camera.solve
from kcal.calibrate.camera.calibrate import CalibrationOptions, CameraCalibrationResult, calibrate_camera

TRUTH = camera("opencv14")
# Of a standard deviation: the noise that priors count against is settled to 1e-4.
SAME = 1e-3


def apart(one: CameraCalibrationResult, other: CameraCalibrationResult) -> float:
    """Largest difference of fx, fy, cx, cy in standard deviations."""
    return max(
        abs(float(a) - float(b)) / float(one.sigma[name] or math.nan)
        for name, a, b in zip(one.camera.names[:4], one.camera.params, other.camera.params, strict=False)
    )


@pytest.mark.parametrize("views", [20, 110])
def test_it_ends_where_the_ladder_ends(views: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Few views are solved on all of them, many on compressed ones."""
    seen = observe(pixels_of(TRUTH, motions(TRUTH, views, 5), noise=0.2))
    options = CalibrationOptions(model="opencv14", weak_prior=0.3)
    quick = calibrate_camera(seen, options)

    monkeypatch.setattr(kcal.calibrate.camera.solve, "solve_directly", lambda *_: None)
    slow = calibrate_camera(seen, options)
    assert apart(slow, quick) < SAME
    assert quick.rms == pytest.approx(slow.rms, rel=1e-6)
    assert quick.iterations < slow.iterations


def test_the_start_does_not_matter() -> None:
    seen = observe(pixels_of(TRUTH, motions(TRUTH, 15, 7), noise=0.2))
    ends = [
        calibrate_camera(seen, CalibrationOptions(model="ext20", weak_prior=0.3, focal=focal))
        for focal in (None, 250.0, 400.0, 700.0, 1100.0)
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
