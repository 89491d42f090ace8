"""The view to take next: what it promises is what its rows give, and no other view promises more."""

import dataclasses
import math

import pytest
import torch
from calibrate_scenes import observe
from printed_boards import printed_views

from kcal import Board, CalibrationOptions, Camera, calibrate_camera
from kcal.calibrate.camera import advice as module
from kcal.calibrate.camera.advice import far_sigma, next_view, possible_views
from kcal.lens import CameraCalibration, pixel_covariance

BOARD = Board(columns=8, rows=6, square=0.03)
SIZE = (1280, 960)
CAMERA = Camera.build(
    focal=(800, 800), center=(636, 484), size=SIZE, coefficients=[-0.12, 0.03, 4e-4, -3e-4, 0.0], model="opencv5"
)
SEEN = observe(printed_views(CAMERA, BOARD, BOARD.points, 5, 4, noise=0.1), board=BOARD, size=SIZE)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["opencv5", "hybrid"])
def test_it_gives_what_it_promises(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against the covariance with the view's rows stacked onto those of the calibration."""
    result = calibrate_camera(SEEN, CalibrationOptions(model=model))
    camera, noise = result.camera, 0.1
    known = result.information
    assert known is not None
    assert far_sigma(camera) == pytest.approx(
        float(pixel_covariance(camera, camera.grid(13, 9).reshape(-1, 2)).diagonal(dim1=-2, dim2=-1).mean().sqrt()),
        rel=0.01,  # the best turn is found on another grid there
    )
    found = next_view(camera, BOARD, noise)
    promised, informed = [], []
    views, shapes = possible_views(camera, BOARD), module.board_modes(BOARD.points).shapes
    some = [i for i, text in enumerate(views.words) if text == found.words] + [0, 20, 40]
    for i in some:
        held = views.rotation[i], views.translation[i]
        rows = module._view_rows(camera, known, BOARD.points, shapes, *held) / noise
        more = dataclasses.replace(
            known, rows=torch.cat([known.rows, rows]), residuals=torch.cat([known.residuals, torch.zeros(len(rows))])
        )
        after = Camera(camera.params.detach(), size=SIZE, model=camera.model)
        after.calibration = CameraCalibration(information=more)
        informed.append(more)
        promised.append(far_sigma(after))
    assert promised[0] == pytest.approx(found.sigma, rel=1e-6)
    assert found.sigma < 0.98 * far_sigma(camera)
    assert min(promised) == promised[0]
    # Once it is taken, the next one is asked for, without a new calibration; a view without a pose tells nothing.
    then = next_view(camera, BOARD, noise, torch.stack([found.pixels, torch.full_like(found.pixels, torch.nan)]))
    again = next_view(camera, BOARD, noise, found.pixels[None].repeat(2, 1, 1))
    after.calibration = CameraCalibration(information=informed[0])
    known_then = next_view(after, BOARD, noise)
    assert then.words == known_then.words != found.words
    assert then.sigma == pytest.approx(known_then.sigma, rel=1e-5)
    assert again.sigma < then.sigma < found.sigma


def test_rows_are_derivatives_of_what_is_seen() -> None:
    """Numerically, by lens, board and pose: the pose's derivatives span what was taken out."""
    result = calibrate_camera(SEEN)
    known, camera = result.information, result.camera
    views = possible_views(camera, BOARD)
    rotation, translation = views.rotation[3], views.translation[3]
    shapes = module.board_modes(BOARD.points).shapes
    rows = module._view_rows(camera, known, BOARD.points, shapes, rotation, translation)
    assert rows.shape == (2 * BOARD.corners - 6, len(known.estimate))
    assert known.board_size == len(shapes)
    step = 1e-6

    def pixels(params: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        moved = Camera(params, size=SIZE, model=camera.model)
        return moved.project(points @ rotation.T + translation)[0].T.flatten()

    base = camera.params.detach()
    for column in (0, 2, 5, known.lens_size + 1):
        change = known.selection()[:, column] * step
        bent = shapes[column - known.lens_size].T * step if column >= known.lens_size else 0.0 * BOARD.points
        slope = (pixels(base + change, BOARD.points + bent) - pixels(base - change, BOARD.points - bent)) / (2 * step)
        # Off the pose, lengths are what is left after the best step of the pose.
        by_pose = module.step_rows(
            module.project_components((BOARD.points @ rotation.T + translation).T, base, camera.model, [0]).by_point,
            (BOARD.points @ rotation.T + translation).T,
        )
        pose = by_pose.flatten(1).T
        left = slope - pose @ torch.linalg.lstsq(pose, slope[:, None]).solution[:, 0]
        # Differences over 2e-6 are good to 1e-6 of the slope.
        assert float(rows[:, column].norm()) == pytest.approx(
            float(left.norm()), rel=1e-5, abs=1e-6 * float(slope.norm())
        )


def test_possible_views_are_seen_whole() -> None:
    views = possible_views(CAMERA, BOARD)
    projected, valid = CAMERA.project(BOARD.points @ views.rotation.mT + views.translation[:, None])
    assert bool(valid.all())
    torch.testing.assert_close(projected, views.pixels)
    assert bool(((projected > 0) & (projected < torch.tensor(SIZE))).all())
    assert len(set(views.words)) == len(views.words) > 100
    # A board that faces the camera shows its front, the first row above the second.
    facing = views.words.index("far, in the middle of the image, facing the camera")
    corners = views.pixels[facing].view(BOARD.rows, BOARD.columns, 2)
    assert float(corners[1, 0, 1]) > float(corners[0, 0, 1])
    assert float(corners[0, 1, 0]) > float(corners[0, 0, 0])
    # Its right side away: the right edge is shorter than the left one.
    leaning = views.words.index("far, in the middle of the image, its right side away from the camera")
    corners = views.pixels[leaning].view(BOARD.rows, BOARD.columns, 2)
    assert float((corners[-1, -1] - corners[0, -1]).norm()) < 0.9 * float((corners[-1, 0] - corners[0, 0]).norm())
    leaning = views.words.index("far, in the middle of the image, its upper side away from the camera")
    corners = views.pixels[leaning].view(BOARD.rows, BOARD.columns, 2)
    assert float((corners[0, -1] - corners[0, 0]).norm()) < 0.9 * float((corners[-1, -1] - corners[-1, 0]).norm())


def test_a_rolled_board_lies_in_the_same_plane() -> None:
    """It is turned about its own normal, wherever it is held and however it leans."""
    views = possible_views(CAMERA, BOARD)
    normal, across = views.rotation[..., 2], views.rotation[..., 0]
    pairs = [(i, views.words.index(f"{text}, rolled by a quarter")) for i, text in enumerate(views.words)
             if f"{text}, rolled by a quarter" in views.words]  # fmt: skip
    assert len(pairs) > 40
    for i, rolled in pairs:
        torch.testing.assert_close(normal[i], normal[rolled], rtol=0, atol=1e-12)
        assert abs(float(across[i] @ across[rolled])) < 1e-12


def test_without_error_bars() -> None:
    assert math.isnan(far_sigma(CAMERA))
    assert next_view(CAMERA, BOARD, 0.1) is None
