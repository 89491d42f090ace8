"""mrcal: camera models, and the optimization inputs in them."""

from __future__ import annotations

import ast
import base64
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import kcal.io.foreign as foreign
from kcal.errors import InputError
from kcal.files import read_text, write_atomic
from kcal.gaussian import posterior_half, triangular
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.pose import Pose, rotation_from_vector, step_rows, vector_from_rotation
from kcal.lens.projection import project_components
from kcal.strict_formats import read_npz

# What mrcal's `optimization_inputs` say of a camera: its covariance from the corners that are stored in its file.
#
# A `.cameramodel` has all corners, poses of boards, and weights of its calibration, as an .npz archive in base 85. The
# covariance is that of mrcal's own least-squares problem at its solution, from the views of this camera alone, without
# mrcal's regularization; noise is the RMS of its residuals.

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


# mrcal's `.cameramodel` files: a Python dictionary, one camera each. Same pixels as kcal.
#
# Lenses that mrcal's parametric models cannot hold are written as its splined stereographic model: cubic B-splines of
# what is added to the stereographic projection of a ray, `u = 2 (X, Y) / (|p| + Z)`, before it is scaled by the focal
# length.

_TEXT = re.compile(r"'(?:[^'\\]|\\.)*+'|\"(?:[^\"\\]|\\.)*+\"")
# Characters besides texts.
_MOST_NUMBERS = 2**20
_LENSES = {"LENSMODEL_PINHOLE": "pinhole"} | {f"LENSMODEL_OPENCV{n}": f"opencv{n}" for n in (4, 5, 8, 12)}


def read_mrcal(path: Path, hints: foreign.Hints) -> foreign.ImportedCameras:
    """Read one camera and its pose."""
    text = read_text(path, foreign.MOST_BYTES)
    # What a model was made from is stored as long texts; numbers take Python a hundred times their length in memory.
    if len(_TEXT.sub("", text)) > _MOST_NUMBERS:
        raise ValueError(f"more than {_MOST_NUMBERS // 2**20} MiB of numbers and names")
    try:
        content = ast.literal_eval(text)
    except (SyntaxError, MemoryError, RecursionError):
        raise ValueError("a Python dictionary of plain values is needed") from None
    if not isinstance(content, dict):
        raise ValueError("a Python dictionary is needed")
    kind = content.get("lensmodel") or content.get("lens_model") or content["distortion_model"]
    kind = str(kind).replace("DISTORTION", "LENSMODEL")
    if kind not in _LENSES:
        raise ValueError(
            f"{kind}: kcal reads {', '.join(_LENSES)}; mrcal-convert-lensmodel --to LENSMODEL_OPENCV8 fits one of them"
        )
    model = _LENSES[kind]
    size = foreign.whole_size(*content["imagersize"])
    count = {"pinhole": 4}.get(model) or 4 + int(model.removeprefix("opencv"))
    fx, fy, cx, cy, *lens = foreign.numbers(content["intrinsics"], count, "intrinsics")
    camera = foreign.named_camera(path.stem, (fx, fy, cx, cy), size, model, lens)
    key = "rt_cam_ref" if "rt_cam_ref" in content else "extrinsics"
    *turn, x, y, z = foreign.numbers(content[key], 6, key)
    rotation = rotation_from_vector(torch.tensor(turn, dtype=torch.float64))
    lost = []
    if packed := content.get("optimization_inputs"):
        try:
            covariance = inputs_covariance(packed, int(content.get("icam_intrinsics", 0)), camera, str(path))
            camera.calibration = CameraCalibration(name=path.stem, covariance=covariance)
            lost = ["error bars are those of the corners in the file; the corners themselves are not kept"]
        except NoInformationError as reason:
            lost = [f"no error bars: {reason}"]
    pose = foreign.checked_pose(foreign.plain(rotation), [x, y, z])
    return foreign.ImportedCameras(format="mrcal", cameras=(camera,), poses=(pose,), notes=tuple(lost))


def write_mrcal(cameras: Sequence[Camera], poses: Sequence[Pose], path: Path) -> list[Path]:
    """Write a file for each camera."""
    lenses = {model: name for name, model in _LENSES.items()}
    paths = foreign.paths_for(path, len(cameras))
    for i, (camera, target) in enumerate(zip(cameras, paths, strict=True)):
        values = [*camera.params[:4].tolist(), *camera.coefficients.tolist()]
        write_model(target, camera, lenses[str(camera.model)], values, poses[i] if poses else None)
    return paths


def write_model(path: Path, camera: Camera, lens: str, values: Sequence[float], pose: Pose | None) -> Path:
    """Write a camera whose intrinsics in mrcal's lens model are given, with as many digits as they have."""
    motion = [0.0] * 6
    if pose is not None:
        motion = [*foreign.plain(vector_from_rotation(pose.rotation)), *foreign.plain(pose.translation)]
    lines = [
        f"# {' '.join(foreign.camera_name(camera, 'camera').split())}, written by kcal",
        "{",
        f"    'lensmodel': '{lens}',",
        "    # fx, fy, cx, cy, then the lens",
        f"    'intrinsics': {list(values)!r},",
        "    # from the reference frame to the camera: rotation vector, translation",
        f"    'extrinsics': {motion!r},",
        f"    'imagersize': {list(camera.size)!r},",
        "}",
    ]
    return write_atomic(path, "\n".join(lines) + "\n")


class SplineGrid:
    """Control points of mrcal's splined stereographic model of order 3.

    Args:
        columns: of control points.
        rows: of control points.
        fov_deg: horizontal field of view that they cover.
    """

    def __init__(self, columns: int, rows: int, fov_deg: int) -> None:
        self.columns, self.rows, self.fov_deg = columns, rows, fov_deg
        # One more interval on each side: a cubic reaches that far.
        self.per_unit = (columns - 3) / (4.0 * math.tan(math.radians(fov_deg) / 4.0))

    @property
    def name(self) -> str:
        """As mrcal calls the model."""
        return f"LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx={self.columns}_Ny={self.rows}_fov_x_deg={self.fov_deg}"

    def weights(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Indices (N, 16) of the control points that count at places u (N, 2), and their weights."""
        along = []
        for values, count in ((u[:, 0], self.columns), (u[:, 1], self.rows)):
            place = values * self.per_unit + 0.5 * (count - 1)
            first = np.clip(np.floor(place).astype(int), 1, count - 3)
            f = place - first
            basis = np.stack([(1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, -3 * f**3 + 3 * f**2 + 3 * f + 1, f**3], 1) / 6.0
            along.append((first[:, None] - 1 + np.arange(4), basis))
        (across, across_weight), (down, down_weight) = along
        index = down[:, :, None] * self.columns + across[:, None, :]
        return index.reshape(-1, 16), (down_weight[:, :, None] * across_weight[:, None, :]).reshape(-1, 16)


def stereographic(rays: np.ndarray) -> np.ndarray:
    """(N, 2) places of rays (N, 3)."""
    return 2.0 * rays[:, :2] / (np.linalg.norm(rays, axis=1) + rays[:, 2])[:, None]


def fit_spline(rays: np.ndarray, pixels: np.ndarray, size: tuple[int, int]) -> tuple[SplineGrid, np.ndarray]:
    """Fit mrcal's splined model to pixels (N, 2) of rays (N, 3); return the grid and its intrinsics.

    Control points are about 30 across. Those that no ray determines are continued smoothly.

    Raises:
        InputError: rays of 350° and more.
    """
    from scipy.sparse import csr_matrix, vstack
    from scipy.sparse.linalg import splu

    u = stereographic(rays)
    widest, tallest = np.abs(u).max(0)
    fov = math.ceil(math.degrees(4.0 * math.atan(widest / 2.0)) * 1.02)
    if fov >= 350:
        raise InputError(f"mrcal's splined model reaches to 350°, this camera's rays to {fov}°")
    columns = 30
    grid = SplineGrid(columns, 8, fov)
    grid = SplineGrid(columns, max(8, math.ceil(2.0 * tallest * 1.02 * grid.per_unit) + 3), fov)
    # The best scaling and shift are left to the core, as in models that mrcal fits itself.
    core = [np.polyfit(u[:, i], pixels[:, i], 1) for i in (0, 1)]
    index, weight = grid.weights(u)
    count = grid.columns * grid.rows
    matrix = csr_matrix((weight.ravel(), (np.repeat(np.arange(len(u)), 16), index.ravel())), (len(u), count))
    smooth = 1e-6 * _second_differences(grid.rows, grid.columns)
    whole = vstack([matrix, smooth]).tocsc()
    solver = splu((whole.T @ whole).tocsc())
    intrinsics = np.empty(4 + 2 * count)
    for i, (slope, shift) in enumerate(core):
        target = (pixels[:, i] - shift) / slope - u[:, i]
        found = solver.solve(matrix.T @ target)
        # One step of refinement: normal equations lose half the digits.
        found += solver.solve(matrix.T @ (target - matrix @ found) - smooth.T @ (smooth @ found))
        intrinsics[i], intrinsics[2 + i], intrinsics[4 + i :: 2] = slope, shift, found
    return grid, intrinsics


def _second_differences(rows: int, columns: int) -> Any:
    from scipy.sparse import csr_matrix, diags, eye, kron, vstack

    def along(count: int) -> Any:
        return diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(count - 2, count))

    return csr_matrix(vstack([kron(eye(rows), along(columns)), kron(along(rows), eye(columns))]))


def project_spline(grid: SplineGrid, intrinsics: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of rays (N, 3) in mrcal's splined model."""
    u = stereographic(rays)
    index, weight = grid.weights(u)
    added = (intrinsics[4:].reshape(-1, 2)[index] * weight[..., None]).sum(1)
    return (u + added) * intrinsics[:2] + intrinsics[2:4]
