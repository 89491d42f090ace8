"""Refuse cameras and views that are in each other's place, or not of one another: by names and sizes in the files."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from kcal.cli.inputs import typed_with
from kcal.errors import InputError

if TYPE_CHECKING:
    from kcal.corners.observations import Observations
    from kcal.lens.calibration import CalibrationRecord
    from kcal.lens.camera import Camera

_Given = TypeVar("_Given")
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
    if exchanged or _are_exchanged(cameras, paths, _by_file) or _are_exchanged(cameras, seen, _by_images):
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


def _are_exchanged(
    cameras: Sequence[Camera], given: Sequence[_Given], of: Callable[[CalibrationRecord, _Given], bool]
) -> bool:
    """Whether each camera was calibrated from what the other was given, and neither from its own."""
    known = [camera.calibration.record if camera.calibration else None for camera in cameras]
    first, second = ([record is not None and of(record, one) for one in given] for record in known)
    return [first, second] == [[False, True], [True, False]]


def _by_file(record: CalibrationRecord, path: Path) -> bool:
    return record.observations == path.name


def _by_images(record: CalibrationRecord, views: Observations) -> bool:
    return set(record.per_view_rms) <= set(views.names)


def _exchanged(paths: Sequence[Path]) -> str:
    first, second = map(str, paths)
    return typed_with({first: second, second: first})
