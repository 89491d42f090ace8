"""kcal's own rig file: two whole cameras, where the second stands, and how that was found.

JSON, `"kcal": "rig"`, version 1. The cameras are embedded, not referred to: relative yaw of 0.01° is 436 m at 5 km,
so a rig must never be combined with cameras that were solved again after it.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import ClassVar, Literal

import pydantic
import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.files import NativeFile
from kcal.io.camera_file import CameraFile, Exclusion, camera_to_file
from kcal.io.record import Record
from kcal.lens.projection import INTRINSICS
from kcal.lens.rig import StereoRig

Triple = tuple[float, float, float]


class RigPose(Record):
    """`points_right = rotation @ points_left + translation`, meters."""

    rotation: tuple[Triple, Triple, Triple]
    translation: Triple

    @pydantic.model_validator(mode="after")
    def _rigid(self) -> RigPose:
        rotation = self.matrix()
        # As StereoRig asks for; told here so that the error names the file.
        error = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max()
        if not float(error) <= 1e-6 or float(torch.linalg.det(rotation)) < 0:
            raise ValueError("rotation is no rotation matrix (R Rᵀ must be 1 and det R = +1)")
        return self

    def matrix(self) -> Tensor:
        """The rotation, (3, 3) float64."""
        return torch.tensor(self.rotation, dtype=torch.float64)


Matrix = tuple[tuple[float, ...], ...]


def _matrix(value: Matrix, size: int, what: str) -> Tensor:
    if len(value) != size or any(len(row) != size for row in value):
        raise ValueError(f"{what} must be {size} x {size}")
    matrix = torch.tensor(value, dtype=torch.float64)
    scale = matrix.diagonal().clamp_min(0.0).sqrt()
    unit = matrix / torch.where(scale > 0, scale, 1.0)[:, None] / torch.where(scale > 0, scale, 1.0)
    if not torch.allclose(unit, unit.T, atol=1e-9) or float(torch.linalg.eigvalsh(unit)[0]) < -1e-9 * size:
        raise ValueError(f"{what} is no covariance: it must be symmetric without negative eigenvalues")
    return matrix


class RigMounting(Record):
    """Where the left camera stands on the Earth and where it looks.

    Args:
        lat: of its projection center, degrees (WGS84).
        lon: degrees.
        height: meters above the ellipsoid.
        heading_deg: of its axis, clockwise from true north.
        pitch_deg: of its axis, positive up.
        roll_deg: clockwise as seen from behind.
        covariance: (6, 6) of east, north, up of the center (meters) and of turns about these axes (radians).
        link: (P, 6) covariance of the rig's P quantities (`RigFile.covariance`) with these six.
    """

    lat: float = pydantic.Field(ge=-90, le=90)
    lon: float = pydantic.Field(ge=-180, le=180)
    height: float
    heading_deg: float
    pitch_deg: float = pydantic.Field(ge=-90, le=90)
    roll_deg: float
    covariance: Matrix | None = None
    link: Matrix | None = None

    @pydantic.model_validator(mode="after")
    def _square(self) -> RigMounting:
        if self.covariance is not None:
            _matrix(self.covariance, 6, "the mounting's covariance")
        return self


class RigSource(Record):
    """One kind of data that a rig was solved from; see `kcal.calibrate.rig.result.SourceResidual`."""

    name: str
    used: pydantic.NonNegativeInt
    left_out: pydantic.NonNegativeInt
    rms_px: pydantic.NonNegativeFloat | None = None
    rms_m: pydantic.NonNegativeFloat | None = None
    sigmas: pydantic.NonNegativeFloat | None = None


class RigCalibration(Record):
    """How a rig was solved.

    Args:
        rms: sqrt(mean ‖r‖²) over the points of both cameras, pixels.
        rms_left: of the left camera alone.
        rms_right: of the right camera alone.
        pairs: how many pairs of views were used.
        per_pair_rms: pair name -> RMS in pixels, for the pairs used.
        flipped: pairs in which one camera's corner order had to be turned by 180°.
        excluded: pairs, landmarks and matches left out, with the reason.
        sources: what the rig was solved from, where that is more than boards.
        relocked: when only the cameras' attitudes were solved again, and from what.
        baseline_m: distance between the cameras' centers, meters; must be the length of the translation.
        frame: what the rig's frame is.
        kcal_version: the version that calibrated; see `kcal.io.camera_file.provenance`.
        created: when, with its time zone.
    """

    rms: pydantic.NonNegativeFloat
    rms_left: pydantic.NonNegativeFloat
    rms_right: pydantic.NonNegativeFloat
    pairs: pydantic.NonNegativeInt
    per_pair_rms: dict[str, pydantic.NonNegativeFloat]
    flipped: tuple[str, ...] = ()
    excluded: tuple[Exclusion, ...] = ()
    sources: tuple[RigSource, ...] = ()
    relocked: str | None = None
    baseline_m: pydantic.PositiveFloat
    frame: Literal["left camera"] = "left camera"
    kcal_version: str
    created: pydantic.AwareDatetime

    @pydantic.model_validator(mode="after")
    def _counted(self) -> RigCalibration:
        if self.pairs != len(self.per_pair_rms):
            raise ValueError(f"pairs is {self.pairs}, but per_pair_rms has {len(self.per_pair_rms)}")
        return self


class RigFile(NativeFile):
    """A stereo rig (file kind `rig`, version 1).

    Args:
        left: the first camera, whole; its frame is the rig's.
        right: the second camera, whole.
        right_from_left: where the right camera stands.
        covariance: of both cameras' parameters and the relative pose together, in the order of
            `kcal.locate.covariances.RigCovariance`; what was held has zeros.
        mounting: where the rig stands on the Earth, if that was solved.
        calibration: how the rig was solved, if it was.

    Example:
        >>> from kcal.lens.camera import Camera
        >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080))
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> float(rig_to_file(rig).rig().baseline)
        10.0
    """

    KIND: ClassVar[str] = "rig"
    VERSION: ClassVar[int] = 1

    left: CameraFile
    right: CameraFile
    right_from_left: RigPose
    covariance: Matrix | None = None
    mounting: RigMounting | None = None
    calibration: RigCalibration | None = None

    @pydantic.model_validator(mode="after")
    def _measured(self) -> RigFile:
        if self.covariance is not None:
            counts = (len(self.left.coefficients), len(self.right.coefficients))
            matrix = _matrix(self.covariance, sum(counts) + 2 * len(INTRINSICS) + 6, "the rig's covariance")
            if self.mounting is not None and self.mounting.link is not None:
                link, stands = self.mounting.link, self.mounting.covariance
                if stands is None or len(link) != len(matrix) or any(len(row) != 6 for row in link):
                    raise ValueError(f"the mounting's link must be {len(matrix)} x 6, beside a covariance")
                cross = torch.tensor(link, dtype=torch.float64)
                below = torch.cat([cross.T, torch.tensor(stands, dtype=torch.float64)], 1)
                whole = torch.cat([torch.cat([matrix, cross], 1), below])
                _matrix(tuple(map(tuple, whole.tolist())), len(whole), "rig and mounting together")
        elif self.mounting is not None and self.mounting.link is not None:
            raise ValueError("the mounting's link needs the rig's covariance")
        length = math.hypot(*self.right_from_left.translation)
        # A thousandth of a millimeter in a meter: more is not rounding but another rig.
        if self.calibration and not math.isclose(self.calibration.baseline_m, length, rel_tol=1e-6):
            raise ValueError(f"baseline_m is {self.calibration.baseline_m:g}, but the translation is {length:g} m long")
        return self

    def joint_covariance(self) -> Tensor | None:
        """The stored covariance, float64."""
        return None if self.covariance is None else torch.tensor(self.covariance, dtype=torch.float64)

    def rig(self) -> StereoRig:
        """The rig, equal to the stored one to the last bit."""
        pose = self.right_from_left
        translation = torch.tensor(pose.translation, dtype=torch.float64)
        return StereoRig(self.left.camera(), self.right.camera(), pose.matrix(), translation)


def rig_to_file(
    rig: StereoRig,
    *,
    left: CameraFile | None = None,
    right: CameraFile | None = None,
    covariance: Tensor | None = None,
    mounting: RigMounting | None = None,
    calibration: RigCalibration | None = None,
) -> RigFile:
    """Put a rig in the form in which it is stored.

    Args:
        rig: the rig.
        left: the left camera's file, to keep its name, error bars and record; it must hold the same camera.
        right: likewise for the right camera.
        covariance: see `RigFile`.
        mounting: see `RigFile`.
        calibration: how the rig was solved.

    Raises:
        InputError: a camera file that holds another camera than the rig, or values that do not fit together.

    Example:
        >>> from kcal.lens.camera import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> rig_to_file(rig).right_from_left.translation
        (-1.0, 0.0, 0.0)
    """
    for name, file, camera in (("left", left, rig.left), ("right", right, rig.right)):
        if file is not None and file.camera().fingerprint != camera.fingerprint:
            raise InputError(f"the {name} camera file holds another camera than the rig; pass the file it came from")
    try:
        return RigFile(
            left=left or camera_to_file(rig.left, name="left"),
            right=right or camera_to_file(rig.right, name="right"),
            right_from_left=RigPose.model_validate(
                {
                    "rotation": rig.right_from_left_rotation.tolist(),
                    "translation": rig.right_from_left_translation.tolist(),
                }
            ),
            covariance=None if covariance is None else tuple(map(tuple, covariance.tolist())),
            mounting=mounting,
            calibration=calibration,
        )
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"this rig cannot be stored: {first['msg']}") from error


def save_rig(rig: StereoRig, path: str | Path) -> Path:
    """Write a rig without its calibration record; `rig_to_file(...).save(path)` writes one with it.

    Raises:
        InputError: see `rig_to_file`.
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> from kcal.lens.camera import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     float(load_rig(save_rig(rig, Path(folder, "rig.json"))).baseline)
        1.0
    """
    return rig_to_file(rig).save(path)


def load_rig(path: str | Path) -> StereoRig:
    """Read the rig of a kcal rig file.

    Raises:
        FileError: missing, not JSON, another kind of file (a camera, say), or a field that is wrong; it names the path.

    Example:
        >>> load_rig("no-such-file.json")
        Traceback (most recent call last):
        kcal.errors.FileError: no-such-file.json: cannot read: No such file or directory
    """
    return RigFile.load(path).rig()
