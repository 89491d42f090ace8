"""Located points against known ranges: whether the intervals are true jointly, and what explains it if they are not."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from scipy.stats import chi2 as chi2_of
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import FileError, InputError
from kcal.finding import Finding
from kcal.lens.rig import Rig
from kcal.locate.marks import PAIR, PIXELS, Marks, pixel_of, read_marks
from kcal.locate.max_likelihood import calibration_effect
from kcal.locate.stereo import QUANTILE, PositionStatus, checked_rig
from kcal.locate.tables import TableRow, header_of, read_rows
from kcal.locate.views import fit_pairs
from kcal.texts import brief

# Ranges that are this much too long or too short for most are no error of a calibration, but of a unit or a place.
_ABSURD = 3.0
_COLUMNS = ("range", "range_sigma")
_HEADER = "name,left_u,left_v,right_u,right_v,range,range_sigma"
# -2 log likelihood by which one cause is clearly likelier than another, and what it leaves unexplained.
_CLEAR, _UNLIKELY = 4.0, 0.01
# Of noise, times what was stated.
_TIMES = torch.logspace(0.0, 2.0, 101, dtype=torch.float64)


class KnownRanges(NamedTuple):
    """Marks of two cameras, and how far the N points are from the left one: meters, (N,) each."""

    marks: Marks
    ranges: Tensor
    sigmas: Tensor


class Cause(NamedTuple):
    """One explanation of all errors, in place of those that the rig states.

    Attributes:
        name: "yaw": the right camera is turned in the plane of baseline and view, degrees; "scale": the baseline is
            longer by a share; "noise": marks are noisier than stated, times.
        amount: the most likely error of the rig: its yaw or its baseline is too large by that.
        sigma: of the amount, with what the rig states of it; NaN for noise.
        sigmas: the root of what it takes off -2 log likelihood: how far it is from what the rig states.
        probability: of errors that large or larger once it is taken into account.
    """

    name: str
    amount: float
    sigma: float
    sigmas: float
    probability: float

    @property
    def text(self) -> str:
        """In words."""
        if self.name == "noise":
            return f"marks {self.amount:.2g} times as noisy as stated ({self.sigmas:.1f} sigma)"
        what, unit, times = ("yaw", "°", 1.0) if self.name == "yaw" else ("length of the baseline", " %", 100.0)
        return f"{what} off by {times * self.amount:+.2g} ± {times * self.sigma:.2g}{unit} ({self.sigmas:.1f} sigma)"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RangeCheck:
    """What `check_ranges` found of N points.

    Args:
        names: of the points.
        known: (N,) meters from the left camera.
        measured: (N,) by the rig; infinite where the lines of sight do not meet.
        low: (N,) of the 95 % interval of the difference, as a range that would agree.
        high: (N,) its other end.
        pulls: (N,) errors of one over the range, each over its own sigma; positive where it is measured too short.
        chi2: of all errors jointly, with their covariance.
        probability: of one that large or larger if the intervals are true.
        common: probability of the part of the errors that a yaw and a scale make, as large or larger.
        rest: that of all others; NaN for fewer than three points.
        causes: yaw, scale and noise, the likeliest first.
        findings: one "stop" if the intervals are not true, none otherwise.
    """

    __repr__ = brief

    names: tuple[str, ...]
    known: Tensor
    measured: Tensor
    low: Tensor
    high: Tensor
    pulls: Tensor
    chi2: float
    probability: float
    common: float
    rest: float
    causes: tuple[Cause, ...]
    findings: tuple[Finding, ...]

    @property
    def true(self) -> bool:
        """Whether the intervals agree with the known ranges."""
        return not self.findings

    @property
    def text(self) -> str:
        """The answer, in words."""
        count = len(self.names)
        agree = f"known ranges agree with the stated intervals: χ² {self.chi2:.3g} of {count} points (probability "
        return self.findings[0].sentence if self.findings else f"{agree}{self.probability:.2g})"


@torch.no_grad()
def check_ranges(
    rig: Rig, marks: Marks, ranges: Tensor, sigmas: Tensor, *, pixel_sigma: float = 0.3, level: float = 0.05
) -> RangeCheck:
    """Compare ranges by a rig with known ones, jointly, and tell whether yaw, scale or noise explains what is off.

    All points share the errors of the rig: with a yaw that is off by two sigma all ranges are, and one by one none of
    them tells more than another. So errors of one over the range, which are Gaussian, are compared with their full
    covariance: of marks, known ranges, and the rig. Their χ² has two independent parts, the one that a turn of the
    right camera and another length of the baseline would make, and the rest. Each is tested so that a rig with true
    intervals fails in `level` of all cases.

    Args:
        rig: of two cameras; without a covariance it counts as exact.
        marks: of N points in both images; their covariance, where stated, replaces `pixel_sigma`.
        ranges: (N,) meters from the left camera.
        sigmas: (N,) meters, standard deviations of these; independent of each other.
        pixel_sigma: of a mark along an axis, px.
        level: share of rigs with true intervals that fail.

    Raises:
        InputError: no points, shapes that are wrong, ranges that are not positive and finite, a mark outside the image,
            or ranges that are of another place or unit.

    Source: generalized least squares with one parameter for each cause; causes are compared by their likelihood.

    Example:
        >>> from kcal.rig import RigCovariance, planned_rig
        >>> rig = planned_rig()
        >>> sigma = torch.tensor([0, 1e-4, 0, 0, 0, 0], dtype=torch.float64)  # of the yaw: 0.006°
        >>> rig.covariance = RigCovariance.of(rig, pose=torch.diag(sigma**2))
        >>> known = torch.tensor([500.0, 800.0, 1200.0], dtype=torch.float64)
        >>> left, right = rig(known[:, None] * torch.tensor([[0.0, 0.0, 1.0]]).double())[0].unbind(-2)
        >>> right = right - torch.tensor([0.8, 0.0]).double()  # px: as a yaw that is off by 0.029° would
        >>> found = check_ranges(rig, Marks.of_pair("abc", left, right), known, 0.01 * known, pixel_sigma=0.1)
        >>> found.true, found.causes[0].name, round(found.causes[0].amount, 3)
        (False, 'yaw', 0.029)
    """
    checked_rig(rig, pixel_sigma)
    if len(rig) != 2:
        raise InputError(f"check_ranges: a rig of two cameras is needed, this one has {len(rig)}")
    names, pixels = tuple(marks.names), as_points("marks", marks.pixels, 2, rig.center)
    ranges, sigmas = (torch.as_tensor(value, dtype=torch.float64) for value in (ranges, sigmas))
    if not names or not (ranges.shape == sigmas.shape == (len(names),)):
        raise InputError(f"ranges and sigmas: one number for each of {len(names)} points is needed")
    if not bool((torch.isfinite(ranges) & (ranges > 0) & torch.isfinite(sigmas) & (sigmas > 0)).all()):
        raise InputError("ranges and sigmas: positive finite meters are needed")
    if not bool((3.0 * sigmas < ranges).all()):
        raise InputError("sigmas: a range with a sigma of a third of it or more checks nothing; are both in meters?")
    if not 0.0 < level < 1.0:
        raise InputError(f"level: a share between 0 and 1 is needed, got {level}")
    found = fit_pairs(
        rig, pixels[:, 0], pixels[:, 1], marks.covariance_or(pixel_sigma), noise=pixel_sigma, by_camera=True
    )
    for name, status, fine in zip(names, found.status.tolist(), found.fitted.tolist(), strict=True):
        if not fine:
            raise InputError(f"{name}: {PositionStatus(status).name}: its marks give no range; correct or delete them")
    unit = found.scale * found.length
    inverse, error = found.fit.inverse / unit, found.fit.inverse / unit - 1.0 / ranges
    # What marks, known ranges and the rig do to it.
    noise = found.variance * found.fit.covariance[5] / unit.square()
    own = (sigmas / ranges.square()).square()
    effect = calibration_effect(found.fit, found.scale, _rig_errors(rig))[2].mT / unit[:, None]
    shared, slopes = effect[:, :-2], dict(zip(("yaw", "scale"), effect[:, -2:].T, strict=True))

    def covariance(times: Tensor) -> Tensor:
        return torch.diag_embed(times.square()[:, None] * noise + own) + shared @ shared.T

    whole = covariance(_TIMES[:1])[0]
    unexplained, *weighed = _whitened(whole, error, *slopes.values())
    chi2 = float(unexplained.square().sum())
    plane = torch.linalg.qr(torch.stack(weighed, 1))[0]
    part = float((plane.T @ unexplained).square().sum())
    degrees, others = plane.shape[1], len(names) - plane.shape[1]
    common = _chance(part, degrees)
    rest = _chance(chi2 - part, others) if others else math.nan
    chance = min(common, rest) if others else common
    causes = [_shift(name, unexplained, slope) for name, slope in zip(slopes, weighed, strict=True)]
    causes.append(_noisier(covariance, error))
    causes.sort(key=lambda cause: -cause.sigmas)
    deviation = whole.diagonal().sqrt()
    ends = (inverse + QUANTILE * deviation, inverse - QUANTILE * deviation)
    measured, low, high = (torch.where(value > 0, 1.0 / value, math.inf) for value in (inverse, *ends))
    smallest = 1.0 - (1.0 - level) ** (0.5 if others else 1.0)
    findings = []
    if chance < smallest:
        ratio = float((inverse * ranges).median())
        if not 1.0 / _ABSURD < ratio < _ABSURD and bool((error.abs() > 10.0 * deviation).all()):
            raise InputError(
                f"ranges by the rig are {1.0 / ratio if ratio > 0 else math.inf:.3g} times the known ones: are these "
                "meters from the left camera, and of the same points?"
            )
        findings.append(_contradiction(causes, chance))
    return RangeCheck(
        names=names, known=ranges, measured=measured, low=low, high=high, pulls=error / deviation, chi2=chi2,
        probability=_chance(chi2, len(names)), common=common, rest=rest, causes=tuple(causes),
        findings=tuple(findings),
    )  # fmt: skip


def _rig_errors(rig: Rig) -> Tensor:
    """(P, K + 2) what errors of a rig change in its parameters: K that it states, a turn by 1°, a longer baseline."""
    stated = rig.covariance.half.T if rig.covariance else rig.center.new_zeros(sum(rig.sizes) + 6, 0)
    shift, right = rig.right_from_left_translation, rig.right_from_left_rotation
    # The turn in the plane of the baseline and what both cameras look at, about the right camera's own center.
    axis = torch.linalg.cross(right[:, 2] + right.new_tensor([0.0, 0.0, 1.0]), shift)
    axis = -math.radians(1.0) * axis / axis.norm()
    axis = axis if float(axis[axis.abs().argmax()]) > 0 else -axis
    steps = torch.stack([torch.cat([axis, torch.linalg.cross(axis, shift)]), torch.cat([0.0 * shift, shift])], 1)
    return torch.cat([stated, torch.nn.functional.pad(steps, (0, 0, len(stated) - 6, 0))], 1)


def _whitened(covariance: Tensor, *values: Tensor) -> Tensor:
    """(K, N) of values (N,), in units of their sigmas and independent."""
    return torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), torch.stack(values, 1), upper=False).T


def _shift(name: str, error: Tensor, slope: Tensor) -> Cause:
    """The most likely amount of a shift, of errors in units of their sigmas."""
    fall = float(error @ slope) ** 2 / float(slope.square().sum())
    amount, sigma = float(error @ slope) / float(slope.square().sum()), float(slope.norm()) ** -1
    return Cause(name, amount, sigma, math.sqrt(fall), _chance(float(error.square().sum()) - fall, len(error) - 1))


def _noisier(covariance: Callable[[Tensor], Tensor], error: Tensor) -> Cause:
    """The most likely noise of marks, not below the stated one, and what it takes off -2 log likelihood."""
    root = torch.linalg.cholesky(covariance(_TIMES))
    squares = torch.linalg.solve_triangular(root, error[:, None], upper=False).square().sum((-2, -1))
    costs = squares + 2.0 * root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    best = int(costs.argmin())
    fall = math.sqrt(float(costs[0] - costs[best]))
    return Cause("noise", float(_TIMES[best]), math.nan, fall, _chance(float(squares[best]), len(error)))


def _chance(chi2: float, freedom: int) -> float:
    """Probability of a χ² as large or larger; 1 without freedom."""
    return float(chi2_of.sf(max(chi2, 0.0), freedom)) if freedom else 1.0


_CURES = {
    "yaw": "solve the rig again with these points as features with a range, or with other features far away",
    "scale": "measure the baseline again, and check the known ranges' unit and origin",
    "noise": "state the noise of marks (--pixel-sigma), or mark again what is farthest off",
}


def _contradiction(causes: Sequence[Cause], chance: float) -> Finding:
    """What is off, and what explains it best."""
    best, other = causes[:2]
    text = f"the intervals contradict the known ranges (probability {chance:.1g}); best explained by {best.text}"
    if best.sigmas**2 - other.sigmas**2 < _CLEAR:
        text += f", or nearly as well by {other.text}"
    if best.probability < _UNLIKELY:
        text += f", which does not explain all (probability of the rest {best.probability:.1g})"
    return Finding("ranges", "stop", text, _CURES[best.name])


def read_known_ranges(path: str | Path, marks: str | Path | None = None) -> KnownRanges:
    r"""Read known ranges: name,range,range_sigma in meters from the left camera, with marks in both images.

    The four columns of marks stand in the same table, or in one of their own, in which the names are looked up.

    Raises:
        FileError: see `read_marks`; a range without its sigma; a name that has no marks, or marks in both tables.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "known.csv")
        ...     _ = path.write_text("left_u,left_v,right_u,right_v,range,range_sigma\n960,540,952,540,2000,20\n")
        ...     read_known_ranges(path).ranges.tolist()
        [2000.0]
    """
    header = header_of(path)
    inside = [column for column in PIXELS if column in header]
    if bool(inside) == (marks is not None):
        wanted = "marks stand in both tables; leave --marks out" if inside else "no columns of marks; give --marks"
        raise FileError(f"{path}: {wanted} ({_HEADER})")
    rows = read_rows(
        path, _HEADER, ("name", *PIXELS, *_COLUMNS, "note"), (*(PIXELS if marks is None else ("name",)), *_COLUMNS)
    )
    names = tuple(row.name for row in rows)
    known = torch.tensor([[_known_meters(row, column) for column in _COLUMNS] for row in rows], dtype=torch.float64)
    if marks is None:
        pixels = torch.tensor([[pixel_of(row, side, False) for side in PAIR] for row in rows], dtype=torch.float64)
        return KnownRanges(Marks(names, pixels), *known.T)
    found = read_marks(marks)
    place = {name: i for i, name in enumerate(found.names)}
    for row in rows:
        if row.name not in place:
            raise FileError(f"{row.where}: {row.name!r} has no marks in {marks}")
    which = [place[name] for name in names]
    covariance, sigma = (None if value is None else value[which] for value in (found.covariance, found.sigma))
    return KnownRanges(Marks(names, found.pixels[which], covariance, sigma), *known.T)


def _known_meters(row: TableRow, column: str) -> float:
    if row.number(column, "a number of meters") <= 0:
        raise FileError(f"{row.where}: {column} is {row.cells[column]!r}; a positive number of meters is needed")
    return float(row.cells[column])
