"""What the calibration of one camera returns."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from kcal.calibrate.hybrid.fit import HybridFit
from kcal.calibrate.hybrid.measured_board import MeasuredBoard
from kcal.calibrate.problem.state import warp_modes
from kcal.calibrate.problem.views import among
from kcal.corners.observations import Observations
from kcal.io.camera_file import CameraFile, camera_to_file, provenance
from kcal.lens.calibration import CalibrationRecord, CameraCalibration, Exclusion, LensSetting
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.solve.result import SolverStatus
from kcal.texts import brief


@dataclasses.dataclass(frozen=True, kw_only=True)
class RejectedCorner:
    """A corner that was left out.

    Args:
        view: name of its view.
        corner: its index on the board.
        residual: pixels between it and its projection by the camera that was calibrated without it.
        reason: one sentence.
    """

    view: str
    corner: int
    residual: float
    reason: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class RejectedView:
    """A view that was left out.

    Args:
        view: its name.
        corners: how many corners it had.
        residual: its RMS in pixels when it was last part of the calibration, without corners left out before.
        reason: one sentence.
    """

    view: str
    corners: int
    residual: float
    reason: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class SharedBoard:
    """That a camera shared its board with others with which it was calibrated.

    Args:
        others: their places among the cameras, from 0.
        evidence: nats by which one board for all is better than another one for this camera.
    """

    others: tuple[int, ...]
    evidence: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraCalibrationResult:
    """A calibrated camera with its residuals and error bars.

    Args:
        camera: the camera.
        rms: sqrt(mean ‖r‖²) over all corners, pixels (Eq. 5), plain also where the corners were weighted.
        weighted_rms: likewise of what was minimized, with the corners' weights and the robust loss; None where all
            corners counted alike.
        per_view_rms: (V,) likewise for each view, in the order of the observations; NaN for a view that was left out.
        residuals: (V, N, 2) projected minus observed, pixels; NaN where a corner was not seen or was left out.
        cam_from_board_rotation: (V, 3, 3); NaN for a view that was left out.
        cam_from_board_translation: (V, 3) meters; likewise.
        board_warp: (2,) meters of bend along x and y, or None if not estimated.
        sigma: name -> standard deviation of each parameter, priors included. None where the data do not determine it
            and where it was fixed; all None, with a warning, where it cannot be computed. Skew is listed only if the
            options name it.
        covariance: (5 + P, 5 + P) of all parameters in the order of `Camera.names`, poses free; its diagonal is σ².
            Zero for what was held. What the data leave open has a large variance, which only rounding limits (σ is None
            there). NaN, except for what was held, where it cannot be computed.
        information: the same before anything was inverted, with which a rig refines the camera; None where it cannot be
            computed and where nothing was estimated.
        status: why the solver stopped.
        iterations: trial steps of the solver, all starts and models together.
        warnings: what the user should doubt, and what to do about it.
        observations: what was calibrated from.
        hybrid: how the hybrid lens and the board were fitted: noise, tempering, board; None for parametric models.
        advice: what to photograph next, the most useful first.
        fixed: names of the parameters that the options held.
        led_by_prior: names of the parameters that a prior determines more than the views do: without it their σ would
            be more than 1.4 times as large.
        rejected_corners: corners of the views that were used, left out by `CalibrationOptions.reject`.
        rejected_views: views left out likewise, and copies of other views.
        shared_board: which cameras helped to measure the board, where several were calibrated together. Errors of such
            cameras are not quite independent of each other; a rig of them knows that.
    """

    __repr__ = brief

    camera: Camera
    rms: float
    weighted_rms: float | None
    per_view_rms: Tensor
    residuals: Tensor
    cam_from_board_rotation: Tensor
    cam_from_board_translation: Tensor
    board_warp: Tensor | None
    sigma: dict[str, float | None]
    covariance: Tensor
    status: SolverStatus
    iterations: int
    warnings: tuple[str, ...]
    observations: Observations
    information: CameraInformation | None = None
    hybrid: HybridFit | None = None
    advice: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    led_by_prior: tuple[str, ...] = ()
    rejected_corners: tuple[RejectedCorner, ...] = ()
    rejected_views: tuple[RejectedView, ...] = ()
    shared_board: SharedBoard | None = None

    def __post_init__(self) -> None:
        """Give the camera its error bars and history, which it keeps until its parameters change."""
        self.camera.calibration = CameraCalibration(
            sigma=self.sigma, information=self.information, record=self._record()
        )

    def among(self, views: Sequence[int], observations: Observations) -> CameraCalibrationResult:
        """This result of some views as one of all `observations`: NaN for the others."""
        count = len(observations.views)
        return dataclasses.replace(
            self,
            observations=observations,
            per_view_rms=among(self.per_view_rms, views, count),
            residuals=among(self.residuals, views, count),
            cam_from_board_rotation=among(self.cam_from_board_rotation, views, count),
            cam_from_board_translation=among(self.cam_from_board_translation, views, count),
            hybrid=None if self.hybrid is None else self.hybrid.among(views, count),
        )

    def _record(self) -> CalibrationRecord:
        board, warp = self.observations.board, self.board_warp
        per_view = zip(self.observations.names, self.per_view_rms.tolist(), strict=True)
        used = {view: rms for view, rms in per_view if not math.isnan(rms)}
        return CalibrationRecord(
            rms=self.rms,
            views=len(used),
            points=int(self.residuals[..., 0].isfinite().sum()),
            per_view_rms=used,
            excluded=self.excluded,
            board=board.record,
            board_warp=None if warp is None else (float(warp[0]), float(warp[1])),
            stop_reason=self.status.message,
            iterations=self.iterations,
            noise=self.noise,
            tempering=None if self.hybrid is None else self.hybrid.tempering,
            board_deviation=self._board_deviation(),
            warnings=self.warnings,
            **provenance(),
        )

    def _board_deviation(self) -> tuple[tuple[float, float, float], ...] | None:
        """As `CalibrationRecord.board_deviation`."""
        if self.hybrid is None and self.board_warp is None:
            return None
        moved = self.board_points - self.observations.board.points
        return tuple((x, y, z) for x, y, z in moved.tolist())

    @property
    def board_points(self) -> Tensor:
        """(N, 3) meters: the board's corners as the views show them."""
        if self.hybrid is not None:
            return self.hybrid.board_points
        points = self.observations.board.points.clone()
        if self.board_warp is not None:
            points[:, 2] = self.board_warp @ warp_modes(points)[:, 2]
        return points

    @property
    def measured_board(self) -> MeasuredBoard | None:
        """The board that the hybrid camera saw, with its covariance, to be used as known; None for parametric models.

        Its evidence against a board that is exactly as ordered is not computed here (`measure_board` does).
        """
        if self.hybrid is None:
            return None
        own = self.hybrid.half[:, -len(self.hybrid.state.board) :]
        return MeasuredBoard(
            name="",
            board=self.observations.board,
            amplitudes=self.hybrid.state.board,
            half=torch.linalg.qr(own, mode="r").R,
            log_evidence=0.0,
        )

    @property
    def noise(self) -> float:
        """Pixels of a corner along an axis, from the residuals and without what the fit takes up."""
        if self.hybrid is not None:
            return self.hybrid.sigma / math.sqrt(self.hybrid.tempering)
        used = int(self.residuals[..., 0].isfinite().sum())
        views = int(self.per_view_rms.isfinite().sum())
        free = sum(value is not None for value in self.sigma.values()) + (0 if self.board_warp is None else 2)
        return self.rms * math.sqrt(used / max(2 * used - 6 * views - free, 1))

    @property
    def rejected_share(self) -> float:
        """Share of all corners that was left out, those of left-out views included."""
        gone = len(self.rejected_corners) + sum(view.corners for view in self.rejected_views)
        used = int(torch.isfinite(self.residuals).all(-1).sum())
        return gone / (gone + used)

    @property
    def excluded(self) -> tuple[Exclusion, ...]:
        """Views, then single corners, that were left out, each with its reason."""
        return (
            *(Exclusion(name=view.view, reason=view.reason) for view in self.rejected_views),
            *(Exclusion(name=f"{c.view} corner {c.corner}", reason=c.reason) for c in self.rejected_corners),
        )

    def file(
        self,
        *,
        name: str = "",
        source: str | None = None,
        temperature: float | None = None,
        setting: LensSetting | None = None,
    ) -> CameraFile:
        """The camera with its error bars and history, in the form in which it is stored.

        Args:
            name: free text that tells cameras apart.
            source: name of the observations file, if there is one.
            temperature: of the camera when the views were taken, °C, if it is known.
            setting: where zoom and focus of the lens stood, if they can move.
        """
        record = dataclasses.replace(self._record(), observations=source, temperature=temperature)
        return camera_to_file(self.camera, name=name, calibration=record, setting=setting)

    def save(
        self,
        path: str | Path,
        *,
        name: str = "",
        source: str | None = None,
        temperature: float | None = None,
        setting: LensSetting | None = None,
    ) -> Path:
        """Write the camera file, with error bars and record; arguments as in `file`.

        Raises:
            FileError: the file cannot be written.
        """
        return self.file(name=name, source=source, temperature=temperature, setting=setting).save(path)
