"""What the calibration of one camera returns."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.solve.result import SolverStatus


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
        status: why the solver stopped.
        iterations: trial steps of the solver, all starts and models together.
        warnings: what the user should doubt, and what to do about it.
        fixed: names of the parameters that the options held.
        led_by_prior: names of the parameters that a prior determines more than the views do: without it their σ would
            be more than 1.4 times as large.
        rejected_corners: corners of the views that were used, left out by `CalibrationOptions.reject`.
        rejected_views: views left out likewise.
    """

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
    fixed: tuple[str, ...] = ()
    led_by_prior: tuple[str, ...] = ()
    rejected_corners: tuple[RejectedCorner, ...] = ()
    rejected_views: tuple[RejectedView, ...] = ()

    @property
    def rejected_share(self) -> float:
        """Share of all corners that was left out, those of left-out views included."""
        gone = len(self.rejected_corners) + sum(view.corners for view in self.rejected_views)
        used = int(torch.isfinite(self.residuals).all(-1).sum())
        return gone / (gone + used)
