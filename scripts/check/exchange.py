"""Whether cameras survive the way to other programs and back: 10,000 points through each peer's own reader.

KCAL_MRCAL, KCAL_ROS and KCAL_PEERS name interpreters that have mrcal, ROS's camera_calibration_parsers and
image_geometry, and pycolmap; without one its rows stay as they are on the page. OpenCV and SciPy are read in this
process. Where no reader of a program can be installed here, its published formula projects what PyYAML or json reads.
"""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import yaml
from scipy.io import loadmat, savemat

from kcal import Camera
from kcal.io.formats import FORMATS
from kcal.lens import CameraCalibration, LensModel, camera_difference, export_cameras, import_cameras
from kcal.lens.model import HybridForm, radius_over_angle
from kcal.lens.zernike import ZernikeModes
from scripts.check.foreign_lenses import by_formula, growth, opencv_formula, pycolmap_camera, tangential
from scripts.shared.children import interpreter
from scripts.shared.page import Lines, in_folder, merged, section, table

POINTS = 10_000
FOURTEEN = [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.02, 0.003, 1e-3, -1e-3, 2e-3, 1e-3, 0.01, 0.02]
LENSES = {"pinhole": [], "fisheye4": [0.05, -0.01, 0.003, -0.001]}
LENSES |= {f"opencv{count}": FOURTEEN[:count] for count in (4, 5, 8, 12, 14)}
FISHEYE, BROWN = ("k1", "k2", "k3", "k4"), ("k1", "k2", "p1", "p2", "k3")
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


def by_vector(values: Sequence[float] | np.ndarray, points: np.ndarray, fisheye: bool = False) -> np.ndarray:
    """By fx, fy, cx, cy and OpenCV's coefficients, or none."""
    fx, fy, cx, cy, *lens = values
    return opencv_formula(points, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(lens or [0.0] * 4), fisheye)


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
    values = [*camera["intrinsics"], *camera["distortion_coeffs"]]
    return by_vector(values, points, camera["distortion_model"] == "equidistant")


def by_nerfstudio(path: Path, points: np.ndarray) -> np.ndarray:
    c = json.loads(path.read_text())
    fisheye = c["camera_model"] == "OPENCV_FISHEYE"
    names = "fl_x", "fl_y", "cx", "cy", *(FISHEYE if fisheye else BROWN)
    return by_vector([c.get(name, 0.0) for name in names], points, fisheye) - 0.5


def by_matlab(path: Path, points: np.ndarray) -> np.ndarray:
    c = loadmat(path, simplify_cells=True)["cameraParams"]
    x, y = (points[:, :2] / points[:, 2:]).T
    grown = growth(x, y, [*np.atleast_1d(c["RadialDistortion"]), 0.0][:3])
    across, down = tangential(x, y, *c["TangentialDistortion"])
    # MATLAB's first pixel is (1, 1).
    return np.stack([x * grown + across, y * grown + down, np.ones_like(x)], 1) @ np.array(c["K"]).T[:, :2] - 1.0


def by_opensfm(path: Path, points: np.ndarray) -> np.ndarray:
    c = next(iter(json.loads(path.read_text()).values()))
    fisheye = c["projection_type"] == "fisheye_opencv"
    names = "focal_x", "focal_y", "c_x", "c_y", *(FISHEYE if fisheye else BROWN)
    seen = by_vector([c[name] for name in names], points, fisheye)
    return seen * max(c["width"], c["height"]) + (np.array([c["width"], c["height"]]) - 1) / 2


def by_basalt(path: Path, points: np.ndarray) -> np.ndarray:
    (lens,) = json.loads(path.read_text())["value0"]["intrinsics"]
    if lens["camera_type"] in ("ds", "eucm"):
        return by_formula("basalt", lens["camera_type"], path, points)
    # What follows the eight of pinhole-radtan8 is the radius of its domain.
    return by_vector([*lens["intrinsics"].values()][:12], points, lens["camera_type"] == "kb4")


def by_multical(path: Path, points: np.ndarray) -> np.ndarray:
    (camera,) = json.loads(path.read_text())["cameras"].values()
    return opencv_formula(points, np.array(camera["K"]), np.array(camera["dist"]), False)


def exact_rows(folder: Path) -> Iterator[list[str]]:
    """For each format, over the models that it holds: largest error of the peer, and of the way back to kcal."""
    for format_name, (file, reader, project) in readers_of().items():
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
        yield [format_name, ", ".join(FORMATS[format_name].models), reader, *worst]


def fitted_rows(folder: Path) -> Iterator[list[str]]:
    """Lenses that formats do not hold: the stated maximum, and that of 10,000 points by the peer's reader."""
    subjects = {"hybrid, 72°": hybrid_camera(0.9, 36.0), "hybrid, 150°": hybrid_camera(0.2, 75.0)}
    for label, camera in (*subjects.items(), ("opencv14", sample_camera("opencv14"))):
        rays, pixels = random_points(camera, 1)
        far = 1e6 * rays
        for format_name, (file, _, project) in readers_of().items():
            if label == "opencv14" and "opencv14" in FORMATS[format_name].models:
                continue
            try:
                done = export_cameras(camera, folder / file, format=format_name)
            except Exception as error:
                yield [label, format_name, "refused", "", "", str(error).split(" (")[0][:40].strip()]
                continue
            misfit = done.misfits[0]
            assert misfit is not None
            found = np.linalg.norm(project(done.paths[0], far) - pixels, axis=1).max()
            model = done.models[0].removeprefix("LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_")
            true = "yes" if found <= misfit.largest + 1e-6 else "NO"
            yield [label, format_name, model, f"{misfit.rms:.2g}", f"{misfit.largest:.4g}", f"{found:.4g} {true}"]


def difference_rows(folder: Path) -> Iterator[list[str]]:
    """`camera_difference` beside mrcal's on the same two files."""
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
        yield [f"{own.rms:.3f}", f"{rms:.3f}", *(f"{error:.1e}" for error in errors)]


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
    return merged("other-programs.md", "formats", heads, in_folder(exact_rows))


@section("other-programs.md", "refitted")
def refitted() -> Iterator[str]:
    heads = ["lens", "format", "fitted", "RMS, px", "stated maximum, px", "of 10,000 points; within"]
    return merged("other-programs.md", "refitted", heads, in_folder(fitted_rows), keys=2)


@section("other-programs.md", "difference")
def difference() -> Lines:
    if not interpreter("mrcal"):
        raise SystemExit("KCAL_MRCAL names an interpreter that has mrcal")
    yield ["kcal, RMS px", "mrcal, RMS px", "equal frames, px", "mrcal's turn, px", "own turns, px"]
    yield from in_folder(difference_rows)


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
    return np.asarray(pycolmap_camera(path).img_from_cam(points)) - 0.5


def by_numpy(path: Path, points: np.ndarray) -> np.ndarray:
    with np.load(path) as file:
        names, values = file["parameters_0"].tolist(), file["mean_0"]
    assert names[:4] == ["fx", "fy", "cx", "cy"]
    return by_vector(values, points)


def by_ceres(path: Path, points: np.ndarray) -> np.ndarray:
    return by_vector(json.loads(path.read_text())["cameras"][0]["mean"], points)


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
    path = folder / "a.xml"
    terms = dict(f=1000.0, cx=3.0, cy=-2.0, k1=-0.2, k2=0.05, k3=0.01, k4=-0.002, p1=1e-3, p2=-2e-3)
    f, cx, cy, k1, k2, k3, k4, p1, p2 = terms.values()
    sigma = dict(zip(terms, (0.5, 0.7, 0.8, 1e-3, 2e-3, 3e-3, 4e-3, 1e-4, 2e-4), strict=True))
    spread = " ".join(map(str, np.diag(np.array(list(sigma.values())) ** 2).ravel()))
    path.write_text(
        '<document><chunk><sensors><sensor id="0"><calibration type="frame" class="adjusted">'
        '<resolution width="1280" height="720"/>' + "".join(f"<{n}>{v!r}</{n}>" for n, v in terms.items())
        + f"</calibration><covariance><params>{' '.join(terms)}</params><coeffs>{spread}</coeffs></covariance>"
        "</sensor></sensors></chunk></document>"
    )  # fmt: skip

    def project(points: np.ndarray) -> np.ndarray:
        x, y = (points[:, :2] / points[:, 2:]).T
        grown, (across, down) = growth(x, y, [k1, k2, k3, k4]), tangential(x, y, p2, p1)
        across, down = x * grown + across, y * grown + down
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
    return table(HEADS, in_folder(lambda folder: [*out_rows(folder), *in_rows(folder)]))
