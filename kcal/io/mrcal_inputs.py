"""What mrcal's `optimization_inputs` say of a camera: its covariance from the corners that are stored in its file.

A `.cameramodel` has all corners, poses of boards, and weights of its calibration, as an .npz archive in base 85. The
covariance is that of mrcal's own least-squares problem at its solution, from the views of this camera alone, without
mrcal's regularization; noise is the RMS of its residuals.
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcal.gaussian import posterior_half, triangular
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector, step_rows, vector_from_rotation
from kcal.lens.projection import project_components
from kcal.strict_npz import read_npz

# A thousand views of a large board by ten cameras take a tenth of it.
_MOST_BYTES, _MOST_VIEWS = 256 * 2**20, 20_000
# Relative; files have ten digits.
_SAME = 1e-6
_POSE = 6


class NoInformationError(ValueError):
    """Why no covariance follows from the inputs."""


def inputs_covariance(packed: bytes | str, number: int, camera: Camera, source: str) -> Tensor:
    """Covariance (5 + P, 5 + P) of a camera's parameters.

    Args:
        packed: what the file has as `optimization_inputs`.
        number: of the camera in the calibration.
        camera: as the file has it.
        source: names the file in errors.

    Raises:
        NoInformationError: inputs without boards, of another lens, with fixed poses, or with too few corners.
        FileError: no archive, or a damaged one.
    """
    try:
        data = base64.b85decode(packed)
    except ValueError as error:
        raise ValueError(f"optimization_inputs are not in base 85: {error}") from None
    stored = read_npz(data, source, _MOST_BYTES, "set of mrcal's optimization inputs")
    views, poses, points, modes = _views(stored, number, camera)
    free = _free(stored, camera)
    rows, squares, count = [], 0.0, 0
    modes = modes if bool(stored.get("do_optimize_calobject_warp", False)) else modes[:0]
    for view, pose in zip(views, poses, strict=True):
        corners, weight = view[:, :2], view[:, 2].clamp_min(0.0)
        rotation = rotation_from_vector(pose[:3])
        there = (points @ rotation.T + pose[3:]).T
        seen = project_components(there, camera.params, camera.model, free)
        # What bends the board moves its corners along its axis.
        lifted = torch.einsum("cpn,c->pn", seen.by_point, rotation[:, 2])
        slopes = torch.cat([step_rows(seen.by_point, there), lifted * modes[:, None, :], seen.by_camera]) * weight
        used = weight > 0
        if int(used.sum()) < 4:
            continue
        residuals = ((seen.pixels - corners.T) * weight)[:, used]
        squares, count = squares + float(residuals.square().sum()), count + residuals.numel()
        # Below the triangle of the view's pose, rows say nothing of it.
        rows.append(triangular(slopes[:, :, used].flatten(1).T)[_POSE:, _POSE:])
    known = torch.cat(rows) if rows else torch.zeros(0, 0)
    unknowns = known.shape[1] + _POSE * len(rows)
    if count <= unknowns:
        raise NoInformationError("too few corners")
    half = posterior_half(known)[:, len(modes) :] * (squares / (count - unknowns)) ** 0.5
    covariance = torch.zeros(len(camera.params), len(camera.params), dtype=torch.float64)
    covariance[torch.tensor(free)[:, None], torch.tensor(free)] = half.T @ half
    return covariance


def _views(stored: dict[str, np.ndarray], number: int, camera: Camera) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Corners (V, N, 3) of a camera with their weights, poses (V, 6), board (N, 3), and modes of its warp (2, N)."""
    try:
        seen, index = stored["observations_board"], stored["indices_frame_camintrinsics_camextrinsics"]
        frames, extrinsics = stored["frames_rt_toref"], stored.get("extrinsics_rt_fromref", np.zeros((0, 6)))
        intrinsics, spacing = stored["intrinsics"], float(stored["calibration_object_spacing"])
        bend = np.asarray(stored.get("calobject_warp", np.zeros(2)), dtype=float)
    except KeyError as missing:
        raise NoInformationError(f"no {missing.args[0]} in the optimization inputs") from None
    if seen.ndim != 4 or seen.shape[3] != 3 or index.shape != (len(seen), 3) or len(seen) > _MOST_VIEWS:
        raise NoInformationError("optimization inputs without boards, or with too many")
    if bend.shape != (2,):
        bend = np.zeros(2)
    own = np.concatenate([camera.params[:4].numpy(), camera.coefficients.numpy()])
    if intrinsics.ndim != 2 or not 0 <= number < len(intrinsics) or intrinsics.shape[1] != len(own):
        raise NoInformationError("optimization inputs of another lens")
    if np.abs(intrinsics[number] - own).max() > _SAME * np.abs(own).max():
        raise NoInformationError("the optimization inputs are of other intrinsics than the file")
    mine = index[:, 1] == number
    corners, index = torch.from_numpy(seen[mine].astype(float)), index[mine]
    if not len(index) or not bool(corners.isfinite().all()):
        raise NoInformationError("no corner of this camera, or one that is not finite")
    if index[:, 0].min() < 0 or index[:, 0].max() >= len(frames) or index[:, 2].max() >= len(extrinsics):
        raise NoInformationError("optimization inputs name boards that they do not have")
    poses = torch.stack([_pose(frames[frame], extrinsics[at] if at >= 0 else np.zeros(6)) for frame, _, at in index])
    rows, columns = corners.shape[1:3]
    x, y = torch.meshgrid(torch.arange(columns).double(), torch.arange(rows).double(), indexing="xy")
    modes = torch.stack([1.0 - (2.0 * part / max(extent - 1, 1) - 1.0) ** 2
                         for part, extent in ((x, columns), (y, rows))]).reshape(2, -1)  # fmt: skip
    height = torch.from_numpy(bend) @ modes
    points = torch.stack([spacing * x.reshape(-1), spacing * y.reshape(-1), height], 1)
    return corners.reshape(len(corners), -1, 3), poses, points, modes


def _pose(board: np.ndarray, seen_from: np.ndarray) -> Tensor:
    """(6,) turn and shift from a board to the camera: that to the reference, then that from it."""
    first, second = torch.from_numpy(np.asarray(board, float)), torch.from_numpy(np.asarray(seen_from, float))
    if first.shape != (6,) or second.shape != (6,) or not bool((first.isfinite() & second.isfinite()).all()):
        raise NoInformationError("a pose in the optimization inputs has not six finite numbers")
    turn = rotation_from_vector(second[:3])
    rotation = turn @ rotation_from_vector(first[:3])
    return torch.cat([vector_from_rotation(rotation), turn @ first[3:] + second[3:]])


def _free(stored: dict[str, Any], camera: Camera) -> list[int]:
    """Numbers of the camera's parameters that were estimated."""
    if not bool(stored.get("do_optimize_frames", True)):
        raise NoInformationError("poses of boards were held")
    core = bool(stored.get("do_optimize_intrinsics_core", True))
    lens = bool(stored.get("do_optimize_intrinsics_distortions", True))
    free = [*(range(4) if core else ()), *(range(5, len(camera.params)) if lens else ())]
    if not free:
        raise NoInformationError("the camera was held")
    return free
