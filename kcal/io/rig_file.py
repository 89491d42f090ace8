"""kcal's own rig files: whole cameras, where they stand, and how that was found.

JSON, `"kcal": "rig"`. Two cameras are version 2, which maps of pairs read too; any other number is version 3. The
cameras are embedded, not referred to: relative yaw of 0.01° is 436 m at 5 km, so a rig must never be combined with
cameras that were solved again after it.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any, ClassVar, Self

import pydantic
import torch
from torch import Tensor, nn

from kcal.checks import as_covariance, require_root
from kcal.dispatch import still
from kcal.errors import FileError
from kcal.file_kind import CAMERA_RIG_VERSION
from kcal.io.camera_file import CameraFile, named_camera_file
from kcal.io.file_summary import RigSummary
from kcal.io.record import Packed
from kcal.lens.calibration import RigCalibration
from kcal.lens.projection import INTRINSICS
from kcal.lens.rig import CameraRigCalibration, Mounting, Origin, Rig, RigCovariance
from kcal.native_file import NativeFile, Record, storing

Triple = tuple[float, float, float]


class RigPose(Record):
    """`points_right = rotation @ points_left + translation`, meters."""

    rotation: tuple[Triple, Triple, Triple]
    translation: Triple

    @pydantic.model_validator(mode="after")
    def _rigid(self) -> RigPose:
        rotation = self.matrix()
        # As in Rig; checked here so that the error names the file.
        error = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max()
        if not float(error) <= 1e-6 or float(torch.linalg.det(rotation)) < 0:
            raise ValueError("rotation is no rotation matrix (R Rᵀ must be 1 and det R = +1)")
        return self

    def matrix(self) -> Tensor:
        """The rotation, (3, 3) float64."""
        return torch.tensor(self.rotation, dtype=torch.float64)


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
        covariance: (6, 6) of east, north, up of the center (meters) and of turns about these axes (radians), or (7, 7)
            with the coefficient of refraction.
        link: (P, 6) or (P, 7) covariance of the rig's P quantities (`RigFile.covariance`) with these.
        refraction: the coefficient, if anything was found of it.
    """

    heading_deg: float
    pitch_deg: float = pydantic.Field(ge=-90, le=90)
    roll_deg: float
    covariance: Matrix | None = None
    link: Matrix | None = None
    refraction: float | None = pydantic.Field(default=None, ge=-2, le=2)

    @pydantic.model_validator(mode="after")
    def _square(self) -> RigMounting:
        if self.covariance is not None:
            size = 7 if len(self.covariance) == 7 else 6
            matrix = _tensor(self.covariance, size, size, "the mounting's covariance")
            as_covariance("the mounting's covariance", matrix, size)
            if self.link is not None:
                _tensor(self.link, len(self.link), size, "the mounting's link")
        self.mounting()
        return self

    @classmethod
    def of(cls, mounting: Mounting) -> RigMounting:
        """In the form in which it is stored."""
        own = {name: getattr(mounting, name) for name in cls.model_fields if hasattr(mounting, name)}
        return cls(**dataclasses.asdict(mounting.origin), **own)

    def mounting(self) -> Mounting:
        """As `Rig.mounting`."""
        content: dict[str, Any] = dict(self)
        origin = Origin(**{name: content.pop(name) for name in FrameOrigin.model_fields})
        for name in ("covariance", "link"):
            if content[name] is not None:
                content[name] = torch.tensor(content[name], dtype=torch.float64)
        return Mounting(origin=origin, **content)


class RigFile(NativeFile):
    """A stereo rig (file kind `rig`, version 2).

    Args:
        left: the first camera, whole; its frame is the rig's.
        right: the second camera, whole.
        right_from_left: where the right camera stands.
        covariance: always None; files of version 1 had the matrix.
        half: (K, P) root of the covariance of both cameras' parameters and the relative pose together, in the order of
            `RigCovariance`: halfᵀ half is the covariance; what was held has zeros.
        mounting: where the rig stands on the Earth, if that was solved.
        calibration: how the rig was solved, if it was.
        summary: what `kcal show` prints of the relative pose without computing.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080))
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> float(rig_to_file(rig).rig().baseline)
        10.0
    """

    KIND: ClassVar[str] = "rig"
    VERSION: ClassVar[int] = 2

    left: CameraFile
    right: CameraFile
    right_from_left: RigPose
    covariance: None = None
    half: Packed | None = None
    mounting: RigMounting | None = None
    calibration: RigCalibration | None = None
    summary: RigSummary | None = None

    @pydantic.model_validator(mode="after")
    def _measured(self) -> RigFile:
        link = None if self.mounting is None else self.mounting.link
        size = len(self.left.coefficients) + len(self.right.coefficients) + 2 * len(INTRINSICS) + 6
        if self.half is not None:
            require_root("half", self.half.tensor(), size)
        known = self.known()
        if link is not None:
            if known is None:
                raise ValueError("the mounting's link needs the rig's covariance")
            if self.mounting is None or self.mounting.covariance is None:
                raise ValueError("the mounting's link needs the mounting's covariance")
            mounted = torch.tensor(self.mounting.covariance, dtype=torch.float64)
            known.checked_link(mounted, _tensor(link, size, len(mounted), "the mounting's link"))
        length = math.hypot(*self.right_from_left.translation)
        # A thousandth of a millimeter in a meter: more is not rounding but another rig.
        if self.calibration and not math.isclose(self.calibration.baseline_m, length, rel_tol=1e-6):
            raise ValueError(f"baseline_m is {self.calibration.baseline_m:g}, but the translation is {length:g} m long")
        return self

    @classmethod
    def parse(cls, content: Any, source: str) -> Self:
        """See `NativeFile.parse`."""
        head = (content.get("kcal"), content.get("version")) if isinstance(content, dict) else None
        if head == (cls.KIND, CAMERA_RIG_VERSION):
            many = len(content["names"]) if isinstance(content.get("names"), list) else "many"
            raise FileError(
                f"{source}: a rig of {many} cameras; a rig of two is needed here (kcal locate and kcal show take both)"
            )
        return super().parse(content, source)

    def known(self) -> RigCovariance | None:
        """The stored covariance."""
        return None if self.half is None else RigCovariance(half=self.half.tensor())

    def rig(self, field: nn.Module | None = None) -> Rig:
        """The rig, equal to the stored one to the last bit, with its covariance, mounting and calibration.

        `field` as for `load_rig`.
        """
        pose = self.right_from_left
        translation = torch.tensor(pose.translation, dtype=torch.float64)
        rig = Rig.pair(self.left.camera(field), self.right.camera(field), pose.matrix(), translation)
        rig.covariance = self.known()
        rig.mounting = None if self.mounting is None else self.mounting.mounting()
        rig.calibration = self.calibration
        return rig


def rig_to_file(rig: Rig) -> RigFile:
    """Put a rig, with all that is known of it and of its cameras, in the form in which it is stored.

    Raises:
        InputError: values that do not fit together.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> rig_to_file(rig).right_from_left.translation
        (-1.0, 0.0, 0.0)
    """
    rig = still(rig)
    covariance, mounting = rig.covariance, rig.mounting
    pose: Any = {"rotation": rig.right_from_left_rotation, "translation": rig.right_from_left_translation}
    with storing("rig"):
        file = RigFile(
            left=named_camera_file(rig.left, "left"),
            right=named_camera_file(rig.right, "right"),
            right_from_left=RigPose(**pose),
            half=None if covariance is None else Packed.of(covariance.half),
            mounting=None if mounting is None else RigMounting.of(mounting),
            calibration=rig.calibration,
        )
    return file.model_copy(update={"summary": RigSummary.made(rig, file.model_dump(mode="json"))})


def save_rig(rig: Rig, path: str | Path) -> Path:
    """Write a rig with both cameras and all that is known of them: covariances, mounting and how they were calibrated.

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
    """Read the rig of a kcal rig file, with its covariance, mounting and calibration, and those of its cameras.

    `field` as for `kcal.load_camera`, for both cameras: each gets a copy with its own weights.

    Raises:
        FileError: missing, not JSON, another kind of file (a camera, say), or a field that is wrong; it names the path.

    Example:
        >>> load_rig("no-such-file.json")
        Traceback (most recent call last):
        kcal.errors.FileError: no-such-file.json: cannot read: No such file or directory
    """
    return RigFile.load(path).rig(field)


# Any number of cameras.


class StationPose(Record):
    """`points_cam = rotation @ (points - center)`, meters, in the rig's frame."""

    rotation: tuple[Triple, Triple, Triple]
    center: Triple


class CameraRigFile(NativeFile):
    """A rig of any number of cameras (file kind `rig`, version 3).

    Args:
        names: of the cameras.
        cameras: whole.
        poses: where they stand.
        origin: of the frame, east, north, up; None: the first camera's frame.
        refraction: coefficient.
        root: (K, P) as `Rig.root`.
        calibration: how the rig was solved, if it was.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = Rig([camera] * 3, ["a", "b", "c"], torch.eye(3).repeat(3, 1, 1), center=torch.eye(3))
        >>> camera_rig_to_file(rig).rig().names
        ('a', 'b', 'c')
    """

    KIND: ClassVar[str] = "rig"
    VERSION: ClassVar[int] = CAMERA_RIG_VERSION

    names: tuple[str, ...]
    cameras: tuple[CameraFile, ...]
    poses: tuple[StationPose, ...]
    origin: FrameOrigin | None = None
    refraction: float = pydantic.Field(default=0.0, ge=-2, le=2)
    root: Packed | None = None
    calibration: CameraRigCalibration | None = None

    @pydantic.model_validator(mode="after")
    def _fitting(self) -> CameraRigFile:
        if not len(self.names) == len(self.cameras) == len(self.poses):
            raise ValueError(f"{len(self.names)} names, {len(self.cameras)} cameras and {len(self.poses)} poses")
        if all(file.model.complete for file in self.cameras):
            self.rig()
        return self

    def rig(self, field: nn.Module | None = None) -> Rig:
        """The rig, equal to the stored one to the last bit; `field` as for `kcal.load_rig`."""
        rig = Rig(
            [file.camera(field) for file in self.cameras],
            self.names,
            torch.tensor([pose.rotation for pose in self.poses], dtype=torch.float64).reshape(-1, 3, 3),
            center=torch.tensor([pose.center for pose in self.poses], dtype=torch.float64).reshape(-1, 3),
            origin=None if self.origin is None else Origin(**dict(self.origin)),
            refraction=self.refraction,
        )
        rig.root = None if self.root is None else self.root.tensor()
        rig.calibration = self.calibration
        return rig


def camera_rig_to_file(rig: Rig) -> CameraRigFile:
    """Put a rig, with all that is known of it and of its cameras, in the form in which it is stored.

    Raises:
        InputError: values that do not fit together.
    """
    rig = still(rig)
    root, origin = rig.root, rig.origin
    with storing("rig"):
        return CameraRigFile(
            names=rig.names,
            cameras=tuple(named_camera_file(camera, name) for camera, name in zip(rig.each, rig.names, strict=True)),
            poses=tuple(
                StationPose(rotation=turn, center=at) for turn, at in zip(rig.rotation, rig.center, strict=True)
            ),
            origin=None if origin is None else FrameOrigin(**dataclasses.asdict(origin)),
            refraction=float(rig.refraction),
            root=None if root is None else Packed.of(root),
            calibration=rig.calibration,
        )


def save_camera_rig(rig: Rig, path: str | Path) -> Path:
    """Write a rig of any number of cameras with all that is known of it.

    Raises:
        InputError: see `camera_rig_to_file`.
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = Rig([camera], ["tower"], torch.eye(3)[None], center=torch.zeros(1, 3))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     CameraRigFile.load(save_camera_rig(rig, Path(folder, "rig.json"))).names
        ('tower',)
    """
    return camera_rig_to_file(rig).save(path)
