"""Stars together with boards, and in two images."""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import ran

from kcal import CalibrationOptions, Camera, InputError, calibrate_camera, load_camera
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.io.images import write_png
from kcal.sim.captures import drawn_lens
from kcal.stars import SkyView
from kcal.stars.detect import DetectedStars
from kcal.stars.lens import StarCamera, calibrate_by_stars, refine_by_stars
from kcal.stars.lens_fit import StarField, fit_star_lens
from kcal.stars.sky import StarCatalog, cache_folder, pair_table
from scripts.check.stars import PLACE, SIZE, lens_difference, rendered, star_images, true_lens
from scripts.shared.captures import PRESCRIPTIONS, capture, error_at_infinity

# Boards and stars together: one posterior, and whether they contradict each other.


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
    assert agreement.contradiction is None
    assert agreement.freedom >= 4
    assert 0.1 < agreement.chi2 / agreement.freedom < 3
    joint = both.joint
    # Stars add information: no parameter is known less well than before, and the focal length far better.
    for name in ("fx", "cx", "cy"):
        old, new = boards.sigma[name], joint.sigma[name]
        assert old is not None
        assert new is not None
        assert new <= old * 1.001
    assert abs(float(camera.params[0] - true_lens().params[0])) < 4 * float(joint.covariance[0, 0].sqrt())
    # Boards are in it still: of the entrance pupil stars know nothing.
    known = joint.information
    assert known.board_size == boards.information.board_size  # type: ignore[union-attr]
    pupil = [i for i, name in enumerate(camera.names) if name.startswith("pupil")]
    assert all(known.slots[i] >= 0 for i in pupil)


def test_the_posterior_is_at_its_minimum(both: StarCamera) -> None:
    """Rows and priors together have no slope at the estimate, in lens and board alike."""
    known = both.lens.camera.calibration
    rows = known.information.whole.rows
    slope = rows[:, :-1].T @ rows[:, -1]
    assert float((known.information.half() @ slope).abs().max()) < 1e-4


def test_another_focus_contradicts(boards: CameraCalibrationResult, night: Night) -> None:
    """The night at a focal length that is 1 % longer than that of the boards, which is five of its sigmas."""
    images, views = night
    middle = torch.tensor([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2]).numpy()
    zoomed = [image._replace(pixels=middle + 1.01 * (image.pixels - middle)) for image in images]
    found = calibrate_by_stars(zoomed, views, SIZE, boards=boards)
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
    boards = calibrate_camera(capture(true_lens(), 10, 0.1, 1), CalibrationOptions(model="opencv5"))
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
    capture(true_lens(), 10, 0.1, 1).save(tmp_path / "left.obs.json")
    output = tmp_path / "left.camera.json"
    command = ["calibrate", str(tmp_path / "left.obs.json"), "--stars", str(folder), "--time", "name:Z", "--json"]
    command += ["--site", f"{PLACE.lat},{PLACE.lon},{PLACE.height}"]
    done = ran(*command, "-o", output)
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["agreement"]["by_chance"] > 1e-4
    assert len(told["images"]) == 3
    assert error_at_infinity(load_camera(output), true_lens()).rms < 0.1
    two = ran(command[0], command[1], command[1], *command[2:], "-o", tmp_path / "two")
    assert "--stars are of one camera" in str(two.exception)


# A lens from two images of the simulated sky, in a few seconds, and the table of pairs that names their stars.


@pytest.fixture(scope="module")
def found() -> StarCamera:
    images, views = star_images(35.0, 2, seed=1)
    told: list[str] = []
    made = calibrate_by_stars(images, views, SIZE, focal=1100.0, progress=told.append)
    # The image of most stars comes first; images are counted from one.
    most = max(range(2), key=lambda number: len(images[number].pixels))
    assert told[0] == f"search 1 of 3: image {most + 1}, focal length 1100 px"
    assert [text for text in told if not text.startswith("search 1")] == ["names", "lens", "lens", "lens"]
    return made


@pytest.mark.slow
def test_the_lens_is_found(found: StarCamera) -> None:
    lens = found.lens
    error = lens_difference(found)
    assert np.sqrt((error**2).mean()) < 0.06
    assert error.max() < 0.3
    assert lens.rms_px == pytest.approx(0.1, rel=0.2)
    # Of 178 stars with two coordinates: a scatter of 5 %.
    assert lens.widened == pytest.approx(1.0, abs=0.15)
    for residuals, used in zip(lens.residuals, lens.used, strict=True):
        assert bool((residuals.abs().amax(-1) < 0.6)[used].all())
        assert int((~used).sum()) <= 2


def test_its_uncertainty(found: StarCamera) -> None:
    known = found.lens.camera.calibration
    assert known.sigma is not None
    for name in ("fx", "cx", "cy"):
        place = found.lens.camera.names.index(name)
        sigma = known.sigma[name]
        assert sigma is not None
        assert 0.05 < sigma < 0.6
        assert abs(float(found.lens.camera.params[place] - true_lens().params[place])) < 3.5 * sigma
    # Focal length, center, and as much of the field as some 180 stars tell.
    assert 5 < found.lens.effective < 40


def test_all_pairs_of_bright_stars_are_in_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KCAL_CACHE", str(tmp_path))
    catalog = StarCatalog.bundled()
    for field_deg, limit_deg in ((3.7, 3.0), (3.8, 5.0), (8.7, 7.0), (8.8, 10.0), (70.0, 60.0), (150.0, 60.0)):
        table = pair_table(catalog, np.radians(field_deg))
        # Over eight tenths of the field.
        assert np.radians(limit_deg) * 0.995 < table.angle[-1] <= np.float32(np.radians(limit_deg))
        assert len(table.pairs) == len(table.angle)
        # Fewer stars take part for wide angles: some 700,000 pairs, each both ways.
        assert len(table.angle) < 2 * 700_000 * 1.2
        if table.stars < len(table.order):
            assert len(table.angle) > 2 * 700_000 * 0.8
        bright = min(150, table.stars)
        angle = np.arccos(np.clip(table.directions[:bright] @ table.directions[:bright].T, -1, 1))
        wanted = np.sort(angle[(angle < np.radians(limit_deg)) & ~np.eye(bright, dtype=bool)])
        np.testing.assert_allclose(np.sort(table.angle[(table.pairs < bright).all(1)]), wanted, atol=1e-4)
        assert np.all(np.diff(table.angle) >= 0)
    # Each pair both ways, one after the other; the brightest star is the first.
    assert np.array_equal(table.pairs[::2], table.pairs[1::2, ::-1])
    assert catalog.name_of(int(catalog.number[table.order[0]])) == "Sirius"


@pytest.mark.parametrize(
    ("platform", "folder"),
    [("win32", "AppData/Local/kcal"), ("darwin", "Library/Caches/kcal"), ("linux", ".cache/kcal")],
)
def test_folders_of_caches(platform: str, folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("KCAL_CACHE", "LOCALAPPDATA", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.setattr("sys.platform", platform)
    assert cache_folder() == tmp_path / folder
    monkeypatch.setenv("LOCALAPPDATA", "/local")
    monkeypatch.setenv("XDG_CACHE_HOME", "/xdg")
    assert str(cache_folder()) == {"win32": "/local/kcal", "linux": "/xdg/kcal"}.get(platform, str(tmp_path / folder))
    monkeypatch.setenv("KCAL_CACHE", "/given")
    assert str(cache_folder()) == "/given"


# A lens from stars alone: simulated, of which nothing is known, and from six real images.


@pytest.mark.slow
def test_a_lens_of_another_kind_that_explains_a_few_stars_is_not_the_end() -> None:
    """With 1600 px, a fisheye gives eight stars in the middle of the first image names; the second image tells more."""
    lens = drawn_lens(PRESCRIPTIONS["surveillance"], 1.0, 2, wander=1.0)
    images, views = star_images(0.0, 10, 2, lens=lens)
    found = calibrate_by_stars(images[:7:-1], views[:7:-1], lens.size, focal=1600.0)
    assert found.refused == {}
    assert float(found.lens.camera.params[0]) == pytest.approx(1599.5, abs=0.3)


REAL = Path(os.environ.get("KCAL_DATA", ""), "stars")


@pytest.mark.slow
def test_a_lens_from_stars() -> None:
    images, views = star_images(35.0, 6, seed=1)
    found = calibrate_by_stars(images, views, SIZE)
    assert found.images == tuple(range(6))
    # Of each image five points are no stars.
    for star, image in zip(found.stars, images, strict=True):
        assert 0.7 * (len(image.pixels) - 5) < len(star) <= len(image.pixels) - 5
    assert found.lens.rms_px == pytest.approx(0.1, rel=0.15)
    error = lens_difference(found)
    assert np.sqrt((error**2).mean()) < 0.06
    # The lens of an image without distortion would be off by 19 px in the corners.
    assert error.max() < 0.3
    known = found.lens.camera.calibration
    assert known.information is not None
    focal_sigma = known.sigma["fx"]
    assert focal_sigma is not None
    assert abs(float(found.lens.camera.params[0] - true_lens().params[0])) < 5 * focal_sigma


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="needs KCAL_DATA/stars")
def test_six_real_images(tmp_path: Path) -> None:
    """Names, lens and attitude on the Earth of a camera of which only time and place are known."""
    camera = tmp_path / "camera.json"
    place = ["--time", "name:Z"]
    done = ran("calibrate", "--stars", REAL, *place, "--site", "52,4.37,0", "-o", camera)
    assert done.exit_code == 0, done.output
    assert float(load_camera(camera).params[0]) == pytest.approx(5117, abs=3)
    picture = tmp_path / "named.png"
    where = ["--site", "52,4.37,0", "--picture", str(picture), "--json"]
    done = ran("stars", REAL, "--camera", camera, *place, *where)
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)["images"]
    assert len(told) == 6
    # A narrow lens: stars of three of these images give a lens whose attitudes are 0.05° off.
    assert 0.03 < json.loads(done.stdout)["lens_turn_deg"] < 0.1
    assert all(max(image["sigma_deg"]) < 0.005 for image in told)
    for image in told:
        # Altitude and azimuth of the axis stand in the names, roughly.
        altitude, azimuth = (float(part[3:]) for part in image["image"].split("_")[1:3])
        assert image["pitch_deg"] == pytest.approx(altitude, abs=1.6)
        assert (image["heading_deg"] - azimuth + 180) % 360 - 180 == pytest.approx(0.0, abs=1.2)
        assert image["rms_px"] < 0.12
        assert image["identified"] >= 7
    assert picture.stat().st_size > 10_000
