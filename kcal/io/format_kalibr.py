"""Kalibr: camchains, and its omnidirectional model."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

import kcal.io.foreign as foreign
from kcal.files import read_text, write_atomic
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.fitted_hybrid import hybrid_through
from kcal.strict_yaml import MOST_BYTES as MOST_YAML
from kcal.strict_yaml import read_yaml

# Kalibr's omni-radtan lens: a ray on the unit sphere, seen from a point xi behind its center, then radial terms.
#
# It holds lenses of any width that Kalibr's pinhole models cannot. OpenCV's `omnidir` is the same lens. kcal has none
# such: one that is read becomes a hybrid lens, and the note says how far it is from it.

Array = NDArray[np.float64]
NAME = "omni-radtan"
# Starts of xi: a pinhole, a fisheye, and between them.
_STARTS = (0.0, 1.0, 2.0)
# Typical sizes of xi, and of the four coefficients of the distortion.
_SCALES = (0.1, 0.1, 0.1, 0.01, 0.01)
# Columns and rows of pixels through which a hybrid lens is laid, and those between them on which it is compared.
_GRID, _BETWEEN = (49, 37), (64, 48)
_MOST_XI = 100.0
# Pixels beyond which a lens does not stand for another.
_FAR = 0.5


def project_omni(values: Array, rays: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Pixels (N, 2) of rays (N, 3), and whether a ray is in front of the point of view.

    Args:
        values: xi, fu, fv, pu, pv, k1, k2, p1, p2, as Kalibr orders them.
        rays: of any length.
    """
    xi, fu, fv, pu, pv, k1, k2, p1, p2 = values
    depth = rays[:, 2] + xi * np.linalg.norm(rays, axis=1)
    ahead = depth > 1e-9
    x, y = (rays[:, :2] / np.where(ahead, depth, 1.0)[:, None]).T
    r2 = x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2 * r2
    across = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    down = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([fu * across + pu, fv * down + pv], 1), ahead


def fit_omni(rays: Array, pixels: Array, focal: float) -> Array:
    """The nine numbers of the lens that comes nearest to pixels (N, 2) of rays (N, 3).

    Args:
        rays: of the camera.
        pixels: where it sees them.
        focal: its focal length, for a start, px.
    """
    from scipy.optimize import least_squares

    def errors(values: Array) -> Array:
        return (project_omni(values, rays)[0] - pixels).ravel()

    middle, found = pixels.mean(0), []
    for xi in _STARTS:
        length = focal * (1.0 + xi)
        start = np.array([xi, length, length, *middle, 0.0, 0.0, 0.0, 0.0])
        scales = [_SCALES[0], focal, focal, 0.1 * focal, 0.1 * focal, *_SCALES[1:]]
        found.append(least_squares(errors, start, x_scale=scales, max_nfev=200))
    best = min(found, key=lambda one: one.cost if math.isfinite(one.cost) else math.inf)
    return np.asarray(best.x, dtype=np.float64)


def omni_camera(name: str, values: Sequence[float], size: tuple[int, int]) -> tuple[Camera, str]:
    """The hybrid camera that comes nearest to such a lens over the image, and a note on how near.

    Args:
        name: of the camera.
        values: xi, fu, fv, pu, pv, k1, k2, p1, p2.
        size: (width, height).

    Raises:
        ValueError: a lens that no hybrid lens follows.
    """
    xi, fu, fv, pu, pv, *lens = map(float, values)
    if not -1.0 < xi < _MOST_XI:
        raise ValueError(f"{name}: xi is {xi:g}; from -1 to {_MOST_XI:g} is possible")
    inner = foreign.named_camera(name, (fu, fv, pu, pv), size, "opencv4", lens)

    def lines(grid: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
        pixels = inner.grid(*grid).reshape(-1, 2)
        plane, seen = inner.normalize(pixels)
        square = plane.square().sum(-1)
        root = 1.0 + (1.0 - xi * xi) * square
        along = (xi + root.clamp_min(0.0).sqrt()) / (square + 1.0)
        rays = torch.cat([plane * along[:, None], (along - xi)[:, None]], -1)
        good = seen & (root > 0)
        return rays[good], pixels[good]

    rays, pixels = lines(_GRID)
    if len(rays) < _GRID[0] * _GRID[1] // 4:
        raise ValueError(f"{name}: this omni lens has no ray for most of the image")
    camera, _ = hybrid_through(rays, pixels, size)
    camera.calibration = CameraCalibration(name=name)
    rays, pixels = lines(_BETWEEN)
    seen, shown = camera.project_rays(rays)
    error = (seen - pixels)[shown].norm(dim=-1)
    rms, most = float(error.square().mean().sqrt()), float(error.max())
    if not most < _FAR:
        raise ValueError(f"{name}: no lens of kcal follows this omni lens: the nearest is {most:.2g} px off")
    covered = float(len(rays) / (_BETWEEN[0] * _BETWEEN[1]))
    rest = "" if covered == 1.0 else f"; {1.0 - covered:.1%} of the image has no ray"
    return camera, f"{name}: {NAME} became kcal's hybrid lens, RMS {rms:.2g} px, at most {most:.2g} px{rest}"


# Kalibr's camchain YAML: `cam0`, `cam1`, ... with `T_cn_cnm1` from each camera to the next.

_LENSES = {"radtan": "opencv4", "equidistant": "fisheye4", "none": "pinhole"}
# Of a text of results: names of lenses, and lines with numbers and their standard deviations.
_GEOMETRIES = {"DistortedPinholeCamera": "opencv4", "EquidistantDistortedPinholeCamera": "fisheye4"}
_RESULTS = re.compile(r"^\s*(distortion|projection): \[([^\]\n]*)\] \+- \[([^\]\n]*)\]", re.MULTILINE)


def read_kalibr(path: Path, hints: foreign.Hints) -> foreign.ImportedCameras:
    """Read all cameras of a chain, with poses from the first camera's frame; or of a `results-cam.txt`, with σ."""
    text = read_text(path, MOST_YAML)
    if _RESULTS.search(text):
        return _read_results(text, hints)
    content = read_yaml(text, str(path))
    cameras: list[Camera] = []
    poses: list[foreign.CameraPose] = []
    lost: set[str] = set()
    whole = np.eye(4)
    while (name := f"cam{len(cameras)}") in content:
        part = content[name]
        kind, lens = str(part["camera_model"]), str(part["distortion_model"])
        if kind == "omni" and lens in ("radtan", "none"):
            core = foreign.numbers(part["intrinsics"], 5, f"{name} intrinsics")
            terms = foreign.numbers(part.get("distortion_coeffs", []), (0, 4), f"{name} distortion_coeffs") or [0.0] * 4
            camera, note = omni_camera(name, [*core, *terms], foreign.whole_size(*part["resolution"]))
            cameras.append(camera)
            lost.add(note)
        elif kind != "pinhole" or lens not in _LENSES:
            raise ValueError(f"{name}: camera_model {kind} with distortion_model {lens}: kcal reads pinhole with "
                             f"{', '.join(_LENSES)}, and omni with radtan or none")  # fmt: skip
        else:
            coefficients = foreign.numbers(
                part.get("distortion_coeffs", []), 0 if lens == "none" else 4, f"{name} distortion_coeffs"
            )
            intrinsics = foreign.numbers(part["intrinsics"], 4, f"{name} intrinsics")
            size = foreign.whole_size(*part["resolution"])
            cameras.append(foreign.named_camera(name, intrinsics, size, _LENSES[lens], coefficients))
        if "T_cn_cnm1" in part:
            step = np.array(foreign.numbers(part["T_cn_cnm1"], 16, f"{name} T_cn_cnm1")).reshape(4, 4)
            whole = step @ whole
        elif len(cameras) > 1:
            poses = []
            lost.add(f"{name} has no T_cn_cnm1")
            continue
        poses.append(foreign.checked_pose(whole[:3, :3].tolist(), whole[:3, 3].tolist()))
        lost |= {f"{key} is not kept" for key in ("T_cam_imu", "timeshift_cam_imu") if key in part}
    if not cameras:
        raise ValueError("no cam0")
    return foreign.ImportedCameras(
        format="kalibr",
        cameras=tuple(cameras),
        poses=tuple(poses) if len(poses) == len(cameras) > 1 else (),
        notes=tuple(sorted(lost)),
    )


def _read_results(text: str, hints: foreign.Hints) -> foreign.ImportedCameras:
    """The cameras of Kalibr's text of results, which has standard deviations and no image size."""
    size = foreign.known_size(hints.size)
    cameras, notes = [], {"poses are read from the camchain, not from the text of results"}
    for part in re.split(r"^(?=cam\d+ \()", text, flags=re.MULTILINE)[1:]:
        name, found = part.split(" ", 1)[0], {key: (value, sigma) for key, value, sigma in _RESULTS.findall(part)}
        kind = re.search(r"type:.*?\.(\w+)Geometry", part)
        if kind is None or kind[1] not in _GEOMETRIES:
            raise ValueError(f"{name}: {kind[1] if kind else 'no type'}: kcal reads {', '.join(_GEOMETRIES)}")
        lens = foreign.numbers(found["distortion"][0].split(), 4, f"{name} distortion")
        core = foreign.numbers(found["projection"][0].split(), 4, f"{name} projection")
        camera = foreign.named_camera(name, core, size, _GEOMETRIES[kind[1]], lens)
        sigmas = [foreign.numbers(found[key][1].split(), 4, f"{name} {key}") for key in ("projection", "distortion")]
        notes.add(foreign.with_sigmas(camera, [*sigmas[0], *sigmas[1]]))
        cameras.append(camera)
    return foreign.ImportedCameras(format="kalibr", cameras=tuple(cameras), notes=tuple(sorted(notes)))


class KalibrLens(NamedTuple):
    """A lens as Kalibr writes it."""

    camera_model: str
    intrinsics: Sequence[float]
    distortion_model: str
    distortion_coeffs: Sequence[float]
    resolution: tuple[int, int]


def write_kalibr(cameras: Sequence[Camera], poses: Sequence[foreign.CameraPose], path: Path) -> list[Path]:
    """Write a chain of cameras."""
    names = {model: name for name, model in _LENSES.items()}
    lenses = [
        KalibrLens(
            "pinhole",
            camera.params[:4].tolist(),
            "radtan" if not camera.model.size else names[str(camera.model)],
            camera.coefficients.tolist() or [0.0] * 4,
            camera.size,
        )
        for camera in cameras
    ]
    return write_chain(lenses, poses, path)


def write_omni(
    cameras: Sequence[Camera], values: Sequence[Sequence[float]], poses: Sequence[foreign.CameraPose], path: Path
) -> list[Path]:
    """Write a chain of cameras as omni-radtan, with the nine numbers of `fit_omni` for each."""
    lenses = [
        KalibrLens("omni", list(own[:5]), "radtan", list(own[5:]), camera.size)
        for camera, own in zip(cameras, values, strict=True)
    ]
    return write_chain(lenses, poses, path)


def write_chain(lenses: Sequence[KalibrLens], poses: Sequence[foreign.CameraPose], path: Path) -> list[Path]:
    """Write lenses, and the pose of each from the one before, as a camchain."""
    content: dict[str, Any] = {}
    for i, lens in enumerate(lenses):
        part: dict[str, Any] = {
            "cam_overlaps": [k for k in range(len(lenses)) if k != i],
            "camera_model": lens.camera_model,
            "distortion_coeffs": list(lens.distortion_coeffs),
            "distortion_model": lens.distortion_model,
            "intrinsics": list(lens.intrinsics),
            "resolution": list(lens.resolution),
            "rostopic": f"/cam{i}/image_raw",
        }
        if i and poses:
            before, here = poses[i - 1], poses[i]
            rotation = here.rotation @ before.rotation.T
            translation = here.translation - rotation @ before.translation
            step = np.eye(4)
            step[:3, :3], step[:3, 3] = np.array(foreign.plain(rotation)), foreign.plain(translation)
            part["T_cn_cnm1"] = step.tolist()
        content[f"cam{i}"] = part
    return [write_atomic(path, foreign.dump_yaml(content))]
