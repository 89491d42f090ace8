"""Boards and stars together: one posterior, and whether they contradict each other."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.cli.main import app
from kcal.errors import InputError
from kcal.io.camera_file import load_camera
from kcal.io.images import write_png
from kcal.stars.detect import DetectedStars
from kcal.stars.lens import StarCamera, calibrate_by_stars, refine_by_stars
from kcal.stars.night import SkyView
from scripts.shared.infinity import error_at_infinity
from scripts.shared.night_scenes import PLACE, rendered
from scripts.shared.star_lenses import SIZE, star_images, true_lens
from scripts.shared.traced import capture

Night = tuple[list[DetectedStars], list[SkyView]]


@pytest.fixture(scope="module")
def boards() -> CameraCalibrationResult:
    return calibrate_camera(capture(true_lens(), 10, 0.1, 1))


@pytest.fixture(scope="module")
def night() -> Night:
    return star_images(35.0, 3, seed=1)


@pytest.fixture(scope="module")
def both(boards: CameraCalibrationResult, night: Night) -> StarCamera:
    return calibrate_by_stars(*night, SIZE, boards=boards)


def test_stars_refine_the_lens_of_boards(boards: CameraCalibrationResult, both: StarCamera) -> None:
    camera, agreement = both.lens.camera, both.agreement
    before, after = (error_at_infinity(one, true_lens()).rms for one in (boards.camera, camera))
    assert after < 0.5 * before
    assert agreement is not None
    assert agreement.contradiction is None
    assert agreement.freedom >= 4
    assert 0.1 < agreement.chi2 / agreement.freedom < 3
    joint = both.joint
    assert joint is not None
    # Stars add information: no parameter is known less well than before, and the focal length far better.
    for name in ("fx", "cx", "cy"):
        old, new = boards.sigma[name], joint.sigma[name]
        assert old is not None
        assert new is not None
        assert new <= old * 1.001
    assert abs(float(camera.params[0] - true_lens().params[0])) < 4 * float(joint.covariance[0, 0].sqrt())
    # Boards are in it still: of the entrance pupil stars know nothing.
    known = joint.information
    assert known is not None
    assert known.board_size == boards.information.board_size  # type: ignore[union-attr]
    pupil = [i for i, name in enumerate(camera.names) if name.startswith("pupil")]
    assert all(known.slots[i] >= 0 for i in pupil)


def test_the_posterior_is_at_its_minimum(both: StarCamera) -> None:
    """Rows and priors together have no slope at the estimate, in lens and board alike."""
    known = both.lens.camera.calibration
    assert known is not None
    assert known.information is not None
    rows = known.information.whole.rows
    slope = rows[:, :-1].T @ rows[:, -1]
    half = known.information.half()
    assert float((half @ slope).abs().max()) < 1e-4


def test_another_focus_contradicts(boards: CameraCalibrationResult, night: Night) -> None:
    """The night at a focal length that is 1 % longer than that of the boards, which is five of its sigmas."""
    images, views = night
    middle = torch.tensor([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2]).numpy()
    zoomed = [image._replace(pixels=middle + 1.01 * (image.pixels - middle)) for image in images]
    found = calibrate_by_stars(zoomed, views, SIZE, boards=boards)
    assert found.joint is not None
    assert found.agreement is not None
    assert found.agreement.by_chance < 1e-6
    assert any("boards and stars contradict each other" in text for text in found.joint.warnings)


def test_what_boards_must_say(boards: CameraCalibrationResult, both: StarCamera, night: Night) -> None:
    mute = dataclasses.replace(boards, information=None)
    with pytest.raises(InputError, match="do not say how well"):
        calibrate_by_stars(*night, SIZE, boards=mute)
    with pytest.raises(InputError, match=r"1920x1080 pixels, those of boards 1280x800"):
        calibrate_by_stars(*night, (1920, 1080), boards=boards)
    with pytest.raises(InputError, match="0 named stars tell no lens"):
        refine_by_stars([], [], boards)


def test_a_parametric_lens_is_refined_as_well(night: Night) -> None:
    seen = capture(true_lens(), 10, 0.1, 1)
    boards = calibrate_camera(seen, CalibrationOptions(model="opencv5"))
    found = calibrate_by_stars(*night, SIZE, boards=boards)
    before, after = (error_at_infinity(one, true_lens()).rms for one in (boards.camera, found.lens.camera))
    assert after < before
    assert after < 0.03


@pytest.mark.slow
def test_the_command(night: Night, tmp_path: Path) -> None:
    images, views = night
    folder = tmp_path / "night"
    folder.mkdir()
    for image, view in zip(images, views, strict=True):
        magnitude = 5.0 - 2.5 * torch.log10(torch.from_numpy(image.flux / image.flux.min()))
        assert view.time is not None
        write_png(folder / f"{view.time:%Y-%m-%dT%H%M%S}.png", rendered(true_lens(), image.pixels, magnitude.numpy()))
    seen = capture(true_lens(), 10, 0.1, 1)
    seen.save(tmp_path / "left.obs.json")
    output = tmp_path / "left.camera.json"
    command = ["calibrate", str(tmp_path / "left.obs.json"), "--stars", str(folder), "--time", "name:Z", "--json"]
    command += ["--place", f"{PLACE.lat},{PLACE.lon},{PLACE.height}"]
    done = CliRunner().invoke(app, [*command, "-o", str(output)])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["agreement"]["by_chance"] > 1e-4
    assert len(told["images"]) == 3
    assert error_at_infinity(load_camera(output), true_lens()).rms < 0.1
    two = CliRunner().invoke(app, [command[0], command[1], command[1], *command[2:], "-o", str(tmp_path / "two")])
    assert "--stars are of one camera" in str(two.exception)
