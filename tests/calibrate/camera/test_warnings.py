"""Warnings that say what was found, why it matters and what to do: rolls of the board, the entrance pupil, the rest."""

from __future__ import annotations

import math
import re

import pytest
import torch
from calibrate_scenes import BOARD, camera, motions, observe, pixels_of
from lenses import FEW_MODES, hybrid_camera
from torch import Tensor

from kcal.calibrate.camera.advice import reached, roll_warnings, what_to_photograph
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.camera.warnings import corner_pupil, general_warnings, outlier_warnings, pupil_warnings
from kcal.corners.board import Board
from kcal.corners.detect import detect
from kcal.corners.observations import Observations, View
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector
from kcal.solve.problem import SolverStatus


def rolled(*degrees: float) -> Tensor:
    """Rotations by these rolls after tilts of some 30 degrees."""
    tilt = torch.tensor([[0.5, 0.1, 0.0], [-0.4, 0.3, 0.0], [0.1, -0.5, 0.0]], dtype=torch.float64)
    roll = torch.tensor([[0.0, 0.0, math.radians(angle)] for angle in degrees], dtype=torch.float64)
    tilts = rotation_from_vector(tilt)[torch.arange(len(degrees)) % 3]
    return tilts @ rotation_from_vector(roll)


class TestRolls:
    def test_a_board_upright_in_all_views(self) -> None:
        (text,) = roll_warnings(rolled(3.0, -7.2, 1.0, 178.0))
        assert text.startswith("all 4 views show the board upright (rolled by at most 7°): ")
        assert text.endswith("turn the board or the camera by 90° for a third of the views")

    def test_on_its_side(self) -> None:
        assert "all 3 views show the board on its side (rolled by at most 5°)" in roll_warnings(rolled(90, -85, 270))[0]

    def test_one_view_of_another_roll_is_enough(self) -> None:
        assert roll_warnings(rolled(0.0, 5.0, -5.0, 45.0)) == []
        assert roll_warnings(rolled(0.0, 90.0)) == []

    def test_views_left_out_and_none_at_all(self) -> None:
        rotation = rolled(0.0, 90.0, 2.0)
        rotation[1] = torch.nan
        assert "all 2 views" in roll_warnings(rotation)[0]
        assert roll_warnings(rotation[1:2]) == []

    def test_only_where_the_board_is_estimated(self) -> None:
        """A plate that is as ordered has no print to confound with anything."""
        seen = observe(pixels_of(camera("pinhole"), motions(camera("pinhole"), 8, 2), noise=0.05))
        assert any("upright" in text for text in calibrate_camera(seen).warnings)
        exact = calibrate_camera(seen, CalibrationOptions(board="exact"))
        assert not any("upright" in text for text in exact.warnings)

    @pytest.mark.parametrize("name", ["pi640", "ch1280"])
    def test_captures_by_others(self, kcal_data, name: str) -> None:
        """Rolls do not depend on a calibration's quality: those of a plain start are enough."""
        if name == "ch1280":
            seen = Observations.load(kcal_data / "captures" / "ch1280.obs.json")
            rotation = calibrate_camera(seen, CalibrationOptions(model="opencv4")).cam_from_board_rotation
            assert roll_warnings(rotation) == []
            return

        images = sorted((kcal_data / "captures" / "pi640").glob("*.jpg"))
        seen = detect(images[5:16], Board(columns=7, rows=7, square=0.0254), "none")
        rotation = calibrate_camera(seen, CalibrationOptions(model="opencv4")).cam_from_board_rotation
        assert re.search(r"upright \(rolled by at most [1-5]°\)", roll_warnings(rotation)[0])


class TestPupil:
    def lens(self, first: float, kind: str = "wide") -> Camera:
        lens = hybrid_camera(kind, modes=FEW_MODES)
        values = lens.params.detach().clone()
        values[[lens.names.index("pupil1"), lens.names.index("pupil2")]] = torch.tensor([first, 0.0]).double()
        return lens.with_parameters(values)

    def spread(self, lens: Camera, sigma: float) -> Tensor:
        out = torch.zeros(2 * (len(lens.names),), dtype=torch.float64)
        out[6, 6] = sigma**2
        return out

    def test_what_no_lens_does(self) -> None:
        lens = self.lens(0.1)
        found = corner_pupil(lens, self.spread(lens, 0.001))
        assert found is not None
        assert found.depth == pytest.approx(0.1 * found.angle**2)
        assert found.sigma == pytest.approx(0.001 * found.angle**2)
        assert 70 < math.degrees(found.angle) < 76
        (text,) = pupil_warnings(lens, self.spread(lens, 0.001))
        moved = f"moves by {1e3 * found.depth:.0f} ± {1e3 * found.sigma:.0f} mm, which no lens does"
        assert f"{moved} ({30 * found.angle**2:.0f} mm at most" in text
        assert "measure the squares" in text

    @pytest.mark.parametrize(("first", "sigma"), [(0.006, 1e-4), (0.029, 1e-4), (0.1, 0.051), (-0.029, 1e-4)])
    def test_what_a_lens_may_do_or_chance(self, first: float, sigma: float) -> None:
        """Glass moves some 3 mm per square radian, the wide lens of the tests' data 6."""
        lens = self.lens(first)
        assert pupil_warnings(lens, self.spread(lens, sigma)) == []

    def test_either_way(self) -> None:
        lens = self.lens(-0.04)
        assert "moves by" in pupil_warnings(lens, self.spread(lens, 1e-4))[0]
        # As of 88 thermal views: 43 ± 18 mm.
        assert "moves by" in pupil_warnings(lens, self.spread(lens, 0.04 * 18 / 43))[0]

    def test_at_small_angles_a_centimeter_is_allowed(self) -> None:
        """A long lens is large: its pupil moves by more than the rule for angles says."""
        narrow = self.lens(0.024, "pinhole")
        found = corner_pupil(narrow, self.spread(narrow, 1e-4))
        assert found is not None
        assert 0.03 * found.angle**2 < 0.01
        assert pupil_warnings(narrow, self.spread(narrow, 1e-4)) == []
        assert pupil_warnings(self.lens(0.06, "pinhole"), self.spread(narrow, 1e-4)) != []

    def test_parametric_lenses_have_none(self) -> None:
        assert pupil_warnings(camera(), torch.zeros(10, 10).double()) == []


class TestGeneral:
    def warned(self, lens: Camera, status: SolverStatus = SolverStatus.CONVERGED, rms: float = 0.1) -> list[str]:
        return general_warnings(["a"], lens, rms, torch.tensor([rms]).double(), (), status)

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
        """A board of which each corner is elsewhere than was ordered: it is small in each view, and no noise."""
        truth, generator = camera("pinhole"), torch.Generator().manual_seed(4)
        pixels = pixels_of(truth, motions(truth, 10, 2), noise=0.08)
        seen = observe(pixels + misprint * torch.randn(BOARD.corners, 2, dtype=torch.float64, generator=generator))
        spread = ((stated**2, 0.0, stated**2),) * BOARD.corners
        views = tuple(view.model_copy(update={"covariance": spread}) for view in seen.views)
        found = calibrate_camera(seen.model_copy(update={"views": views}))
        assert 0.08 < found.rms < 1.0
        warned = [text for text in found.warnings if "corners' own covariances" in text]
        assert len(warned) == said
        if said:
            ratio = found.rms / (2**0.5 * stated)
            assert warned[0].startswith(f"RMS {found.rms:.2g} px is {ratio:.0f} times what")
            assert f"({2**0.5 * stated:.2g} px)" in warned[0]


def test_a_far_corner_blames_the_lens_only_where_it_may_be_too_simple() -> None:
    residuals = 0.1 * torch.randn(4, 40, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert outlier_warnings("abcd", residuals) == []
    residuals[1, 3] = 5.0
    (plain,), (model,) = outlier_warnings("abcd", residuals), outlier_warnings("abcd", residuals, "; a richer model")
    assert plain.startswith("1 of 160 corners are farther off than noise explains, corner 3 of view b by 7.07 px")
    assert plain.endswith("(--reject)")
    assert model == plain + "; a richer model"


def test_advice_names_three_parts_of_the_image_or_all_of_them() -> None:
    lens = camera("pinhole")
    rotation, translation = motions(lens, 3, 2)
    middle = observe(pixels_of(lens, (rotation, torch.tensor([-0.15, -0.125, 1.5]).double().expand(3, 3))))
    (place,) = [text for text in what_to_photograph(middle, lens, rotation) if "of the image" in text]
    assert place.startswith("show the board in the corners and along the sides of the image")
    assert len(BOARD.points) == 42
    assert translation.shape == (3, 3)


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
