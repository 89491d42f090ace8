"""What goes to other programs and comes from them: lens, error bars, pupil, board, and the largest error in the image.

A FOLDER on PYTHONPATH may have aniposelib, pycolmap, pyceres and gtsam (`pip install --target FOLDER --no-deps ...`),
and KCAL_MRCAL names an interpreter that has mrcal; what is not there is left out and named. "out": 10,000 points all
over the image through the other program's own reader, against kcal's pixels. "in": a file that the other program wrote,
or one in its published format, read by kcal, against the other program's projection. σ is the largest error of a
standard deviation, relative, after the way through the file.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.io import savemat

from kcal import Camera
from kcal.io.formats import FORMATS
from kcal.lens import CameraCalibration, export_cameras, import_cameras
from scripts.check.exchange import (
    ask,
    opencv_formula,
    peer,
    random_points,
    readers_of,
    sample_camera,
)
from scripts.shared.children import interpreter
from scripts.shared.page import table
from scripts.shared.sections import section

HEADS = ["program", "direction", "lens", "σ", "pupil", "board", "largest error, px", "reader"]
K, D = np.array([[1000.1, 0, 640.3], [0, 1001.3, 359.2], [0, 0, 1]]), np.array([-0.2, 0.05, 1e-3, -2e-3, 0.01])
SIGMA = np.array([0.5, 0.6, 0.7, 0.8, 1e-3, 2e-3, 1e-4, 2e-4, 3e-3])
SIZE, OMNI = (1280, 720), (0.9, np.array([-0.1, 0.02, 1e-3, -5e-4]))
Row = list[str]
# Program, its lens, a file, the σ in it, who reads or wrote it, and a projection of points by the program.
Given = tuple[str, str, Path, np.ndarray | None, str, Callable[[np.ndarray], Any]]


def known(model: str) -> Camera:
    """The sample camera with a covariance whose parameters are correlated."""
    camera = sample_camera(model)
    scale = torch.full((len(camera.params),), 1e-3, dtype=torch.float64)
    scale[:4], scale[4] = 0.5, 0.0
    half = (torch.eye(len(scale)).double() + 0.2) * scale
    camera.calibration = CameraCalibration(name="sample", covariance=half.T @ half)
    return camera


def sigma_error(camera: Camera, sigma: np.ndarray) -> str:
    """Largest relative error of a camera's standard deviations, those that are zero left out."""
    if camera.calibration is None or camera.calibration.covariance is None:
        return "no"
    found = camera.calibration.covariance.diagonal().sqrt().numpy()
    wanted = sigma if len(sigma) == len(found) else np.insert(sigma, 4, 0.0)
    there = wanted > 0
    return f"{np.abs(found[there] / wanted[there] - 1.0).max():.0e}".replace("0e+00", "0")


def by_gtsam(path: Path, points: np.ndarray) -> np.ndarray:
    import gtsam

    prior = json.loads(path.read_text())["cameras"][0]
    lens = getattr(gtsam, prior["model"])(np.array(prior["mean"]))
    camera = getattr(gtsam, f"PinholeCamera{prior['model']}")(gtsam.Pose3(), lens)
    return np.array([camera.project(point) for point in points])


def by_pycolmap(path: Path, points: np.ndarray) -> np.ndarray:
    import pycolmap

    _, model, width, height, *values = path.read_text().splitlines()[-1].split()
    size = {"width": int(width), "height": int(height)}
    camera = pycolmap.Camera(model=model, params=list(map(float, values)), **size)
    return np.asarray(camera.img_from_cam(points)) - 0.5


def by_numpy(path: Path, points: np.ndarray) -> np.ndarray:
    with np.load(path) as file:
        names, values = file["parameters_0"].tolist(), file["mean_0"]
    assert names[:4] == ["fx", "fy", "cx", "cy"]
    matrix = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1]])
    return opencv_formula(points, matrix, values[4:], False)


def by_ceres(path: Path, points: np.ndarray) -> np.ndarray:
    values = np.array(json.loads(path.read_text())["cameras"][0]["mean"])
    matrix = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1]])
    return opencv_formula(points, matrix, values[4:], False)


def by_rosbags(path: Path, points: np.ndarray) -> np.ndarray:
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    with Reader(path) as bag:
        ((_, _, data),) = bag.messages()
    info: Any = get_typestore(Stores.LATEST).deserialize_cdr(data, "sensor_msgs/msg/CameraInfo")
    return opencv_formula(points, info.k.reshape(3, 3), info.d, info.distortion_model == "equidistant")


def bag_of_rosbags(folder: Path) -> Path:
    """A bag of ROS 1 with the camera K, D, as a driver publishes it."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, kind = get_typestore(Stores.ROS1_NOETIC), "sensor_msgs/msg/CameraInfo"
    types = store.types
    time = types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
    info = types[kind](
        header=types["std_msgs/msg/Header"](seq=0, stamp=time, frame_id="camera"), height=SIZE[1], width=SIZE[0],
        distortion_model="plumb_bob", D=D, K=K.ravel(), R=np.eye(3).ravel(), P=np.pad(K, ((0, 0), (0, 1))).ravel(),
        binning_x=0, binning_y=0,
        roi=types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )  # fmt: skip
    with Writer(folder / "driver.bag") as bag:
        bag.write(bag.add_connection("/camera_info", kind, typestore=store), 10**9, store.serialize_ros1(info, kind))
    return folder / "driver.bag"


def by_aniposelib(path: Path, points: np.ndarray) -> np.ndarray:
    from aniposelib.cameras import CameraGroup  # type: ignore[import-not-found, unused-ignore]

    return np.asarray(CameraGroup.load(str(path)).cameras[0].project(points)).reshape(-1, 2)


def out_rows(folder: Path) -> Iterator[Row]:
    readers = readers_of() | {
        "colmap": ("cameras.txt", "pycolmap", by_pycolmap),
        "gtsam": ("g.json", "gtsam", by_gtsam),
        "ceres": ("ceres.json", "json, cv2.projectPoints", by_ceres),
        "numpy": ("n.npz", "numpy, cv2.projectPoints", by_numpy),
        "bag": ("calibration.mcap", "rosbags, cv2.projectPoints", by_rosbags),
        "toml": ("anipose.toml", "aniposelib", by_aniposelib),
    }
    for name, (file, reader, project) in readers.items():
        camera = known(
            max((m for m in FORMATS[name].models if m != "fisheye4"), key=lambda m: len(sample_camera(m).names))
        )
        points, pixels = random_points(camera)
        done = export_cameras(camera, folder / file, format=name)
        try:
            error = np.abs(project(done.paths[0], points) - pixels).max()
        except ImportError as missing:
            print(f"{name}: left out, {missing}", flush=True)
            continue
        assert camera.calibration is not None
        assert camera.calibration.covariance is not None
        back = import_cameras(done.paths[-1]).cameras[0]
        sigma = sigma_error(back, camera.calibration.covariance.diagonal().sqrt().numpy())
        yield [name, "out", f"{camera.model}, exact", sigma, "no", "no", f"{error:.0e}", reader]


def opencv_file(path: Path, **more: Any) -> Path:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in {"image_width": SIZE[0], "image_height": SIZE[1], "camera_matrix": K, **more}.items():
        file.write(name, value)
    file.release()
    return path


def in_files(folder: Path) -> Iterator[Given]:
    """Files of other programs, or in their formats."""
    zero = np.zeros(3)
    deviations = np.append(SIGMA, np.zeros(18 - len(SIGMA)))
    brown = opencv_file(folder / "o.yml", distortion_coefficients=D, stdDeviationsIntrinsics=deviations)
    yield "opencv", "opencv5", brown, SIGMA, "cv2.projectPoints", lambda p: opencv_formula(p, K, D, False)
    four = np.array([0.05, -0.01, 0.003, -0.001])
    wide = opencv_file(folder / "f.yml", distortion_coefficients=four, fisheye_model=1)
    yield "opencv", "fisheye", wide, None, "cv2.fisheye", lambda p: opencv_formula(p, K, four, True)
    xi, lens = OMNI
    omni = opencv_file(folder / "omni.yml", distortion_coefficients=lens, xi=xi)

    def omnidir(points: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.omnidir.projectPoints(points[None], zero, zero, K, xi, lens[None])[0]).reshape(-1, 2)

    yield "opencv", "omnidir → hybrid", omni, None, "cv2.omnidir", omnidir
    core = [xi, K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    chain = folder / "chain.yaml"
    chain.write_text(f"cam0: {{camera_model: omni, distortion_model: radtan, intrinsics: {list(map(float, core))}, "
                     f"distortion_coeffs: {lens.tolist()}, resolution: [1280, 720]}}\n")  # fmt: skip
    yield "kalibr", "omni-radtan → hybrid", chain, None, "cv2.omnidir", omnidir
    text, joined = folder / "results-cam.txt", lambda values: " ".join(map(repr, map(float, values)))
    text.write_text(
        "cam0 (/image):\n  type: <class 'aslam_cv.DistortedPinholeCameraGeometry'>\n"
        f"  distortion: [{joined(D[:4])}] +- [{joined(SIGMA[4:8])}]\n"
        f"  projection: [{joined([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])}] +- [{joined(SIGMA[:4])}]\n"
    )
    formula = "its text, cv2.projectPoints"
    yield "kalibr", "radtan", text, SIGMA[:8], formula, lambda p: opencv_formula(p, K, D[:4], False)
    cells = {
        "FocalLength": [[K[0, 0], K[1, 1]]],
        "PrincipalPoint": [[K[0, 2] + 1, K[1, 2] + 1]],
        "RadialDistortion": [[*D[:2], D[4]]],
        "TangentialDistortion": [D[2:4]],
        "ImageSize": [[720.0, 1280.0]],
    }
    errors = {
        "FocalLengthError": [SIGMA[:2]],
        "PrincipalPointError": [SIGMA[2:4]],
        "RadialDistortionError": [[*SIGMA[4:6], SIGMA[8]]],
        "TangentialDistortionError": [SIGMA[6:8]],
    }
    savemat(folder / "in.mat", {"cameraParams": cells, "estimationErrors": {"IntrinsicsErrors": errors}})
    yield "matlab", "opencv5", folder / "in.mat", SIGMA, "SciPy", lambda p: opencv_formula(p, K, D, False)
    bag = bag_of_rosbags(folder)
    yield "bag", "plumb_bob", bag, None, "rosbags, cv2.projectPoints", lambda p: opencv_formula(p, K, D, False)
    yield "agisoft", "frame", *agisoft(folder)
    qualisys = folder / "q.qca.txt"
    order = ("radial", 1), ("radial", 2), ("tangental", 1), ("tangental", 2), ("radial", 3)
    names = [f"{kind}Distortion{number}" for kind, number in order]
    qualisys.write_text(
        '<calibration><cameras><camera serial="1"><fov_video left="0" top="0" right="1279" bottom="719"/><transform '
        'x="0" y="0" z="0" r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1"/><intrinsic '
        f'skew="0" focalLengthU="{64 * K[0, 0]}" focalLengthV="{64 * K[1, 1]}" centerPointU="{64 * K[0, 2] + 31.5}" '
        f'centerPointV="{64 * K[1, 2] + 31.5}" ' + " ".join(f'{n}="{v}"' for n, v in zip(names, D, strict=True))
        + "/></camera></cameras></calibration>"
    )  # fmt: skip
    yield "qualisys", "opencv5", qualisys, None, "its XML, cv2.projectPoints", lambda p: opencv_formula(p, K, D, False)
    try:
        from aniposelib.cameras import Camera as Theirs
        from aniposelib.cameras import CameraGroup

        theirs = Theirs(matrix=K, dist=D, size=SIZE, rvec=np.zeros(3), tvec=np.zeros(3), name="a")
        CameraGroup([theirs]).dump(str(folder / "in.toml"))
        yield "toml", "opencv5", folder / "in.toml", None, "aniposelib", lambda p: theirs.project(p).reshape(-1, 2)
    except ImportError as missing:
        print(f"toml: left out, {missing}", flush=True)
    try:
        import pycolmap

        params = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, *D[:4]]
        colmap = pycolmap.Camera(model="OPENCV", width=1280, height=720, params=params, camera_id=1)
        reconstruction = pycolmap.Reconstruction()
        reconstruction.add_camera_with_trivial_rig(colmap)
        reconstruction.write_text(str(folder))
        yield "colmap", "OPENCV", folder / "cameras.txt", None, "pycolmap", lambda p: _half_less(colmap.img_from_cam(p))
    except ImportError as missing:
        print(f"colmap: left out, {missing}", flush=True)
    if mrcal := interpreter("mrcal"):
        solved, deviations_path = folder / "b.cameramodel", folder / "sigma.npy"
        ask(mrcal, "mrcal-solve", str(solved), folder, deviations_path)
        project = peer(mrcal, "mrcal")
        yield "mrcal", "opencv5", solved, np.load(deviations_path), "mrcal", lambda p: project(solved, p)


def _half_less(pixels: Any) -> np.ndarray:
    return np.asarray(pixels) - 0.5


def agisoft(folder: Path) -> tuple[Path, np.ndarray, str, Callable[[np.ndarray], np.ndarray]]:
    """A sensor with Metashape's parameters and their covariance, and the manual's formula."""
    path, f, cx, cy = folder / "a.xml", 1000.0, 3.0, -2.0
    k1, k2, k3, k4, p1, p2 = -0.2, 0.05, 0.01, -0.002, 1e-3, -2e-3
    terms = dict(
        zip(("f", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2"), (f, cx, cy, k1, k2, k3, k4, p1, p2), strict=True)
    )
    sigma = dict(zip(terms, (0.5, 0.7, 0.8, 1e-3, 2e-3, 3e-3, 4e-3, 1e-4, 2e-4), strict=True))
    spread = " ".join(map(str, np.diag(np.array(list(sigma.values())) ** 2).ravel()))
    path.write_text(
        '<document><chunk><sensors><sensor id="0"><calibration type="frame" class="adjusted">'
        '<resolution width="1280" height="720"/>' + "".join(f"<{n}>{v!r}</{n}>" for n, v in terms.items())
        + f"</calibration><covariance><params>{' '.join(terms)}</params><coeffs>{spread}</coeffs></covariance>"
        "</sensor></sensors></chunk></document>"
    )  # fmt: skip

    def project(points: np.ndarray) -> np.ndarray:
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
        across = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
        down = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
        return np.stack([640 + cx + across * f - 0.5, 360 + cy + down * f - 0.5], 1)

    order = ("f", "f", "cx", "cy", "k1", "k2", "p2", "p1", "k3", "k4")
    return path, np.array([sigma[name] for name in order]), "its XML, the manual's formula", project


def in_rows(folder: Path) -> Iterator[Row]:
    for program, lens, path, sigma, reader, project in in_files(folder):
        camera = import_cameras(path, size=SIZE if path.name == "results-cam.txt" else None).cameras[0]
        points, _ = random_points(camera)
        there = project(points)
        error = np.abs(camera.project(torch.from_numpy(points))[0].numpy() - there).max()
        deviation = "not in the file" if sigma is None else sigma_error(camera, sigma)
        yield [program, "in", lens, deviation, "no", "no", f"{error:.0e}", reader]


@section("other-programs.md", "round trips")
def round_trips() -> Iterator[str]:
    with tempfile.TemporaryDirectory() as name:
        return table(HEADS, [*out_rows(Path(name)), *in_rows(Path(name))])
