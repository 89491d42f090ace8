"""What the calibration of a camera is asked for, and what it answers."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from kcal.calibrate.bundle.parameters import Rules, natural_value
from kcal.calibrate.camera.outliers import OutlierRejection, RejectedCorner, RejectedView
from kcal.corners.observations import Observations
from kcal.errors import InputError
from kcal.io.camera_file import CameraFile, camera_to_file, provenance
from kcal.lens.calibration import BoardRecord, CalibrationRecord, CameraCalibration, Exclusion
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.solve.lm import LMOptions
from kcal.solve.result import Status
from kcal.solve.robust import RobustLoss


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibrationOptions:
    """Options of `calibrate_camera`.

    Args:
        model: lens model, by name or as a `LensModel`.
        board_warp: estimate how the board bends (two more parameters).
        weighted: let corners count by their covariances where all views have them (`kcal.calibrate.bundle.weights`);
            False minimizes the plain RMS, as OpenCV does.
        loss: a robust loss of each corner's residual in pixels, for data with wrong corners, or None. It is used after
            a plain solution has been found; a scale of some three times the noise is good.
        reject: leave out corners, then views, that noise cannot explain (`kcal.calibrate.camera.outliers`), and list
            them; or None, the default: every corner counts, because a calibration that quietly picks its data reports
            an RMS that cannot be compared with any other, and because what stands out is often the model's fault. A
            warning then tells that corners stand out.
        focal: roughly known focal length in pixels (from EXIF or the field of view), tried first as a start, or None.
        field_of_view: likewise as the image's horizontal field of view in degrees, below 180.
        fixed: parameters held at a value, by name; None as the value means the image's center for cx and cy, and 0 for
            skew and coefficients.
        tied: groups of names whose values are kept equal, as (("fx", "fy"),).
        free: names that are estimated although they are held by default: "skew".
        priors: Gaussian knowledge by name, as {"fx": (1600, 5)}: mean and standard deviation. It counts against the
            corners by their noise, which is taken from the residuals.
        weak_prior: how far a rich lens (with a denominator, prism or tilt) is expected to be from a pinhole: every
            coefficient gets the mean zero and the standard deviation with which its term would shift the outermost
            corner by this share of its radius (by a thirtieth of it for decentering, prism and tilt;
            `kcal.calibrate.bundle.coefficient_prior`). 0.3 hardly changes what the views tell, and keeps rich models
            from what they do not
            tell: one minimum, found fast, with a σ that holds (docs/measured/solver.md has figures). None, the default:
                the
            corners alone decide, as in OpenCV, and their minima are searched for the lowest.
        camera: a known camera: all its parameters are held but those that `free` names, and only the board's poses (and
            its warp) are found, from one view on. Its lens model takes the place of `model`.
        solver: options of the Levenberg-Marquardt solver.
    """

    model: LensModel | str = "opencv5"
    board_warp: bool = False
    weighted: bool = True
    loss: RobustLoss | None = None
    reject: OutlierRejection | None = None
    focal: float | None = None
    field_of_view: float | None = None
    fixed: Mapping[str, float | None] = dataclasses.field(default_factory=dict)
    tied: tuple[tuple[str, ...], ...] = ()
    free: tuple[str, ...] = ()
    priors: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    weak_prior: float | None = None
    camera: Camera | None = None
    solver: LMOptions = dataclasses.field(
        default_factory=lambda: LMOptions(max_iterations=1000, tolerance=1e-12, flatness=2e-6)
    )

    def __post_init__(self) -> None:
        if self.focal is not None and not 0 < self.focal < float("inf"):
            raise InputError(f"CalibrationOptions: focal must be positive pixels, got {self.focal}")
        if self.field_of_view is not None and not 0 < self.field_of_view < 180:
            raise InputError(f"CalibrationOptions: field_of_view must be in (0, 180) degrees, got {self.field_of_view}")
        if self.focal is not None and self.field_of_view is not None:
            raise InputError("CalibrationOptions: focal and field_of_view say the same; give one")
        if self.weak_prior is not None and not 0 < self.weak_prior < float("inf"):
            raise InputError(f"CalibrationOptions: weak_prior must be positive, got {self.weak_prior}")
        if self.camera is not None and self.camera.field is not None:
            raise InputError("CalibrationOptions: a known camera must be parametric, this one has a residual field")
        if self.camera is not None and (self.fixed or self.focal is not None or self.field_of_view is not None):
            raise InputError("CalibrationOptions: a known camera fixes all parameters; name those to free instead")
        fixed = self._of_camera() or {name: 1.0 if value is None else value for name, value in self.fixed.items()}
        Rules(fixed=fixed, tied=self.tied, free=self.free, priors=self.priors).check(self.lens)

    @property
    def lens(self) -> LensModel:
        """The lens model to solve for."""
        return LensModel.named(self.model) if self.camera is None else self.camera.model

    def _of_camera(self) -> dict[str, float]:
        """What the known camera fixes."""
        if self.camera is None:
            return {}
        values = self.camera.params.detach().tolist()
        return {n: value for n, value in zip(self.camera.names, values, strict=True) if n not in self.free}

    def rules(self, size: tuple[int, int]) -> Rules:
        """What is said of the parameters, for an image of (width, height)."""
        values = self._of_camera() or {
            n: natural_value(n, size) if value is None else float(value) for n, value in self.fixed.items()
        }
        return Rules(fixed=values, tied=self.tied, free=self.free, priors=self.priors)

    def start_focal(self, size: tuple[int, int]) -> float | None:
        """The focal length to begin with, if one is hinted at."""
        if self.field_of_view is None:
            return self.focal
        return 0.5 * size[0] / math.tan(0.5 * math.radians(self.field_of_view))


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraCalibrationResult:
    """A calibrated camera and what it rests on.

    Args:
        camera: the camera.
        rms: sqrt(mean ‖r‖²) over all corners, pixels (Eq. 5), plain also where the corners were weighted.
        weighted_rms: likewise of what was minimized, by the corners' weights and under the robust loss; None where all
            corners counted alike.
        per_view_rms: (V,) likewise for each view, in the order of the observations; NaN for a view that was left out.
        residuals: (V, N, 2) projected minus observed, pixels; NaN where a corner was not seen or was left out.
        cam_from_board_rotation: (V, 3, 3); NaN for a view that was left out.
        cam_from_board_translation: (V, 3) meters; likewise.
        board_warp: (2,) meters of bend along x and y, or None if not estimated.
        sigma: name -> standard deviation of each parameter, priors counted; None where the data do not determine it and
            where it was fixed; all None, with a warning, where it cannot be computed. Skew is listed only if the
            options name it.
        covariance: (5 + P, 5 + P) of all parameters in the order of `Camera.names`, poses free: of σ, the square in its
            diagonal. Zero for what was held; what the data leave open has a large variance, which rounding alone limits
            (σ is None there). NaN, but for what was held, where it cannot be computed.
        status: why the solver stopped.
        iterations: trial steps of the solver, all starts and models together.
        warnings: sentences about what the user should doubt.
        observations: what was calibrated.
        fixed: names of the parameters that the options held.
        led_by_prior: names of the parameters of which a prior knows more than the views do: without it their σ would be
            more than 1.4 times as large.
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
    status: Status
    iterations: int
    warnings: tuple[str, ...]
    observations: Observations
    fixed: tuple[str, ...] = ()
    led_by_prior: tuple[str, ...] = ()
    rejected_corners: tuple[RejectedCorner, ...] = ()
    rejected_views: tuple[RejectedView, ...] = ()

    def __post_init__(self) -> None:
        """Give the camera its error bars and history, which it keeps until its parameters change."""
        known = self.covariance if bool(self.covariance.isfinite().all()) else None
        self.camera.calibration = CameraCalibration(sigma=self.sigma, covariance=known, record=self._record())

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
            board=BoardRecord(columns=board.columns, rows=board.rows, square=board.square),
            board_warp=None if warp is None else (float(warp[0]), float(warp[1])),
            stop_reason=self.status.message,
            iterations=self.iterations,
            **provenance(),
        )

    @property
    def rejected_share(self) -> float:
        """Share of all corners that was left out, those of left-out views counted."""
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

    def file(self, *, name: str = "", source: str | None = None) -> CameraFile:
        """The camera with its error bars and history, in the form in which it is stored.

        Args:
            name: free text that tells cameras apart.
            source: name of the observations file, if there is one.
        """
        record = dataclasses.replace(self._record(), observations=source)
        return camera_to_file(self.camera, name=name, calibration=record)

    def save(self, path: str | Path, *, name: str = "", source: str | None = None) -> Path:
        """Write the camera file, with error bars and record; arguments as in `file`.

        Raises:
            FileError: the file cannot be written.
        """
        return self.file(name=name, source=source).save(path)
