"""Refuse cameras and views that are in each other's place, or not of one another: by names and sizes in the files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kcal.cli.inputs import typed_with
from kcal.errors import InputError

if TYPE_CHECKING:
    from kcal.corners.observations import Observations
    from kcal.lens.camera import Camera

_SIDE = re.compile(r"(?<![a-z])(left|right)(?![a-z])", re.IGNORECASE)


def check_sides(cameras: Sequence[Camera], paths: Sequence[Path]) -> None:
    """Refuse a left camera that is named right, and a right one that is named left.

    Raises:
        InputError: with the command in which they are exchanged.
    """
    names = [camera.calibration.name if camera.calibration else "" for camera in cameras]
    sides = [set(map(str.lower, _SIDE.findall(name))) for name in names]
    if sides == [{"right"}, {"left"}]:
        raise InputError(
            f"{paths[0]}: this camera is named {names[0]!r}, and {paths[1]} {names[1]!r}: left and right are "
            f"exchanged. Perhaps: {_exchanged(paths)}"
        )


def check_views_of(cameras: Sequence[Camera], seen: Sequence[Observations], paths: Sequence[Path]) -> None:
    """Refuse views of another size than their camera's, and those that the other camera was calibrated from.

    Raises:
        InputError: with the file, the camera and, where the files are exchanged, the right command.
    """
    for camera, views, path in zip(cameras, seen, paths, strict=True):
        if camera.size != views.image_size and len(cameras) == 1:
            raise InputError(_other_size(camera, views, path))
    if len(cameras) != 2:
        return
    sizes = [camera.size for camera in cameras]
    views_sizes = [views.image_size for views in seen]
    exchanged = sizes != views_sizes and sizes == views_sizes[::-1]
    if exchanged or (_of(cameras[0], seen[1], paths[1]) and _of(cameras[1], seen[0], paths[0])):
        raise InputError(
            f"{paths[0]}: these are views of the right camera, and {paths[1]} has those of the left one: they are "
            f"exchanged. Perhaps: {_exchanged(paths)}"
        )
    for camera, views, path in zip(cameras, seen, paths, strict=True):
        if camera.size != views.image_size:
            raise InputError(_other_size(camera, views, path))


def _other_size(camera: Camera, views: Observations, path: Path) -> str:
    name = camera.calibration.name if camera.calibration else ""
    return (
        f"{path}: images of {views.image_size[0]}x{views.image_size[1]} px, but the camera {name or 'given'} has "
        f"{camera.size[0]}x{camera.size[1]} px: these are not its views. To calibrate from them: "
        f"kcal calibrate {path} -o {path.name.split('.')[0]}.camera.json"
    )


def _of(camera: Camera, views: Observations, path: Path) -> bool:
    """Whether the camera was calibrated from these views alone, by their names or by the name of their file."""
    record = camera.calibration.record if camera.calibration else None
    if record is None:
        return False
    return record.observations == path.name or set(record.per_view_rms) <= set(views.names)


def _exchanged(paths: Sequence[Path]) -> str:
    first, second = map(str, paths)
    return typed_with({first: second, second: first})
