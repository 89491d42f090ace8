"""What files of other programs contain, in kcal's conventions, and helpers to read and write them.

Principal points are shifted so that (0, 0) is the center of the first pixel; poses become `cam_from_reference`, meters.
"""

from __future__ import annotations

import configparser
import dataclasses
import math
import re
from collections import UserDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
import yaml
from torch import Tensor

from kcal.checks import MOST_FOCAL
from kcal.errors import FileError, InputError, KcalError
from kcal.file_kind import check_pixel_count
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.pose import Pose, nearest_rotation, rotation_from_vector, vector_from_rotation
from kcal.lens.rig import Rig
from kcal.texts import brief

# Rotations of files with six digits; beyond it they are no rotation but a mistake.
_ROUNDED = 1e-4
# Of a file of cameras: ten thousand frames of nerfstudio have 10 MiB.
MOST_BYTES = 32 * 2**20
# Meters that no rig has, and what no coefficient of a lens comes near.
_LEAST_METERS, _MOST_METERS, _MOST_COEFFICIENT = 1e-9, 1e6, 1e15


class Hints(NamedTuple):
    """What a file may leave open: image size (width, height), whether four coefficients are a fisheye's, its unit."""

    size: tuple[int, int] | None = None
    fisheye: bool | None = None
    meters: float | None = None


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ImportedCameras:
    """Cameras and poses from a file of another program.

    Args:
        format: name of the format.
        cameras: the cameras, each with a name (`camera.calibration.name`).
        poses: rotation (3, 3) and translation (3,) of each camera from the reference frame of the file, meters; empty
            if the file contains none.
        notes: what the file left open and how it was read, and what of it kcal does not keep.
        unread: cameras of the file that cannot be read, each with the reason.
    """

    format: str
    cameras: tuple[Camera, ...]
    poses: tuple[Pose, ...] = ()
    notes: tuple[str, ...] = ()
    unread: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names."""
        return tuple(camera.calibration.name if camera.calibration else "" for camera in self.cameras)

    @property
    def _second_from_first(self) -> Pose:
        return self.poses[1].after(self.poses[0].inverse())

    def is_rig(self) -> bool:
        """Whether these are two cameras at different places.

        Raises:
            InputError: two at one place, but for rounding.
        """
        if not len(self.cameras) == len(self.poses) == 2:
            return False
        apart = float(self._second_from_first.translation.norm())
        if 0 < apart < _LEAST_METERS:
            raise InputError(
                f"{' and '.join(self.names)} stand in one place: by their poses they are {apart:.1g} m apart"
            )
        return apart > 0

    def rig(self) -> Rig:
        """Both cameras as a rig, the first one on the left.

        Raises:
            InputError: not two cameras, or no poses.
        """
        if not self.is_rig():
            raise InputError(
                f"a rig needs two cameras with their relative pose; found {len(self.cameras)} cameras "
                f"({', '.join(self.names)}) and {len(self.poses)} poses"
            )
        left, right = self.cameras
        return Rig.pair(left, right, *self._second_from_first)

    def camera_rig(self) -> Rig:
        """All cameras as a rig, in the frame of the file.

        Raises:
            InputError: cameras without poses, or with equal names.
        """
        turns, shifts = (torch.stack([pose[i] for pose in self.poses]) for i in (0, 1))
        return Rig(self.cameras, self.names, turns, shifts)

    __repr__ = brief


def rig_poses(rig: Rig) -> tuple[Pose, ...]:
    """Each camera from the rig's frame."""
    return tuple(map(Pose, rig.rotation, rig.translation))


def each_readable(readers: Iterable[tuple[str, Callable[[], Camera]]]) -> tuple[tuple[Camera, ...], dict[str, str]]:
    """The cameras that can be read, and why the others, by name, cannot.

    Raises:
        ValueError: none can; the reason is that of the first one.
    """
    cameras, unread = [], dict[str, str]()
    for name, read in readers:
        try:
            cameras.append(read())
        except KeyError as error:
            unread[name] = f"{error.args[0]} is missing"
        except (ValueError, TypeError) as error:
            unread[name] = str(error)
    if unread and not cameras:
        raise ValueError(next(iter(unread.values())))
    return tuple(cameras), unread


def checked_pose(rotation: Any, translation: Any) -> Pose:
    """A pose from lists: the rotation is made exact, because files round it.

    Raises:
        ValueError: no rotation, or wrong shapes.
    """
    matrix = torch.tensor(rotation, dtype=torch.float64).reshape(3, 3)
    if not all(abs(value) <= _MOST_METERS for value in translation):
        raise ValueError(f"its translation is not finite or beyond {_MOST_METERS:g} m")
    exact = nearest_rotation(matrix)
    if not float((matrix - exact).abs().max()) <= _ROUNDED:
        raise ValueError("its rotation is no rotation matrix (R Rᵀ must be 1 and det R = +1)")
    # One that is exact already stays as it is, to the last bit.
    same = float((matrix - exact).abs().max()) < 1e-14
    return Pose(matrix if same else exact, torch.tensor(translation, dtype=torch.float64).reshape(3))


def moved_by(quaternion: Sequence[float], translation: Sequence[float]) -> Pose:
    """A pose from a quaternion (4,) of any length, w first, and a translation (3,), meters."""
    turn = torch.tensor(quaternion, dtype=torch.float64)
    if not 0.0 < float(turn.square().sum()) < math.inf:
        raise ValueError("a quaternion is zero, or not finite")
    length = turn[1:].norm()
    rotation = rotation_from_vector(2.0 * torch.atan2(length, turn[0]) * turn[1:] / length.clamp_min(1e-300))
    return checked_pose(rotation.tolist(), translation)


def pose_of(matrix: Any, what: str) -> Pose:
    """A pose from a matrix of three or four rows of four numbers."""
    whole = torch.tensor(numbers(matrix, (12, 16), what), dtype=torch.float64).reshape(-1, 4)
    return checked_pose(whole[:3, :3].tolist(), whole[:3, 3].tolist())


def poses_from_root(parents: Mapping[str, tuple[str, Pose]], frames: Sequence[str]) -> tuple[Pose, ...]:
    """Each frame's pose from the one that all hang on; `parents` has parent_from_frame of each that hangs on another.

    Empty if they do not hang together, or for a frame alone.
    """
    poses, roots = [], set()
    for frame in frames:
        pose, passed = Pose.still(), {frame}
        while frame in parents:
            frame, parent_from_child = parents[frame]
            pose = parent_from_child.after(pose)
            if frame in passed:
                return ()
            passed.add(frame)
        roots.add(frame)
        poses.append(pose.inverse())
    return tuple(poses) if len(roots) == 1 and len({*frames}) == len(frames) > 1 else ()


def quaternion_of(rotation: Tensor) -> list[float]:
    """w, x, y, z of a rotation (3, 3).

    Example:
        >>> [round(each, 12) for each in quaternion_of(moved_by([1.0, 1.0, -1.0, 1.0], [0.0, 0.0, 0.0]).rotation)]
        [0.5, 0.5, -0.5, 0.5]
    """
    turn = vector_from_rotation(rotation.double())
    return [float((0.5 * turn.norm()).cos()), *(0.5 * turn * torch.sinc(0.5 * turn.norm() / math.pi)).tolist()]


def named_camera(
    name: str,
    intrinsics: Sequence[float],
    size: Sequence[int],
    model: LensModel | str,
    coefficients: Sequence[float] = (),
    skew: float = 0.0,
) -> Camera:
    """A camera from fx, fy, cx, cy in kcal's convention."""
    fx, fy, cx, cy = map(float, intrinsics)
    width, height = check_pixel_count((int(size[0]), int(size[1])))
    if not all(1.0 / MOST_FOCAL <= focal <= MOST_FOCAL for focal in (fx, fy)):
        raise ValueError(f"{name}: focal lengths of {fx:g} and {fy:g} px are not finite, or no camera's")
    if not all(abs(value) <= MOST_FOCAL for value in (cx, cy, skew)):
        raise ValueError(
            f"{name}: a principal point at {cx:g}, {cy:g} px, or skew {skew:g}, is not finite or no camera's"
        )
    if not all(abs(value) <= _MOST_COEFFICIENT for value in coefficients):
        raise ValueError(f"{name}: a coefficient of the lens is not finite or beyond {_MOST_COEFFICIENT:g}")
    camera = Camera.build(
        focal=(fx, fy), center=(cx, cy), size=(width, height), coefficients=coefficients, model=model, skew=skew
    )
    camera.calibration = CameraCalibration(name=name)
    return camera


def with_sigmas(camera: Camera, sigmas: Sequence[float]) -> str:
    """Give a camera standard deviations in the order of fx, fy, cx, cy and its coefficients; return a note.

    Raises:
        ValueError: negative ones, or another number of them.
    """
    names = [name for name in camera.names if name != "skew"]
    if len(sigmas) != len(names) or not all(0.0 <= sigma < math.inf for sigma in sigmas):
        raise ValueError(f"standard deviations of {', '.join(names)} are needed, none negative")
    known = dict(zip(names, sigmas, strict=True))
    spread = torch.tensor([known.get(name, 0.0) for name in camera.names], dtype=torch.float64)
    camera.calibration = CameraCalibration(
        name=camera_name(camera, ""), sigma={name: known.get(name) or None for name in camera.names},
        covariance=torch.diag(spread.square()),
    )  # fmt: skip
    return "the file has standard deviations without correlations: taken as independent"


def numbers(value: Any, count: Sequence[int] | int, what: str) -> list[float]:
    """A list of finite numbers, flattened; `count` says how many, or which counts are allowed.

    Raises:
        ValueError: something else.
    """
    found = flat(value)
    if found is None:
        raise ValueError(f"{what} must be numbers")
    allowed = (count,) if isinstance(count, int) else tuple(count)
    if len(found) not in allowed:
        raise ValueError(f"{what} has {len(found)} numbers; {' or '.join(str(n) for n in allowed if n)} are needed")
    if not all(map(math.isfinite, found)):
        raise ValueError(f"{what} has a number that is not finite")
    return found


def whole_size(width: Any, height: Any) -> tuple[int, int]:
    """Width and height as positive whole numbers."""
    sizes = [float(value) for value in (width, height)]
    if not all(0 < value < math.inf and value == int(value) for value in sizes):
        raise ValueError(f"the image size is {width} x {height}; positive whole numbers are needed")
    return int(sizes[0]), int(sizes[1])


# Keys of files. Names are compared without case and punctuation.

BEFORE = re.compile(r"(left|right|(?:cam(?:era)?)?[0-9]{1,3})(.+)")
# Keys of other things than a lens, and keys of a lens.
OTHER = re.compile(
    "err|(?<!pa)rms|resid|uncert|^std|std$|sigma|view|object|(?<!principal)point|corner|board|square|pattern|marker|target|grid|time"
    "|date$|stamp|flag|extrin|pose|rotat|translat|rvec|tvec|quat|orient|posit|world|valid|^new|optimal|undist|rectif|^proj"
    "|essential|fundamental|fps|rate(?!d)|name|path|file|version|count|^num|comment|note|desc|serial|id$|header|frame|gain|lidar|mm$|ext[rt]$|^estim"
    "|expos|aspect|bias|noise|gyro|acc|imu|body|base(?:line)?$|overlap|resolutions|transform|aabb|scene|bound|render|^(?:[rp][12]?|[qef]|om|h[12]|t(?!ang?$|au|ilt)[0-9a-z]{0,4})$"
)
_LENS = re.compile(
    "distor|dist[kp]?[0-9]|^dist(?!ance)|coef|lens|^[dk][0-9]|^[prt][0-9]|^s[1-4]$|tau|xi$|alpha|beta|gamma|model|skew|binn|roi|tan$|tang|tilt|radial|fisheye|omni|mirror"
    "|intrins|matrix|focal|princip|cent(?:er|re)|^[fc][xyuv]$|mapping|stretch|poly|affin|equi|^[dfk]$"
)
# What no part of a name makes another thing than a lens, unless it says of what else: an error, a switch, a count.
_ITS_COEFFICIENTS = re.compile(
    "^(?!.*(err|(?<!pa)rms|resid|uncert|std|sigma|dev|view|valid|optimal|rectif|undist(?!.*coef)|flag|num|count|version|stamp))"
    ".*(distor|dist[a-z]*(coef|par)|coef)"
)
_SHAPED = re.compile("(?:matrix|mtx)|dist(?:ortion)?(?:coef+s|coef+icients)|k[1-6]|p[12]")
_MOST_NAMED = 12


def bare(key: object) -> str:
    """A name without case and punctuation."""
    return re.sub("[^a-z0-9]", "", str(key).lower())


def _number_words(text: str) -> list[str]:
    """Numbers of a text such as "[1.5, -2 3]", as words; none where commas may be those of decimals."""
    inner = text.translate({ord(bracket): " " for bracket in "[](){};"}).strip()
    words = inner.split() if re.search(r"\s", inner) else inner.split(",")
    words = [word.removesuffix(",") for word in words]
    return words if all(re.fullmatch(r"[-+]?[.\d][.\deE+-]*", word) for word in words) else []


def flat(value: Any) -> list[float] | None:
    """All numbers of a scalar, of nested lists, of an array, of a text or of a block with `data`; None otherwise."""
    if isinstance(value, Mapping):
        counted = [str(key) for key in value] == list(map(str, range(len(value))))
        if counted and value and not any(isinstance(part, Mapping | list | tuple) for part in value.values()):
            return flat([*value.values()])
        return flat(value["data"]) if "data" in value else None
    if isinstance(value, str) and len(words := _number_words(value)) > 1:
        value = words
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        # At once: maps for cv2.remap have millions.
        return None if value.dtype == bool else list(value.astype(float).ravel().tolist())
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        parts = [flat(part) for part in value]
        return None if any(part is None for part in parts) else [n for part in parts for n in part or ()]
    try:
        return None if isinstance(value, bool) else [float(value)]
    except (TypeError, ValueError):
        return None


class Keys(UserDict[str, Any]):
    """A mapping that knows which of its keys were read."""

    def __init__(self, content: Mapping[str, Any]) -> None:
        # Not copied, nor checked: what is no mapping is refused where it is read.
        self.data, self.read = cast(dict[str, Any], content), set[str]()

    def __getitem__(self, key: str) -> Any:
        value = self.data[key]
        self.read.add(key)
        return value

    def rest(self, where: str = "") -> list[str]:
        """A note on the keys that were not read.

        Raises:
            ValueError: one of them may describe the lens.
        """
        unknown = sorted(self._unread(where))
        return [f"not read: {', '.join(unknown[:_MOST_NAMED])}"] if unknown else []

    def _unread(self, where: str) -> Iterator[str]:
        for key in (key for key in self.data if key not in self.read):
            value, name = self.data[key], re.sub("^cam(?:era)?(?=[a-z])", "", bare(key))
            name = (BEFORE.fullmatch(name) or ("", "", name))[2]
            found = whole = flat(value)
            if whole is None and isinstance(value, list):
                found = flat([part for part in value if flat(part)])
            if isinstance(value, Mapping) and found is None and not OTHER.search(name):
                yield from Keys(value)._unread(f"{where}{key}.")
            text = value if isinstance(value, str) else ""
            if not found and _LENS.search(name) and re.fullmatch("(?i)[^a-df-z/:]*[0-9][^a-df-z/:]*", text):
                raise ValueError(f"{where}{key} ({text}) must be numbers with decimal points")
            if not found or not any(found):
                continue
            if (
                OTHER.search(name)
                and not _ITS_COEFFICIENTS.search(name)
                and not (len(found) == 1 and re.fullmatch("[prt][12]|f", name))
            ):
                continue
            if _LENS.search(name) or 4 <= len(found) <= 14:
                if whole is None:
                    raise ValueError(f"{where}{key} must be numbers")
                shape = f"{len(found)} numbers" if len(found) > 1 else f"{found[0]:g}"
                if _SHAPED.fullmatch(name):
                    raise ValueError(
                        f"{where}{key} has {shape}, and cannot have so many: decimals need a point, a matrix is 3 x 3"
                    )
                raise ValueError(
                    f"{where}{key} ({shape}) may describe the lens, and kcal does not know this name; rename it as the "
                    "format has it (camera_matrix, distortion_coefficients, ...), or delete it if it is no lens's"
                )
            yield f"{where}{key}"


@contextmanager
def reading(path: str | Path, what: str) -> Iterator[None]:
    """Turn any error while a file is read into one `FileError` that names the file.

    What is in a file must not end a program: parsers raise errors of a dozen kinds, and all mean that the file is bad.
    """
    try:
        yield
    except FileError:
        raise
    except (KcalError, ValueError, yaml.YAMLError) as error:
        raise FileError(f"{path}: bad {what} file: {error}") from error
    except OSError as error:
        raise FileError(f"{path}: cannot read: {error.strerror or error}") from error
    except KeyError as error:
        raise FileError(f"{path}: bad {what} file: {error.args[0]} is missing") from error
    except Exception as error:
        raise FileError(f"{path}: bad {what} file: {type(error).__name__}: {error!s:.200}") from error


def dump_yaml(content: Mapping[str, Any]) -> str:
    """YAML text with exact numbers, short lists on one line."""
    return yaml.safe_dump(dict(content), sort_keys=False, default_flow_style=None, width=120)


def ini_sections(text: str) -> dict[str, dict[str, str]]:
    """Values of an INI file by section."""
    sections = configparser.RawConfigParser(strict=True)
    sections.read_string(text)
    return {name: dict(sections[name]) for name in sections.sections()}


def core_of(matrix: Any, what: str) -> tuple[list[float], float]:
    """fx, fy, cx, cy, and the skew, of a camera matrix's nine numbers, row by row.

    Raises:
        ValueError: see `numbers`; another number than 0 or 1 where these belong.
    """
    fx, skew, cx, below, fy, cy, *last = numbers(matrix, 9, what)
    if below or last != [0.0, 0.0, 1.0]:
        turned = "; exchange its rows and columns" if not (skew or cx or cy) and last[2] == 1.0 else ""
        raise ValueError(f"{what} is no camera matrix{turned}")
    return [fx, fy, cx, cy], skew


def known_size(stated: tuple[int, int] | None) -> tuple[int, int]:
    """A size that a file or its reader's options tell.

    Raises:
        ValueError: neither does.
    """
    if stated is None:
        raise ValueError("the image size is not in the file; give it (--size WIDTHxHEIGHT)")
    return stated


def camera_name(camera: Camera, otherwise: str) -> str:
    """The name that a camera has, or another one."""
    return (camera.calibration.name if camera.calibration else "") or otherwise


def plain(values: Tensor) -> list[Any]:
    """Nested lists of Python floats."""
    listed: list[Any] = values.detach().cpu().double().tolist()
    return listed


def paths_for(path: Path, count: int) -> list[Path]:
    """Where files of one camera each go: the path itself, or NAME_left and NAME_right beside it."""
    if count == 1:
        return [path]
    sides = ("left", "right") if count == 2 else tuple(str(i) for i in range(count))
    return [path.with_name(f"{path.stem}_{side}{path.suffix}") for side in sides]
