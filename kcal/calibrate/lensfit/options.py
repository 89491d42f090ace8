"""What the calibration of a hybrid camera is asked for, and what it answers."""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Literal

from kcal.calibrate.camera.options import CalibrationOptions, CameraCalibrationResult
from kcal.calibrate.lensfit.stacking import Prior
from kcal.errors import InputError
from kcal.lens.model import LensModel


@dataclasses.dataclass(frozen=True, kw_only=True)
class HybridOptions:
    """Options of `calibrate_hybrid`.

    Args:
        models: lens models for the field to correct, in order of preference: the first whose hybrid is not surely worse
            on what was held out than the best one. A plain lens leaves the field a clear task where the data are few or
            noisy or the lens is very wide, a rich one leaves it little where the lens is far from any plain formula.
        rivals: the parametric models that it is compared with, in order of preference likewise. With none and a single
            model nothing is compared, which takes half the time.
        board_warp: estimate how the board bends.
        weighted: as in `CalibrationOptions`.
        groups: which views are held out together. "blocks": runs of views in the order of the observations, for
            videos and captures in which neighbors are alike; "views": every view for itself; or a label for each view.
            The claim that a hybrid is better holds for new data that differ from the calibration's as the groups
            differ from each other.
        widths: of the field's units, in half widths of the image. The narrowest says what detail the field can show
            and most of what it costs: units grow with its inverse square.
        gate: keep the hybrid only where it is better on held-out views; False returns it in any case, with the same
            figures.
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
        """What a parametric model is calibrated with."""
        return CalibrationOptions(
            model=model,
            board_warp=self.board_warp,
            weighted=self.weighted,
            focal=self.focal,
            field_of_view=self.field_of_view,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class HybridResult:
    """What `calibrate_hybrid` found, and why it returns what it returns.

    Args:
        calibration: of the camera that is returned, a `HybridCamera` or the best parametric `Camera`. A hybrid's σ
            counts what the averaged fits disagree about.
        kept: whether the hybrid is returned.
        reason: one sentence that says why.
        choice: "hybrid", or the name of the parametric model that held-out views prefer.
        held_out: name -> RMS (pixels, by the corners' weights) on views that were held out in groups, their poses
            solved again: of each parametric model and of "hybrid". Infinite where a model could not show a corner.
            Empty where one model was given and no rival.
        model: the lens model that the field corrects: chosen likewise.
        groups: how many groups of views there were.
        shares: how much each prior counts in the average that makes the field.
        effective: how many of the field's weights the data determine, in effect; `units` x 2 there are.
        units: of the field.
        largest: the most that the field moves a point, pixels.
    """

    calibration: CameraCalibrationResult
    kept: bool
    reason: str
    choice: str
    held_out: dict[str, float]
    model: LensModel
    groups: int
    shares: tuple[tuple[Prior, float], ...]
    effective: float
    units: int
    largest: float

    def save(self, path: str | Path, *, name: str = "", source: str | None = None) -> Path:
        """Write the file of the camera that is returned; see `CameraCalibrationResult.save`."""
        return self.calibration.save(path, name=name, source=source)
