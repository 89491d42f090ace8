"""Cameras from files of kcal or of other programs, as commands name them: FILE, or FILE:CAMERA."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from kcal.errors import InputError
from kcal.file_kind import file_kind

if TYPE_CHECKING:
    from kcal.io.foreign import ImportedCameras
    from kcal.lens.camera import Camera
    from kcal.lens.rig import StereoRig


def named_source(source: str) -> tuple[Path, str | None]:
    """Split `rig.json:left` into the file and the camera's name."""
    path, colon, name = source.rpartition(":")
    if colon and not Path(source).exists() and Path(path).exists():
        return Path(path), name
    return Path(source), None


def picked(found: ImportedCameras, name: str | None, source: str) -> Camera:
    """The only camera, or the one of that name; of a rig `left` and `right` name the cameras as well.

    Raises:
        InputError: several cameras and no name, or a name that none has.
    """
    if name is None and len(found.cameras) == 1:
        return found.cameras[0]
    names = list(found.names)
    if len(names) == 2 and name in ("left", "right") and name not in names:
        return found.cameras[("left", "right").index(name)]
    if name is None or names.count(name) != 1:
        wrong = f"no camera {name!r}" if name else f"{len(names)} cameras"
        raise InputError(f"{source}: {wrong}; name one of {', '.join(map(repr, names))}")
    return found.cameras[names.index(name)]


def cameras_and_rig(path: Path) -> tuple[ImportedCameras, StereoRig | None]:
    """The cameras of a file of any program, and the rig that they are, if they are one."""
    from kcal.io.formats import import_cameras, recognized
    from kcal.io.rig_file import load_rig

    found = import_cameras(path)
    if len(found.cameras) == 1:
        return found, None
    if recognized(path) == "kcal":
        return found, load_rig(path)
    return found, found.rig() if found.is_rig() else None


def single_camera(source: str) -> Camera:
    """The camera that FILE or FILE:CAMERA names."""
    path, name = named_source(source)
    # Without the readers of other programs' files, which take long to load.
    if (file_kind(path), name) in (("camera", None), ("rig", "left"), ("rig", "right")):
        return calibrated_camera(source)
    from kcal.io.formats import import_cameras

    return picked(import_cameras(path), name, source)


def calibrated_camera(source: str | Path) -> Camera:
    """The camera of a file of kcal, or one of a rig of kcal: `rig.json:left`.

    Raises:
        FileError: no such file.
        InputError: the rig has no camera of that name.
    """
    path, name = named_source(str(source))
    if name is None:
        from kcal.io.camera_file import load_camera

        return load_camera(path)
    if name not in ("left", "right"):
        raise InputError(f"{source}: a rig has the cameras left and right, and none named {name!r}")
    from kcal.io.rig_file import load_rig

    rig = load_rig(path)
    return rig.left if name == "left" else rig.right


def parse_size(text: str | None) -> tuple[int, int] | None:
    """Read `1920x1080`.

    Raises:
        InputError: something else.
    """
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()) or not (int(width) and int(height)):
        raise InputError(f"--size {text}: write WIDTHxHEIGHT in pixels, for example 1920x1080")
    return int(width), int(height)
