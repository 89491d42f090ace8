"""What a camera or rig is at a glance, stored in its file for readers that cannot compute it.

Derived when the file is written, with a digest of what it was derived from: if a file was changed by hand since, the
digest tells, and `kcal show` computes anew. kcal itself reads nothing else from it.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Self

from kcal.errors import KcalError
from kcal.lens.calibration import CameraCalibration
from kcal.native_file import Record, digest

if TYPE_CHECKING:
    from kcal.lens.camera import Camera
    from kcal.lens.rig import Rig


class CameraSummary(Record):
    """Of one camera.

    Args:
        of: digest of the rest of the file.
        model: the lens model in words.
        board: the board that it was calibrated with, in words.
        focal_length: on the optical axis, with its σ.
        covers_image: whether every pixel has a ray.
        sigma: of each parameter by name; None where it was held, or nothing is known.
        sigma_px: median and largest σ of where the camera sees far points, over the image; None without error bars.
    """

    of: str
    model: str
    board: str | None
    focal_length: str
    covers_image: bool
    sigma: dict[str, float | None]
    sigma_px: tuple[float, float] | None

    @classmethod
    def made(cls, camera: Camera, content: dict[str, Any]) -> Self | None:
        """That of a camera; None where something cannot be derived."""
        try:
            return cls.derived(camera, content)
        except (KcalError, ValueError):
            return None

    @classmethod
    def derived(cls, camera: Camera, content: dict[str, Any]) -> Self:
        """Derive the summary; an error is raised if something cannot be derived."""
        from kcal.lens.uncertainty import paraxial_focal

        record = camera.calibration.record if camera.calibration else None
        return cls(
            of=digest(content), model=str(camera.model), board=None if record is None else str(record.board),
            focal_length=str(paraxial_focal(camera)), covers_image=bool(camera.covers_image()), sigma=sigma_of(camera),
            sigma_px=sigma_over_image(camera),
        )  # fmt: skip


def sigma_of(camera: Camera) -> dict[str, float | None]:
    """σ of each parameter by name; None where it was held, or nothing is known of it."""
    known = camera.calibration
    if known is not None and known.sigma is not None:
        return {name: known.sigma.get(name) for name in camera.names}
    if known is None or known.covariance is None:
        return dict.fromkeys(camera.names)
    variances = known.covariance.diagonal().tolist()
    return {name: _rounded(v**0.5) if v > 0 else None for name, v in zip(camera.names, variances, strict=True)}


def take_joint_errors(rig: Rig) -> None:
    """Give the cameras the error bars of the solved rig, in place of those of their own calibrations."""
    if rig.covariance is None:
        return
    first = 0
    for camera in (rig.left, rig.right):
        size = camera.params.shape[-1]
        half = rig.covariance.half[:, first : first + size]
        known, matrix = camera.calibration or CameraCalibration(), half.T @ half if half.any() else None
        camera.calibration = dataclasses.replace(known, sigma=None, information=None, covariance=matrix)
        first += size


def sigma_over_image(camera: Camera) -> tuple[float, float] | None:
    """Median and largest σ of where the camera sees far points, px; None without error bars."""
    if camera.calibration is None or camera.calibration.covariance is None:
        return None
    from kcal.lens.uncertainty import image_sigma

    spread = image_sigma(camera)
    spread = spread[spread.isfinite()]
    return (_rounded(spread.median()), _rounded(spread.max())) if spread.numel() else None


def _rounded(value: Any) -> float:
    # Six digits: what rounding errors change shall not change the file.
    return float(f"{float(value):.6g}")


class RigSummary(Record):
    """Of the relative pose of a rig of two cameras.

    Args:
        of: digest of the rest of the file, without its cameras.
        cameras: of each camera, with the error bars that the rig has of it.
        baseline_m: distance between the cameras.
        rotation_vector_deg: of the right camera.
        sigma_m: of the translation along x, y, z; None without error bars.
        sigma_deg: of the rotation about x, y, z.
    """

    of: str
    cameras: tuple[CameraSummary | None, ...]
    baseline_m: float
    rotation_vector_deg: tuple[float, float, float]
    sigma_m: tuple[float, float, float] | None
    sigma_deg: tuple[float, float, float] | None

    @classmethod
    def made(cls, rig: Rig, content: dict[str, Any]) -> Self:
        """That of a rig."""
        from kcal.lens.pose import vector_from_rotation

        turn = vector_from_rotation(rig.right_from_left_rotation).rad2deg().tolist()
        errors = None
        if rig.covariance is not None:
            errors = rig.covariance.matrix.diagonal()[-6:].clamp_min(0.0).sqrt().tolist()
        both = copy.deepcopy(rig)
        take_joint_errors(both)
        files = content.get("cameras") or [{}] * len(rig)
        return cls(
            cameras=tuple(CameraSummary.made(*both) for both in zip(both.each, files, strict=True)),
            of=digest({key: value for key, value in content.items() if key != "cameras"}),
            baseline_m=_rounded(rig.baseline),
            rotation_vector_deg=_triple(turn),
            sigma_m=None if errors is None else _triple(errors[3:]),
            sigma_deg=None if errors is None else _triple(map(math.degrees, errors[:3])),
        )


def _triple(values: Iterable[float]) -> tuple[float, float, float]:
    x, y, z = map(_rounded, values)
    return x, y, z
