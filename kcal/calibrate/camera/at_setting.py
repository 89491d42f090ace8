"""A camera at a setting of zoom or focus between those at which its lens was calibrated.

What is interpolated is the image itself: for each pixel of a grid, the ray that it sees and where on the axis that ray
starts, whatever lens models the calibrations have. A lens is fitted to the rays, and errors go the same way: those of
the calibrations, that of the curve between them (`kcal.calibrate.camera.setting_spline`), and that of the motor.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from kcal.calibrate.camera.fitted_lines import FittedLines, LinesSeen
from kcal.calibrate.camera.setting_checks import setting_sigmas, spline_between, usable_information, varied_settings
from kcal.errors import InputError
from kcal.gaussian import triangular
from kcal.lens.calibration import CameraCalibration, LensSetting
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.uncertainty import pixel_covariance

_GRID = (41, 25)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class InterpolatedCamera:
    """A camera between settings, and where its error bars come from.

    Args:
        camera: with its covariance; `camera.calibration.setting` names its sources.
        weights: of the cameras that were given; their sum is 1.
        calibration_px: median over the image of the standard deviation of a far direction that comes from the
            calibrations (as `kcal.lens.projection_sigma`).
        interpolation_px: likewise of the curve between the settings.
        setting_px: likewise of the settings themselves.
        misfit_px: root mean square of what the lens model cannot follow of the interpolated rays; part of the
            covariance.
    """

    camera: Camera
    weights: tuple[float, ...]
    calibration_px: float
    interpolation_px: float
    setting_px: float
    misfit_px: float


def camera_at_setting(
    cameras: Sequence[Camera],
    setting: Mapping[str, float],
    *,
    setting_sigma: Mapping[str, float] | None = None,
    names: Sequence[str] | None = None,
) -> InterpolatedCamera:
    """Interpolate a camera between calibrations of one lens at several settings of its zoom or focus.

    Rays are interpolated by a cubic spline, each pixel by itself. The error of the spline is stated from how the
    calibrations curve (Student's distribution, so few settings give wide error bars), and added to that of the
    calibrations. Where these saw a board of the same kind, its errors count as the same board's. A setting that was
    calibrated gives the calibration itself.

    Args:
        cameras: of the same image size, with their covariance and setting (`CameraCalibration.setting`); one more
            than a line through them needs, so three for one kind of setting, four for two. Five are better.
        setting: name -> number, within the range of the calibrations (for two kinds their convex hull).
        setting_sigma: standard deviation with which the motor comes back to a setting, by name: the lens's position
            now, and also those in which it was calibrated, are that uncertain.
        names: of the cameras, for messages and the record; their own names if not given.

    Raises:
        InputError: a setting outside those that were calibrated, too few of them, two cameras at one setting, or
            cameras that do not fit together.

    Example:
        >>> from kcal.lens import CameraCalibration, LensSetting
        >>> cameras, known = [], torch.diag(torch.tensor([1.0, 1, 1, 1, 0])).double()
        >>> for focus in (0.0, 1.0, 2.0, 3.0, 4.0, 5.0):
        ...     camera = Camera.build(focal=(800 + focus**2,) * 2, center=(320, 240), size=(640, 480), model="pinhole")
        ...     stood = LensSetting(values={"focus": focus})
        ...     camera.calibration = CameraCalibration(covariance=known, setting=stood)
        ...     cameras.append(camera)
        >>> found = camera_at_setting(cameras, {"focus": 2.5})
        >>> [round(float(value), 2) for value in found.camera.focal]
        [806.26, 806.26]
    """
    if not cameras:
        raise InputError("camera_at_setting: no camera")
    names = [_own_name(camera, i) for i, camera in enumerate(cameras)] if names is None else list(names)
    known = [
        usable_information(camera, cameras[0], name, names[0]) for camera, name in zip(cameras, names, strict=True)
    ]
    axes, places = varied_settings(cameras, setting, names)
    at = torch.tensor([float(setting[axis]) for axis in axes], dtype=torch.float64)
    spread = setting_sigmas(axes, setting, setting_sigma or {})
    same = (places == at).all(1).nonzero()[:, 0]
    if len(same) == 1 and not bool(spread.any()):
        return _calibrated(cameras, int(same[0]))
    spline = spline_between(axes, places, at, names)
    weights = spline.weights(at)
    pixels = cameras[0].grid(*_GRID).reshape(-1, 2)
    free = [[i for i, slot in enumerate(one.slots) if slot >= 0] for one in known]
    seen = [LinesSeen.by(camera, pixels, own) for camera, own in zip(cameras, free, strict=True)]
    lines = torch.stack([one.lines for one in seen])
    good = torch.stack([one.valid for one in seen]).all(0)
    nearest = int(weights.argmax())
    between = torch.einsum("i,inc->nc", weights, lines)
    fit = FittedLines.of(cameras[nearest], known[nearest], pixels[good], between[good])

    def by_settings(factors: Tensor) -> Tensor:
        """Changes (K, N, 3) of the lines, from factors (K, n) of those at the settings."""
        return torch.einsum("ki,inc->knc", factors, lines)

    calibrations = []
    alone, boards = zip(*map(_errors, known), strict=True)
    for halves, together in ((alone, False), (boards, _one_board(cameras, boards))):
        parts = [
            weight * one.changes(half[:, own])
            for weight, one, half, own in zip(weights, seen, halves, free, strict=True)
        ]
        calibrations.append(torch.stack(parts).sum(0) if together else torch.cat(parts))
    # The motor is wrong now, and was at each calibration.
    here = [spline.slopes(at), *(weight * spline.slopes(place) for weight, place in zip(weights, places, strict=True))]
    motor = by_settings((torch.cat(here, 1) * spread.repeat(len(here))).T)
    groups = [torch.cat(calibrations), by_settings(spline.errors(at)), motor]
    half = fit.errors(torch.cat(groups)[:, good])
    calibration, curve, setting_error, _ = half.split([*map(len, groups), len(half) - sum(map(len, groups))])
    fit.camera.calibration = CameraCalibration(
        name=_own_name(cameras[0], 0),
        covariance=half.T @ half,
        setting=LensSetting(values=dict(setting), interpolated_from=tuple(names)),
    )
    return InterpolatedCamera(
        camera=fit.camera,
        weights=tuple(weights.tolist()),
        calibration_px=_far_sigma(fit.camera, calibration),
        interpolation_px=_far_sigma(fit.camera, curve),
        setting_px=_far_sigma(fit.camera, setting_error),
        misfit_px=fit.misfit,
    )


def _errors(known: CameraInformation) -> tuple[Tensor, Tensor]:
    """Errors of a camera's parameters, one sigma each: its own (K, 5 + P), and those by its board (B, 5 + P)."""
    count, board = known.lens_size, known.board_size
    half = triangular(known.half().roll(board, 1))
    # Of one sign, so that the same error of a board is the same row for each camera.
    half = torch.where(half.diagonal() < 0, -1.0, 1.0)[:, None] * half
    by_parameter = half[:, board:] @ known.selection()[:, :count].T
    return by_parameter[board:], by_parameter[:board]


def _one_board(cameras: Sequence[Camera], errors: Sequence[Tensor]) -> bool:
    """Whether all cameras may have seen the same board."""
    records = [camera.calibration.record if camera.calibration else None for camera in cameras]
    boards = {None if record is None else record.board for record in records}
    return len(boards) == 1 and len({len(one) for one in errors}) == 1


def _far_sigma(camera: Camera, half: Tensor) -> float:
    if not bool(half.any()):
        return 0.0
    found = pixel_covariance(camera, camera.grid(17, 13).reshape(-1, 2), half.T @ half)
    found = found[found.isfinite().all(-1).all(-1)]
    return float(torch.linalg.eigvalsh(found)[:, -1].clamp_min(0.0).sqrt().median())


def _calibrated(cameras: Sequence[Camera], number: int) -> InterpolatedCamera:
    """A setting that was calibrated."""
    camera = cameras[number]
    known = camera.calibration.known(camera.params.detach()) if camera.calibration else None
    assert known is not None
    return InterpolatedCamera(
        camera=camera,
        weights=tuple(float(i == number) for i in range(len(cameras))),
        calibration_px=_far_sigma(camera, known.by_parameter(known.half())),
        interpolation_px=0.0,
        setting_px=0.0,
        misfit_px=0.0,
    )


def _own_name(camera: Camera, number: int) -> str:
    return (camera.calibration.name if camera.calibration else "") or f"camera {number + 1}"
