"""Agisoft Metashape's XML: a calibration, or the sensors of exported cameras with the covariances of their parameters.

    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p1 (r² + 2x²) + 2 p2 x y,   u = width / 2 + cx + x' (f + b1) + y' b2
    y' = y (1 + ...) + p2 (r² + 2y²) + 2 p1 x y,                            v = height / 2 + cy + y' f

Pixel (0.5, 0.5) is the center of the first pixel there. p1 and p2 are OpenCV's p2 and p1 (Metashape's manual, appendix
D). A fisheye has θ in place of r = tan θ.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import torch

from kcal.files import read_bytes
from kcal.io.foreign import MOST_BYTES, Hints, ImportedCameras, named_camera, numbers, whole_size
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.strict_xml import read_xml

# What of kcal's parameters changes with each of Metashape's.
_FRAME = {"f": ("fx", "fy"), "b1": ("fx",), "b2": ("skew",), "cx": ("cx",), "cy": ("cy",), "p1": ("p2",), "p2": ("p1",),
          "k1": ("k1",), "k2": ("k2",), "k3": ("k3",), "k4": ("k7",)}  # fmt: skip
_FISHEYE = {name: own for name, own in _FRAME.items() if name[0] != "p"} | {"k4": ("k4",)}
_OTHERS = ("p3", "p4")


def read_agisoft(path: Path, hints: Hints) -> ImportedCameras:
    """Read the adjusted calibration of every sensor; poses are in a frame of the chunk and not read."""
    root = read_xml(read_bytes(path, MOST_BYTES), str(path))
    sensors = [part for part in root.iter("sensor") if part.find("calibration") is not None] or [root]
    cameras = tuple(_agisoft_camera(part, number) for number, part in enumerate(sensors))
    notes = ("the poses of images are not read",) if root.find(".//camera/transform") is not None else ()
    return ImportedCameras(format="agisoft", cameras=cameras, notes=notes)


def _agisoft_camera(sensor: Element, number: int) -> Camera:
    name = sensor.get("label") or f"sensor {sensor.get('id', number)}"
    found = [sensor] if sensor.tag == "calibration" else sensor.findall("calibration")
    if not found:
        raise ValueError("no sensor with a calibration")
    best = next((part for part in found if part.get("class") == "adjusted"), found[0])
    kind = best.get("type") or best.findtext("projection") or "frame"
    if kind not in ("frame", "fisheye"):
        raise ValueError(f"{name}: a lens of type {kind}: kcal reads frame and fisheye")
    own = _FISHEYE if kind == "fisheye" else _FRAME
    size = best.find("resolution")
    if size is not None:
        width, height = whole_size(size.get("width"), size.get("height"))
    else:
        width, height = whole_size(best.findtext("width"), best.findtext("height"))
    given = {tag: numbers([best.findtext(tag, "0")], 1, tag)[0] for tag in (*_FRAME, *_OTHERS)}
    strange = [tag for tag, value in given.items() if value and tag not in own]
    if strange:
        raise ValueError(f"{name}: {', '.join(strange)} of a {kind} lens: no lens of kcal holds it")
    if kind == "fisheye":
        model = LensModel.named("fisheye4")
    else:
        model = LensModel(numerator=4, tangential=True) if given["k4"] else LensModel.named("opencv5")
    names = ("fx", "fy", "cx", "cy", "skew", *model.names)
    values = dict.fromkeys(names, 0.0)
    for tag, changed in own.items():
        for target in changed:
            if target in values:
                values[target] += given[tag]
    fx, fy, cx, cy, skew, *lens = values.values()
    center = cx + 0.5 * width - 0.5, cy + 0.5 * height - 0.5
    camera = named_camera(name, (fx, fy, *center), (width, height), model, lens, skew)
    covariance = _sensor_covariance(sensor, own, names)
    if covariance is not None:
        camera.calibration = CameraCalibration(name=name, covariance=covariance)
    return camera


def _sensor_covariance(sensor: Element, own: dict[str, tuple[str, ...]], names: tuple[str, ...]) -> torch.Tensor | None:
    stated = sensor.find("covariance")
    if stated is None:
        return None
    tags = (stated.findtext("params") or "").split()
    strange = [tag for tag in tags if tag not in own]
    if not tags or len(tags) > len(own) or strange:
        raise ValueError(f"covariance: its parameters are {' '.join(tags)[:80]!r}")
    matrix = numbers((stated.findtext("coeffs") or "").split(), len(tags) ** 2, "covariance")
    moved = torch.zeros(len(names), len(tags), dtype=torch.float64)
    for column, tag in enumerate(tags):
        for target in own[tag]:
            if target in names:
                moved[names.index(target), column] = 1.0
    spread = torch.tensor(matrix, dtype=torch.float64).reshape(len(tags), len(tags))
    return moved @ (0.5 * (spread + spread.T)) @ moved.T
