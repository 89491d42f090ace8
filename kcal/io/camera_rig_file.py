"""kcal's rig file of any number of cameras: each camera whole, where it stands, and what is known of all together.

JSON, `"kcal": "rig"`, version 3. Two cameras are stored as `kcal.io.rig_file` has them (version 2), which maps of
pairs read too.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import pydantic
import torch
from torch import nn

from kcal.dispatch import still
from kcal.file_kind import CAMERA_RIG_VERSION
from kcal.io.camera_file import CameraFile, named_camera_file
from kcal.io.record import Packed
from kcal.lens.rig import CameraRig, CameraRigCalibration, Origin
from kcal.native_file import NativeFile, Record, storing

Triple = tuple[float, float, float]


class StationPose(Record):
    """`points_cam = rotation @ (points - center)`, meters, in the rig's frame."""

    rotation: tuple[Triple, Triple, Triple]
    center: Triple


class FrameOrigin(Record):
    """Where the frame is anchored: degrees, meters above the WGS84 ellipsoid."""

    lat: float = pydantic.Field(ge=-90, le=90)
    lon: float = pydantic.Field(ge=-180, le=180)
    height: float


class CameraRigFile(NativeFile):
    """A rig of any number of cameras (file kind `rig`, version 3).

    Args:
        names: of the cameras.
        cameras: whole.
        poses: where they stand.
        origin: of the frame, east, north, up; None: the first camera's frame.
        refraction: coefficient.
        root: (K, P) as `CameraRig.root`.
        calibration: how the rig was solved, if it was.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = CameraRig([camera] * 3, ["a", "b", "c"], torch.eye(3).repeat(3, 1, 1), torch.eye(3))
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

    def rig(self, field: nn.Module | None = None) -> CameraRig:
        """The rig, equal to the stored one to the last bit; `field` as for `kcal.load_rig`."""
        rig = CameraRig(
            [file.camera(field) for file in self.cameras],
            self.names,
            torch.tensor([pose.rotation for pose in self.poses], dtype=torch.float64).reshape(-1, 3, 3),
            torch.tensor([pose.center for pose in self.poses], dtype=torch.float64).reshape(-1, 3),
            origin=None if self.origin is None else Origin(**self.origin.model_dump()),
            refraction=self.refraction,
        )
        rig.root = None if self.root is None else self.root.tensor()
        rig.calibration = self.calibration
        return rig


def camera_rig_to_file(rig: CameraRig) -> CameraRigFile:
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
                StationPose.model_validate({"rotation": turn, "center": center})
                for turn, center in zip(rig.rotation.tolist(), rig.center.tolist(), strict=True)
            ),
            origin=None if origin is None else FrameOrigin(lat=origin.lat, lon=origin.lon, height=origin.height),
            refraction=float(rig.refraction),
            root=None if root is None else Packed.of(root),
            calibration=rig.calibration,
        )


def save_camera_rig(rig: CameraRig, path: str | Path) -> Path:
    """Write a rig of any number of cameras with all that is known of it.

    Raises:
        InputError: see `camera_rig_to_file`.
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = CameraRig([camera], ["tower"], torch.eye(3)[None], torch.zeros(1, 3))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     CameraRigFile.load(save_camera_rig(rig, Path(folder, "rig.json"))).names
        ('tower',)
    """
    return camera_rig_to_file(rig).save(path)
