"""Find the view of the board that would tell most about a camera, from what its calibration leaves open.

Of many places, distances, tilts and rolls of the board, each adds rows to the square-root information of the camera
once its own pose is eliminated. The best one reduces the variance of far directions most, averaged over the image
(A-optimal design; for calibration: Peng and Sturm, "Calibration wizard", ICCV 2019).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import board_modes
from kcal.calibrate.problem.poses import poses_under
from kcal.calibrate.problem.views import Views
from kcal.corners.board import Board
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.paraxial import paraxial_focal
from kcal.lens.pose import rotation_from_vector, step_rows
from kcal.lens.projection import project_components
from kcal.lens.uncertainty import pixel_covariance, pixel_slopes
from kcal.solve.lm import LMOptions

T = TypeVar("T")

# Grid of the image over which variances are averaged.
_GRID = (13, 9)
# What a person can hold: shares of the image's shorter side that a board fills, degrees of tilt, quarter rolls.
_FILLS, _TILT, _ROLLS = (0.35, 0.65), math.radians(40.0), (0.0, 0.5 * math.pi)
_TILTS = {
    (0.0, 0.0): "facing the camera",
    (_TILT, 0.0): "its lower side away from the camera",
    (-_TILT, 0.0): "its upper side away from the camera",
    (0.0, _TILT): "its left side away from the camera",
    (0.0, -_TILT): "its right side away from the camera",
}


class BoardViews(NamedTuple):
    """Views of a board that could be taken.

    Attributes:
        rotation: (C, 3, 3) cam_from_board.
        translation: (C, 3) meters.
        pixels: (C, N, 2) of the corners.
        words: how the board is held.
    """

    rotation: Tensor
    translation: Tensor
    pixels: Tensor
    words: tuple[str, ...]


class NextView(NamedTuple):
    """The view to take next.

    Attributes:
        rotation: (3, 3) cam_from_board.
        translation: (3,) meters.
        pixels: (N, 2) where its corners would be.
        words: how to hold the board.
        sigma: pixels, `far_sigma` of the camera after this view.
    """

    rotation: Tensor
    translation: Tensor
    pixels: Tensor
    words: str
    sigma: float


def possible_views(camera: Camera, board: Board) -> BoardViews:
    """Views of a board all over the image, near and far, facing the camera and tilted, upright and rolled.

    Args:
        camera: as known so far.
        board: whose corners are all in the image.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="pinhole")
        >>> views = possible_views(camera, Board(columns=7, rows=6, square=0.05))
        >>> len(views.words) > 100, bool((views.pixels > 0).all())
        (True, True)
    """
    width, height = camera.size
    side, points = min(width, height), board.points
    middle = 0.5 * (points.amin(0) + points.amax(0))
    extent = float((points.amax(0) - points.amin(0)).max())
    rotations, translations, words = [], [], []
    for fill in _FILLS:
        margin = (0.5 * fill + 0.06) * side
        rows = {"top": margin, "": 0.5 * height, "bottom": height - margin}
        columns = {"left": margin, "": 0.5 * width, "right": width - margin}
        places = list(itertools.product(rows.items(), columns.items()))
        rays, valid = camera.unproject(torch.tensor([[u, v] for (_, v), (_, u) in places], dtype=torch.float64))
        distance = extent * float(paraxial_focal(camera).value.min()) / (fill * side)
        size = "near" if fill == _FILLS[-1] else "far"
        for ((up, _), (across, _)), ray in zip(_kept(places, valid), rays[valid], strict=True):
            place = " ".join(filter(None, (up, across))) or "middle"
            for roll, (tilt, leaning) in itertools.product(_ROLLS, _TILTS.items()):
                turn = _facing(ray) @ _rotation(*tilt, 0.0) @ _rotation(0.0, 0.0, roll)
                rotations.append(turn)
                translations.append(distance * ray - turn @ middle)
                rolled = ", rolled by a quarter" if roll else ""
                words.append(f"{size}, in the {place} of the image, {leaning}{rolled}")
    rotation, translation = torch.stack(rotations), torch.stack(translations)
    pixels, valid = camera.project(points @ rotation.mT + translation[:, None])
    inside = ((pixels >= 0) & (pixels <= torch.tensor([width - 1, height - 1], dtype=pixels.dtype))).all(-1)
    good = (inside & valid).all(-1)
    return BoardViews(rotation[good], translation[good], pixels[good], tuple(_kept(words, good)))


def far_sigma(camera: Camera) -> float:
    """Standard deviation along an axis of where a camera sees far things, RMS over its image, pixels.

    After the best turn of the camera, as `kcal.lens.uncertainty.projection_sigma`. NaN for a camera without error bars.
    """
    if camera.calibration is None or camera.calibration.known(camera.params.detach()) is None:
        return math.nan
    variances = pixel_covariance(camera, camera.grid(*_GRID).reshape(-1, 2), grid=_GRID).diagonal(dim1=-2, dim2=-1)
    return math.sqrt(float(variances.nanmean()))


def next_view(camera: Camera, board: Board, noise: float, taken: Tensor | None = None) -> NextView | None:
    """The view that reduces the uncertainty of far directions most.

    Args:
        camera: with its calibration.
        board: that is photographed.
        noise: of its corners along an axis, pixels.
        taken: corners (V, N, 2) of views that the calibration does not know yet, NaN where one was not seen.

    Returns:
        None for a camera without error bars, or whose image no board fits into.
    """
    known = None if camera.calibration is None else camera.calibration.known(camera.params.detach())
    views = possible_views(camera, board)
    if known is None or not views.words:
        return None
    half, shapes = known.half(), board_modes(board.points).shapes
    if taken is not None and len(taken):
        half = _half_after(camera, known, board.points, shapes, half, taken, noise)
    slopes = _image_slopes(camera, known) @ half.T
    gains = []
    for rotation, translation in zip(views.rotation, views.translation, strict=True):
        rows = _view_rows(camera, known, board.points, shapes, rotation, translation) @ half.T / noise
        # Variance that this view takes away: G Aᵀ (1 + A Aᵀ)⁻¹ A Gᵀ.
        lower = torch.linalg.cholesky(torch.eye(len(rows), dtype=rows.dtype) + rows @ rows.T)
        gains.append(float(torch.linalg.solve_triangular(lower, rows @ slopes.T, upper=False).square().sum()))
    best = max(range(len(gains)), key=gains.__getitem__)
    sigma = math.sqrt(max(float(slopes.square().sum()) - gains[best], 0.0) / len(slopes))
    return NextView(views.rotation[best], views.translation[best], views.pixels[best], views.words[best], sigma)


def _half_after(
    camera: Camera, known: CameraInformation, points: Tensor, shapes: Tensor, half: Tensor, taken: Tensor, noise: float
) -> Tensor:
    """The half of the covariance after these views as well, each in the pose in which this camera sees it."""
    poses, _ = poses_under(camera, Views(board_points=points, pixels=taken), LMOptions())
    for pixels, rotation, translation in zip(taken, poses.rotation, poses.translation, strict=True):
        seen = torch.isfinite(pixels).all(-1)
        if bool(torch.isfinite(rotation).all()):
            rows = _view_rows(camera, known, points[seen], shapes[..., seen], rotation, translation) @ half.T / noise
            lower = torch.linalg.cholesky(torch.eye(rows.shape[1], dtype=rows.dtype) + rows.T @ rows)
            half = torch.linalg.solve_triangular(lower, half, upper=False)
    return half


def _kept(items: Sequence[T], good: Tensor) -> list[T]:
    return [item for item, fits in zip(items, good.tolist(), strict=True) if fits]


def _image_slopes(camera: Camera, known: CameraInformation) -> Tensor:
    """(2 G, U) derivatives of the image's grid by the unknowns, far away, after the best turn."""
    wanted = [index for index, slot in enumerate(known.slots) if slot >= 0]
    by_camera, by_motion, good = pixel_slopes(camera, camera.grid(*_GRID).reshape(-1, 2), math.inf, wanted)
    flat, by_turn = by_camera[good].flatten(0, 1), by_motion[good][..., :3].flatten(0, 1)
    return (flat - by_turn @ torch.linalg.lstsq(by_turn, flat).solution) @ known.selection()[wanted]


def _view_rows(
    camera: Camera, known: CameraInformation, points: Tensor, shapes: Tensor, rotation: Tensor, translation: Tensor
) -> Tensor:
    """(2 N - 6, U) derivatives of a view's corners by the unknowns, off the view's pose; `shapes` are board modes."""
    wanted = [index for index, slot in enumerate(known.slots) if slot >= 0]
    placed = points @ rotation.T + translation
    seen = project_components(placed.T, camera.params.detach(), camera.model, wanted)
    rows = seen.by_camera.flatten(1).T @ known.selection()[wanted]
    if known.board_size:
        by_point = torch.einsum("pcn,pk->kcn", seen.by_point, rotation)
        rows[:, known.lens_size :] = torch.einsum("kcn,bkn->cnb", by_point, shapes).flatten(0, 1)
    by_pose = step_rows(seen.by_point, placed.T).flatten(1).T
    return torch.linalg.qr(by_pose, mode="complete").Q[:, by_pose.shape[1] :].T @ rows


def _rotation(x: float, y: float, z: float) -> Tensor:
    return rotation_from_vector(torch.tensor([x, y, z], dtype=torch.float64))


def _facing(ray: Tensor) -> Tensor:
    """The smallest turn of the optical axis into a ray."""
    axis = torch.stack([-ray[1], ray[0], torch.zeros_like(ray[0])])
    sine = torch.linalg.vector_norm(axis)
    angle = torch.atan2(sine, ray[2])
    return rotation_from_vector(axis / sine.clamp_min(1e-300) * angle)
