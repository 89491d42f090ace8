"""A lens from stars alone: simulated, of which nothing is known, and from six real images."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from kcal.cli.main import app
from kcal.errors import InputError
from kcal.io.camera_file import load_camera
from kcal.lens.camera import Camera
from kcal.stars.detect import DetectedStars, NightPlan, planned_stars
from kcal.stars.lens import calibrate_by_stars
from kcal.stars.lens_fit import StarField, fit_star_lens
from scripts.shared.infinity import error_at_infinity
from scripts.shared.star_lenses import SIZE, lens_difference, star_images, true_lens

REAL = Path(os.environ.get("KCAL_DATA", ""), "stars")


@pytest.mark.slow
@pytest.mark.parametrize("focal", [None, 1100.0])
def test_a_lens_from_stars(focal: float | None) -> None:
    images, views = star_images(35.0, 6, seed=1)
    found = calibrate_by_stars(images, views, SIZE, focal=focal)
    assert found.images == tuple(range(6))
    assert all(len(star) > 0.7 * (len(image.pixels) - 5) for star, image in zip(found.stars, images, strict=True))
    assert found.lens.rms_px == pytest.approx(0.1, rel=0.15)
    error = lens_difference(found)
    assert np.sqrt((error**2).mean()) < 0.06
    # The lens of an image without distortion would be off by 19 px in the corners.
    assert error.max() < 0.3
    known = found.lens.camera.calibration
    assert known is not None
    assert known.information is not None
    assert known.sigma is not None
    focal_sigma = known.sigma["fx"]
    assert focal_sigma is not None
    assert abs(float(found.lens.camera.params[0] - true_lens().params[0])) < 5 * focal_sigma


def test_a_fisheye_of_which_nothing_is_known() -> None:
    """140 degrees between the corners, which no pinhole has."""
    lens = Camera.build(focal=(618, 618), center=(642, 396), size=SIZE, model="fisheye4")
    lens = lens.with_parameters(lens.params.detach() + torch.tensor([0, 0, 0, 0, 0, -1 / 24, 0, 0, 0]).double())
    images, views = star_images(50.0, 1, seed=1, lens=lens, faintest=4.4)
    told: list[str] = []
    found = calibrate_by_stars(images, views, SIZE, progress=told.append)
    assert found.images == (0,)
    assert found.lens.rms_px < 0.13
    assert error_at_infinity(found.lens.camera, lens, columns=17, rows=11).rms < 0.2
    assert "search 1 of 2: image 1, focal length" in told[0]


def test_too_few_stars() -> None:
    empty = torch.zeros(3, 3).double()
    with pytest.raises(InputError, match="3 named stars tell no lens"):
        fit_star_lens([StarField(empty, empty[:, :2], torch.ones(3).double())], [torch.eye(3).double()], SIZE, 900.0)
    nothing = DetectedStars(np.empty((0, 2)), np.empty(0), np.empty(0), 0.0, {})
    _, views = star_images(35.0, 1, seed=1)
    with pytest.raises(InputError, match="in none of 1 images stars have names"):
        calibrate_by_stars([nothing], views, SIZE)


def test_planned_stars() -> None:
    """More light and a darker sky give more stars; a level camera sees half of the sky."""
    plans = {
        name: planned_stars(NightPlan(focal_px=1600, size=(1920, 1080), aperture_mm=2.9, **more))
        for name, more in {
            "plain": {}, "short": {"seconds": 0.25}, "suburb": {"sky_magnitude": 18.0}, "up": {"altitude_deg": 45.0},
        }.items()
    }  # fmt: skip
    plain = plans["plain"]
    assert plans["short"].stars < 0.5 * plain.stars
    assert plans["suburb"].stars < 0.7 * plain.stars
    assert plans["up"].stars > 2 * plain.stars
    assert plain.range_share(5000.0, 10.0, 1, 1.0) > 0.03
    assert plain.range_share(5000.0, 10.0, 20) == pytest.approx(plain.range_share(5000.0, 10.0) / 20**0.5)


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="needs KCAL_DATA/stars")
def test_six_real_images(tmp_path: Path) -> None:
    """Names, lens and attitude on the Earth of a camera of which only time and place are known."""
    camera = tmp_path / "camera.json"
    place = ["--time", "name:Z"]
    done = CliRunner().invoke(
        app, ["calibrate", "--stars", str(REAL), *place, "--place", "52,4.37,0", "-o", str(camera)]
    )
    assert done.exit_code == 0, done.output
    assert float(load_camera(camera).params[0]) == pytest.approx(5117, abs=3)
    picture = tmp_path / "named.png"
    where = ["--lat", "52", "--lon", "4.37", "--picture", str(picture), "--json"]
    done = CliRunner().invoke(app, ["stars", str(REAL), "--camera", str(camera), *place, *where])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)["images"]
    assert len(told) == 6
    for image in told:
        # Altitude and azimuth of the axis stand in the names, roughly.
        altitude, azimuth = (float(part[3:]) for part in image["image"].split("_")[1:3])
        assert image["pitch_deg"] == pytest.approx(altitude, abs=1.6)
        assert (image["heading_deg"] - azimuth + 180) % 360 - 180 == pytest.approx(0.0, abs=1.2)
        assert image["rms_px"] < 0.12
        assert image["identified"] >= 7
    assert picture.stat().st_size > 10_000
