"""Options of a camera's calibration, and what it returns."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from kcal.arrow import ArrowRows
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit
from kcal.calibrate.hybrid.measured_board import MeasuredBoard
from kcal.calibrate.hybrid.network_fit import FieldTraining
from kcal.calibrate.problem.parameters import ParameterConstraints, natural_value
from kcal.calibrate.problem.state import warp_modes
from kcal.calibrate.problem.views import among
from kcal.corners.observations import Observations
from kcal.doors import shown_in_notebooks
from kcal.errors import InputError
from kcal.finding import Finding, sentences
from kcal.io.camera_file import CameraFile, camera_to_file, provenance
from kcal.lens.calibration import CalibrationRecord, CameraCalibration, Exclusion, LensSetting
from kcal.lens.camera import Camera
from kcal.lens.field_modes import FieldModes, NetworkModes
from kcal.lens.information import CameraInformation
from kcal.lens.model import LensModel
from kcal.solve.lm import LMOptions, RobustLoss, SolverStatus
from kcal.texts import brief

# Options of a camera's calibration.

Progress = Callable[[str], None]
HYBRID = "hybrid"
NETWORK = "network"
# Features of the small network.
_UNITS = 40
# Of rich parametric models.
_WEAK = 0.3
_TRAINING = FieldTraining()
_SOLVER = LMOptions(max_iterations=1000, tolerance=1e-12, flatness=2e-6)
# Degrees across the image from which lenses are nearer to an equidistant image than to a perspective one.
_WIDE = 90.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class OutlierRejection:
    """Leave out corners and views that noise cannot explain.

    Args:
        limit: greatest share of all corners that may be left out, those of left-out views included. Beyond it the
            calibration is refused, because the data or the model are wrong as a whole.
    """

    limit: float = 0.1

    def __post_init__(self) -> None:
        if not 0 < self.limit < 0.5:
            raise InputError(f"OutlierRejection: limit must be between 0 and 0.5, got {self.limit}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibrationOptions:
    """Options of `calibrate_camera`.

    Args:
        model: "hybrid", the default: a lens that fits any camera, whose amplitudes, entrance pupil and board the views
            themselves determine (`kcal.calibrate.camera.hybrid`). "network": the same lens with a small network as its
            residual field. Or a parametric lens model, by name or as a `LensModel`, for exchange with other programs.
        field: a network of your own as residual field of the hybrid lens: any `nn.Module` from places (N, 2) on the
            unit disc to corrections (N, 2). It stays as it is; the camera has a trained copy (`camera.field`).
        training: how the network is trained; None: only its last layer is.
        board: "printed", the default: bending and print errors of the board are estimated with a hybrid lens. "exact":
            the board is a metrology plate. Or a `MeasuredBoard` (`measure_board`, `kcal board measure`), which is used
            as known, with what is not known of it.
        motion: with the hybrid lens, views may move while their rows are read, as with a rolling shutter and a board or
            camera that is held by hand; the views tell how much. False: nothing moved, or all rows were read at once.
        bending: with the hybrid lens, the board may bend by another amount in each view, where the evidence of the
            views says so, as paper does that a hand holds. False: it has one shape in all of them.
        board_warp: with a parametric model, estimate how the board bends (two more parameters).
        weighted: weight corners by their covariances where all views have them (`kcal.calibrate.problem.views`);
            False minimizes the plain RMS, as OpenCV does.
        loss: a robust loss of each corner's residual in pixels, for data with wrong corners, or None. It is used after
            a plain solution has been found; choose a scale of about three times the noise.
        reject: leave out corners, then views, that noise cannot explain (`kcal.calibrate.camera.checks`), and list
            them. None, the default: every corner counts, and a warning reports outliers. A calibration that quietly
            selects its data has an RMS that cannot be compared with others, and outliers are often the model's fault.
        focal: roughly known focal length in pixels (from EXIF or the field of view), tried first as a start, or None.
        field_of_view: likewise as the image's horizontal field of view in degrees: below 180 for a perspective lens
            model, below 360 for the hybrid lens and a fisheye. From 90 degrees on, these two begin with an equidistant
            image, of focal length width / angle.
        fixed: parameters held at a value, by name; None as the value means the image's center for cx and cy, and 0 for
            skew and coefficients.
        tied: groups of names whose values are kept equal, as (("fx", "fy"),).
        free: names that are estimated although they are held by default: "skew".
        priors: Gaussian priors by name, as {"fx": (1600, 5)}: mean and standard deviation. They count in proportion to
            the corners' noise, which is estimated from the residuals.
        weak_prior: with a parametric model, how far a rich lens (with a denominator, prism or tilt) is expected to be
            from a pinhole. Every coefficient gets a prior with mean zero, and with the standard deviation at which its
            term would shift the outermost corner by this share of its radius (a thirtieth of it for decentering, prism
            and tilt; `kcal.calibrate.problem.parameters`). 0.3, the default, hardly changes what the views
            determine, and leaves rich models a single minimum, found quickly, with a reliable σ
            (docs/measured/solver.md has figures). None: the corners alone decide, as in OpenCV; of the minima next to
            that of the prior and next to a lens without distortion the lower one is taken.
        camera: a known camera, whose parameters are held except those that `free` names. Only the board's poses (and
            its warp) are found; one view is enough. Its lens model takes the place of `model`.
        solver: options of the Levenberg-Marquardt solver, with a parametric model.
    """

    __repr__ = brief

    model: LensModel | str = HYBRID
    field: nn.Module | None = None
    training: FieldTraining | None = _TRAINING
    board: Literal["printed", "exact"] | MeasuredBoard = "printed"
    motion: bool = True
    bending: bool = True
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
    weak_prior: float | None = _WEAK
    camera: Camera | None = None
    solver: LMOptions = _SOLVER

    def __post_init__(self) -> None:
        if self.focal is not None and not 0 < self.focal < float("inf"):
            raise InputError(f"CalibrationOptions: focal must be positive pixels, got {self.focal}")
        if self.field_of_view is not None and not 0 < self.field_of_view < 360:
            raise InputError(f"CalibrationOptions: field_of_view must be in (0, 360) degrees, got {self.field_of_view}")
        if self.field_of_view is not None and self.field_of_view >= 180 and not (self.hybrid or self.lens.fisheye):
            raise InputError(
                f"CalibrationOptions: field_of_view is {self.field_of_view:g} degrees, and the lens model {self.lens} "
                "has less than 180; use the hybrid lens (leave the model out) or fisheye4"
            )
        if self.focal is not None and self.field_of_view is not None:
            raise InputError("CalibrationOptions: focal and field_of_view are alternatives; give one")
        if self.weak_prior is not None and not 0 < self.weak_prior < float("inf"):
            raise InputError(f"CalibrationOptions: weak_prior must be positive, got {self.weak_prior}")
        if not isinstance(self.board, MeasuredBoard) and self.board not in ("printed", "exact"):
            raise InputError(f"CalibrationOptions: board must be 'printed' or 'exact', got {self.board!r}")
        if self.camera is not None and (self.fixed or self.focal is not None or self.field_of_view is not None):
            raise InputError(
                "CalibrationOptions: a known camera fixes all parameters; name those to estimate in `free` instead"
            )
        if self.hybrid:
            self._refuse_parametric()
            if self.field is not None:
                NetworkModes.of(self.field)
            return
        if self.field is not None:
            raise InputError(f"CalibrationOptions: a field belongs to the hybrid lens; leave the model {self.lens} out")
        if isinstance(self.board, MeasuredBoard):
            raise InputError("CalibrationOptions: a measured board is used with the hybrid lens; leave the model out")
        fixed = self._of_camera() or {name: 1.0 if value is None else value for name, value in self.fixed.items()}
        self._constraints(fixed).check(self.lens)

    @property
    def hybrid(self) -> bool:
        """Whether the lens is the hybrid one, fitted by evidence."""
        named = self.model in (HYBRID, NETWORK)
        return self.camera is None and (named or bool(LensModel.named(self.model).hybrid))

    @property
    def modes(self) -> FieldModes | None:
        """Of the field; None: those of the default lens."""
        if self.field is not None:
            return NetworkModes.of(self.field)[0]
        return NetworkModes.random(_UNITS) if self.model == NETWORK else None

    def of_fit(self, size: tuple[int, int]) -> FitOptions:
        """Those of the fit of a hybrid lens to images of (width, height)."""
        modes = self.modes
        return FitOptions(
            modes=modes,
            board=self.board,
            motion=self.motion,
            bending=self.bending,
            focal=self.start_focal(size),
            training=None if modes is None else self.training,
        )

    def _refuse_parametric(self) -> None:
        names = ("board_warp", "loss", "fixed", "tied", "free", "priors")
        if isinstance(self.model, LensModel):
            raise InputError('CalibrationOptions: write model="hybrid"; its constants follow from the views')
        given = [name for name in names if getattr(self, name)]
        given += [name for name, own in (("weak_prior", _WEAK), ("solver", _SOLVER)) if getattr(self, name) != own]
        if given:
            raise InputError(
                f"CalibrationOptions: {', '.join(given)} cannot be combined with the hybrid lens, whose parameters and "
                'board the views determine; name a parametric model, for example model="opencv5"'
            )

    @property
    def lens(self) -> LensModel:
        """The parametric lens model to solve for."""
        return LensModel.named(self.model) if self.camera is None else self.camera.model

    def _of_camera(self) -> dict[str, float]:
        """The parameters that the known camera fixes."""
        if self.camera is None:
            return {}
        values = self.camera.params.detach().tolist()
        return {n: value for n, value in zip(self.camera.names, values, strict=True) if n not in self.free}

    def _constraints(self, fixed: Mapping[str, float]) -> ParameterConstraints:
        return ParameterConstraints(fixed=fixed, tied=self.tied, free=self.free, priors=self.priors)

    def constraints(self, size: tuple[int, int]) -> ParameterConstraints:
        """What is known about the parameters, for an image of (width, height)."""
        return self._constraints(
            self._of_camera()
            or {n: natural_value(n, size) if value is None else float(value) for n, value in self.fixed.items()}
        )

    def start_focal(self, size: tuple[int, int]) -> float | None:
        """The focal length to begin with, if one is given."""
        if self.field_of_view is None:
            return self.focal
        angle = math.radians(self.field_of_view)
        if self.field_of_view >= _WIDE and (self.hybrid or self.lens.fisheye):
            return size[0] / angle
        return 0.5 * size[0] / math.tan(0.5 * angle)


# What the calibration of one camera returns.

# Why a view is left out without being asked: the words with which the reason begins.
COPY = "it is a copy of"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rejected:
    """A view, or a corner of one, that was left out.

    Args:
        view: name of the view.
        corner: index of the corner on the board; None: the whole view.
        corners: how many corners were left out.
        residual: of a corner, pixels between it and its projection by the camera that was calibrated without it; of a
            view, its RMS in pixels when it was last part of the calibration, without corners left out before.
        reason: one sentence.
    """

    view: str
    corner: int | None = None
    corners: int = 1
    residual: float
    reason: str

    @property
    def exclusion(self) -> Exclusion:
        """Its line in a file's history."""
        name = self.view if self.corner is None else f"{self.view} corner {self.corner}"
        return Exclusion(name=name, reason=self.reason)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SharedBoard:
    """The board that a camera shared with others in one calibration.

    Args:
        others: their places among the cameras, from 0.
        evidence: nats by which one board for all is better than another one for this camera.
    """

    others: tuple[int, ...]
    evidence: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraCalibrationResult(ArrowRows):
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
        findings: what the user should doubt, and what to do about it.
        observations: what was calibrated from.
        hybrid: how the hybrid lens and the board were fitted: noise, tempering, board; None for parametric models.
        advice: what to photograph next, the most useful first.
        fixed: names of the parameters that the options held.
        led_by_prior: names of the parameters that a prior determines more than the views do: without it their σ would
            be more than 1.4 times as large.
        rejected_corners: corners of the views that were used, left out by `CalibrationOptions.reject`.
        rejected_views: views left out likewise, and copies of other views.
        by_view: (V, 3) logarithm of the scale, and principal point (pixels), of each view off those of the camera, if
            a stabilizer or an autofocus moves the lens; None: all views have the same.
        moves: standard deviations of these, with room for their own errors, as `CalibrationRecord` says them.
        without: what the options left out of a hybrid lens, as `CalibrationRecord` says it.
        tempering: of a parametric model, dispersion factor by which its variances are larger than independent errors of
            corners make them, because residuals repeat within views; `hybrid.tempering` of the hybrid lens.
        shared_board: which cameras helped to measure the board, where several were calibrated together. Errors of such
            cameras are not quite independent of each other; a rig of them knows that.
    """

    __repr__ = brief
    _repr_html_ = shown_in_notebooks

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
    findings: tuple[Finding, ...]
    observations: Observations
    information: CameraInformation | None = None
    hybrid: HybridFit | None = None
    advice: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    led_by_prior: tuple[str, ...] = ()
    rejected_corners: tuple[Rejected, ...] = ()
    rejected_views: tuple[Rejected, ...] = ()
    by_view: Tensor | None = None
    moves: tuple[float, float, float] | None = None
    without: tuple[str, ...] = ()
    tempering: float | None = None
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
            by_view=None if self.by_view is None else among(self.by_view, views, count),
        )

    def _record(self) -> CalibrationRecord:
        board, warp = self.observations.board, self.board_warp
        per_view = zip(self.observations.names, self.per_view_rms.tolist(), strict=True)
        used = {view: rms for view, rms in per_view if not math.isnan(rms)}
        moved = None if self.hybrid is None and warp is None else (self.board_points - board.points).tolist()
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
            tempering=self.tempering if self.hybrid is None else self.hybrid.tempering,
            board_deviation=None if moved is None else tuple((x, y, z) for x, y, z in moved),
            without=self.without,
            moves=self.moves,
            warnings=self.warnings,
            **provenance(),
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """The findings as sentences."""
        return sentences(self.findings)

    def to_arrow(self) -> Any:
        """The table of the observations (`kcal.Observations.to_arrow`), and `residual_u`, `residual_v`; null: left out.

        Example:
            >>> import polars  # doctest: +SKIP
            >>> polars.DataFrame(result).group_by("view").agg(polars.col("residual_u").std())  # doctest: +SKIP
        """
        return self.observations.to_arrow(residual_u=self.residuals[..., 0], residual_v=self.residuals[..., 1])

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
            corners=self.hybrid.displaced,
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
        return gone / (gone + int(torch.isfinite(self.residuals).all(-1).sum()))

    @property
    def excluded(self) -> tuple[Exclusion, ...]:
        """Views, then single corners, that were left out, each with its reason."""
        return tuple(one.exclusion for one in (*self.rejected_views, *self.rejected_corners))

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
