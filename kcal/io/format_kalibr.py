"""Kalibr: camchains, and its omnidirectional model."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import kcal.io.foreign as foreign
from kcal.errors import DegenerateError
from kcal.files import read_text, write_atomic
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.hybrid_terms import HybridForm, radius_over_angle
from kcal.lens.model import LensModel
from kcal.lens.pose import Pose
from kcal.lens.projection import project_components
from kcal.lens.zernike import ZernikeModes
from kcal.strict_formats import MOST_YAML, read_yaml

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


def _central_rays(kind: str, values: Sequence[float], plane: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays (N, 3) of places (N, 2) on the plane of a kind of lens, and where (N,) it has one.

    Sources: Mei and Rives 2007 (omni), Usenko et al. 2018 (ds, eucm), Devernay and Faugeras 2001 (fov), Fitzgibbon 2001
    (division). The places of `theta` are directions times the angle from the axis.
    """
    square, first = plane.square().sum(-1), values[0] if values else 0.0
    radius = square.sqrt()
    if kind == "omni":
        root = 1.0 + (1.0 - first**2) * square
        along = (first + root.clamp_min(0.0).sqrt()) / (square + 1.0)
        return torch.cat([plane * along[:, None], (along - first)[:, None]], -1), root > 0
    if kind in ("ds", "eucm"):
        alpha, beta, behind = (values[1], 1.0, first) if kind == "ds" else (first, values[1], 0.0)
        root = 1.0 - (2.0 * alpha - 1.0) * beta * square
        depth = (1.0 - alpha**2 * beta * square) / (alpha * root.clamp_min(0.0).sqrt() + 1.0 - alpha)
        length = depth**2 + (1.0 - behind**2) * square
        along = (
            (depth * behind + length.clamp_min(0.0).sqrt()) / (depth**2 + square) if behind else torch.ones_like(depth)
        )
        rays = torch.cat([plane * along[:, None], (along * depth - behind)[:, None]], -1)
        return rays, (root > 0) & (length > 0)
    if kind == "division":
        return torch.cat([plane, 1.0 + first * square[:, None]], -1), square >= 0
    angle, good = radius, radius < math.pi
    if kind == "fov":
        # Tangents of angles near 90° are no rays of a camera.
        turned = (radius * first).clamp_max(1.55)
        angle, good = (turned.tan() / (2.0 * math.tan(0.5 * first))).atan(), radius * first < 1.55
    scale = torch.where(radius > 0, angle.sin() / radius.clamp_min(1e-30), 1.0)
    return torch.cat([plane * scale[:, None], angle.cos()[:, None]], -1), good


def central_camera(kind: str, inner: Camera, values: Sequence[float] = ()) -> tuple[Camera, str]:
    """The hybrid camera that comes nearest to another program's lens over the image, and a note on how near.

    Args:
        kind: omni, ds, eucm, fov, division or theta.
        inner: from the plane of the lens to pixels.
        values: xi of omni; xi and alpha of ds; alpha and beta of eucm; omega of fov; k of division.

    Raises:
        ValueError: a lens that no hybrid lens follows.
    """
    size, name = inner.size, foreign.camera_name(inner, "camera")
    limits: dict[str, list[tuple[float, float]]]
    limits = {"omni": [(-1, _MOST_XI)], "ds": [(-1, 1), (0, 1)], "eucm": [(0, 1), (0, 1e3)], "fov": [(0, 3)]}
    for value, (low, high) in zip(values, limits.get(kind, []), strict=False):
        if not low < value < high:
            raise ValueError(f"{name}: {kind} with a parameter of {value:g}; from {low} to {high:g} is possible")

    def lines(grid: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
        pixels = inner.grid(*grid).reshape(-1, 2)
        plane, seen = inner.normalize(pixels)
        rays, has = _central_rays(kind, values, plane)
        good = seen & has
        return rays[good], pixels[good]

    rays, pixels = lines(_GRID)
    if len(rays) < _GRID[0] * _GRID[1] // 4:
        raise ValueError(f"{name}: this {kind} lens has no ray for most of the image")
    camera, _ = hybrid_through(rays, pixels, size)
    camera.calibration = CameraCalibration(name=name)
    rays, pixels = lines(_BETWEEN)
    seen, shown = camera.project_rays(rays)
    error = (seen - pixels)[shown].norm(dim=-1)
    rms, most = float(error.square().mean().sqrt()), float(error.max())
    if not most < _FAR:
        raise ValueError(f"{name}: no lens of kcal follows this {kind} lens: the nearest is {most:.2g} px off")
    covered = float(len(rays) / (_BETWEEN[0] * _BETWEEN[1]))
    rest = "" if covered == 1.0 else f"; {1.0 - covered:.1%} of the image has no ray"
    title = NAME if kind == "omni" else f"its {kind} lens"
    return camera, f"{name}: {title} became kcal's hybrid lens, RMS {rms:.2g} px, at most {most:.2g} px{rest}"


# Kalibr's camchain YAML: `cam0`, `cam1`, ... with `T_cn_cnm1` from each camera to the next.

_LENSES = {"radtan": "opencv4", "equidistant": "fisheye4", "none": "pinhole"}
# Of a text of results: names of lenses, and lines with numbers and their standard deviations.
_GEOMETRIES = {"DistortedPinholeCamera": "opencv4", "EquidistantDistortedPinholeCamera": "fisheye4"}
_RESULTS = re.compile(r"^[ \t]*(distortion|projection): \[([^\]\n]*)\] \+- \[([^\]\n]*)\]", re.MULTILINE)


def read_kalibr(path: Path, hints: foreign.Hints) -> foreign.ImportedCameras:
    """Read all cameras of a chain, with poses from the first camera's frame; or of a `results-cam.txt`, with σ."""
    text = read_text(path, MOST_YAML)
    if _RESULTS.search(text):
        return _read_results(text, hints)
    content = read_yaml(text, str(path))
    names = [name for name in content if re.fullmatch(r"cam\d+", str(name))]
    parts = {name: foreign.Keys(content[name]) for name in names}
    notes: list[str] = []
    cameras, unread = foreign.each_readable((name, partial(_chain_camera, name, parts[name], notes)) for name in names)
    if not names:
        raise ValueError("no cam0")
    whole, poses = np.eye(4), dict[str, Pose]()
    first: np.ndarray | None = None
    for i, (name, part) in enumerate(parts.items()):
        imu = next((_transform(part, key, name) for key in ("T_cam_imu", "T_imu_cam") if key in part), None)
        if imu is not None:
            imu = imu if "T_cam_imu" in part else np.linalg.inv(imu)
            first = imu if not i else first
        if "T_cn_cnm1" in part:
            whole = _transform(part, "T_cn_cnm1", name) @ whole
        elif i and imu is not None and first is not None:
            whole = imu @ np.linalg.inv(first)
        elif i:
            poses = {}
            notes.append(f"{name} has neither T_cn_cnm1 nor T_cam_imu: no pose is read")
            break
        poses[name] = foreign.checked_pose(whole[:3, :3].tolist(), whole[:3, 3].tolist())
    if first is not None:
        notes.append("where the IMU is (T_cam_imu) is not kept")
    for name in parts:
        notes += parts[name].rest(f"{name}.") if name not in unread else []
    return foreign.ImportedCameras(
        format="kalibr",
        cameras=cameras,
        poses=tuple(pose for name, pose in poses.items() if name not in unread) if len(poses) > 1 else (),
        notes=tuple(dict.fromkeys(notes)),
        unread=unread,
    )


def _transform(part: Mapping[str, Any], key: str, name: str) -> np.ndarray:
    return np.array(foreign.numbers(part[key], 16, f"{name} {key}")).reshape(4, 4)


def _chain_camera(name: str, part: Mapping[str, Any], notes: list[str]) -> Camera:
    kind, lens = str(part["camera_model"]), str(part.get("distortion_model", "none"))
    size, before = foreign.whole_size(*part["resolution"]), {"omni": 1, "ds": 2, "eucm": 2}.get(kind, 0)
    allowed = {"pinhole": (*_LENSES, "fov"), "omni": ("radtan", "none"), "ds": ("none",), "eucm": ("none",)}
    if lens not in allowed.get(kind, ()):
        raise ValueError(
            f"camera_model {kind} with distortion_model {lens}: kcal reads "
            + ", ".join(f"{model} with {' or '.join(lenses)}" for model, lenses in allowed.items())
        )
    *values, fu, fv, pu, pv = foreign.numbers(part["intrinsics"], before + 4, f"{name} intrinsics")
    count = {"none": (0, 4) if before else 0, "fov": 1}.get(lens, 4)
    terms = foreign.numbers(part.get("distortion_coeffs", []), count, f"{name} distortion_coeffs")
    if lens == "none" and any(terms):
        raise ValueError("distortion_model none with coefficients")
    model = "pinhole" if lens in ("none", "fov") else _LENSES[lens]
    inner = foreign.named_camera(name, (fu, fv, pu, pv), size, model, [] if model == "pinhole" else terms)
    if kind == "pinhole" and lens != "fov":
        return inner
    camera, note = central_camera("fov" if lens == "fov" else kind, inner, terms if lens == "fov" else values)
    notes.append(note)
    return camera


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


def write_kalibr(cameras: Sequence[Camera], poses: Sequence[Pose], path: Path) -> list[Path]:
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
    cameras: Sequence[Camera], values: Sequence[Sequence[float]], poses: Sequence[Pose], path: Path
) -> list[Path]:
    """Write a chain of cameras as omni-radtan, with the nine numbers of `fit_omni` for each."""
    lenses = [
        KalibrLens("omni", list(own[:5]), "radtan", list(own[5:]), camera.size)
        for camera, own in zip(cameras, values, strict=True)
    ]
    return write_chain(lenses, poses, path)


def write_chain(lenses: Sequence[KalibrLens], poses: Sequence[Pose], path: Path) -> list[Path]:
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


# A hybrid lens through given rays and pixels: lenses of other programs that no parametric model of kcal has.

# Beyond the outermost ray, in proportion.
_MARGIN = 1.05
_SHAPES = torch.linspace(-1.0, 1.2, 221, dtype=torch.float64)
_STEPS = 4


def hybrid_through(rays: Tensor, pixels: Tensor, size: tuple[int, int]) -> tuple[Camera, Tensor]:
    """The hybrid camera that comes nearest to pixels (N, 2) of rays (N, 3), and its errors (N, 2) in pixels.

    By least squares, without an entrance pupil. The rays should reach all over the image.

    Raises:
        DegenerateError: rays that no hybrid lens shows.
    """
    middle = 0.5 * (torch.tensor(size, dtype=torch.float64) - 1.0)
    theta, radius = torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2]), (pixels - middle).norm(dim=-1)
    plane = theta * radius_over_angle(_SHAPES[:, None] * theta**2)
    focal = (plane * radius).sum(1) / plane.square().sum(1)
    off = (focal[:, None] * plane - radius).square().sum(1)
    best = int(torch.where(off.isfinite(), off, math.inf).argmin())
    form = HybridForm(shape=float(_SHAPES[best]), radius=_MARGIN * float(plane[best].max()), modes=ZernikeModes())
    model = LensModel(hybrid=form)
    values = torch.zeros(5 + model.size, dtype=torch.float64)
    values[:4] = torch.stack([focal[best], focal[best], *middle])
    # Aspect and skew are modes of the field.
    free = [0, 2, 3, *(5 + i for i, name in enumerate(model.names) if name not in ("pupil1", "pupil2"))]
    for _ in range(_STEPS):
        found = project_components(rays.T, values, model, free)
        slopes = found.by_camera.flatten(1).T
        scale = slopes.norm(dim=0)
        error = (pixels.T - found.pixels).reshape(-1, 1)
        values[free] += torch.linalg.lstsq(slopes / scale, error, driver="gelsd").solution[:, 0] / scale
    camera = Camera(values, size=size, model=model)
    seen, shown = camera.project_rays(rays)
    if not bool(shown.all()):
        raise DegenerateError(f"a hybrid lens shows only {float(shown.double().mean()):.1%} of these rays")
    return camera, seen - pixels
