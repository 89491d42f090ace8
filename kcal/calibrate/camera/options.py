"""Options of a camera's calibration."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Literal

from torch import nn

from kcal.calibrate.hybrid.measured_board import MeasuredBoard
from kcal.calibrate.hybrid.network_fit import FieldTraining
from kcal.calibrate.problem.parameters import ParameterConstraints, natural_value
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.field_modes import FieldModes
from kcal.lens.model import LensModel
from kcal.lens.network_modes import NetworkModes
from kcal.solve.lm import LMOptions
from kcal.solve.robust import RobustLoss

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
        board_warp: with a parametric model, estimate how the board bends (two more parameters).
        weighted: weight corners by their covariances where all views have them (`kcal.calibrate.problem.weights`);
            False minimizes the plain RMS, as OpenCV does.
        loss: a robust loss of each corner's residual in pixels, for data with wrong corners, or None. It is used after
            a plain solution has been found; choose a scale of about three times the noise.
        reject: leave out corners, then views, that noise cannot explain (`kcal.calibrate.camera.outliers`), and list
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
            and tilt; `kcal.calibrate.problem.coefficient_prior`). 0.3, the default, hardly changes what the views
            determine, and leaves rich models a single minimum, found quickly, with a reliable σ
            (docs/measured/solver.md has figures). None: the corners alone decide, as in OpenCV; of the minima next to
            that of the prior and next to a lens without distortion the lower one is taken.
        camera: a known camera, whose parameters are held except those that `free` names. Only the board's poses (and
            its warp) are found; one view is enough. Its lens model takes the place of `model`.
        solver: options of the Levenberg-Marquardt solver, with a parametric model.
    """

    model: LensModel | str = HYBRID
    field: nn.Module | None = None
    training: FieldTraining | None = _TRAINING
    board: Literal["printed", "exact"] | MeasuredBoard = "printed"
    motion: bool = True
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
