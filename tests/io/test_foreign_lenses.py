"""Lenses of other programs: read as their published formulas have them, all over the image, and written."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from kcal import Camera
from kcal.errors import FileError, InputError
from kcal.io.foreign_lenses import LENSES, ForeignCamera, fit_foreign
from kcal.lens import export_cameras, import_cameras

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


def metashape(fisheye: bool, p: Points) -> Any:
    """p1 and p2 are OpenCV's p2 and p1 there, and p3, p4 grow what they give."""
    x, y = angles(p) if fisheye else (p[:, 0] / p[:, 2], p[:, 1] / p[:, 2])
    across, down = tangential(x, y, -0.003, 0.002)
    grown, factor = growth(x, y, [0.02, -0.005, 0.001, 0.0]), growth(x, y, [0.4, -0.1])
    return x * grown + across * factor, y * grown + down * factor


def pixels_of(plane: tuple[Points, Points], skew: float = 0.0) -> Points:
    return np.stack([FX * plane[0] + skew * plane[1] + CX, FY * plane[1] + CY], 1)


def kalibr(model: str, lens: str, before: list[float], terms: list[float]) -> tuple[str, str]:
    return "c.yaml", yaml.safe_dump({"cam0": {
        "camera_model": model, "distortion_model": lens, "intrinsics": [*before, FX, FY, CX, CY],
        "distortion_coeffs": terms, "resolution": list(SIZE)}})  # fmt: skip


def opensfm(kind: str, **terms: float) -> tuple[str, str]:
    lengths = {"focal_x": FX / 640, "focal_y": FY / 640, "c_x": (CX - 319.5) / 640, "c_y": (CY - 239.5) / 640}
    camera = {"projection_type": kind, "width": 640, "height": 480, **lengths, **terms}
    return "camera_models.json", json.dumps({"one": camera})


def agisoft(kind: str) -> tuple[str, str]:
    terms = {"f": FY, "b1": FX - FY, "b2": 1.5, "cx": CX - 319.5, "cy": CY - 239.5, "k1": 0.02, "k2": -0.005,
             "k3": 0.001, "p1": 0.002, "p2": -0.003, "p3": 0.4, "p4": -0.1}  # fmt: skip
    inside = "".join(f"<{name}>{value!r}</{name}>" for name, value in terms.items())
    head = f'<d><sensors><sensor><calibration type="{kind}"><resolution width="640" height="480"/>'
    return "a.xml", f"{head}{inside}</calibration></sensor></sensors></d>"


NAMES = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s0", "s1", "s2", "s3")
READ: dict[str, tuple[tuple[str, str], Callable[[Points], Points]]] = {
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
    "Metashape frame": (agisoft("frame"), lambda p: pixels_of(metashape(False, p), 1.5)),
    "Metashape fisheye": (agisoft("fisheye"), lambda p: pixels_of(metashape(True, p), 1.5)),
}  # fmt: skip


def imported(folder: Path, file: tuple[str, str]) -> tuple[Camera, str]:
    path = folder / file[0]
    path.write_text(file[1])
    found = import_cameras(path)
    (note,) = (note for note in found.notes if "became kcal's hybrid lens" in note)
    return found.cameras[0], note


@pytest.mark.parametrize("case", READ)
def test_read_as_published_all_over_the_image(tmp_path: Path, case: str) -> None:
    file, project = READ[case]
    camera, note = imported(tmp_path, file)
    pixels = camera.grid(41, 31).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    assert bool(valid.all())
    error = np.abs(project(3.0 * rays.numpy()) - pixels.numpy()).max()
    stated = float(note.split("at most ")[1].split(" px")[0])
    assert error <= 1.5 * stated + 1e-9 < 0.05


PYCOLMAP = {
    "FOV": [0.9], "DIVISION": [-0.3], "EUCM": [0.6, 1.1],
    "THIN_PRISM_FISHEYE": [0.03, -0.01, 0.002, -0.003, 0.002, 0.0005, 0.001, -0.002],
    "RAD_TAN_THIN_PRISM_FISHEYE": TWELVE, "OPENCV_FISHEYE": TWELVE[:4],
    "FULL_OPENCV": [0.1, 0.02, 1e-3, -2e-3, 0.01, 0.12, 0.03, 0.002],
    "SIMPLE_DIVISION": [-0.3], "RADIAL_FISHEYE": [0.03, -0.01], "SIMPLE_FISHEYE": [], "FISHEYE": [],
    "SIMPLE_RADIAL_FISHEYE": [0.03], "RADIAL": [0.03, 0.01], "SIMPLE_RADIAL": [0.03],
    "OPENCV": [0.03, 0.01, 1e-3, 2e-3],
}  # fmt: skip


@pytest.mark.parametrize("model", PYCOLMAP)
@pytest.mark.parametrize("suffix", ["txt", "bin"])
def test_colmap_projects_the_same(tmp_path: Path, model: str, suffix: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    focal = [FX] if model.startswith(("SIMPLE", "RADIAL")) else [FX, FY]
    theirs = pycolmap.Camera(
        model=model, width=640, height=480, params=[*focal, CX + 0.5, CY + 0.5, *PYCOLMAP[model]], camera_id=7
    )
    scene = pycolmap.Reconstruction()
    scene.add_camera_with_trivial_rig(theirs)
    (scene.write_text if suffix == "txt" else scene.write_binary)(str(tmp_path))
    camera = import_cameras(tmp_path / f"cameras.{suffix}").cameras[0]
    pixels = camera.grid(41, 31).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    ahead = valid & (rays[:, 2] > 0.05)
    assert int(ahead.sum()) > 0.9 * len(ahead)
    seen = np.asarray(theirs.img_from_cam(rays[ahead].numpy())) - 0.5
    assert np.abs(seen - pixels[ahead].numpy()).max() < (0.02 if camera.model.hybrid else 1e-9)


def test_every_model_of_colmap_is_known() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    from kcal.io.format_photos import COLMAP_MODELS

    for name, number in pycolmap.CameraModelId.__members__.items():
        if int(number) >= 0:
            known = COLMAP_MODELS[name]
            default = pycolmap.Camera.create_from_model_id(1, number, 500, 640, 480)
            assert (known.number, len(known.parameters)) == (int(number), len(default.params))


WIDE = Camera.build(
    focal=(250, 251), center=(322, 237), size=SIZE, coefficients=[-0.02, 0.004, -0.001, 0.0001], model="fisheye4"
)


@pytest.mark.parametrize("kind", [kind for kind in LENSES if "with" not in kind])
def test_a_lens_is_found_again(kind: str) -> None:
    own = {"omni-radtan": [0.9, -0.1, 0.02, 1e-3, -5e-4], "ds": [-0.2, 0.55], "eucm": [0.6, 1.1], "fov": [0.9],
           "division": [-0.3], "dual": [0.3, -0.05, 0.01]}.get(kind, TWELVE)  # fmt: skip
    truth = ForeignCamera(kind, (FX, FY, CX, CY, 0.0, *own), SIZE, "")
    pixels = WIDE.grid(33, 25).reshape(-1, 2)
    rays, valid = truth.unproject(pixels)
    assert bool(valid.all())
    assert float((truth.project(5.0 * rays)[0] - pixels).abs().max()) < 1e-7

    class Shown(Camera):
        def unproject(self, pixels: Any, *, start: Any = None) -> Any:
            return truth.unproject(torch.as_tensor(pixels))

    stand_in = Shown(WIDE.params, size=SIZE, model=WIDE.model)
    found = fit_foreign(kind, stand_in)
    assert float((found.project(rays)[0] - pixels).norm(dim=-1).max()) < 1e-3


@pytest.mark.parametrize(
    ("form", "file", "model"),
    [("kalibr", "c.yaml", kind) for kind in ("omni-radtan", "ds", "eucm")]
    + [("colmap", "cameras.txt", kind) for kind in ("rad-tan-thin-prism", "eucm")]
    + [("opensfm", "camera_models.json", "fisheye624")],
)
def test_a_lens_that_is_asked_for_is_written(tmp_path: Path, form: str, file: str, model: str) -> None:
    done = export_cameras(WIDE, tmp_path / file, format=form, model=model)
    assert done.models == (model,)
    assert done.misfits[0] is not None
    camera = import_cameras(tmp_path / file).cameras[0]
    pixels = WIDE.grid(21, 16).reshape(-1, 2)
    seen, shown = camera.project_rays(WIDE.unproject(pixels)[0])
    assert bool(shown.all())
    assert float((seen - pixels).norm(dim=-1).max()) < done.misfits[0].largest + 0.01 < 3.0
    if form == "colmap":
        pycolmap = pytest.importorskip("pycolmap")
        _, name, width, height, *values = (tmp_path / file).read_text().splitlines()[-1].split()
        theirs = pycolmap.Camera(model=name, width=int(width), height=int(height), params=list(map(float, values)))
        rays = WIDE.unproject(pixels)[0]
        ahead = (rays[:, 2] > 0.05).numpy()
        by_them = np.asarray(theirs.img_from_cam(rays.numpy()[ahead])) - 0.5
        assert np.abs(by_them - pixels.numpy()[ahead]).max() < done.misfits[0].largest


def test_a_lens_that_shows_too_little_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="fov does not show the whole image"):
        export_cameras(WIDE, tmp_path / "c.yaml", format="kalibr", model="fov")
    with pytest.raises(InputError, match=r"do not hold dual; choose one of .*omni-radtan, ds"):
        export_cameras(WIDE, tmp_path / "c.yaml", format="kalibr", model="dual")


def test_parameters_out_of_range_and_lenses_without_rays_are_refused(tmp_path: Path) -> None:
    for file, words in (
        (kalibr("ds", "none", [-0.2, 1.4], []), "ds with a parameter of 1.4; from 0 to 1"),
        (opensfm("fisheye62", k1=-50.0), "has no ray for most of the image"),
        (opensfm("spherical"), "projection_type spherical: kcal reads .*fisheye624, dual"),
    ):
        with pytest.raises(FileError, match=words):
            imported(tmp_path, file)
