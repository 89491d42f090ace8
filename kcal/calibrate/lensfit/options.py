"""Options of a hybrid camera's calibration, and its result."""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Literal

from kcal.calibrate.camera.options import CalibrationOptions
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.lensfit.stacking import FieldPrior
from kcal.errors import InputError
from kcal.lens.model import LensModel


@dataclasses.dataclass(frozen=True, kw_only=True)
class HybridOptions:
    """Options of `calibrate_hybrid`.

    Args:
        models: lens models for the field to correct, in order of preference. The first one is used whose hybrid is not
            significantly worse on held-out views than the best one. A simple model suits few or noisy data and very
            wide lenses; a rich one leaves less to the field where the lens is far from any simple formula.
        rivals: parametric models to compare with, in order of preference. With none and a single model nothing is
            compared, which takes half the time.
        board_warp: estimate how the board bends.
        weighted: as in `CalibrationOptions`.
        groups: which views are held out together. "blocks": runs of views in the order of the observations, for
            videos and captures with similar neighbors; "views": each view for itself; or a label for each view. That a
            hybrid is better is shown for new data that differ from the calibration's as the groups differ from each
            other.
        widths: of the field's units, in half widths of the image. The narrowest determines the detail of the field and
            most of the run time: the number of units grows with its inverse square.
        gate: keep the hybrid only where it is better on held-out views; False always returns it, with the same figures.
        focal: as in `CalibrationOptions`.
        field_of_view: likewise.
    """

    models: tuple[LensModel | str, ...] = ("opencv14", "opencv8", "ext20")
    rivals: tuple[LensModel | str, ...] = ("opencv14", "ext20")
    board_warp: bool = False
    weighted: bool = True
    groups: Literal["blocks", "views"] | Sequence[Hashable] = "blocks"
    widths: tuple[float, ...] = (1.2, 0.6, 0.3, 0.15)
    gate: bool = True
    focal: float | None = None
    field_of_view: float | None = None

    def __post_init__(self) -> None:
        if not self.models:
            raise InputError("HybridOptions: at least one lens model is needed for the field to correct")
        if not self.widths or not all(0.02 <= width <= 10 for width in self.widths):
            raise InputError(f"HybridOptions: widths from 0.02 to 10 half widths of the image, got {self.widths}")

    def parametric(self, model: LensModel | str) -> CalibrationOptions:
        """Options for calibrating a parametric model."""
        return CalibrationOptions(
            model=model,
            board_warp=self.board_warp,
            weighted=self.weighted,
            focal=self.focal,
            field_of_view=self.field_of_view,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class HybridResult:
    """The camera that `calibrate_hybrid` chose, and why.

    Args:
        calibration: of the camera that is returned, a `HybridCamera` or the best parametric `Camera`. A hybrid's σ
            includes the differences between the averaged fits.
        kept: whether the hybrid is returned.
        reason: why, in one sentence.
        choice: "hybrid", or the name of the parametric model that is best on held-out views.
        held_out: name -> RMS (pixels, with the corners' weights) on views that were held out in groups, with their
            poses solved again, for each parametric model and for "hybrid". Infinite where a corner has no image.
            Empty with a single model and no rival.
        model: the lens model that the field corrects, chosen likewise.
        groups: number of groups of views.
        shares: the weight of each prior in the average that makes the field.
        effective: effective number of the field's weights that the data determine, of `units` x 2.
        units: number of units of the field.
        largest: the largest shift of a point by the field, pixels.
    """

    calibration: CameraCalibrationResult
    kept: bool
    reason: str
    choice: str
    held_out: dict[str, float]
    model: LensModel
    groups: int
    shares: tuple[tuple[FieldPrior, float], ...]
    effective: float
    units: int
    largest: float

    def save(self, path: str | Path, *, name: str = "", source: str | None = None) -> Path:
        """Write the file of the camera that is returned; see `CameraCalibrationResult.save`."""
        return self.calibration.save(path, name=name, source=source)
