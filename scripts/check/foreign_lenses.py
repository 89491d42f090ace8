"""Lenses of other programs, by their published formulas written out once more, and what kcal makes of their files.

"in": a file in the program's published form, or one that pycolmap writes, read by kcal; the largest error of 10,000
pixels all over the image against the formula, or against pycolmap's own projection. "out": a fisheye lens of 190°
written as the program's lens; the largest distance of what the formula makes of the file from the lens itself.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import yaml
from scipy.io import savemat

from kcal import Camera
from kcal.lens import export_cameras, import_cameras
from scripts.shared.page import in_folder, section, table

SIZE, FX, FY, CX, CY = (640, 480), 280.0, 285.0, 330.0, 236.0
Points = np.ndarray
TWELVE = [0.03, -0.01, 0.002, 0.0005, -0.0001, 0.00001, 0.002, -0.003, 0.001, -0.0005, -0.002, 0.0004]
EIGHT = TWELVE[:8]


def tangential(x: Points, y: Points, p1: float, p2: float) -> tuple[Points, Points]:
    """In OpenCV's order."""
    r2 = x * x + y * y
    return 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def angles(p: Points) -> tuple[Points, Points]:
    across = np.hypot(p[:, 0], p[:, 1])
    return p[:, 0] * np.arctan2(across, p[:, 2]) / across, p[:, 1] * np.arctan2(across, p[:, 2]) / across


def growth(x: Points, y: Points, k: list[float]) -> Points:
    return 1 + sum(each * (x * x + y * y) ** (i + 1) for i, each in enumerate(k))


def fisheye624(p: Points, c: list[float] = TWELVE) -> tuple[Points, Points]:
    (x, y), c = angles(p), [*c, *[0.0] * 12]
    r2, (across, down) = x * x + y * y, tangential(x, y, c[6], c[7])
    grown = growth(x, y, c[:6])
    return x * grown + across + c[8] * r2 + c[9] * r2**2, y * grown + down + c[10] * r2 + c[11] * r2**2


def omni(p: Points, xi: float = 0.9, k: tuple[float, ...] = (-0.1, 0.02), t: tuple[float, ...] = (1e-3, -5e-4)) -> Any:
    unit = p / np.linalg.norm(p, axis=1, keepdims=True)
    x, y = unit[:, 0] / (unit[:, 2] + xi), unit[:, 1] / (unit[:, 2] + xi)
    across, down = tangential(x, y, *t)
    return x * growth(x, y, list(k)) + across, y * growth(x, y, list(k)) + down


def double_sphere(p: Points, xi: float = -0.2, alpha: float = 0.55) -> Any:
    first = np.linalg.norm(p, axis=1)
    second = np.sqrt(p[:, 0] ** 2 + p[:, 1] ** 2 + (xi * first + p[:, 2]) ** 2)
    below = alpha * second + (1 - alpha) * (xi * first + p[:, 2])
    return p[:, 0] / below, p[:, 1] / below


def eucm(p: Points, alpha: float = 0.6, beta: float = 1.1) -> Any:
    below = alpha * np.sqrt(beta * (p[:, 0] ** 2 + p[:, 1] ** 2) + p[:, 2] ** 2) + (1 - alpha) * p[:, 2]
    return p[:, 0] / below, p[:, 1] / below


def fov(p: Points, omega: float = 0.9) -> Any:
    radius = np.hypot(p[:, 0], p[:, 1]) / p[:, 2]
    scale = np.arctan(2 * radius * math.tan(omega / 2)) / omega / radius / p[:, 2]
    return p[:, 0] * scale, p[:, 1] * scale


def dual(p: Points, t: float = 0.3, k1: float = -0.05, k2: float = 0.01) -> Any:
    x, y = angles(p)
    x, y = t * p[:, 0] / p[:, 2] + (1 - t) * x, t * p[:, 1] / p[:, 2] + (1 - t) * y
    return x * growth(x, y, [k1, k2]), y * growth(x, y, [k1, k2])


def metashape(kind: str, p: Points) -> Any:
    """p1 and p2 are OpenCV's p2 and p1 there, and p3, p4 grow what they give."""
    x, y = (p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]) if kind == "frame" else angles(p)
    if kind == "equisolid_fisheye":
        angle = np.hypot(x, y)
        x, y = x / angle * 2 * np.sin(angle / 2), y / angle * 2 * np.sin(angle / 2)
    across, down = tangential(x, y, -0.003, 0.002)
    grown, factor = growth(x, y, [0.02, -0.005, 0.001, 0.0]), growth(x, y, [0.4, -0.1])
    return x * grown + across * factor, y * grown + down * factor


def pixels_of(plane: tuple[Points, Points], skew: float = 0.0) -> Points:
    return np.stack([FX * plane[0] + skew * plane[1] + CX, FY * plane[1] + CY], 1)


def kalibr(model: str, lens: str, before: list[float], terms: list[float]) -> tuple[str, Any]:
    return "c.yaml", yaml.safe_dump({"cam0": {
        "camera_model": model, "distortion_model": lens, "intrinsics": [*before, FX, FY, CX, CY],
        "distortion_coeffs": terms, "resolution": list(SIZE)}})  # fmt: skip


def opensfm(kind: str, **terms: float) -> tuple[str, Any]:
    lengths = {"focal_x": FX / 640, "focal_y": FY / 640, "c_x": (CX - 319.5) / 640, "c_y": (CY - 239.5) / 640}
    camera = {"projection_type": kind, "width": 640, "height": 480, **lengths, **terms}
    return "camera_models.json", {"one": camera}


def agisoft(kind: str) -> tuple[str, Any]:
    terms = {"f": FY, "b1": FX - FY, "b2": 1.5, "cx": CX - 319.5, "cy": CY - 239.5, "k1": 0.02, "k2": -0.005,
             "k3": 0.001, "p1": 0.002, "p2": -0.003, "p3": 0.4, "p4": -0.1}  # fmt: skip
    inside = "".join(f"<{name}>{value!r}</{name}>" for name, value in terms.items())
    head = f'<d><sensors><sensor><calibration type="{kind}"><resolution width="640" height="480"/>'
    return "a.xml", f"{head}{inside}</calibration></sensor></sensors></d>"


K = [[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]]
RATIONAL = dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
                    (0.1, 0.02, 1e-3, -2e-3, 0.01, 0.12, 0.03, 0.002), strict=True))  # fmt: skip


def opencv_formula(points: Points, matrix: Points, lens: Points, fisheye: bool = False) -> Points:
    zero = np.zeros(3)
    if fisheye:
        return np.asarray(cv2.fisheye.projectPoints(points[:, None], zero, zero, matrix, lens)[0][:, 0])
    return np.asarray(cv2.projectPoints(points, zero, zero, matrix, lens)[0][:, 0])


def rational(p: Points) -> Points:
    return opencv_formula(p, np.array(K), np.array([*RATIONAL.values()]))


def kb4(p: Points) -> Any:
    x, y = angles(p)
    return x * growth(x, y, TWELVE[:4]), y * growth(x, y, TWELVE[:4])


def basalt(kind: str, **terms: float) -> tuple[str, Any]:
    lens = {"camera_type": kind, "intrinsics": {"fx": FX, "fy": FY, "cx": CX, "cy": CY, **terms}}
    return "calibration.json", {"value0": {"intrinsics": [lens], "resolution": [SIZE]}}


def multical() -> tuple[str, Any]:
    lens = {"model": "rational", "image_size": SIZE, "K": K, "dist": [[*RATIONAL.values()]]}
    return "calibration.json", {"cameras": {"a": lens}, "camera_poses": {}}


def calibio() -> tuple[str, Any]:
    values = {"f": FX, "ar": FY / FX, "cx": CX, "cy": CY, **RATIONAL}
    base = {"CameraModelBase": {"imageSize": {"width": 640, "height": 480}}}
    data = {"parameters": {name: {"val": value} for name, value in values.items()}, "CameraModelCRT": base}
    model = {"polymorphic_name": "libCalib::CameraModelOpenCV", "ptr_wrapper": {"data": data}}
    return "calib.json", {"Calibration": {"cameras": [{"model": model}]}}


# MATLAB's lens has a formula for the rays of pixels, which are counted from 1.
MAPPING, STRETCH, MIDDLE = (290.0, -1.1e-3, 4e-7, -1.5e-9), [[1.002, 0.001], [-0.0005, 1.0]], [325.0, 238.0]
FISHEYE = {"MappingCoefficients": MAPPING, "DistortionCenter": MIDDLE, "ImageSize": [480.0, 640.0],
           "StretchMatrix": STRETCH}  # fmt: skip


def rays_of_matlab(pixels: Points) -> Points:
    sensor = np.linalg.solve(np.array(STRETCH), (pixels + 1 - MIDDLE).T).T
    rho = np.linalg.norm(sensor, axis=1)
    depth = MAPPING[0] + MAPPING[1] * rho**2 + MAPPING[2] * rho**3 + MAPPING[3] * rho**4
    return np.concatenate([sensor, depth[:, None]], 1)


NAMES = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s0", "s1", "s2", "s3")
READ: dict[str, tuple[tuple[str, Any], Callable[[Points], Points]]] = {
    "Kalibr omni": (kalibr("omni", "radtan", [0.9], [-0.1, 0.02, 1e-3, -5e-4]), lambda p: pixels_of(omni(p))),
    "Kalibr omni-none": (
        kalibr("omni", "none", [0.9], [0.0] * 4), lambda p: pixels_of(omni(p, 0.9, (0, 0), (0, 0)))
    ),
    "Kalibr ds": (kalibr("ds", "none", [-0.2, 0.55], []), lambda p: pixels_of(double_sphere(p))),
    "Kalibr eucm": (kalibr("eucm", "none", [0.6, 1.1], []), lambda p: pixels_of(eucm(p))),
    "Kalibr fov": (kalibr("pinhole", "fov", [], [0.9]), lambda p: pixels_of(fov(p))),
    "OpenSfM fisheye62": (
        opensfm("fisheye62", **dict(zip(NAMES, EIGHT, strict=False))), lambda p: pixels_of(fisheye624(p, EIGHT))
    ),
    "OpenSfM fisheye624": (
        opensfm("fisheye624", **dict(zip(NAMES, TWELVE, strict=True))), lambda p: pixels_of(fisheye624(p))
    ),
    "OpenSfM dual": (opensfm("dual", transition=0.3, k1=-0.05, k2=0.01), lambda p: pixels_of(dual(p))),
    "Basalt ds": (basalt("ds", xi=-0.2, alpha=0.55), lambda p: pixels_of(double_sphere(p))),
    "Basalt eucm": (basalt("eucm", alpha=0.6, beta=1.1), lambda p: pixels_of(eucm(p))),
    "Basalt ucm": (basalt("ucm", alpha=0.6), lambda p: pixels_of(eucm(p, 0.6, 1.0))),
    "Basalt kb4": (basalt("kb4", **dict(zip(NAMES, TWELVE[:4], strict=False))), lambda p: pixels_of(kb4(p))),
    "Basalt pinhole-radtan8": (basalt("pinhole-radtan8", **RATIONAL), rational),
    "multical rational": (multical(), rational),
    "calib.io OpenCV": (calibio(), rational),
    "Metashape frame": (agisoft("frame"), lambda p: pixels_of(metashape("frame", p), 1.5)),
    "Metashape fisheye": (agisoft("fisheye"), lambda p: pixels_of(metashape("fisheye", p), 1.5)),
    "Metashape equisolid_fisheye": (
        agisoft("equisolid_fisheye"), lambda p: pixels_of(metashape("equisolid_fisheye", p), 1.5)
    ),
}  # fmt: skip


PYCOLMAP = {
    "FOV": [0.9], "DIVISION": [-0.3], "EUCM": [0.6, 1.1],
    "THIN_PRISM_FISHEYE": [0.03, -0.01, 0.002, -0.003, 0.002, 0.0005, 0.001, -0.002],
    "RAD_TAN_THIN_PRISM_FISHEYE": TWELVE, "OPENCV_FISHEYE": TWELVE[:4],
    "FULL_OPENCV": [0.1, 0.02, 1e-3, -2e-3, 0.01, 0.12, 0.03, 0.002],
    "SIMPLE_DIVISION": [-0.3], "RADIAL_FISHEYE": [0.03, -0.01], "SIMPLE_FISHEYE": [], "FISHEYE": [],
    "SIMPLE_RADIAL_FISHEYE": [0.03], "RADIAL": [0.03, 0.01], "SIMPLE_RADIAL": [0.03],
    "OPENCV": [0.03, 0.01, 1e-3, 2e-3],
}  # fmt: skip


def written(folder: Path, file: tuple[str, Any]) -> Path:
    """The file: text, what JSON says, or for the suffix .mat a struct."""
    path = folder / file[0]
    if path.suffix == ".mat":
        savemat(path, file[1])
    else:
        path.write_text(file[1] if isinstance(file[1], str) else json.dumps(file[1]))
    return path


def pixels_everywhere(count: int = 10_000) -> torch.Tensor:
    """(N, 2) all over the image, its edges included."""
    return torch.from_numpy(np.random.default_rng(0).random((count, 2)) * SIZE - 0.5)


def error_of(camera: Camera, project: Callable[[Points], Points]) -> float:
    """Largest distance from a formula's pixels in a coordinate, where it has any: within 89° of the axis."""
    pixels = pixels_everywhere()
    rays, valid = camera.unproject(pixels)
    ahead = valid & (rays[:, 2] > math.cos(math.radians(89.0)))
    return float(np.abs(project(3.0 * rays[ahead].numpy()) - pixels[ahead].numpy()).max())


def by_colmap(model: str, folder: Path) -> tuple[Path, Callable[[Points], Points]]:
    """A file that pycolmap writes, and its projection."""
    import pycolmap

    focal = [FX] if model.startswith(("SIMPLE", "RADIAL")) else [FX, FY]
    params = [*focal, CX + 0.5, CY + 0.5, *PYCOLMAP[model]]
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=params, camera_id=7)
    scene = pycolmap.Reconstruction()
    scene.add_camera_with_trivial_rig(theirs)
    scene.write_text(str(folder))
    scene.write_binary(str(folder))
    return folder / "cameras.txt", lambda p: np.asarray(theirs.img_from_cam(p)) - 0.5


WIDE = Camera.build(
    focal=(250, 251), center=(322, 237), size=SIZE, coefficients=[-0.02, 0.004, -0.001, 0.0001], model="fisheye4"
)
# Lenses that are written, with the formula of what is in the file.
WRITTEN: dict[tuple[str, str], Callable[[list[float], Points], Any]] = {
    ("kalibr", "omni-radtan"): lambda v, p: omni(p, v[0], tuple(v[1:3]), tuple(v[3:5])),
    ("kalibr", "ds"): lambda v, p: double_sphere(p, *v),
    ("kalibr", "eucm"): lambda v, p: eucm(p, *v),
    ("basalt", "ds"): lambda v, p: double_sphere(p, *v),
    ("basalt", "eucm"): lambda v, p: eucm(p, *v),
    ("opensfm", "fisheye624"): lambda v, p: fisheye624(p, v),
}


def in_file(form: str, path: Path) -> tuple[list[float], list[float]]:
    """fx, fy, cx, cy in kcal's convention, and the other parameters."""
    if form == "kalibr":
        part = yaml.safe_load(path.read_text())["cam0"]
        *before, fu, fv, pu, pv = part["intrinsics"]
        return [fu, fv, pu, pv], [*before, *part["distortion_coeffs"]]
    if form == "basalt":
        values = list(json.loads(path.read_text())["value0"]["intrinsics"][0]["intrinsics"].values())
        return values[:4], values[4:]
    one = next(iter(json.loads(path.read_text()).values()))
    core = [640 * one["focal_x"], 640 * one["focal_y"], 640 * one["c_x"] + 319.5, 640 * one["c_y"] + 239.5]
    return core, [one[name] for name in NAMES]


def by_formula(form: str, kind: str, path: Path, points: Points) -> Points:
    """Pixels of points by the published formula of what is in the file."""
    (fx, fy, cx, cy), own = in_file(form, path)
    plane = WRITTEN[form, kind](own[:2] if kind in ("ds", "eucm") else own, points)
    return np.stack([fx * plane[0] + cx, fy * plane[1] + cy], 1)


def pycolmap_camera(path: Path, **more: int) -> Any:
    """The last camera of COLMAP's text, as pycolmap has it."""
    import pycolmap

    _, model, width, height, *values = path.read_text().splitlines()[-1].split()
    size = {"width": int(width), "height": int(height)}
    return pycolmap.Camera(model=model, params=list(map(float, values)), **size, **more)


def error_of_written(form: str, kind: str, path: Path) -> float:
    """Largest distance of the file's lens from the one that was written."""
    pixels = pixels_everywhere()
    points = 3.0 * WIDE.unproject(pixels)[0].numpy()
    if form == "colmap":
        seen = np.asarray(pycolmap_camera(path).img_from_cam(points)) - 0.5
    else:
        seen = by_formula(form, kind, path, points)
    # COLMAP sees nothing beside the camera and behind it.
    return float(np.nanmax(np.linalg.norm(seen - pixels.numpy(), axis=1)))


FILES = {"kalibr": "chain.yaml", "basalt": "basalt.json", "opensfm": "camera_models.json", "colmap": "cameras.txt"}
OUT = [*WRITTEN, ("colmap", "rad-tan-thin-prism"), ("colmap", "eucm")]


def rows(folder: Path) -> Iterator[list[str]]:
    for name, (file, project) in READ.items():
        program, lens = name.split(" ", 1)
        camera = import_cameras(written(folder, file)).cameras[0]
        to = " → hybrid" if camera.model.hybrid else ""
        yield [program, "in", f"{lens}{to}", f"{error_of(camera, project):.0e}", "its published formula"]
    camera = import_cameras(written(folder, ("f.mat", {"params": FISHEYE}))).cameras[0]
    pixels = pixels_everywhere()
    off = camera.project_rays(torch.from_numpy(rays_of_matlab(pixels.numpy())))[0] - pixels
    yield ["MATLAB", "in", "fisheye → hybrid", f"{float(off.abs().max()):.0e}", "its published formula"]
    for model in PYCOLMAP:
        path, project = by_colmap(model, folder)
        camera = import_cameras(path).cameras[0]
        to = " → hybrid" if camera.model.hybrid else ""
        yield ["COLMAP", "in", f"{model}{to}", f"{error_of(camera, project):.0e}", "pycolmap"]
    for form, kind in OUT:
        done = export_cameras(WIDE, folder / FILES[form], format=form, model=kind)
        assert done.misfits[0] is not None
        far = error_of_written(form, kind, done.paths[0])
        stated = f"{far:.2g} (stated: {done.misfits[0].largest:.2g})"
        yield [form, "out", f"fisheye → {kind}", stated, "pycolmap" if form == "colmap" else "its published formula"]


@section("other-programs.md", "foreign lenses")
def foreign_lenses() -> Iterator[str]:
    return table(["program", "direction", "lens", "largest error, px", "reader"], in_folder(rows))
