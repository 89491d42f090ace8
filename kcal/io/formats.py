"""The formats of other programs that kcal reads and writes: the table, and `import_cameras`."""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NamedTuple

import torch

from kcal.errors import FileError, InputError
from kcal.file_kind import file_kind, is_image
from kcal.files import read_bytes, read_head, read_text
from kcal.io import format_bag, format_devices, format_kalibr, format_mrcal, format_opencv, format_photos, format_prior
from kcal.io.camera_file import load_camera
from kcal.io.foreign import MOST_BYTES, Hints, ImportedCameras, camera_name, reading, rig_poses
from kcal.io.keyed import speaks_of_camera
from kcal.io.rig_file import load_rig
from kcal.lens.camera import Camera
from kcal.lens.camera_conversions import OPENCV_MODELS, size_doubt
from kcal.lens.model import LensModel
from kcal.lens.pose import Pose
from kcal.strict_json import MOST_BYTES as MOST_JSON
from kcal.strict_json import read_json


class CameraFormat(NamedTuple):
    """A format of another program. Its module has `read_NAME(path, hints)` and, if kcal writes it, `write_NAME`.

    Args:
        name: of the format.
        module: that reads and writes it.
        title: what the files are.
        models: kcal's lens models that it can hold.
        suffixes: of file names that mean this format where nothing else is said.
        poses: of how many cameras it can hold the relative poses.
        skew: whether it can hold a skew.
        prior: whether it is a file of priors, which has the parameters and their square-root information.
        lenses: lenses of `kcal.io.foreign_lenses.LENSES` that it can hold as well.
        wide: whether these are chosen unasked where kcal's models are far off.
        unit: of its lengths: meters, unless a user who knows what wrote a file says otherwise; open; or stated in it.
    """

    name: str
    module: ModuleType
    title: str
    models: tuple[str, ...] = ()
    suffixes: tuple[str, ...] = ()
    poses: int = 0
    skew: bool = False
    prior: bool = False
    lenses: tuple[str, ...] = ()
    wide: bool = False
    unit: Literal["meters", "open", "stated"] = "stated"

    @property
    def read(self) -> Callable[[Path, Hints], ImportedCameras]:
        """Read one file."""
        read: Callable[[Path, Hints], ImportedCameras] = getattr(self.module, f"read_{self.name}")
        return read

    @property
    def write(self) -> Callable[[Sequence[Any], Sequence[Pose], Path], list[Path]] | None:
        """Write cameras and their poses, all of one of the models; None for formats that kcal only reads."""
        return getattr(self.module, f"write_{self.name}", None)


_ANY = 1_000_000
# The first section of an INI file or of TOML.
_SECTION = re.compile(r"(?:[ \t]*(?:[#;].*)?\n)*+[ \t]*\[\w[\w .-]*\][ \t]*\n")
# What begins the cameras of Qualisys, and the sensors or the calibration of Metashape.
_XML = re.compile(r"<cameras(?=>\s*<camera[^>]*serial)|<sensors(?=[ >])|<calibration(?=>\s*<(projection|width|type))")


_OPENCV, _ROS = (*OPENCV_MODELS.values(), "fisheye4"), ("pinhole", "opencv4", "opencv5", "opencv8", "fisheye4")
_KALIBR, _MRCAL = tuple(format_kalibr.KALIBR_LENSES), ("pinhole", "opencv4", "opencv5", "opencv8", "opencv12")
_DEVICES = "depthai, Azure Kinect, RealSense, ZED, EuRoC, KITTI, Open3D, nuScenes, photos of DJI's drones"
_LIST = (
    CameraFormat(
        "opencv", format_opencv, "OpenCV YAML, XML or JSON, one camera or a pair", _OPENCV, (".yml", ".yaml", ".xml"),
        2, unit="open",
    ),
    CameraFormat("ros", format_opencv, "ROS camera_info, a file per camera", _ROS, poses=2, unit="meters"),
    CameraFormat("bag", format_bag, "ROS bag with camera_info and tf", _ROS, format_bag.SUFFIXES, _ANY, unit="meters"),
    CameraFormat(
        "kalibr", format_kalibr, "Kalibr camchain", ("pinhole", "opencv4", "fisheye4"), poses=_ANY, lenses=_KALIBR,
        wide=True, unit="meters",
    ),
    CameraFormat(
        "basalt", format_kalibr, "Basalt calibration.json", ("pinhole", "opencv8", "fisheye4"), poses=_ANY,
        lenses=("ds", "eucm", "fov"), wide=True, unit="meters",
    ),
    CameraFormat(
        "mrcal", format_mrcal, "mrcal cameramodel, a file per camera", _MRCAL, (".cameramodel",), _ANY, unit="meters"
    ),
    CameraFormat(
        "colmap", format_photos, "COLMAP cameras.txt or cameras.bin with its rigs, or database",
        ("pinhole", "opencv4", "opencv8", "fisheye4"), (".txt", ".bin"), _ANY,
        lenses=("rad-tan-thin-prism", "eucm", "fov", "division"), unit="open",
    ),
    CameraFormat(
        "nerfstudio", format_photos, "nerfstudio transforms.json", ("pinhole", "opencv4", "opencv5", "fisheye4"),
        (".json",),
    ),
    CameraFormat(
        "matlab", format_opencv, "MATLAB struct of camera or stereo parameters", ("pinhole", "opencv4", "opencv5"),
        (".mat",), 2, skew=True, unit="open",
    ),
    CameraFormat(
        "opensfm", format_photos, "OpenSfM camera_models.json", ("pinhole", "opencv4", "opencv5", "fisheye4"),
        lenses=("fisheye624",),
    ),
    CameraFormat(
        "toml", format_opencv, "TOML of aniposelib, pose2sim and Caliscope; INI", _OPENCV, (".toml",), _ANY, unit="open"
    ),
    CameraFormat(
        "multical", format_opencv, "multical calibration.json", tuple(OPENCV_MODELS.values()), poses=_ANY, unit="meters"
    ),
    CameraFormat("calibio", format_opencv, "calib.io JSON", unit="open"),
    CameraFormat("qualisys", format_photos, "Qualisys .qca.txt"),
    CameraFormat("agisoft", format_photos, "Agisoft Metashape XML"),
    CameraFormat("device", format_devices, _DEVICES),
    CameraFormat(
        "gtsam", format_prior, "Values and noise model for GTSAM, JSON", format_prior.GTSAM_MODELS, skew=True,
        prior=True,
    ),
    CameraFormat("ceres", format_prior, "A and b of Ceres's NormalPrior, JSON", format_prior.PLAIN_MODELS, prior=True),
    CameraFormat(
        "numpy", format_prior, "Parameters and their square-root information, .npz", format_prior.PLAIN_MODELS,
        prior=True,
    ),
)  # fmt: skip
FORMATS = {known.name: known for known in _LIST}


def format_named(name: str) -> CameraFormat:
    """The format of that name.

    Raises:
        InputError: an unknown name; the message lists the known ones.
    """
    if name not in FORMATS:
        raise InputError(f"unknown format {name!r}; choose one of {', '.join(FORMATS)}")
    return FORMATS[name]


def held_exactly(camera: Camera, models: Sequence[str], skew: bool = False) -> Camera | None:
    """The camera in the first of the models that represents its lens exactly; None if none does.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1, 0.01])
        >>> str(held_exactly(camera, ("pinhole", "opencv4", "opencv8")).model)
        'opencv4'
    """
    values = dict(zip(camera.names, camera.params.detach().tolist(), strict=True))
    if camera.model.hybrid or (values["skew"] and not skew):
        return None
    needed = {name for name, value in values.items() if value} - {"fx", "fy", "cx", "cy", "skew"}
    for model in map(LensModel.named, models):
        if model.fisheye == camera.model.fisheye and needed <= set(model.names):
            names = ("fx", "fy", "cx", "cy", "skew", *model.names)
            parameters = torch.tensor([values.get(name, 0.0) for name in names], dtype=torch.float64)
            found = Camera(parameters, size=camera.size, model=model)
            if camera.calibration is not None:
                found.calibration = dataclasses.replace(
                    camera.calibration, sigma=None, covariance=None, information=None
                )
            return found
    return None


def recognized(path: Path) -> str:
    """The format of a file, by its suffix or by what is in it; `kcal` for a camera or rig of kcal.

    Raises:
        FileError: it cannot be read, or is of no known format.
    """
    suffix = (path.with_suffix("") if path.suffix.lower() == ".gz" else path).suffix.lower()
    if file_kind(path) == "bag":
        return "bag"
    if read_head(path, len(format_photos.SQLITE)) == format_photos.SQLITE:
        return "colmap"
    if suffix in (".mat", ".cameramodel", ".bin"):
        return {".mat": "matlab", ".cameramodel": "mrcal", ".bin": "colmap"}[suffix]
    if suffix == ".npz":
        # Names of arrays are in clear in an archive.
        return "numpy" if b"kcal_prior" in read_bytes(path, MOST_BYTES) else "opencv"
    if is_image(read_head(path, 4096)):
        return "device"
    text = read_text(path, MOST_BYTES)
    if format_opencv.ROS_TEXT.search(text):
        return "ros"
    if format_devices.device_of(text):
        return "device"
    if suffix == ".toml" or _SECTION.match(text):
        return "toml"
    # mrcal's files begin with comments.
    if suffix == ".json" or re.sub(r"^[ \t]*#.*$", "", text, flags=re.MULTILINE).lstrip()[:1] in ("{", "["):
        return _json_format(path, text)
    if (found := _XML.search(text)) is not None:
        return "qualisys" if found[0] == "<cameras" else "agisoft"
    if re.search(r"^cam\d+\s*:(?s:.*)\bcamera_model\b|^cam0 \(.*\):", text, re.MULTILINE):
        return "kalibr"
    if suffix == ".xml" or "opencv-matrix" in text or text.startswith("%YAML"):
        return "opencv"
    if re.search(r"^\d+ [A-Z][A-Z0-9_]+ \d+ \d+ ", text, re.MULTILINE):
        return "colmap"
    if speaks_of_camera(text):
        return (
            "ros" if re.search(r"^(distortion_model|(rectif|project)\w+_matrix)\s*:", text, re.MULTILINE) else "opencv"
        )
    other = next((program for program, mark in _UNREAD_TEXT.items() if re.search(mark, text, re.MULTILINE)), "")
    if other:
        raise FileError(f"{path}: a file of {other}, which kcal does not read; copy its numbers into one of Kalibr")
    raise FileError(f"{path}: not a camera file that kcal knows; name its format (--format {', '.join(FORMATS)})")


def _json_format(path: Path, text: str) -> str:
    try:
        content = read_json(text.encode(), str(path))
    except FileError as error:
        # mrcal's files are Python, with comments and single quotes.
        if "lensmodel" in text or "distortion_model" in text:
            return "mrcal"
        raise FileError(f"{path}: neither a camera file that kcal knows nor JSON that can be read ({error})") from None
    if "projection_type" in text:
        return "opensfm"
    if isinstance(content, dict):
        for name, marks in _JSON.items():
            if marks & set(content):
                return name
        other = next((program for keys, program in _UNREAD.items() if {*keys.split()} <= {*content}), "")
        if other:
            raise FileError(f"{path}: a file of {other}, which kcal does not read; copy its numbers into one of Kalibr")
        if speaks_of_camera(json.dumps(content, indent=1)):
            return "opencv"
    raise FileError(f"{path}: a JSON file, but no camera that kcal knows")


# Keys that JSON files of a format have, and of programs whose files are not read.
_UNREAD = {
    "sfm_data_version": "OpenMVG", "views intrinsics": "Meshroom", "calib_dimension": "Gyroflow", "invpol": "OCamCalib",
}  # fmt: skip
_UNREAD_TEXT = {
    "OCamCalib": "^#polynomial coefficients for the DIRECT", "Bundler": r"\A# Bundle file", "VisualSFM": r"\ANVM_V3",
    "Hugin or PTGui": "^# (?:hugin|ptGui) project file", "Pix4D": r"\APix4D", "RealityCapture": r"\bxcr:",
    "DSO": r"\A(?:(?:Pinhole|RadTan|EquiDistant|FOV|KannalaBrandt)(?:\s+[-+.\de]+){4}"
           r"|(?:[-+.\de]+\s+){5,8}\d+ \d+\s+(?:crop|full|none))",
    "Middlebury": r"\Acam0=\[",
}  # fmt: skip
_JSON = {
    "kcal": {"kcal"}, "ceres": {"kcal_prior"}, "basalt": {"value0"}, "multical": {"camera_poses"},
    "calibio": {"Calibration"}, "nerfstudio": {"fl_x", "frames", "camera_angle_x"},
    "matlab": {"RadialDistortion", "IntrinsicMatrix", "CameraParameters1"},
}  # fmt: skip


# Meters that cameras of formats in meters are rarely apart.
_FAR = 10.0


def import_cameras(
    *paths: str | Path,
    format: str | None = None,
    size: tuple[int, int] | None = None,
    fisheye: bool | None = None,
    meters: float | None = None,
) -> ImportedCameras:
    """Read cameras, and their relative poses, from files of other programs or of kcal.

    OpenCV (YAML, XML; fisheye and omnidir, too), ROS camera_info and bags with it, Kalibr camchains and results,
    Basalt, mrcal, COLMAP with its rigs and databases, nerfstudio, MATLAB structs, OpenSfM, TOML of aniposelib, pose2sim
    and Caliscope, multical, calib.io, Qualisys, Agisoft Metashape, devices and data sets (depthai, Azure Kinect,
    RealSense, ZED, EuRoC, KITTI, Open3D, nuScenes, DJI), and kcal's priors for other programs. Error bars come with a
    camera where its file has them.
    Principal points are converted to kcal's convention: (0, 0) is the center of the first pixel.

    Args:
        paths: one file, or several whose cameras belong together: two of ROS or mrcal, or the intrinsics and extrinsics
            of OpenCV's stereo sample.
        format: name of the format; None: by the suffix and the content.
        size: (width, height) where the file has none.
        fisheye: whether four coefficients of OpenCV are a fisheye's, where the file does not say.
        meters: length of the file's unit in meters, where the file does not say; 1 for OpenCV if not given.

    Raises:
        FileError: a file that cannot be read, or a lens that kcal does not have; the message names the file.
        InputError: no file, or an unknown format.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "cameras.txt")
        ...     _ = path.write_text("1 PINHOLE 640 480 500 500 320 240")
        ...     import_cameras(path).cameras[0].center.tolist()
        [319.5, 239.5]
    """
    if not paths:
        raise InputError("import_cameras: name a file")
    if format is not None:
        format_named(format)
    parts = [_imported(Path(path), format, Hints(size, fisheye, meters)) for path in paths]
    cameras = tuple(itertools.chain.from_iterable(part.cameras for part in parts))
    unread = {name: reason for part in parts for name, reason in part.unread.items()}
    poses = tuple(itertools.chain.from_iterable(part.poses for part in parts))
    if not cameras:
        raise InputError(f"{paths[0]}: the pose of a pair without its cameras; name the file of the cameras too")
    notes = [*itertools.chain.from_iterable(part.notes for part in parts)]
    notes += [f"camera {name} cannot be read: {reason}" for name, reason in unread.items()]
    if (
        meters is None
        and len(poses) == len(cameras)
        and all(part.format in FORMATS and FORMATS[part.format].unit == "meters" for part in parts)
    ):
        centers = torch.stack([pose.inverse().translation for pose in poses])
        if (apart := float(torch.cdist(centers, centers).max())) > _FAR:
            notes.append(f"cameras are {apart:.4g} m apart, as the format has meters (--unit mm for millimeters)")
    foreign = [camera for part in parts if part.format != "kcal" for camera in part.cameras]
    notes += [f"{camera_name(camera, 'camera')}: {text}" for camera in foreign if (text := _doubt(camera, paths[0]))]
    return ImportedCameras(
        format=parts[0].format,
        cameras=cameras,
        poses=poses if len(poses) == len(cameras) else (),
        notes=tuple(dict.fromkeys(notes)),
        unread=unread,
    )


def _doubt(camera: Camera, path: str | Path) -> str:
    """Why a camera does not seem to be of images of its size.

    Raises:
        FileError: its principal point is a fraction of the image.
    """
    fx, fy, cx, cy = camera.params[:4].tolist()
    if 0 < max(abs(cx), abs(cy)) < 1 <= min(camera.size) / 16:
        raise FileError(
            f"{path}: the principal point ({cx:.3g}, {cy:.3g}) is a fraction of the image and not in pixels; multiply "
            f"the lengths by the image's sides, {camera.size[0]} and {camera.size[1]} px"
        )
    return size_doubt(fx, fy, cx, cy, camera.size, most=0.09)


def _imported(path: Path, name: str | None, hints: Hints) -> ImportedCameras:
    name = name or recognized(path)
    if name != "kcal":
        with reading(path, name):
            found = FORMATS[name].read(path, hints)
        if hints.meters is None or not found.poses or FORMATS[name].unit == "open":
            return found
        if FORMATS[name].unit == "stated":
            raise InputError(f"{path}: the unit is in files of this format ({found.format}): leave --unit out")
        return dataclasses.replace(
            found, poses=tuple(Pose(pose.rotation, hints.meters * pose.translation) for pose in found.poses)
        )
    with reading(path, "kcal"):
        kind = read_json(read_text(path, MOST_JSON).encode(), str(path))["kcal"]
    if kind == "rig":
        rig = load_rig(path)
        return ImportedCameras(format="kcal", cameras=tuple(rig.each), poses=rig_poses(rig))
    return ImportedCameras(format="kcal", cameras=(load_camera(path),))
