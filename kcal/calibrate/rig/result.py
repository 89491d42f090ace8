"""The result of `calibrate_rig`, and its records: residuals by source and by item."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.arrow import ArrowRows, arrow_table
from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.initial_poses import TurnedBoard
from kcal.calibrate.rig.problem import RigSolution
from kcal.calibrate.rig.sources import RigData
from kcal.doors import shown_in_notebooks
from kcal.finding import Finding, sentences
from kcal.io.rig_file import save_rig
from kcal.lens.calibration import Exclusion, ItemResidual, RigCalibration, RigSource
from kcal.lens.camera import Camera
from kcal.lens.pair_errors import RigCovariance
from kcal.lens.rig import Origin, Rig
from kcal.solve.lm import LMOptions, SolverStatus
from kcal.texts import brief

# The result of solving a rig: cameras, residuals by source and by item, what was left out and why, covariances.


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RigResult(ArrowRows):
    """What `solve_rig` and `calibrate_rig` found.

    Convention: `cam_from_local` of camera c is p = rotation[c] (x - center[c]); the local frame is east-north-up of the
    data's origin if `absolute`, otherwise the first camera's.

    Args:
        data: what the rig was solved from, with boards turned where they had been read from the other end and pixels
            without ray as NaN.
        cameras: as solved; the same as given where intrinsics are fixed.
        rotation: (C, 3, 3).
        center: (C, 3) meters.
        board_warp: (2,) meters along rows and columns, if it was estimated
            (`kcal.calibrate.problem.state.warp_modes`).
        sources: residuals by source.
        items: residuals by item, those left out included.
        flipped: boards that had been read from the other end and were turned.
        rms: sqrt(mean ‖r‖²) over the pixels of all cameras.
        rms_px: sqrt(mean ‖r‖²) over the pixels of each camera; NaN for a camera with none.
        chi2: sum of squares of all residuals over their sigmas, as used: those of a source that fits itself worse than
            stated were multiplied (`kcal.calibrate.rig.problem`).
        freedom: degrees of freedom.
        variance: by which covariances are multiplied, because residuals are larger than their sigmas say or because
            ranges are not linear in errors of the baseline (`kcal.calibrate.rig.assess`); 1 if neither.
        sigma_corner: of a board's corner along an axis, px, as used; None without boards.
        undetermined: what the data leave open, in words; none of it concerns the cameras' relative poses.
        status: why the solver stopped.
        findings: what the user should doubt; a source that contradicts the others beyond reasonable doubt
            (`kcal.calibrate.rig.explanations`) is a "stop": such a rig should not be used.
    """

    __repr__ = brief
    _repr_html_ = shown_in_notebooks

    data: RigData
    cameras: tuple[Camera, ...]
    rotation: Tensor
    center: Tensor
    board_warp: Tensor | None
    sources: tuple[RigSource, ...]
    items: tuple[ItemResidual, ...]
    flipped: tuple[TurnedBoard, ...]
    rms: float
    rms_px: tuple[float, ...]
    chi2: float
    freedom: int
    variance: float
    sigma_corner: float | None
    undetermined: tuple[str, ...]
    status: SolverStatus
    findings: tuple[Finding, ...]
    _solution: RigSolution
    _places: dict[str, dict[str, Tensor]]
    _provenance: dict[str, Any]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return self.data.names

    @property
    def absolute(self) -> bool:
        """Whether the local frame is that of landmarks or measured positions; otherwise it is the first camera's."""
        return self.data.absolute

    @property
    def exact(self) -> tuple[str, ...]:
        """Names of the cameras that were taken as exact: errors of their lenses are in no covariance."""
        maps = self._solution.problem.unknowns.cameras
        return tuple(name for name, by_unknown in zip(self.names, maps, strict=True) if not bool(by_unknown.any()))

    @property
    def warnings(self) -> tuple[str, ...]:
        """The findings as sentences."""
        return sentences(self.findings)

    @property
    def contradictions(self) -> tuple[str, ...]:
        """Those of the findings that forbid the use."""
        return sentences(one for one in self.findings if one.severity == "stop")

    @property
    def left_out(self) -> tuple[ItemResidual, ...]:
        """What is not part of the solution."""
        return tuple(item for item in self.items if not item.used)

    @property
    def _boards_used(self) -> tuple[ItemResidual, ...]:
        return tuple(item for item in self.items if item.source == "boards" and item.used)

    @property
    def pairs(self) -> tuple[str, ...]:
        """Names of the boards used, P of them."""
        return tuple(item.name for item in self._boards_used)

    @property
    def pixels(self) -> Tensor:
        """(P, C, N, 2) corners of the boards used, turned where `flipped`; NaN where not seen."""
        boards = self.data.boards
        if boards is None:
            return torch.empty(0, len(self.cameras), 0, 2, dtype=torch.float64)
        return boards.pixels[[boards.names.index(name) for name in self.pairs]]

    @property
    def pair_rms(self) -> Tensor:
        """(P,) sqrt(mean ‖r‖²) of each board used, over the corners of all cameras, pixels."""
        count = torch.isfinite(self.pixels).all(-1).sum(-1)
        rms = torch.tensor([value or 0.0 for item in self._boards_used for value in item.pixels], dtype=torch.float64)
        return ((count * rms.reshape(count.shape).square()).sum(-1) / count.sum(-1)).sqrt()

    @property
    def sigma_rotation(self) -> Tensor:
        """(3,) radians, of second_from_first about the second camera's x (pitch), y (yaw) and z (roll)."""
        return self.relative_covariance().diagonal()[:3].sqrt()

    @property
    def sigma_translation(self) -> Tensor:
        """(3,) meters, of second_from_first along the second camera's axes."""
        return self.relative_covariance().diagonal()[3:].sqrt()

    @property
    def sigma_baseline(self) -> float:
        """Standard deviation of the distance between the first two cameras, meters."""
        shift = self.rotation[1] @ (self.center[0] - self.center[1])
        along = shift / torch.linalg.vector_norm(shift)
        return math.sqrt(float(along @ self.relative_covariance()[3:, 3:] @ along))

    def stereo(self, first: int = 0, second: int = 1) -> Rig:
        """Two of the cameras as a rig, with its covariance and with how it was solved.

        `kcal.rig.placed_rig` adds where it stands on the Earth. The covariance is left out where the data do not
        determine all parameters of the cameras.
        """
        rotation = self.rotation[second] @ self.rotation[first].T
        translation = self.rotation[second] @ (self.center[first] - self.center[second])
        rig = Rig.pair(self.cameras[first], self.cameras[second], rotation, translation)
        half = self._solution.half_of(self._joint_rows(first, second))
        rig.covariance = None if half is None else RigCovariance(half=half)
        rig.calibration = self._calibration(first, second)
        return rig

    def stations(self, origin: Origin | None = None) -> Rig:
        """All cameras with what is known of them together, which is left out where the data leave something open.

        Args:
            origin: of the frame in which landmarks and positions were given.
        """
        each = range(len(self.cameras))
        rig = Rig(
            self.cameras, self.names, self.rotation, center=self.center, origin=origin if self.absolute else None,
            refraction=self.refraction if self.absolute and origin is not None else 0.0,
        )  # fmt: skip
        poses = [self._solution.mounting_rows(camera) for camera in each]
        lenses = [self._solution.parameter_rows(camera) for camera in each]
        rig.root = self._solution.half_of(torch.cat([*lenses, *(pose[:6] for pose in poses), poses[0][6:]]))
        rig.calibration = self._calibration(*each)
        return rig

    def _calibration(self, *cameras: int) -> RigCalibration:
        """How a rig of these cameras was solved."""
        return RigCalibration(
            rms=self.rms,
            rms_px=tuple(None if math.isnan(self.rms_px[camera]) else self.rms_px[camera] for camera in cameras),
            pairs=len(self.pairs),
            per_pair_rms=dict(zip(self.pairs, self.pair_rms.tolist(), strict=True)),
            flipped=tuple(dict.fromkeys(turned.board for turned in self.flipped)),
            # Boards by their names alone, as in `per_pair_rms`.
            excluded=tuple(
                Exclusion(f"{item.source} {item.name}".removeprefix("boards "), item.reason) for item in self.left_out
            ),
            sources=self.sources,
            undetermined=self.undetermined,
            warnings=self.warnings,
            contradictions=self.contradictions,
            **self._provenance,
        )

    def to_arrow(self) -> Any:
        """A `pyarrow.Table` of `items`, one row each: where a camera did not see one, its `NAME_px` is null."""
        items, nowhere = self.items, (None,) * len(self.names)
        pixels = np.array([item.pixels or nowhere for item in items], float).reshape(-1, len(nowhere))
        numbers = {f"{name}_px": pixels[:, c] for c, name in enumerate(self.names)}
        numbers |= {name: np.array([getattr(one, name) for one in items], float) for name in ("meters", "sigmas")}
        texts = {name: [getattr(item, name) for item in items] for name in ("source", "name", "reason")}
        return arrow_table(texts | {"used": np.array([item.used for item in items], bool)} | numbers)

    def save(self, path: str | Path) -> Path:
        """Write the rig of the first two cameras as `stereo` gives it; see `kcal.save_rig`."""
        return save_rig(self.stereo(), path)

    def places(self) -> dict[str, dict[str, Tensor]]:
        """Where boards (their middle), landmarks and features are: (3,) meters in the local frame, by name.

        Features as far away as their inverse range says, at most 100 km.
        """
        return self._places

    def relative_covariance(self, first: int = 0, second: int = 1) -> Tensor:
        """(6, 6) of second_from_first: rotation vector about the second camera's axes, translation along them."""
        return self._solution.of(self._solution.relative_rows(first, second))[0]

    def joint_covariance(self, first: int = 0, second: int = 1) -> Tensor:
        """Covariance of both cameras' parameters (zeros where held) and relative pose, ordered as `RigCovariance`."""
        return self._solution.of(self._joint_rows(first, second))[0]

    @property
    def refraction(self) -> float:
        """Coefficient of refraction of the light from landmarks; its variance is the last of `mounting_covariance`."""
        return float(self._solution.state.refraction)

    def effects(self) -> dict[str, tuple[float, float]]:
        """What shifts stars, landmarks or features together: its amount and standard deviation, in stated sigmas."""
        problem = self._solution.problem
        maps = problem.unknowns.by_effects
        if maps is None:
            return {}
        rows = torch.nn.functional.pad(maps, (0, problem.shared_size - maps.shape[1]))
        sigma, amount = self._solution.variances(rows).sqrt(), maps @ self._solution.state.unknown
        return dict(zip(self.data.effects, zip(amount.tolist(), sigma.tolist(), strict=True), strict=True))

    def joint_half(self, first: int = 0, second: int = 1) -> Tensor | None:
        """(K, P + 7) root of the covariance of `joint_covariance`'s P quantities and those of `mounting_covariance`.

        None where the data leave one of them open.
        """
        return self._solution.half_of(torch.cat([self._joint_rows(first, second), self._solution.mounting_rows(first)]))

    def mounting_covariance(self, camera: int = 0) -> Tensor:
        """(7, 7) of a camera's center (meters), of small turns of it (radians), and of the coefficient of refraction.

        Centers and turns are along and about the local frame's axes. Infinite variances where the data leave something
        open; zeros for the first camera of a rig that is not `absolute`.
        """
        return self._solution.of(self._solution.mounting_rows(camera))[0]

    def _joint_rows(self, first: int, second: int) -> Tensor:
        rows = [self._solution.parameter_rows(camera) for camera in (first, second)]
        return torch.cat([*rows, self._solution.relative_rows(first, second)])


# Report a solved rig: residuals of every item and of every source, in pixels, meters and sigmas.

# Reasons for leaving items out, by their places among all.
Reasons = Mapping[int, str]


class Records(NamedTuple):
    """What is told of the residuals of a solved rig.

    Attributes:
        items: one record for each point that was seen or measured.
        sources: one for each source.
        squared: (C,) squares of the residuals in each image, px².
        counts: (C,) how many marks, or columns of a skyline, these are.
    """

    items: tuple[ItemResidual, ...]
    sources: tuple[RigSource, ...]
    squared: Tensor
    counts: Tensor


def records(work: Adjustment, mask: Tensor, reasons: Reasons) -> Records:
    """One record for each item and measurement, and one for each source.

    What was left out is compared with where the others put it: a landmark at its surveyed place, a board or feature at
    the place that suits it best.

    Args:
        work: at the solution of the items in the mask.
        mask: the items that take part.
        reasons: why others could not take part, where that is known.
    """
    telling = [source.marked.flatten(1).sum(-1) >= source.told_by for source, _ in work.sources]
    outside = ~mask & torch.cat([mask[:0], *telling])
    if bool(outside.any()):
        work.solve(outside, LMOptions(residual_floor=1e-8), held=True)
    square, freedom = work.squares(mask), work.freedom(mask)
    squared, count = work.squares_px(mask, work.state)
    over = work.over_limit(mask, work.deletions(mask))
    items = _item_records(work, mask, (square, freedom, squared, count, over), reasons, used=True)
    if bool(outside.any()):
        gone = work.squares(outside)
        fit = gone, work.freedom(outside), *work.squares_px(outside, work.at_survey(work.state))
        items += _item_records(work, outside, (*fit, work.over_limit(outside, gone, 0.999)), reasons, used=False)
    for source, at in work.sources:
        for i in (~mask & ~outside)[at].nonzero()[:, 0].tolist():
            name, why = source.names[i], reasons[at.start + i]
            items.append(
                ItemResidual(
                    source=source.kind, name=name, sigmas=math.inf, over_limit=math.inf, used=False, reason=why
                )
            )
    items += [item for term in work.terms for item in term.told(work.state.center, work.data.names)]
    order = list(dict.fromkeys(source.kind for source in work.data.sources))
    items.sort(key=lambda item: (order.index(item.source), not item.used))
    sources = list[RigSource]()
    for source, at in work.sources:
        dof, times = int(freedom[at].sum()), work.widened[source.kind]
        sigmas = times * math.sqrt(float(square[at].nansum()) / dof) if dof > 0 else None
        sources += _source_record(source.kind, items, squared[at].sum(0), count[at].sum(0), sigmas)
    squared, count = squared.sum(0), count.sum(0)
    for kind in dict.fromkeys(term.kind for term in work.terms):
        pixels = [found for term in work.terms if term.kind == kind and (found := term.squares_px()) is not None]
        own = [torch.stack(values).sum(0) for values in zip(*pixels, strict=True)] or [torch.zeros(len(count))] * 2
        sigmas = _root_mean_square([item.sigmas for item in items if item.source == kind])
        sources += _source_record(kind, items, own[0], own[1], sigmas)
        squared, count = squared + own[0], count + own[1]
    return Records(tuple(items), tuple(sources), squared, count)


def _item_records(
    work: Adjustment, mask: Tensor, fit: tuple[Tensor, ...], reasons: Reasons, *, used: bool
) -> list[ItemResidual]:
    """Records of the items in the mask.

    Args:
        work: with their state.
        mask: which.
        fit: χ² (V,) of all items, their degrees of freedom (V,), squares of the distances of their marks (V, C), how
            many marks (V, C), and how far they are over their limits (V,).
        reasons: see `records`.
        used: whether they take part.
    """
    square, freedom, squared, count, over = fit
    rms, found = (squared / count.clamp_min(1)).sqrt().nan_to_num(math.inf).tolist(), list[ItemResidual]()
    marks, limits = count.tolist(), over.tolist()
    for source, at in work.sources:
        meters = source.meters(work.state.items[at])
        for i in mask[at].nonzero()[:, 0].tolist():
            k = at.start + i
            sigmas = work.widened[source.kind] * math.sqrt(float(square[k]) / max(int(freedom[k]), 1))
            pixels = tuple(px if n else None for px, n in zip(rms[k], marks[k], strict=True))
            seen = [(px, name) for px, name in zip(pixels, work.data.names, strict=True) if px is not None]
            off = ", ".join(
                f"{px:.2g} px in {name}" if math.isfinite(px) else f"not seen by {name}" for px, name in seen
            )
            why = "" if used else reasons.get(k) or source.doubt(off, sigmas, limits[k])
            found.append(
                ItemResidual(
                    source=source.kind,
                    name=source.names[i],
                    pixels=pixels,
                    meters=None if meters is None else float(meters[i]),
                    sigmas=sigmas,
                    over_limit=limits[k],
                    used=used,
                    reason=why,
                )
            )
    return found


def _source_record(
    kind: str, items: Sequence[ItemResidual], squared: Tensor, count: Tensor, sigmas: float | None
) -> list[RigSource]:
    """The record of a source, if it has items, from the squares (C,) of its residuals in each image and how many."""
    own = [item for item in items if item.source == kind]
    if not own:
        return []
    meters = [item.meters for item in own if item.used and item.meters is not None]
    marks = int(count.sum())
    return [
        RigSource(
            name=kind,
            used=sum(item.used for item in own),
            left_out=sum(not item.used for item in own),
            rms_px=math.sqrt(float(squared.sum()) / marks) if marks else None,
            rms_m=_root_mean_square(meters) if meters else None,
            sigmas=sigmas,
        )
    ]


def _root_mean_square(values: Sequence[float]) -> float:
    return math.sqrt(sum(value**2 for value in values) / len(values))


def places(work: Adjustment) -> dict[str, dict[str, Tensor]]:
    """Positions (3,) of boards (their middle), landmarks and features in the local frame, by name."""
    each = [(source, source.places(work.state.items[at], work.anchor)) for source, at in work.sources]
    return {source.kind: dict(zip(source.names, where, strict=True)) for source, where in each if where is not None}
