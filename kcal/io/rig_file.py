"""kcal's own rig files: whole cameras, where they stand, and how that was found.

JSON, `"kcal": "rig"`, version 4. kcal 1.0 wrote version 2 for two cameras and version 3 for any other number; both are
read. The cameras are embedded, not referred to: relative yaw of 0.01° is 436 m at 5 km, so a rig must never be combined
with cameras that were solved again after it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import pydantic
import torch
from torch import Tensor, nn

from kcal.checks import as_covariance, require_root
from kcal.dispatch import still
from kcal.errors import FileError, InputError
from kcal.gaussian import half_of_covariance
from kcal.io.camera_file import CameraFile, camera_to_file
from kcal.io.file_summary import RigSummary
from kcal.io.foreign import camera_name
from kcal.io.record import Packed
from kcal.lens.calibration import RigCalibration
from kcal.lens.pair_errors import relative_root
from kcal.lens.projection import INTRINSICS
from kcal.lens.rig import REFRACTION, REFRACTION_SIGMA, Mounting, Origin, Rig
from kcal.native_file import NativeFile, Record, storing

Triple = tuple[float, float, float]


class RigPose(Record):
    """`points_cam = rotation @ points_rig + translation`, meters."""

    rotation: tuple[Triple, Triple, Triple]
    translation: Triple

    @pydantic.model_validator(mode="after")
    def _rigid(self) -> RigPose:
        rotation = torch.tensor(self.rotation, dtype=torch.float64)
        # As in Rig; checked here so that the error names the file.
        error = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max()
        if not float(error) <= 1e-6 or float(torch.linalg.det(rotation)) < 0:
            raise ValueError("rotation is no rotation matrix (R Rᵀ must be 1 and det R = +1)")
        return self


Matrix = tuple[tuple[float, ...], ...]


def _tensor(value: Matrix, rows: int, columns: int, what: str) -> Tensor:
    if len(value) != rows or any(len(row) != columns for row in value):
        raise ValueError(f"{what} must be {rows} x {columns}")
    return torch.tensor(value, dtype=torch.float64)


class FrameOrigin(Record):
    """Where the frame is anchored: degrees, meters above the WGS84 ellipsoid."""

    lat: float = pydantic.Field(ge=-90, le=90)
    lon: float = pydantic.Field(ge=-180, le=180)
    height: float


class RigMounting(FrameOrigin):
    """Where the left camera stands on the Earth and where it looks.

    Args:
        lat: of its projection center, degrees (WGS84).
        lon: degrees.
        height: meters above the ellipsoid.
        heading_deg: of its axis, clockwise from true north.
        pitch_deg: of its axis, positive up.
        roll_deg: clockwise as seen from behind.
        refraction: coefficient.
    """

    heading_deg: float
    pitch_deg: float = pydantic.Field(ge=-90, le=90)
    roll_deg: float
    refraction: float = pydantic.Field(default=REFRACTION, ge=-2, le=2)

    @classmethod
    def of(cls, mounting: Mounting) -> RigMounting:
        """In the form in which it is stored."""
        own = {name: getattr(mounting, name) for name in cls.model_fields if hasattr(mounting, name)}
        return cls(**dataclasses.asdict(mounting.origin), **own)

    @pydantic.model_validator(mode="after")
    def _possible(self) -> RigMounting:
        self.mounting()
        return self

    def mounting(self) -> Mounting:
        """As `Rig.mounting`, exact."""
        content = dict(self)
        return Mounting(origin=Origin(**{name: content.pop(name) for name in FrameOrigin.model_fields}), **content)


class RigFile(NativeFile):
    """A rig of any number of cameras (file kind `rig`, version 4).

    Args:
        names: of the cameras.
        cameras: whole.
        poses: where they stand in the rig's frame.
        origin: where this frame is anchored on the Earth, east, north, up; None: it is a camera's or any other one.
        refraction: coefficient.
        root: (K, P) as `Rig.root`: what was held has zeros.
        mounting: where the left one of two cameras stands on the Earth, if that is known.
        calibration: how the rig was solved, if it was.
        summary: what `kcal show` prints of two cameras without computing.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080))
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> float(rig_to_file(rig).rig().baseline)
        10.0
    """

    KIND: ClassVar[str] = "rig"
    VERSION: ClassVar[int] = 4
    _LATER: ClassVar[Mapping[str, Any]] = {"calibration.lens_change": 0.0}

    names: tuple[str, ...]
    cameras: tuple[CameraFile, ...]
    poses: tuple[RigPose, ...]
    origin: FrameOrigin | None = None
    refraction: float = pydantic.Field(default=REFRACTION, ge=-2, le=2)
    root: Packed | None = None
    mounting: RigMounting | None = None
    calibration: RigCalibration | None = None
    summary: RigSummary | None = None

    @pydantic.model_validator(mode="after")
    def _fitting(self) -> RigFile:
        if not len(self.names) == len(self.cameras) == len(self.poses):
            raise ValueError(f"{len(self.names)} names, {len(self.cameras)} cameras and {len(self.poses)} poses")
        if len(set(self.names)) != len(self.names) or not all(self.names):
            raise ValueError(f"unlike names are needed, got {', '.join(self.names)}")
        if self.mounting is not None:
            if len(self.names) != 2:
                raise ValueError(f"mounting is that of two cameras; there are {len(self.names)}")
            still = RigPose(rotation=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), translation=(0.0, 0.0, 0.0))
            if self.origin is not None or self.poses[0] != still:
                raise ValueError("mounting is that of the left camera, whose frame must be the rig's")
        lenses = sum(len(camera.coefficients) + len(INTRINSICS) for camera in self.cameras)
        if self.root is not None:
            require_root("root", self.root.tensor(), lenses + 6 * len(self.names) + 1)
        if (len(self.names) != 2 or self.origin is not None) and all(file.model.complete for file in self.cameras):
            self.rig()
        return self

    @classmethod
    def parse(cls, content: Any, source: str) -> Self:
        """See `NativeFile.parse`."""
        if isinstance(content, dict) and content.get("kcal") == cls.KIND and content.get("version") in _EARLIER:
            try:
                content = _EARLIER[content["version"]](content)
            except (InputError, ValueError, TypeError) as error:
                raise FileError(f"{source}: bad rig file: {error}") from error
        return super().parse(content, source)

    def rig(self, field: nn.Module | None = None) -> Rig:
        """The rig, equal to the stored one to the last bit, with all that is known of it; `field` as for `load_rig`."""
        cameras = [file.camera(field) for file in self.cameras]
        rotation, translation = (
            torch.tensor([getattr(pose, part) for pose in self.poses], dtype=torch.float64).reshape(-1, *shape)
            for part, shape in (("rotation", (3, 3)), ("translation", (3,)))
        )
        origin = None if self.origin is None else Origin(**dict(self.origin))
        rig = Rig(cameras, self.names, rotation, translation, origin=origin, refraction=self.refraction)
        rig.mounting = None if self.mounting is None else self.mounting.mounting()
        rig.root = None if self.root is None else self.root.tensor()
        rig.calibration = self.calibration
        return rig


def _joint_errors(size: int, half: Any, stands: dict[str, Any] | None) -> Tensor:
    """`Rig.relative_root` of what 1.0 wrote of two cameras.

    Args:
        size: quantities of `RigCovariance`.
        half: packed root of these.
        stands: covariance (6, 6) or (7, 7) of the mounting, and link (size, 6) or (size, 7), its covariance with these.
    """
    known = torch.zeros(0, size, dtype=torch.float64) if half is None else Packed.model_validate(half).tensor()
    require_root("half", known, size)
    joint = torch.nn.functional.pad(known, (0, 7))
    if stands is None:
        return joint
    rows = stands.get("covariance", torch.zeros(6, 6).tolist())
    count = 7 if len(rows) == 7 else 6
    mounting = as_covariance(
        "the mounting's covariance", _tensor(rows, count, count, "the mounting's covariance"), count
    )
    if "link" in stands:
        if half is None or "covariance" not in stands:
            raise ValueError("the mounting's link needs the covariances of the rig and of the mounting")
        link = _tensor(stands["link"], size, count, "the mounting's link")
        whole = torch.cat([torch.cat([known.T @ known, link], 1), torch.cat([link.T, mounting], 1)])
        as_covariance("covariance of rig and mounting", whole, size + count)
        # What the mounting owes to the rig's errors: knownᵀ of = link.
        scale = torch.linalg.vector_norm(known, dim=0)[:, None]
        unit = torch.where(scale > 0, scale, 1.0)
        of = torch.linalg.lstsq(known.T / unit, link / unit, driver="gelsd").solution
        joint[:, size : size + count] = of
        left_over = mounting - of.T @ of
        # What the rig's errors explain is zero but for rounding.
        kept = left_over.diagonal() > 1e-12 * mounting.diagonal()
        mounting = left_over * (kept[:, None] & kept)
    own = half_of_covariance(mounting)
    if count == 6:
        own = torch.block_diag(own, own.new_full((1, 1), REFRACTION_SIGMA))
    return torch.cat([joint, torch.nn.functional.pad(own, (size, 0))])


def _from_two(content: dict[str, Any]) -> dict[str, Any]:
    """A file of version 2, of two cameras, as one of version 4."""
    pose: Any = content.get("right_from_left")
    solved: Any = content.get("calibration")
    if isinstance(solved, dict):
        solved = dict(solved)
        length, frame = solved.pop("baseline_m", None), solved.pop("frame", "left camera")
        if frame != "left camera":
            raise InputError(f"calibration.frame: left camera is needed, got {frame!s:.40}")
        shift: Any = pose.get("translation") if isinstance(pose, dict) else None
        if isinstance(shift, list) and len(shift) == 3 and all(isinstance(x, int | float) for x in [*shift, length]):
            apart = math.hypot(*shift)
            # A thousandth of a millimeter in a meter: more is not rounding but another rig.
            if not math.isclose(length, apart, rel_tol=1e-6):
                raise InputError(f"baseline_m is {length:g}, but the translation is {apart:g} m long")
        solved["rms_px"] = [solved.pop("rms_left", None), solved.pop("rms_right", None)]
    known = ("version", "left", "right", "right_from_left", "calibration", "summary")
    more = {name: value for name, value in content.items() if name not in known}
    if more.get("covariance") is None:
        more.pop("covariance", None)
    half, stands, cameras = more.pop("half", None), more.get("mounting"), [content.get("left"), content.get("right")]
    owned: dict[str, Any] = {}
    if isinstance(stands, dict):
        owned = {name: stands[name] for name in ("covariance", "link") if stands.get(name) is not None}
        more["mounting"] = {k: v for k, v in stands.items() if k not in ("covariance", "link") and v is not None}
    try:
        lenses = sum(len(camera["coefficients"]) + len(INTRINSICS) for camera in cameras)  # type: ignore[index, misc]
        turn, shift = (torch.tensor(pose[part], dtype=torch.float64) for part in ("rotation", "translation"))
        center = torch.stack([torch.zeros_like(shift), -turn.T @ shift])
        look = RigMounting(**more["mounting"]).mounting().enu_from_cam if stands else torch.eye(3, dtype=torch.float64)
    except (KeyError, TypeError, ValueError, RuntimeError):
        # What is wrong with it is told by the checks of the fields.
        pass
    else:
        if isinstance(half, dict) and list(half.get("shape", ()))[1:] != [lenses + 6]:
            # Of other cameras: the checks say so.
            more["root"] = half
        elif len(joint := _joint_errors(lenses + 6, half, owned if stands else None)):
            more["root"] = Packed.of(relative_root(joint, center, turn, look, back=True)).model_dump()
    still = {"rotation": torch.eye(3).tolist(), "translation": [0.0, 0.0, 0.0]}
    return {
        "version": RigFile.VERSION, "names": ["left", "right"], "cameras": cameras, "poses": [still, pose],
        "calibration": solved, **more,
    }  # fmt: skip


def _from_many(content: dict[str, Any]) -> dict[str, Any]:
    """A file of version 3, whose poses have centers in place of translations, as one of version 4."""

    def moved(pose: Any) -> Any:
        try:
            rotation, center = (torch.tensor(pose[part], dtype=torch.float64) for part in ("rotation", "center"))
            shift = -(rotation @ center)
        except (KeyError, TypeError, ValueError, RuntimeError):
            # What is wrong with it is told by the checks of the fields.
            return pose
        rest = {part: value for part, value in pose.items() if part != "center"}
        return rest | {"translation": shift.tolist()}

    poses = content.get("poses")
    there = {"poses": list(map(moved, poses))} if isinstance(poses, list) else {}
    # 1.0 had another default.
    return {"refraction": 0.0, **content, **there, "version": RigFile.VERSION}


# Versions of kcal 1.0, and how each becomes the present one.
_EARLIER = {2: _from_two, 3: _from_many}


def rig_to_file(rig: Rig) -> RigFile:
    """Put a rig, with all that is known of it and of its cameras, in the form in which it is stored.

    Raises:
        InputError: values that do not fit together.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> rig_to_file(rig).poses[1].translation
        (-1.0, 0.0, 0.0)
    """
    rig = still(rig)
    root, mounting, origin = rig.root, rig.mounting, rig.origin
    with storing("rig"):
        file = RigFile(
            names=rig.names,
            cameras=tuple(
                camera_to_file(camera, name=camera_name(camera, name))
                for camera, name in zip(rig.each, rig.names, strict=True)
            ),
            poses=tuple(
                RigPose(rotation=turn, translation=shift)
                for turn, shift in zip(rig.rotation, rig.translation, strict=True)
            ),
            origin=None if origin is None else FrameOrigin(**dataclasses.asdict(origin)),
            refraction=float(rig.refraction),
            root=None if root is None else Packed.of(root),
            mounting=None if mounting is None else RigMounting.of(mounting),
            calibration=rig.calibration,
        )
    if len(rig) != 2 or origin is not None:
        return file
    return file.model_copy(update={"summary": RigSummary.made(rig, file.model_dump(mode="json"))})


def save_rig(rig: Rig, path: str | Path) -> Path:
    """Write a rig with its cameras, covariances, mounting, and how they were calibrated.

    Raises:
        InputError: see `rig_to_file`.
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     float(load_rig(save_rig(rig, Path(folder, "rig.json"))).baseline)
        1.0
    """
    return rig_to_file(rig).save(path)


def load_rig(path: str | Path, *, field: nn.Module | None = None) -> Rig:
    """Read the rig of a kcal rig file, with the error bars and the history of it and its cameras.

    `field` as for `kcal.load_camera`, for all cameras: each gets a copy with its own weights.

    Raises:
        FileError: missing, not JSON, another kind of file (a camera, say), or a field that is wrong; it names the path.

    Example:
        >>> load_rig("no-such-file.json")
        Traceback (most recent call last):
        kcal.errors.FileError: no-such-file.json: cannot read: No such file or directory
    """
    return RigFile.load(path).rig(field)


def load_pair(path: str | Path) -> Rig:
    """Read a rig of two cameras, as `load_rig` does.

    Raises:
        FileError: also a rig of any other number.
    """
    file = RigFile.load(path)
    if len(file.names) != 2:
        raise FileError(
            f"{path}: a rig of {len(file.names)} cameras; a rig of two is needed here (kcal locate and kcal show take "
            "both)"
        )
    return file.rig()
