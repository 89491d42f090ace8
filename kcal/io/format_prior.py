"""Priors for the bundle adjustment of other programs: a program's own parameters and their square-root information.

A JSON file (or a numpy archive) says for each camera that the program's parameters x have the density
exp(-½ ‖R (x - mean)‖²). R is upper triangular: `NormalPrior(A, b)` of Ceres takes A = R and b = mean, GTSAM
`noiseModel.Gaussian.SqrtInformation(R)`. R is in pixels as they are; a program whose
reprojection errors are not divided by their standard deviation σ needs σR.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

import kcal.io.foreign as foreign
from kcal.errors import InputError
from kcal.files import read_bytes, write_atomic
from kcal.io.format_photos import WRITTEN
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.pose import Pose
from kcal.lens.projection import parameter_names
from kcal.lens.uncertainty import square_root_information
from kcal.strict_formats import read_npz
from kcal.strict_json import read_json

# More parameters than any lens of another program has.
_MOST_PARAMETERS, _MOST_CAMERAS = 64, 10_000
KEYS = ("name", "model", "size", "parameters", "mean", "sqrt_information", "held", "misfit_px", "kcal")
_GTSAM = {"pinhole": "Cal3_S2", "opencv4": "Cal3DS2", "fisheye4": "Cal3Fisheye"}
GTSAM_MODELS, PLAIN_MODELS = tuple(_GTSAM), ("pinhole", "opencv4", "opencv5", "opencv8", "opencv12", "opencv14",
                                              "fisheye4")  # fmt: skip


class Parameter(NamedTuple):
    """A parameter of another program: its name there, kcal's, and value = scale · kcal's + offset."""

    name: str
    kcal: str
    scale: float = 1.0
    offset: float = 0.0


# What programs call kcal's parameters, where they call them otherwise; and what is added to the principal point.
_NAMES = {
    "gtsam": {"skew": "s", "cx": "u0", "cy": "v0"},
    "nerfstudio": {"fx": "fl_x", "fy": "fl_y"},
    "kalibr": {"fx": "fu", "fy": "fv", "cx": "pu", "cy": "pv", "p1": "r1", "p2": "r2"},
    "matlab": {
        "fx": "FocalLength(1)", "fy": "FocalLength(2)", "cx": "PrincipalPoint(1)", "cy": "PrincipalPoint(2)",
        "skew": "Skew", "k1": "RadialDistortion(1)", "k2": "RadialDistortion(2)", "k3": "RadialDistortion(3)",
        "p1": "TangentialDistortion(1)", "p2": "TangentialDistortion(2)",
    },
    "opensfm": {"fx": "focal_x", "fy": "focal_y", "cx": "c_x", "cy": "c_y"},
}  # fmt: skip
_FIRST = {"colmap": 0.5, "nerfstudio": 0.5, "matlab": 1.0}
_KALIBR = {"pinhole": "pinhole-none", "opencv4": "pinhole-radtan", "fisheye4": "pinhole-equi"}


def arranged(program: str, camera: Camera) -> tuple[str, list[Parameter]]:
    """The program's name of a camera's lens model, and its parameters in the program's order."""
    model, lens, fisheye = str(camera.model), camera.model.names, camera.model.fisheye
    kinds = {
        "gtsam": _GTSAM.get(model), "colmap": WRITTEN.get(model), "kalibr": _KALIBR.get(model),
        "nerfstudio": "OPENCV_FISHEYE" if fisheye else "OPENCV", "opensfm": "fisheye_opencv" if fisheye else "brown",
        "mrcal": f"LENSMODEL_OPENCV{len(lens)}" if lens else "LENSMODEL_PINHOLE", "matlab": "cameraIntrinsics",
    }  # fmt: skip
    orders = {"gtsam": ("fx", "fy", "skew", "cx", "cy"), "matlab": ("fx", "fy", "cx", "cy", "skew")}
    offset, scale = dict.fromkeys(("cx", "cy"), _FIRST.get(program, 0.0)), dict[str, float]()
    if program == "opensfm":
        size = float(max(camera.size))
        scale = dict.fromkeys(("fx", "fy", "cx", "cy"), 1.0 / size)
        offset = {name: -(side - 1) / 2.0 / size for name, side in zip(("cx", "cy"), camera.size, strict=True)}
    own = (*orders.get(program, ("fx", "fy", "cx", "cy")), *lens)
    names = _NAMES.get(program, {})
    return kinds.get(program) or model, [
        Parameter(names.get(name, name), name, scale.get(name, 1.0), offset.get(name, 0.0)) for name in own
    ]


def prior_of(program: str, camera: Camera, misfit: tuple[float, float] | None = None) -> dict[str, Any]:
    """What the file says of one camera.

    Args:
        program: whose parameters are meant, a name of `kcal.io.formats.FORMATS`.
        camera: of a model that the program has, with a covariance.
        misfit: RMS and maximum over the image of the distance to the lens that it stands for, pixels.
    """
    model, order = arranged(program, camera)
    names = camera.names
    chosen = [names.index(parameter.kcal) for parameter in order]
    scale = torch.tensor([parameter.scale for parameter in order], dtype=torch.float64)
    offset = torch.tensor([parameter.offset for parameter in order], dtype=torch.float64)
    found = square_root_information(camera, chosen)
    root, held = (None, ()) if found is None else found
    values = (
        foreign.camera_name(camera, "camera"),
        model,
        list(camera.size),
        [parameter.name for parameter in order],
        foreign.plain(camera.params[chosen] * scale + offset),
        None if root is None else foreign.plain(root / scale),
        [parameter.name for parameter in order if parameter.kcal in held],
        None if misfit is None else dict(zip(("rms", "largest"), misfit, strict=True)),
        {"model": str(camera.model), "parameters": [list(parameter[1:]) for parameter in order]},
    )
    return dict(zip(KEYS, values, strict=True))


def write_priors(program: str, priors: Sequence[dict[str, Any]], path: Path) -> Path:
    """Write what `prior_of` found: a numpy archive for the suffix .npz, otherwise JSON."""
    if path.suffix.lower() == ".npz":
        data = io.BytesIO()
        arrays: dict[str, Any] = {"kcal_prior": 1, "program": program, "cameras": len(priors)}
        for index, prior in enumerate(priors):
            texts = ("kcal", "misfit_px")
            arrays |= {f"{key}_{index}": json.dumps(value) if key in texts else value
                       for key, value in prior.items() if value is not None}  # fmt: skip
        np.savez(data, allow_pickle=False, **{key: np.asarray(value) for key, value in arrays.items()})
        return write_atomic(path, data.getvalue())
    content = {"kcal_prior": 1, "program": program, "cameras": list(priors)}
    return write_atomic(path, json.dumps(content, indent=1) + "\n")


def _write(program: str, cameras: Sequence[Camera], poses: Sequence[Pose], path: Path) -> list[Path]:
    """Cameras for a program without a file format of cameras."""
    return [write_priors(program, [prior_of(program, camera) for camera in cameras], path)]


write_gtsam, write_ceres, write_numpy = (partial(_write, program) for program in ("gtsam", "ceres", "numpy"))


def read_prior(path: Path, hints: foreign.Hints) -> foreign.ImportedCameras:
    """Read the cameras of such a file, with their covariances."""
    data = read_bytes(path, foreign.MOST_BYTES)
    content = _from_archive(data, path) if data[:2] == b"PK" else read_json(data, str(path))
    if not isinstance(content, dict) or content.get("kcal_prior") != 1 or not isinstance(content.get("cameras"), list):
        raise ValueError("no prior that kcal wrote: kcal_prior must be 1")
    if len(content["cameras"]) > _MOST_CAMERAS:
        raise ValueError(f"more than {_MOST_CAMERAS} cameras")
    program = str(content["program"])
    cameras = tuple(_camera_of(part) for part in content["cameras"])
    fitted = [
        f"{foreign.camera_name(camera, 'camera')}: a fit to another lens, RMS {float(part['misfit_px']['rms']):.2g} px"
        for camera, part in zip(cameras, content["cameras"], strict=True)
        if part.get("misfit_px")
    ]
    return foreign.ImportedCameras(format=program, cameras=cameras, notes=tuple(fitted))


read_gtsam = read_ceres = read_numpy = read_prior


def ceres_prior(path: str | Path, camera: Any, *, pixel_sigma: float, number: int = 0) -> Any:
    """A residual block of pyceres: the exported prior of a camera of COLMAP.

    Args:
        path: what `kcal export --format colmap` wrote beside the cameras, NAME.prior.json.
        camera: of pycolmap; its `params` are the block's parameters.
        pixel_sigma: standard deviation of the marks, px: COLMAP's residuals are pixels that are not divided by it.
        number: which of the file's cameras, from 0.

    Raises:
        FileError: no such file, or none of kcal.
        InputError: a camera of another model or size, one without error bars, or pyceres is missing.
    """
    try:
        import pyceres
    except ImportError:
        raise InputError("ceres_prior needs pyceres: pip install pyceres") from None
    with foreign.reading(path, "prior"):
        prior = read_json(read_bytes(path, foreign.MOST_BYTES), str(path))["cameras"][number]
        model, size, mean = str(prior["model"]), tuple(prior["size"]), np.array(prior["mean"], dtype=np.float64)
    theirs = camera.model.name, (camera.width, camera.height)
    if theirs != (model, size) or prior["sqrt_information"] is None:
        raise InputError(f"ceres_prior: {path} is of {model} {size} with its error bars; the camera is {theirs}")
    root = pixel_sigma * np.array(prior["sqrt_information"], dtype=np.float64)

    class Prior(pyceres.CostFunction):
        def __init__(self) -> None:
            super().__init__()
            self.set_num_residuals(len(mean))
            self.set_parameter_block_sizes([len(mean)])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
            residuals[:] = root @ (parameters[0] - mean)
            if jacobians is not None and jacobians[0] is not None:
                jacobians[0][:] = root.ravel()
            return True

    return Prior()


def _from_archive(data: bytes, path: Path) -> dict[str, Any]:
    stored = read_npz(data, str(path), foreign.MOST_BYTES, "prior")
    count = int(stored["cameras"])
    if count > _MOST_CAMERAS:
        raise ValueError(f"more than {_MOST_CAMERAS} cameras")
    cameras = []
    for index in range(count):
        part = {key: stored[f"{key}_{index}"].tolist() for key in KEYS if f"{key}_{index}" in stored}
        cameras.append(part | {key: read_json(str(part[key]).encode(), str(path)) for key in ("kcal", "misfit_px")
                               if key in part})  # fmt: skip
    return {"kcal_prior": int(stored["kcal_prior"]), "program": str(stored["program"]), "cameras": cameras}


def _camera_of(part: dict[str, Any]) -> Camera:
    model = LensModel.named(str(part["kcal"]["model"]))
    order = [Parameter("", str(own), *foreign.numbers(rest, 2, "kcal")) for own, *rest in part["kcal"]["parameters"]]
    count, names = len(order), parameter_names(model)
    if count > _MOST_PARAMETERS or len({each.kcal for each in order}) != count:
        raise ValueError("kcal names a parameter twice, or too many")
    mean = foreign.numbers(part["mean"], count, "mean")
    given = {each.kcal: (value - each.offset) / each.scale for each, value in zip(order, mean, strict=True)}
    values = [given.pop(name, 0.0) for name in names]
    if given:
        raise ValueError(f"{model} has no parameter {next(iter(given))}")
    (fx, fy, cx, cy, skew, *lens), size = values, foreign.whole_size(*part["size"])
    camera = foreign.named_camera(str(part["name"]), (fx, fy, cx, cy), size, model, lens, skew)
    if part.get("sqrt_information") is not None:
        rows = foreign.numbers(part["sqrt_information"], count * count, "sqrt_information")
        root = np.array(rows).reshape(count, count)
        scale = np.array([each.scale for each in order])
        half = np.linalg.inv(root).T / scale
        held = {str(name) for name in part.get("held", [])}
        half[:, [name in held for name in part["parameters"]]] = 0.0
        places = [names.index(each.kcal) for each in order]
        covariance = torch.zeros(len(names), len(names), dtype=torch.float64)
        covariance[torch.tensor(places)[:, None], torch.tensor(places)] = torch.from_numpy(half.T @ half)
        camera.calibration = CameraCalibration(name=str(part["name"]), covariance=covariance)
    return camera
