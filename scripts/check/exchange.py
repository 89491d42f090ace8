"""Whether cameras survive the way to other programs and back: 10,000 points through each peer's own reader.

KCAL_MRCAL, KCAL_ROS and KCAL_PEERS name interpreters that have mrcal, ROS's camera_calibration_parsers and
image_geometry, and pycolmap; without one its rows stay as they are on the page. OpenCV and SciPy are read in this
process. Where no reader of a program can be installed here, its published formula projects what PyYAML or json reads.
"""

from __future__ import annotations

import json
import math
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
import yaml
from scipy.io import loadmat

from kcal import Camera
from kcal.lens import LensModel, camera_difference, export_cameras, import_cameras
from kcal.lens.model import HybridForm, radius_over_angle
from kcal.lens.zernike import ZernikeModes
from scripts.check.foreign_lenses import by_formula
from scripts.shared.children import interpreter
from scripts.shared.page import merged, table
from scripts.shared.sections import section

POINTS = 10_000
LENSES = {
    "pinhole": [],
    "opencv4": [-0.2, 0.05, 1e-3, -2e-3],
    "opencv5": [-0.2, 0.05, 1e-3, -2e-3, 0.01],
    "opencv8": [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.02, 0.003],
    "opencv12": [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.02, 0.003, 1e-3, -1e-3, 2e-3, 1e-3],
    "opencv14": [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.02, 0.003, 1e-3, -1e-3, 2e-3, 1e-3, 0.01, 0.02],
    "fisheye4": [0.05, -0.01, 0.003, -0.001],
}
Project = Callable[[Path, np.ndarray], np.ndarray]


def sample_camera(model: str) -> Camera:
    """A camera of 1280x720 px whose intrinsics are all unlike."""
    return Camera.build(
        focal=(1000.1, 1001.3), center=(640.3, 359.2), size=(1280, 720), coefficients=LENSES[model], model=model
    )


def hybrid_camera(shape: float, corner_deg: float) -> Camera:
    """A hybrid lens whose field is up to some pixels, as that of calibrated cameras."""
    size, angle = (1920, 1080), math.radians(corner_deg)
    half = 0.5 * math.hypot(*size)
    focal = half / (float(radius_over_angle(torch.tensor(shape * angle * angle).double())) * angle)
    modes = ZernikeModes()
    form = HybridForm(shape=shape, radius=1.08 * half / focal, modes=modes)
    noise = torch.randn(len(modes), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    degrees = torch.tensor([float(degree) for *_, degree in modes.real_modes], dtype=torch.float64)
    head = torch.tensor([focal, 1.0005 * focal, 963.0, 536.0, 0.0, 0.01, 2e-3, 1e-3], dtype=torch.float64)
    weights = 3e-4 * form.radius * torch.exp(-0.5 * degrees) * noise
    return Camera(torch.cat([head, weights]), size=size, model=LensModel(hybrid=form))


def random_points(camera: Camera, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points 1 to 100 m away all over the image, edges included, and their pixels."""
    draw = np.random.default_rng(seed)
    pixels = torch.from_numpy(draw.random((POINTS, 2)) * camera.size - 0.5)
    rays, valid = camera.unproject(pixels)
    distance = torch.from_numpy(draw.uniform(1, 100, (POINTS, 1)))
    return (rays * distance)[valid].numpy(), pixels[valid].numpy()


def peer(python: str, kind: str) -> Project:
    """A projection by another interpreter."""

    def project(path: Path, points: np.ndarray) -> np.ndarray:
        folder = path.parent
        np.save(folder / "points.npy", points)
        ask(python, kind, str(path), folder / "points.npy", folder / "pixels.npy")
        return np.asarray(np.load(folder / "pixels.npy"))

    return project


def ask(python: str, kind: str, path: str, points: Path, output: Path) -> None:
    script = Path(__file__).with_name("peer_cameras.py")
    done = subprocess.run(
        [python, str(script), kind, path, str(points), str(output)], capture_output=True, text=True, env={}
    )
    if done.returncode:
        raise RuntimeError(f"{kind}: {done.stderr.strip().splitlines()[-1]}")


def opencv_formula(points: np.ndarray, matrix: np.ndarray, lens: np.ndarray, fisheye: bool) -> np.ndarray:
    zero = np.zeros(3)
    if fisheye:
        return np.asarray(cv2.fisheye.projectPoints(points[:, None], zero, zero, matrix, lens)[0][:, 0])
    return np.asarray(cv2.projectPoints(points, zero, zero, matrix, lens)[0][:, 0])


def by_opencv(path: Path, points: np.ndarray) -> np.ndarray:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    fisheye = bool(file.getNode("fisheye_model").real())
    return opencv_formula(
        points, file.getNode("camera_matrix").mat(), file.getNode("distortion_coefficients").mat(), fisheye
    )


def by_kalibr(path: Path, points: np.ndarray) -> np.ndarray:
    camera = yaml.safe_load(path.read_text())["cam0"]
    kind = "omni-radtan" if camera["camera_model"] == "omni" else camera["camera_model"]
    if kind != "pinhole":
        return by_formula("kalibr", kind, path, points)
    fu, fv, pu, pv = camera["intrinsics"]
    matrix = np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1]])
    fisheye = camera["distortion_model"] == "equidistant"
    return opencv_formula(points, matrix, np.array(camera["distortion_coeffs"]), fisheye)


def by_nerfstudio(path: Path, points: np.ndarray) -> np.ndarray:
    c = json.loads(path.read_text())
    matrix = np.array([[c["fl_x"], 0, c["cx"]], [0, c["fl_y"], c["cy"]], [0, 0, 1]])
    fisheye = c["camera_model"] == "OPENCV_FISHEYE"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    return opencv_formula(points, matrix, np.array([c.get(name, 0.0) for name in names]), fisheye) - 0.5


def by_matlab(path: Path, points: np.ndarray) -> np.ndarray:
    c = loadmat(path, simplify_cells=True)["cameraParams"]
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    k1, k2, k3 = [*np.atleast_1d(c["RadialDistortion"]), 0.0][:3]
    p1, p2 = c["TangentialDistortion"]
    s = x * x + y * y
    radial = 1 + k1 * s + k2 * s**2 + k3 * s**3
    xd = x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x)
    yd = y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y
    # MATLAB's first pixel is (1, 1).
    return np.stack([xd, yd, np.ones_like(xd)], 1) @ np.array(c["K"]).T[:, :2] - 1.0


def by_opensfm(path: Path, points: np.ndarray) -> np.ndarray:
    c = next(iter(json.loads(path.read_text()).values()))
    matrix = np.array([[c["focal_x"], 0, c["c_x"]], [0, c["focal_y"], c["c_y"]], [0, 0, 1]])
    fisheye = c["projection_type"] == "fisheye_opencv"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    seen = opencv_formula(points, matrix, np.array([c[name] for name in names]), fisheye)
    return seen * max(c["width"], c["height"]) + (np.array([c["width"], c["height"]]) - 1) / 2


def by_basalt(path: Path, points: np.ndarray) -> np.ndarray:
    (lens,) = json.loads(path.read_text())["value0"]["intrinsics"]
    if lens["camera_type"] in ("ds", "eucm"):
        return by_formula("basalt", lens["camera_type"], path, points)
    fx, fy, cx, cy, *terms = lens["intrinsics"].values()
    fisheye = lens["camera_type"] == "kb4"
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    # What follows the eight of pinhole-radtan8 is the radius of its domain.
    return opencv_formula(points, matrix, np.array(terms[:8]) if terms else np.zeros(4), fisheye)


def by_multical(path: Path, points: np.ndarray) -> np.ndarray:
    (camera,) = json.loads(path.read_text())["cameras"].values()
    return opencv_formula(points, np.array(camera["K"]), np.array(camera["dist"]), False)


def exact_rows(readers: dict[str, tuple[str, str, Project]], folder: Path) -> list[list[str]]:
    """For each format, over the models that it holds: largest error of the peer, and of the way back to kcal."""
    from kcal.io.formats import FORMATS

    rows = []
    for format_name, (file, reader, project) in readers.items():
        errors = []
        for model in FORMATS[format_name].models:
            camera = sample_camera(model)
            points, pixels = random_points(camera)
            done = export_cameras(camera, folder / file, format=format_name)
            assert done.misfits == (None,)
            error = np.abs(project(done.paths[0], points) - pixels).max()
            back = import_cameras(*done.paths, fisheye=model == "fisheye4").cameras[0]
            again = np.abs(back.project(torch.from_numpy(points))[0].numpy() - pixels).max()
            errors.append((error, again))
        worst = (f"{max(column):.1e}" for column in zip(*errors, strict=True))
        rows.append([format_name, ", ".join(FORMATS[format_name].models), reader, *worst])
    return rows


def fitted_rows(readers: dict[str, tuple[str, str, Project]], folder: Path) -> list[list[str]]:
    """Lenses that formats do not hold: the stated maximum, and that of 10,000 points by the peer's reader."""
    from kcal.io.formats import FORMATS

    rows = []
    subjects = {"hybrid, 72°": hybrid_camera(0.9, 36.0), "hybrid, 150°": hybrid_camera(0.2, 75.0)}
    for label, camera in (*subjects.items(), ("opencv14", sample_camera("opencv14"))):
        rays, pixels = random_points(camera, 1)
        far = 1e6 * rays
        for format_name, (file, _, project) in readers.items():
            if label == "opencv14" and "opencv14" in FORMATS[format_name].models:
                continue
            try:
                done = export_cameras(camera, folder / file, format=format_name)
            except Exception as error:
                rows.append([label, format_name, "refused", "", "", str(error).split(" (")[0][:40].strip()])
                continue
            misfit = done.misfits[0]
            assert misfit is not None
            found = np.linalg.norm(project(done.paths[0], far) - pixels, axis=1).max()
            model = done.models[0].removeprefix("LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_")
            true = "yes" if found <= misfit.largest + 1e-6 else "NO"
            rows.append(
                [label, format_name, model, f"{misfit.rms:.2g}", f"{misfit.largest:.4g}", f"{found:.4g} {true}"]
            )
    return rows


def difference_rows(folder: Path) -> list[list[str]]:
    """`camera_difference` beside mrcal's on the same two files."""
    rows = []
    for scale in (0.1, 1.0, 10.0):
        cameras = []
        for i in range(2):
            camera = sample_camera("opencv8")
            change = scale * torch.tensor([0.5, 0.6, 0.7, -0.8, 0, 2e-3, -1e-3, 1e-4, -1e-4, 1e-3, 1e-3, 0, 0]).double()
            cameras.append(Camera(camera.params + i * change, size=camera.size, model=camera.model))
            export_cameras(cameras[-1], folder / f"{i}.cameramodel")
        names = f"{folder / '0.cameramodel'},{folder / '1.cameramodel'}"
        ask(interpreter("mrcal"), "mrcal-diff", names, folder, folder / "diff.npz")
        with np.load(folder / "diff.npz") as found:
            rows_columns = found["q"].shape[1], found["q"].shape[0]
            frames = camera_difference(*cameras, rotation=torch.eye(3), grid=rows_columns)
            same = camera_difference(*cameras, rotation=torch.from_numpy(found["rotation"]), grid=rows_columns)
            own = camera_difference(*cameras, grid=rows_columns)
            errors = [np.abs(frames.shift.numpy() - found["fixed"]).max()]
            errors += [np.abs(each.shift.numpy() - found["turned"]).max() for each in (same, own)]
            rms = float(np.sqrt((found["turned"] ** 2).sum(-1).mean()))
        rows.append([f"{own.rms:.3f}", f"{rms:.3f}", *(f"{error:.1e}" for error in errors)])
    return rows


Reader = tuple[str, str, Project]


def readers_of() -> dict[str, Reader]:
    """File, name and projection of each program that is here."""
    formula = "json, cv2.projectPoints"
    readers: dict[str, Reader] = {
        "opencv": ("camera.yaml", "cv2.FileStorage, cv2.projectPoints", by_opencv),
        "kalibr": ("camchain.yaml", "PyYAML, cv2.projectPoints", by_kalibr),
        "nerfstudio": ("transforms.json", formula, by_nerfstudio),
        "matlab": ("camera.mat", "SciPy, MATLAB's documented formula", by_matlab),
        "opensfm": ("camera_models.json", formula, by_opensfm),
        "basalt": ("basalt.json", formula, by_basalt),
        "multical": ("multical.json", formula, by_multical),
    }
    if ros := interpreter("ros"):
        readers["ros"] = ("ros.yaml", "camera_calibration_parsers, cv2.projectPoints", peer(ros, "ros"))
    if mrcal := interpreter("mrcal"):
        readers["mrcal"] = ("camera.cameramodel", "mrcal.cameramodel, mrcal.project", peer(mrcal, "mrcal"))
    if colmap := interpreter("peers"):
        readers["colmap"] = ("cameras.txt", "pycolmap", peer(colmap, "colmap"))
    return readers


@section("other-programs.md", "formats")
def formats() -> Iterator[str]:
    heads = ["format", "models", "reader and projection", "peer, px", "back in kcal, px"]
    with tempfile.TemporaryDirectory() as name:
        rows = exact_rows(readers_of(), Path(name))
    return merged("other-programs.md", "formats", heads, rows)


@section("other-programs.md", "refitted")
def refitted() -> Iterator[str]:
    heads = ["lens", "format", "fitted", "RMS, px", "stated maximum, px", "of 10,000 points; within"]
    with tempfile.TemporaryDirectory() as name:
        rows = fitted_rows(readers_of(), Path(name))
    return merged("other-programs.md", "refitted", heads, rows, keys=2)


@section("other-programs.md", "difference")
def difference() -> Iterator[str]:
    if not interpreter("mrcal"):
        raise SystemExit("KCAL_MRCAL names an interpreter that has mrcal")
    heads = ["kcal, RMS px", "mrcal, RMS px", "equal frames, px", "mrcal's turn, px", "own turns, px"]
    with tempfile.TemporaryDirectory() as name:
        return table(heads, difference_rows(Path(name)))
