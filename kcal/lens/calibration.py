"""Error bars and history of a camera or a rig: plain data that travels with it.

kcal's files store these classes field by field (`kcal.io`), and check types and finite numbers when they are read.
"""

from __future__ import annotations

import dataclasses
import datetime
import math
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from kcal.errors import InputError
from kcal.finding import Finding
from kcal.texts import brief, range_text, setting_text

if TYPE_CHECKING:
    from torch import Tensor

    from kcal.lens.information import CameraInformation


# Pixels, of marks on sharp images, where nobody said.
_MARK_SIGMA = 0.3


def _refuse_negative(where: object, names: Iterable[str]) -> None:
    for name in names:
        value = getattr(where, name)
        for number in value.values() if isinstance(value, dict) else value if isinstance(value, tuple) else (value,):
            if number is not None and not 0 <= number < math.inf:
                raise InputError(f"{name} is {number}; it must not be negative")


def _refuse_local_time(created: datetime.datetime) -> None:
    if created.tzinfo is None:
        raise InputError(f"created is {created.isoformat()}; it needs a timezone")


@dataclasses.dataclass(frozen=True)
class Exclusion:
    """A view, a corner of one, or a pair that was left out, and why."""

    name: str
    reason: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class BoardRecord:
    """The board as plain fields.

    Args:
        columns: points in a row: inner corners, circles, or twice the tags.
        rows: points in a column.
        square: meters, the side of a square or of a tag, or the distance of circles.
        pattern: `checkerboard` (ChArUco boards as well), `circles`, `asymmetric` or `aprilgrid`.
        gap: meters from tag to tag, of an `aprilgrid`.

    Example:
        >>> print(BoardRecord(columns=9, rows=6, square=0.025))
        9x6 inner corners, 25 mm squares
        >>> print(BoardRecord(columns=9, rows=6, square=25.0))
        9x6 inner corners, 25 m squares
    """

    columns: int
    rows: int
    square: float
    pattern: Literal["checkerboard", "circles", "asymmetric", "aprilgrid"] = "checkerboard"
    gap: float | None = None

    def __post_init__(self) -> None:
        if not (self.columns > 0 and self.rows > 0 and self.square > 0):
            raise InputError(f"board: columns, rows and square must be positive, got {self!r}")
        if (self.gap is not None and self.gap > 0) != (self.pattern == "aprilgrid"):
            raise InputError(f"board: an aprilgrid, and only this, has a gap that is positive, got {self!r}")

    def __str__(self) -> str:
        length = range_text(self.square)
        if self.gap is not None:
            return f"{self.columns // 2}x{self.rows // 2} tags of {length}, {range_text(self.gap)} apart"
        if self.pattern == "circles":
            return f"{self.columns}x{self.rows} circles, {length} apart"
        if self.pattern == "asymmetric":
            return f"{self.columns}x{self.rows} asymmetric circles, rows {length} apart"
        return f"{self.columns}x{self.rows} inner corners, {length} squares"


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibrationRecord:
    """How a camera was calibrated.

    Args:
        rms: sqrt(mean ‖r‖²) over the points that were used, pixels.
        views: how many views were used.
        points: how many corners were used.
        per_view_rms: view name -> RMS in pixels, for the views used.
        excluded: views, and corners of the views used, that were left out, with the reason.
        board: the board that was shown.
        board_warp: height of the board's bend in x and y, meters; None if it was not estimated.
        stop_reason: why the solver stopped.
        iterations: of the solver.
        noise: of a corner along an axis, pixels; None if it was not estimated.
        board_deviation: x, y, z in meters of each corner of the board, as measured, from where it was ordered; None if
            it was not measured.
        tempering: dispersion factor that divides the weight of all corners, because residuals within a view are
            correlated; None if not estimated.
        observations: name of the observations file, if there was one.
        temperature: of the camera when the views were taken, °C; None if nobody said.
        without: what a hybrid lens was told not to estimate of the views: "motion", "bending".
        moves: standard deviations by which its ln scale and principal point (px) differ from view to view; None:
            they do not.
        warnings: what should be doubted of it, a sentence each.
        kcal_version: the version that calibrated; see `kcal.io.camera_file.provenance`.
        created: when, with its time zone.
    """

    __repr__ = brief

    rms: float
    views: int
    points: int
    per_view_rms: dict[str, float]
    excluded: tuple[Exclusion, ...] = ()
    board: BoardRecord
    board_warp: tuple[float, float] | None = None
    stop_reason: str
    iterations: int
    observations: str | None = None
    noise: float | None = None
    tempering: float | None = None
    board_deviation: tuple[tuple[float, float, float], ...] | None = None
    temperature: float | None = None
    without: tuple[str, ...] = ()
    moves: tuple[float, float, float] | None = None
    warnings: tuple[str, ...] = ()
    kcal_version: str
    created: datetime.datetime

    def __post_init__(self) -> None:
        _refuse_negative(self, ("rms", "per_view_rms", "iterations", "noise", "tempering", "moves"))
        _refuse_local_time(self.created)
        if self.temperature is not None and not -273.15 <= self.temperature < 1000:
            raise InputError(f"temperature is {self.temperature}; degrees Celsius are needed")
        if min(self.views, self.points) < 1:
            raise InputError(f"views is {self.views} and points is {self.points}; both must be positive")
        if self.views != len(self.per_view_rms):
            raise InputError(f"views is {self.views}, but per_view_rms has {len(self.per_view_rms)}")

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The warnings as findings."""
        return tuple(Finding("calibration", "doubt", text) for text in self.warnings)


@dataclasses.dataclass(frozen=True, kw_only=True)
class LensSetting:
    """Zoom and focus of a lens, as numbers of any unit: steps of a motor, a scale, millimeters.

    Args:
        values: name -> number, for example `{"focus": 3.2}`.
        interpolated_from: names of the cameras between whose settings this one was interpolated; empty if calibrated.

    Raises:
        InputError: no name, or a number that is not finite.

    Example:
        >>> print(LensSetting(values={"zoom": 12.5, "focus": 3.2}))
        zoom=12.5 focus=3.2
    """

    __repr__ = brief

    values: dict[str, float]
    interpolated_from: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.values or not all(self.values):
            raise InputError(f"setting {self.values}: each number needs a name, for example focus=3.2")
        for name, value in self.values.items():
            if not math.isfinite(value):
                raise InputError(f"setting {name}={value}: a finite number is needed")

    def __str__(self) -> str:
        return setting_text(self.values)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraCalibration:
    """Name, error bars and history of a camera: what its file stores beside the camera.

    Args:
        name: free text that tells cameras apart, for example `"left"`.
        sigma: parameter name -> one sigma, in the order of `Camera.names`; None for a parameter that was held fixed or
            is not determined. The whole is None if no sigmas were computed.
        covariance: (P, P) of the parameters in the order of `Camera.names`, zero for those held fixed; that of the
            information if that is given, and None if neither was computed.
        information: what the calibration says of the camera (`CameraInformation`); None if that was not computed.
        record: how the camera was calibrated, if it was.
        setting: where zoom and focus stood, if it was stated.

    Example:
        >>> CameraCalibration(name="left", sigma={"fx": 0.5, "fy": 0.5, "skew": None}).sigma["fx"]
        0.5
    """

    __repr__ = brief

    name: str = ""
    sigma: Mapping[str, float | None] | None = None
    covariance: Tensor | None = None
    information: CameraInformation | None = None
    record: CalibrationRecord | None = None
    setting: LensSetting | None = None

    def __post_init__(self) -> None:
        if self.information is not None:
            object.__setattr__(self, "covariance", self.information.covariance())

    def check(self, count: int) -> None:
        """Raise `InputError` unless covariance and information are those of `count` parameters."""
        if self.information is None:
            from kcal.checks import as_covariance

            as_covariance("the camera's covariance", self.covariance, count)
        elif len(self.information.slots) != count:
            raise InputError(f"information on {len(self.information.slots)} parameters; the camera has {count}")

    def known(self, params: Tensor) -> CameraInformation | None:
        """What is known of a camera with these parameters (5 + P,): its information, or that of its covariance."""
        if self.information is not None or self.covariance is None:
            return self.information
        from kcal.lens.information import CameraInformation

        return CameraInformation.from_covariance(params, self.covariance)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RigSource:
    """All items of one source that a rig was solved from: boards, landmarks, and so on.

    Args:
        name: which source.
        used: how many items are part of the solution.
        left_out: how many are not.
        rms_px: sqrt(mean ‖r‖²) over its pixels; None where it has none.
        rms_m: root of the mean squared meters of the items that have them.
        sigmas: root of χ² over the degrees of freedom, by the stated sigmas; 1 where these are right; None without any
            degree of freedom.
    """

    name: str
    used: int
    left_out: int
    rms_px: float | None = None
    rms_m: float | None = None
    sigmas: float | None = None

    def __post_init__(self) -> None:
        _refuse_negative(self, ("used", "left_out", "rms_px", "rms_m", "sigmas"))


@dataclasses.dataclass(frozen=True, kw_only=True)
class ItemResidual:
    """One point that was seen or measured, and how well it agrees with the rest.

    Args:
        source: which kind it is: boards, landmarks, features, stars, skyline, baselines or positions.
        name: its name.
        pixels: RMS distance in px in each camera, of what was left out from where the others put it; None where a
            camera did not see it.
        meters: of a landmark between survey and adjusted position, of a measured position between measured and solved,
            of a baseline its error; None for the others.
        sigmas: root of χ² over its degrees of freedom, by the stated sigmas; 1 is typical.
        over_limit: by how much χ² falls without it, over the most that noise and lenses explain
            (`kcal.calibrate.rig.adjustment`): above 1, it contradicts the rest. 0 for what was measured.
        used: whether it is part of the solution.
        reason: why it was left out.
    """

    __repr__ = brief

    source: str
    name: str
    pixels: tuple[float | None, ...] = ()
    meters: float | None = None
    sigmas: float
    over_limit: float = 0.0
    used: bool = True
    reason: str = ""

    @property
    def label(self) -> str:
        """Kind and name: `landmark post 4`."""
        return f"{self.source.removesuffix('s')} {self.name}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class RigCalibration:
    """How a rig was solved.

    Args:
        rms: sqrt(mean ‖r‖²) over the points of all cameras, pixels.
        rms_px: likewise of each camera; None for a camera with none.
        pairs: how many pairs of views were used.
        per_pair_rms: pair name -> RMS in pixels, for the pairs used.
        flipped: pairs in which one camera's corner order had to be turned by 180°.
        excluded: pairs, landmarks and matches left out, with the reason.
        sources: what the rig was solved from, where that is more than boards.
        undetermined: what the data leave open, camera by camera.
        warnings: what should be doubted of it, a sentence each, for example that its geometry is weak.
        pixel_sigma: noise of marks along each axis, pixels, as stated when the rig was solved; None if nobody did.
        lens_change: by how much each lens may have changed since its calibration, as `RigOptions` states it, pixels.
        contradictions: which source contradicts the others beyond reasonable doubt, a sentence each.
        relocked: when only the cameras' attitudes were solved again, and from what.
        kcal_version: the version that calibrated; see `kcal.io.camera_file.provenance`.
        created: when, with its time zone.
    """

    __repr__ = brief

    rms: float
    rms_px: tuple[float | None, ...]
    pairs: int = 0
    per_pair_rms: dict[str, float] = dataclasses.field(default_factory=dict)
    flipped: tuple[str, ...] = ()
    excluded: tuple[Exclusion, ...] = ()
    sources: tuple[RigSource, ...] = ()
    undetermined: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    pixel_sigma: float | None = None
    lens_change: float = 0.0
    contradictions: tuple[str, ...] = ()
    relocked: str | None = None
    kcal_version: str
    created: datetime.datetime

    def __post_init__(self) -> None:
        _refuse_negative(self, ("rms", "rms_px", "per_pair_rms", "lens_change"))
        _refuse_local_time(self.created)
        if self.pairs != len(self.per_pair_rms):
            raise InputError(f"pairs is {self.pairs}, but per_pair_rms has {len(self.per_pair_rms)}")

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Contradictions and warnings as findings."""
        stops = [Finding("contradiction", "stop", text) for text in self.contradictions]
        return (*stops, *(Finding("rig", "doubt", text) for text in self.warnings if text not in self.contradictions))


Attribute = TypeVar("Attribute")


def noise_of_marks(given: float | None, record: RigCalibration | None, name: str = "pixel_sigma") -> tuple[float, str]:
    """The noise of marks along each axis, px: as given, or as a rig's record states it, or assumed; and its source.

    The source is empty where the noise was given; `name` is for messages.

    Raises:
        InputError: not a positive number.

    Example:
        >>> noise_of_marks(None, None)
        (0.3, 'noise of marks: 0.3 px, assumed; --pixel-sigma states it')
    """
    sigma, source = given, ""
    if sigma is None and record is not None and record.pixel_sigma is not None:
        sigma, source = record.pixel_sigma, f"noise of marks: {record.pixel_sigma:g} px, from the rig's file"
    elif sigma is None:
        sigma, source = _MARK_SIGMA, f"noise of marks: {_MARK_SIGMA:g} px, assumed; --pixel-sigma states it"
    if not 1e-6 <= sigma <= 1e6:
        # Beyond, squares of it leave the range of float64, or the accuracy of the arithmetic.
        raise InputError(f"{name}: a positive number of pixels, 1e-6 to 1e6, is needed, got {sigma}")
    return float(sigma), source


class UntilChanged(Generic[Attribute]):
    """An attribute of a module with a `fingerprint`: None until it is set, and again once the fingerprint has changed.

    So error bars never outlive the parameters that they belong to, however those were changed.
    """

    def __init__(self, check: Callable[[Any, Attribute], object] = lambda module, value: None) -> None:
        self.check = check

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, module: Any, owner: type) -> Attribute | None:
        fingerprint, value = module.__dict__.get(self.name, ("", None))
        return value if value is not None and fingerprint == module.fingerprint else None

    def __set__(self, module: Any, value: Attribute | None) -> None:
        if value is not None:
            self.check(module, value)
        module.__dict__[self.name] = module.fingerprint, value
