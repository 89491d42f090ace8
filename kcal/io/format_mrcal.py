"""mrcal's `.cameramodel` files: a Python dictionary, one camera each. Same pixels as kcal.

Lenses that mrcal's parametric models cannot hold are written as its splined stereographic model: cubic B-splines of
what is added to the stereographic projection of a ray, `u = 2 (X, Y) / (|p| + Z)`, before it is scaled by the focal
length.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from kcal.errors import InputError
from kcal.files import read_text, write_atomic
from kcal.io.foreign import (
    MOST_BYTES,
    CameraPose,
    Hints,
    ImportedCameras,
    camera_name,
    checked_pose,
    named_camera,
    numbers,
    paths_for,
    plain,
    whole_size,
)
from kcal.io.mrcal_inputs import NoInformationError, inputs_covariance
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector, vector_from_rotation

MODELS = ("pinhole", "opencv4", "opencv5", "opencv8", "opencv12")
_TEXT = re.compile(r"'(?:[^'\\]|\\.)*+'|\"(?:[^\"\\]|\\.)*+\"")
# Characters besides texts.
_MOST_NUMBERS = 2**20
_LENSES = {"LENSMODEL_PINHOLE": "pinhole"} | {f"LENSMODEL_OPENCV{n}": f"opencv{n}" for n in (4, 5, 8, 12)}


def read_mrcal(path: Path, hints: Hints) -> ImportedCameras:
    """Read one camera and its pose."""
    text = read_text(path, MOST_BYTES)
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
    size = whole_size(*content["imagersize"])
    count = {"pinhole": 4}.get(model) or 4 + int(model.removeprefix("opencv"))
    fx, fy, cx, cy, *lens = numbers(content["intrinsics"], count, "intrinsics")
    camera = named_camera(path.stem, (fx, fy, cx, cy), size, model, lens)
    key = "rt_cam_ref" if "rt_cam_ref" in content else "extrinsics"
    *turn, x, y, z = numbers(content[key], 6, key)
    rotation = rotation_from_vector(torch.tensor(turn, dtype=torch.float64))
    lost = []
    if packed := content.get("optimization_inputs"):
        try:
            covariance = inputs_covariance(packed, int(content.get("icam_intrinsics", 0)), camera, str(path))
            camera.calibration = CameraCalibration(name=path.stem, covariance=covariance)
            lost = ["error bars are those of the corners in the file; the corners themselves are not kept"]
        except NoInformationError as reason:
            lost = [f"no error bars: {reason}"]
    return ImportedCameras(
        format="mrcal", cameras=(camera,), poses=(checked_pose(plain(rotation), [x, y, z]),), notes=tuple(lost)
    )


def write_mrcal(cameras: Sequence[Camera], poses: Sequence[CameraPose], path: Path) -> list[Path]:
    """Write a file for each camera."""
    lenses = {model: name for name, model in _LENSES.items()}
    paths = paths_for(path, len(cameras))
    for i, (camera, target) in enumerate(zip(cameras, paths, strict=True)):
        values = [*camera.params[:4].tolist(), *camera.coefficients.tolist()]
        write_model(target, camera, lenses[str(camera.model)], values, poses[i] if poses else None)
    return paths


def write_model(path: Path, camera: Camera, lens: str, values: Sequence[float], pose: CameraPose | None) -> Path:
    """Write a camera whose intrinsics in mrcal's lens model are given, with as many digits as they have."""
    motion = [0.0] * 6
    if pose is not None:
        motion = [*plain(vector_from_rotation(pose.rotation)), *plain(pose.translation)]
    lines = [
        f"# {' '.join(camera_name(camera, 'camera').split())}, written by kcal",
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
