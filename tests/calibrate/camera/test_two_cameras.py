"""Captures that are not of one camera are refused, with the names of the views; ordinary ones are not."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from kcal.calibrate.camera import leave_out as module
from kcal.calibrate.camera.calibrate import calibrate_camera
from kcal.calibrate.camera.leave_out import two_camera_warnings
from kcal.calibrate.camera.result import CalibrationOptions
from kcal.calibrate.hybrid.fit import fit_hybrid
from kcal.corners.board import Board
from kcal.corners.observations import Observations, View
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector
from kcal.sim.board import PrintedBoard, true_corners
from kcal.sim.captures import sample_board_poses

BOARD, VIEWS, SIZE = Board(columns=9, rows=6, square=0.03), 12, (1280, 960)
LENS = Camera.build(focal=(1100, 1100), center=(652, 470), size=SIZE, coefficients=[-0.2, 0.05, 2e-4, -3e-4])
OTHER = Camera.build(focal=(1085, 1085), center=(628, 489), size=SIZE, coefficients=[-0.22, 0.07, -2e-4, 1e-4])
SECOND = frozenset(range(1, VIEWS, 2))


def shown(camera: Camera, seed: int) -> Tensor:
    """(V, N, 2) corners with noise."""
    draw = torch.Generator().manual_seed(seed)
    poses = sample_board_poses(LENS, BOARD, VIEWS, draw, fill=(0.3, 0.8))
    rotation, translation = (torch.stack(parts) for parts in zip(*poses, strict=True))
    corners = true_corners(PrintedBoard(BOARD.columns, BOARD.rows, BOARD.square, seed))
    pixels = camera.project(corners @ rotation.transpose(-1, -2) + translation[:, None])[0]
    return pixels + 0.05 * torch.randn(pixels.shape, dtype=torch.float64, generator=draw)


def capture(change: Callable[[Tensor], Tensor] | None = None, *, seed: int = 1, other: Camera = LENS) -> Observations:
    """A capture whose every other view another camera took, or was changed."""
    pixels, second = shown(LENS, seed), sorted(SECOND)
    pixels[second] = shown(other, seed)[second] if change is None else change(pixels[second])
    views = tuple(View(name=f"{i:02d}", pixels=tuple(map(tuple, one))) for i, one in enumerate(pixels.tolist()))
    return Observations(board=BOARD, image_size=SIZE, views=views)


def zoomed(pixels: Tensor) -> Tensor:
    middle = 0.5 * torch.tensor(SIZE, dtype=torch.float64)
    return (pixels - middle) * 1.05 + middle


def cropped(pixels: Tensor) -> Tensor:
    return pixels - torch.tensor([40.0, 0.0], dtype=torch.float64)


def named(text: str, before: str, after: str) -> set[int]:
    """The views that a message lists between two words; none where it has no such list."""
    listed = text.partition(before)[2].partition(after)[0]
    return {int(name) for name in listed.split(", ")} if listed else set()


class TestRefused:
    @pytest.mark.parametrize(
        ("changed", "told"),
        [
            pytest.param(
                {"change": cropped},
                r"show everything [+-]0\.\d % larger than the others, .*\([+-](3|4)\d, [+-]\d\) px",
                marks=pytest.mark.slow,
            ),
            ({"change": zoomed}, r"show everything ([+]5\.\d|[+]4\.\d|-4\.\d|-5\.\d) % larger"),
            pytest.param({"other": OTHER}, "the views are not of one camera", marks=pytest.mark.slow),
        ],
    )
    def test_the_group_is_named(self, changed: dict, told: str) -> None:
        with pytest.raises(InputError, match=told) as error:
            calibrate_camera(capture(**changed))
        text = str(error.value)
        accused, unclear = named(text, "(", ")"), named(text, "not clear for ", ")")
        # A view that tells little about the principal point may be in either group.
        assert min(len((accused ^ group) - unclear) for group in (SECOND, set(range(VIEWS)) - SECOND)) <= 1
        assert len(unclear) <= 2

    @pytest.mark.slow
    def test_parametric_lenses_too(self) -> None:
        with pytest.raises(InputError, match="the views are not of one camera"):
            calibrate_camera(capture(zoomed), CalibrationOptions(model="opencv5"))


class TestNotAccused:
    @pytest.mark.parametrize("seed", [2, 3])
    def test_good_captures_are_not_even_fitted_again(self, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(module, "fit_hybrid", None)
        assert calibrate_camera(capture(seed=seed)).rms < 0.1

    def test_a_lens_that_was_touched_is_another_matter(self) -> None:
        """Less than a pixel of the principal point in half of the views is told by error bars, not by a refusal."""
        result = calibrate_camera(capture(lambda pixels: pixels + 0.7))
        assert result.rms < 0.1

    def test_a_lens_that_focused_is_warned_of(self) -> None:
        """Three percent of scale in every other view."""
        middle = 0.5 * torch.tensor(SIZE, dtype=torch.float64)
        result = calibrate_camera(capture(lambda pixels: (pixels - middle) * 1.03 + middle))
        (text,) = [text for text in result.warnings if "not of one camera" in text]
        assert "switch the autofocus off" in text
        assert min(len(named(text, "(", ")") ^ group) for group in (SECOND, set(range(VIEWS)) - SECOND)) <= 2

    def test_one_camera_whose_residuals_repeat_by_chance(self) -> None:
        """Tempering that another fit does without is no evidence for two cameras: 93 nats of it came from there."""
        draw = torch.Generator().manual_seed(5)
        size, board = (1920, 1080), Board(columns=9, rows=6, square=0.1)
        lens = Camera.build(
            focal=(1470, 1472), center=(962, 542), size=size, coefficients=[-0.186, 0.06, 5e-4, -3e-4, -0.01]
        )

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=draw, dtype=torch.float64)

        turn = rotation_from_vector(0.35 * normal(24, 3)).transpose(-1, -2)
        place = torch.tensor([0.0, 0.0, 4.0]) + normal(24, 3) * torch.tensor([0.35, 0.2, 0.4])
        pixels = lens.project((board.points - board.points.mean(0)) @ turn + place[:, None])[0]
        pixels = pixels + 0.1 * normal(*pixels.shape)
        fit = fit_hybrid(board.points, pixels, size)
        assert fit.tempering > 1.02  # or nothing is tested
        assert module._promising(module._of_fit(fit, pixels), pixels, size) is not None
        assert module.two_cameras(fit, board.points, pixels, CalibrationOptions()) is None

    def test_too_few_views_to_tell(self) -> None:
        seen = capture(cropped).subset(["00", "02", "04", "06", "01"])
        assert math.isfinite(calibrate_camera(seen).rms)


def test_groups_from_quadratic_forms() -> None:
    """The assignment with the largest fall of χ², and what it falls by."""
    draw = torch.Generator().manual_seed(5)
    root = torch.randn(10, 6, 3, dtype=torch.float64, generator=draw)
    N, second = root.transpose(1, 2) @ root, torch.arange(10) >= 6
    theta = torch.where(second[:, None], torch.tensor([0.01, 30.0, 0.0]), torch.tensor([0.0, -10.0, 5.0])).double()
    views = module._ByView(N, -(N @ theta[..., None])[..., 0])
    found = module._grouped(views, SIZE)
    assert found is not None
    assert bool((found == second).all() or (found == ~second).all())
    torch.testing.assert_close(views.best(second)[1], theta[-1])
    everything = float((theta[:, None] @ N @ theta[..., None]).sum())
    assert views.fall(second) == pytest.approx(everything)


def test_a_result_is_checked_once_more_by_hand() -> None:
    result = calibrate_camera(capture(seed=2))
    assert two_camera_warnings(result, CalibrationOptions(), lambda _: None) == ()
