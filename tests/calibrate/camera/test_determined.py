"""What the views determine, and what to trust of it."""

import math
import re

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, observe, pixels_of
from lenses import FEW_MODES, hybrid_camera

from kcal import Board, CalibrationOptions, Camera, DegenerateError, Observations, View, calibrate_camera, detect
from kcal.calibrate.camera.advice import check_directions, direction_share, reached, roll_findings
from kcal.calibrate.camera.checks import stray_corners
from kcal.calibrate.camera.warnings import general_findings, outlier_findings
from kcal.finding import sentences
from kcal.lens import LensModel, rotation_from_vector
from kcal.lens.projection import FAR, project_components
from kcal.lens.uncertainty import paraxial_focal
from kcal.solve import SolverStatus

# Whether views determine where a camera sees what they show: its directions, not its parameters.


def rays_of(lens: Camera) -> torch.Tensor:
    rays, valid = lens.unproject(lens.grid(15, 11).reshape(-1, 2))
    return rays[valid]


def spread_of(lens: Camera, **sigma: float) -> torch.Tensor:
    """Covariance with one common change of the parameters, of these sizes."""
    change = torch.tensor([sigma.get(name, 0.0) for name in lens.names], dtype=torch.float64)
    return change[:, None] * change


def test_for_a_pinhole_it_is_the_share_of_the_focal_length() -> None:
    """A shift of the principal point is a turn; and what is held is known."""
    lens = Camera.build(focal=(5000, 5000), center=(319.5, 239.5), size=SIZE, model="pinhole")
    for sigma, least, most in (({"fx": 100.0, "fy": 100.0}, 0.01998, 0.02002), ({"cx": 100.0}, 0.0, 0.001), ({}, 0, 0)):
        assert least <= direction_share(lens.params, lens.model, rays_of(lens), spread_of(lens, **sigma)) <= most


def test_what_other_parameters_make_up_for_does_not_count() -> None:
    """A focal length known to 29 % together with weights that take it back where boards were."""
    lens = hybrid_camera("webcam")
    rays, change = rays_of(lens), torch.zeros(len(lens.names), dtype=torch.float64)
    # Boards were in the middle, where weights can bend the image as they like.
    rays = rays[rays[:, 2] > 0.5 * (1.0 + float(rays[:, 2].min()))]
    change[:2] = 0.29 * lens.focal.detach()
    plain = direction_share(lens.params.detach(), lens.model, rays, change[:, None] * change)
    assert plain > 0.2
    free = list(range(8, len(lens.names)))
    slopes = project_components(FAR * rays.T, lens.params.detach(), lens.model, [0, 1, *free]).by_camera.flatten(1)
    change[free] = -torch.linalg.lstsq(slopes[2:].T, change[0] * slopes[0] + change[1] * slopes[1]).solution
    assert direction_share(lens.params.detach(), lens.model, rays, change[:, None] * change) < 0.1 * plain


@pytest.mark.parametrize("unknown", [math.nan, math.inf])
def test_no_covariance_is_no_knowledge(unknown: float) -> None:
    lens = camera("pinhole")
    spread = torch.diag(torch.tensor([1.0, unknown, 1.0, 1.0, 0.0], dtype=torch.float64))
    assert direction_share(lens.params.detach(), lens.model, rays_of(lens), spread) == math.inf
    rotation, translation = motions(lens, 4, 3)
    points = BOARD.points @ rotation.mT + translation[:, None]
    with pytest.raises(DegenerateError, match="not at all"):
        check_directions(lens.params.detach(), lens.model, points, points[..., 0] > -9, spread, rotation)


def test_the_message_names_the_view_that_is_tilted_most() -> None:
    lens = camera("pinhole")
    rotation, translation = motions(lens, 5, 3, tilt=12.0)
    points = BOARD.points @ rotation.mT + translation[:, None]
    seen = torch.ones(points.shape[:2], dtype=torch.bool)
    tilts = torch.rad2deg(torch.acos(rotation[:, 2, 2]))
    most = int(tilts.argmax())
    message = rf"only to ±6\.\d %.* in 0 of 5 views \(by {float(tilts[most]):.0f}° at most, in n{most}\).*45 degrees"
    spread = spread_of(lens, fx=30.5, fy=30.5)
    with pytest.raises(DegenerateError, match=message):
        check_directions(lens.params.detach(), lens.model, points, seen, spread, rotation, [f"n{i}" for i in range(5)])
    check_directions(lens.params.detach(), LensModel(), points, seen, spread / 4.0, rotation)


@pytest.mark.slow
def test_a_fisheye_whose_parameter_is_open_calibrates(kcal_data) -> None:
    """Its focal length on the axis is known to a quarter pixel, its fx far less."""
    found = calibrate_camera(Observations.load(kcal_data / "captures" / "fish_l.obs.json"))
    focal, sigma = paraxial_focal(found.camera).mean
    assert (found.sigma["fx"] or 0.0) > 15 * sigma
    assert sigma < 0.25
    assert 226.0 < focal < 230.0


@pytest.mark.slow
def test_the_focal_length_of_a_simulated_capture() -> None:
    """With its σ, over several captures of one camera; the parameter's σ is larger than that of the lens."""
    truth, pulls = camera("opencv4"), []
    wanted = float(truth.focal.mean())
    truth = Camera.build(
        focal=(wanted, wanted), center=truth.center.tolist(), size=SIZE, coefficients=[-0.21, 0.06], model="opencv4"
    )
    for seed in range(6):
        found = calibrate_camera(observe(pixels_of(truth, motions(truth, 10, seed), noise=0.1, seed=seed)))
        focal, sigma = paraxial_focal(found.camera).mean
        assert sigma < (found.sigma["fx"] or 0.0)
        pulls.append((focal - wanted) / sigma)
    # χ² of six: below 22.5 but once in a thousand.
    assert 0.3 < sum(pull * pull for pull in pulls) < 22.5


@pytest.mark.parametrize(("spread", "refused"), [(2.0, True), (5.5, False), (20.0, False)])
def test_the_spread_of_tilts_counts_not_the_tilt(spread: float, refused: bool) -> None:
    """All boards by 25 degrees, and by little or much more or less."""
    draw = torch.Generator().manual_seed(1)
    truth = Camera.build(focal=(800, 800), center=(322, 238), size=(640, 480), model="pinhole")
    board, count = Board(columns=9, rows=6, square=0.03), 14
    tilt = torch.tensor([25.0, 0.0, 0.0]) + spread * (2.0 * torch.rand(count, 3, generator=draw) - 1.0)
    points = (board.points - board.points.mean(0)) @ rotation_from_vector(torch.deg2rad(tilt.double())).mT
    place = (2.0 * torch.rand(count, 3, generator=draw).double() - 1.0) * torch.tensor([0.05, 0.04, 0.04])
    pixels = truth.project(points + (place + torch.tensor([0.0, 0.0, 0.65]))[:, None])[0]
    pixels = pixels + 0.02 * torch.randn(pixels.shape, generator=draw, dtype=torch.float64)
    seen = observe(pixels, board=board)
    if refused:
        with pytest.raises(DegenerateError, match="tilted alike"):
            calibrate_camera(seen)
    else:
        assert float(calibrate_camera(seen).camera.focal[0]) == pytest.approx(800.0, rel=0.02)


# Warnings that say what was found, why it matters and what to do.


def test_rolls_are_told_only_where_the_board_is_estimated() -> None:
    """A plate that is as ordered has no print to confound with anything."""
    seen = observe(pixels_of(camera("pinhole"), motions(camera("pinhole"), 8, 2), noise=0.05))
    assert any("upright" in text for text in calibrate_camera(seen).warnings)
    assert not any("upright" in text for text in calibrate_camera(seen, CalibrationOptions(board="exact")).warnings)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pi640", "ch1280"])
def test_rolls_of_captures_by_others(kcal_data, name: str) -> None:
    """Rolls do not depend on a calibration's quality: those of a plain start are enough."""
    if name == "ch1280":
        seen = Observations.load(kcal_data / "captures" / "ch1280.obs.json")
        rotation = calibrate_camera(seen, CalibrationOptions(model="opencv4")).cam_from_board_rotation
        assert roll_findings(rotation) == []
        return

    images = sorted((kcal_data / "captures" / "pi640").glob("*.jpg"))
    seen = detect(images[5:16], Board(columns=7, rows=7, square=0.0254), "none")
    rotation = calibrate_camera(seen, CalibrationOptions(model="opencv4")).cam_from_board_rotation
    assert re.search(r"upright \(rolled by at most [1-5]°\)", sentences(roll_findings(rotation))[0])


class TestGeneral:
    def warned(self, lens: Camera, status: SolverStatus = SolverStatus.CONVERGED, rms: float = 0.1) -> list[str]:
        return sentences(general_findings(["a"], lens, rms, torch.tensor([rms]).double(), (), status))

    def test_a_hybrid_lens_has_no_smaller_model(self) -> None:
        lens = hybrid_camera("wide", modes=FEW_MODES)
        larger = Camera(lens.params.detach(), size=(2 * lens.size[0], 2 * lens.size[1]), model=lens.model)
        (text,) = self.warned(larger)
        assert "% of the image has no ray: no board was there" in text
        assert "smaller model" not in text

    def test_what_to_do_about_a_fit_that_did_not_settle(self) -> None:
        assert "add views" in self.warned(hybrid_camera("pinhole", modes=FEW_MODES), SolverStatus.ITERATION_LIMIT)[0]

    def test_a_high_rms(self) -> None:
        assert "check the board's size, and look at the views" in self.warned(camera("pinhole"), rms=1.5)[0]

    @pytest.mark.parametrize(("stated", "misprint", "said"), [(0.015, 0.6, True), (0.02, 0.0, False)])
    def test_noise_far_above_that_of_corners(self, stated: float, misprint: float, said: bool) -> None:
        """A plate, as is said, of which each corner is elsewhere: it is small in each view, and no noise."""
        truth, generator = camera("pinhole"), torch.Generator().manual_seed(4)
        pixels = pixels_of(truth, motions(truth, 10, 2), noise=0.08)
        seen = observe(pixels + misprint * torch.randn(BOARD.corners, 2, dtype=torch.float64, generator=generator))
        spread = ((stated**2, 0.0, stated**2),) * BOARD.corners
        views = tuple(view.model_copy(update={"covariance": spread}) for view in seen.views)
        found = calibrate_camera(seen.model_copy(update={"views": views}), CalibrationOptions(board="exact"))
        assert 0.08 < found.rms < 1.0
        warned = [text for text in found.warnings if "corners' own covariances" in text]
        assert len(warned) == said
        if said:
            ratio = found.rms / (2**0.5 * stated)
            assert warned[0].startswith(f"RMS {found.rms:.2g} px is {ratio:.0f} times what")
            assert f"({2**0.5 * stated:.2g} px)" in warned[0]


def test_a_far_corner_blames_the_lens_only_where_it_may_be_too_simple() -> None:
    residuals = 0.1 * torch.randn(4, 40, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert not bool(stray_corners(residuals).any())
    assert outlier_findings("abcd", residuals, stray_corners(residuals)) == []
    residuals[1, 3] = 5.0
    strays = stray_corners(residuals)
    (plain,), (model,) = (
        sentences(outlier_findings("abcd", residuals, strays, more)) for more in ("", "; a richer model")
    )
    assert plain.startswith("1 of 160 corners are farther off than noise explains, corner 3 of view b by 7.07 px")
    assert plain.endswith("(--reject)")
    assert model == plain + "; a richer model"


def test_parts_of_the_image_are_reached_by_their_middles() -> None:
    """To a quarter of a pixel on either side, on pixels and on parts of two pixels."""
    corners = ((2.75, 2.75), (6.25, 2.75), (2.75, 6.25), (6.25, 6.25))
    view = View(name="a", pixels=corners)
    seen = Observations(board=Board(columns=2, rows=2, square=0.1), image_size=(10, 9), views=(view,))
    pixels = torch.zeros(9, 10, dtype=torch.bool)
    pixels[3:7, 3:7] = True
    assert torch.equal(reached(seen, 10, 9), pixels)
    # Middles at 0.5, 2.5, 4.5, 6.5, 8.5, and at 1, 4, 7.
    parts = torch.zeros(3, 5, dtype=torch.bool)
    parts[1, 2] = True
    assert torch.equal(reached(seen, 5, 3), parts)
