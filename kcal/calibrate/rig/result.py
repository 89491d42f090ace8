"""The result of `calibrate_rig`, and its records: residuals by source and by item."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import Adjustment, over_limit
from kcal.calibrate.rig.blocks import KINDS, Kind, PerKind, RigState
from kcal.calibrate.rig.initial_poses import TurnedBoard
from kcal.calibrate.rig.problem import RigProblem
from kcal.calibrate.rig.sources import RigData
from kcal.calibrate.rig.uncertainty import SharedCovariance, mounting_rows, parameter_rows, relative_rows
from kcal.io.rig_file import save_rig
from kcal.lens.calibration import Exclusion, RigCalibration, RigSource
from kcal.lens.camera import Camera
from kcal.lens.rig import CameraRig, CameraRigCalibration, Origin, RigCovariance, StereoRig
from kcal.solve.lm import LMOptions
from kcal.solve.problem import SolverStatus
from kcal.texts import brief

# The result of solving a rig: cameras, residuals by source and by item, what was left out and why, covariances.

Source = Literal["boards", "landmarks", "features", "stars", "skyline", "baselines", "positions"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ItemResidual:
    """One thing that was seen or measured, and how well it agrees with the rest.

    Args:
        source: which kind it is.
        name: its name.
        pixels: RMS distance in px in each camera, of what was left out from where the others put it; None where a
            camera did not see it.
        meters: of a landmark between survey and adjusted position, of a measured position between measured and solved,
            of a baseline its error; None for the others.
        sigmas: root of χ² over its degrees of freedom, by the stated sigmas; 1 is typical.
        over_limit: by how much χ² falls without it, over the most that noise and lenses explain
            (`kcal.calibrate.rig.adjustment`): above 1, it contradicts the rest. 0 for baselines and positions.
        used: whether it is part of the solution.
        reason: why it was left out.
    """

    source: Source
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


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RigResult:
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
        rms_px: likewise of each camera; NaN for a camera with none.
        chi2: sum of squares of all residuals over their sigmas, as used: those of a source that fits itself worse than
            stated were multiplied (`kcal.calibrate.rig.problem`).
        freedom: degrees of freedom.
        variance: by which covariances are multiplied, because residuals are larger than their sigmas say or because
            ranges are not linear in errors of the baseline (`kcal.calibrate.rig.assess`); 1 if neither.
        sigma_corner: of a board's corner along an axis, px, as used; None without boards.
        undetermined: what the data leave open, in words; none of it concerns the cameras' relative poses.
        contradictions: which source contradicts the others beyond reasonable doubt
            (`kcal.calibrate.rig.explanations`), a sentence each; such a rig should not be used.
        status: why the solver stopped.
        warnings: one sentence for each thing that the user should doubt.
    """

    __repr__ = brief

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
    contradictions: tuple[str, ...]
    status: SolverStatus
    warnings: tuple[str, ...]
    _problem: RigProblem
    _state: RigState
    _covariance: SharedCovariance
    _places: dict[Source, dict[str, Tensor]]
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
        maps = self._problem.unknowns.cameras
        return tuple(name for name, by_unknown in zip(self.names, maps, strict=True) if not bool(by_unknown.any()))

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

    def stereo(self, first: int = 0, second: int = 1) -> StereoRig:
        """Two of the cameras as a rig, with its covariance and with how it was solved.

        `kcal.rig.placed_rig` adds where it stands on the Earth. The covariance is left out where the data do not
        determine all parameters of the cameras.
        """
        rotation = self.rotation[second] @ self.rotation[first].T
        translation = self.rotation[second] @ (self.center[first] - self.center[second])
        rig = StereoRig(self.cameras[first], self.cameras[second], rotation, translation)
        half = self._covariance.half_of(self._joint_rows(first, second))
        if half is not None:
            rig.covariance = RigCovariance(half=half)
        rms = [0.0 if math.isnan(self.rms_px[camera]) else self.rms_px[camera] for camera in (first, second)]
        rig.calibration = RigCalibration(
            rms=self.rms,
            rms_left=rms[0],
            rms_right=rms[1],
            pairs=len(self.pairs),
            per_pair_rms=dict(zip(self.pairs, self.pair_rms.tolist(), strict=True)),
            flipped=tuple(dict.fromkeys(turned.board for turned in self.flipped)),
            baseline_m=float(rig.baseline),
            **self._history(),
        )
        return rig

    def stations(self, origin: Origin | None = None) -> CameraRig:
        """All cameras with what is known of them together, which is left out where the data leave something open.

        Args:
            origin: of the frame in which landmarks and positions were given.
        """
        each = range(len(self.cameras))
        rig = CameraRig(
            self.cameras, self.names, self.rotation, self.center, origin=origin if self.absolute else None,
            refraction=self.refraction if self.absolute and origin is not None else 0.0,
        )  # fmt: skip
        poses = [mounting_rows(self._problem, self._state, camera) for camera in each]
        lenses = [parameter_rows(self._problem, camera) for camera in each]
        rig.root = self._covariance.half_of(torch.cat([*lenses, *(pose[:6] for pose in poses), poses[0][6:]]))
        rig.calibration = CameraRigCalibration(
            rms=self.rms,
            rms_px=tuple(None if math.isnan(rms) else rms for rms in self.rms_px),
            undetermined=self.undetermined,
            **self._history(),
        )
        return rig

    def _history(self) -> dict[str, Any]:
        """What `stereo` and `stations` tell alike of how a rig was solved."""
        return {
            # Boards by their names alone, as in `per_pair_rms`.
            "excluded": tuple(
                Exclusion(f"{item.source} {item.name}".removeprefix("boards "), item.reason) for item in self.left_out
            ),
            "sources": self.sources,
            "warnings": self.warnings,
            "contradictions": self.contradictions,
            **self._provenance,
        }

    def save(self, path: str | Path) -> Path:
        """Write the rig of the first two cameras as `stereo` gives it; see `kcal.save_rig`."""
        return save_rig(self.stereo(), path)

    def places(self) -> dict[Source, dict[str, Tensor]]:
        """Where boards (their middle), landmarks and features are: (3,) meters in the local frame, by name.

        Features as far away as their inverse range says, at most 100 km.
        """
        return self._places

    def relative_covariance(self, first: int = 0, second: int = 1) -> Tensor:
        """(6, 6) of second_from_first: rotation vector about the second camera's axes, translation along them."""
        return self._covariance.of(relative_rows(self._problem, self._state, first, second))[0]

    def joint_covariance(self, first: int = 0, second: int = 1) -> Tensor:
        """Of both cameras' parameters (zeros where held) and their relative pose, in the order of `RigCovariance`."""
        return self._covariance.of(self._joint_rows(first, second))[0]

    @property
    def refraction(self) -> float:
        """Coefficient of refraction of the light from landmarks; its variance is the last of `mounting_covariance`."""
        return float(self._state.refraction)

    def effects(self) -> dict[str, tuple[float, float]]:
        """What shifts stars, landmarks or features together: its amount and standard deviation, in stated sigmas."""
        maps = self._problem.unknowns.by_effects
        if maps is None:
            return {}
        rows = torch.nn.functional.pad(maps, (0, self._problem.shared_size - maps.shape[1]))
        sigma, amount = self._covariance.variances(rows).sqrt(), maps @ self._state.unknown
        return dict(zip(self.data.effects, zip(amount.tolist(), sigma.tolist(), strict=True), strict=True))

    def mounting_link(self, first: int = 0, second: int = 1) -> Tensor:
        """(P, 7) covariance of `joint_covariance`'s P quantities with `mounting_covariance`'s of the first camera."""
        rows = [self._joint_rows(first, second), mounting_rows(self._problem, self._state, first)]
        return self._covariance.of(torch.cat(rows))[0][:-7, -7:]

    def mounting_covariance(self, camera: int = 0) -> Tensor:
        """(7, 7) of a camera's center (meters), of small turns of it (radians), and of the coefficient of refraction.

        Centers and turns are along and about the local frame's axes. Infinite variances where the data leave something
        open; zeros for the first camera of a rig that is not `absolute`.
        """
        return self._covariance.of(mounting_rows(self._problem, self._state, camera))[0]

    def _joint_rows(self, first: int, second: int) -> Tensor:
        rows = [parameter_rows(self._problem, camera) for camera in (first, second)]
        return torch.cat([*rows, relative_rows(self._problem, self._state, first, second)])


# Report a solved rig: residuals of every item and of every source, in pixels, meters and sigmas.

# Reasons for leaving items out, by their indices.
Reasons = Mapping[Kind, Mapping[int, str]]
# Fewest marks of an item whose residuals say anything about it.
_MARKS: Mapping[Kind, int] = {"boards": 4, "landmarks": 1, "features": 2, "stars": 1}
# 1/m: features are drawn no farther away than 100 km.
_LEAST_INVERSE_RANGE = 1e-5


def item_records(work: Adjustment, masks: PerKind, reasons: Reasons) -> tuple[ItemResidual, ...]:
    """One record for each board, landmark, feature, baseline and position.

    What was left out is compared with where the others put it: a landmark at its surveyed place, a board or feature at
    the place that suits it best.
    """
    items: list[ItemResidual] = []
    outside = PerKind(*(~mask & _marked(work, kind, mask) for kind, mask in zip(KINDS, masks, strict=True)))
    if any(bool(mask.any()) for mask in outside):
        work.solve(outside, LMOptions(residual_floor=1e-8), held=True)
    for used, chosen in ((True, masks), (False, outside)):
        squares, freedom, pixels = work.squares(chosen), work.freedom(chosen), _rms_by_camera(work, chosen, used)
        over = over_limit(work, chosen, work.deletions(chosen)) if used else over_limit(work, chosen, squares, 0.999)
        for k, kind in enumerate(KINDS):
            times = work.widened[kind]
            for i in chosen[k].nonzero()[:, 0].tolist():
                sigmas = times * math.sqrt(float(squares[k][i]) / max(int(freedom[k][i]), 1))
                why = (
                    ""
                    if used
                    else reasons[kind].get(i) or _contradiction(work, kind, pixels[kind][i], sigmas, float(over[k][i]))
                )
                items.append(
                    ItemResidual(
                        source=kind,
                        name=work.names(kind)[i],
                        pixels=pixels[kind][i],
                        meters=_off_survey(work, i) if kind == "landmarks" else None,
                        sigmas=sigmas,
                        over_limit=float(over[k][i]),
                        used=used,
                        reason=why,
                    )
                )
    for kind, mask, marked in zip(KINDS, masks, outside, strict=True):
        for i in (~mask & ~marked).nonzero()[:, 0].tolist():
            name, why = work.names(kind)[i], reasons[kind][i]
            items.append(
                ItemResidual(source=kind, name=name, sigmas=math.inf, over_limit=math.inf, used=False, reason=why)
            )
    items += _measurement_records(work)
    order = list(get_args(Source))
    return tuple(sorted(items, key=lambda item: (order.index(item.source), not item.used)))


def source_records(work: Adjustment, masks: PerKind, items: Sequence[ItemResidual]) -> tuple[RigSource, ...]:
    """Each source that there is."""
    squares, freedom, found = work.squares(masks), work.freedom(masks), list[RigSource]()
    problem, state = work.problem(masks), work.part(masks)
    rms_px: dict[Source, float] = {
        block.kind: math.sqrt(float(block.errors(problem.posed(state), state).square().sum()) / int(block.seen.sum()))
        for block in problem.blocks
    }
    skyline = work.data.skyline
    if skyline is not None:
        squares_px = [many * px**2 for many, px in zip(skyline.columns, skyline.rms_px, strict=True)]
        rms_px["skyline"] = math.sqrt(sum(squares_px) / sum(skyline.columns))
    for source in get_args(Source):
        own = [item for item in items if item.source == source]
        if not own:
            continue
        sigmas: float | None = _root_mean_square([item.sigmas for item in own])
        if source in KINDS:
            k = KINDS.index(source)
            total, dof = float(squares[k].nansum()), int(freedom[k].sum())
            sigmas = work.widened[KINDS[k]] * math.sqrt(total / dof) if dof > 0 else None
        meters = [item.meters for item in own if item.used and item.meters is not None]
        found.append(
            RigSource(
                name=source,
                used=sum(item.used for item in own),
                left_out=sum(not item.used for item in own),
                rms_px=rms_px.get(source),
                rms_m=_root_mean_square(meters) if meters else None,
                sigmas=sigmas,
            )
        )
    return tuple(found)


def _root_mean_square(values: Sequence[float]) -> float:
    return math.sqrt(sum(value**2 for value in values) / len(values))


def _marked(work: Adjustment, kind: Kind, mask: Tensor) -> Tensor:
    source = getattr(work.data, kind)
    if source is None:
        return mask.clone()
    return torch.isfinite(source.pixels).all(-1).flatten(1).sum(-1) >= _MARKS[kind]


def _rms_by_camera(work: Adjustment, masks: PerKind, used: bool) -> dict[Kind, dict[int, tuple[float | None, ...]]]:
    """RMS distance in pixels of each item in each camera; of landmarks that are not used, from their surveyed place."""
    problem, state = work.problem(masks), work.part(masks)
    if not used and work.data.landmarks is not None:
        state = state._replace(points=work.data.landmarks.points[masks.landmarks])
    found: dict[Kind, dict[int, tuple[float | None, ...]]] = {}
    for block in problem.blocks:
        squared, count = block.errors(problem.posed(state), state).square().sum((2, 3)), block.seen.sum(-1)
        rms = (squared / count.clamp_min(1)).sqrt().nan_to_num(math.inf)
        rows = [
            tuple(value if n else None for value, n in zip(values, ns, strict=True))
            for values, ns in zip(rms.tolist(), count.tolist(), strict=True)
        ]
        found[block.kind] = dict(zip(getattr(masks, block.kind).nonzero()[:, 0].tolist(), rows, strict=True))
    return found


def _off_survey(work: Adjustment, index: int) -> float:
    assert work.data.landmarks is not None
    return float(torch.linalg.vector_norm(work.state.points[index] - work.data.landmarks.points[index]))


def _contradiction(work: Adjustment, kind: Kind, pixels: Sequence[float | None], sigmas: float, over: float) -> str:
    seen = [(value, name) for value, name in zip(pixels, work.data.names, strict=True) if value is not None]
    text = ", ".join(
        f"{value:.2g} px in {name}" if math.isfinite(value) else f"not seen by {name}" for value, name in seen
    )
    if kind == "landmarks":
        return f"its marks are off the surveyed place by {text} ({sigmas:.0f} sigma): a wrong mark or survey"
    if kind == "features":
        return f"its marks do not meet: off by {text} ({sigmas:.0f} sigma): not the same thing, or it moved"
    if kind == "stars":
        return f"off by {text} ({sigmas:.0f} sigma): not that star, or an aircraft or satellite"
    why = "it moved between the views, or a lens differs from its model"
    # A board of many corners is wrong at few sigmas. One that is within its own limit was left out because the others
    # fit better without it (`outliers.without_wrong`).
    if over > 1.0:
        most = f"{sigmas:.2f} sigma on average, where so many corners allow {sigmas / math.sqrt(over):.2f}"
        return f"it does not fit the other boards: off by {text} ({most}): {why}"
    return (
        "it does not fit the other boards: with it, these fit worse than chance explains, though it is off by only "
        f"{text} ({sigmas:.2f} sigma on average): {why}"
    )


def _measurement_records(work: Adjustment) -> list[ItemResidual]:
    data, center, out = work.data, work.state.center, []
    for b in data.baselines:
        error = float(torch.linalg.vector_norm(center[b.first] - center[b.second])) - b.length
        name = f"{data.names[b.first]} to {data.names[b.second]}"
        out.append(ItemResidual(source="baselines", name=name, meters=error, sigmas=abs(error) / b.sigma))
    if data.skyline is not None:
        own = zip(data.skyline.names, data.skyline.cameras, data.skyline.rms_px, data.skyline.sigmas, strict=True)
        for name, camera, rms, sigmas in own:
            pixels = tuple(rms if c == camera else None for c in range(len(data.cameras)))
            out.append(ItemResidual(source="skyline", name=name, pixels=pixels, sigmas=sigmas))
    for p in data.positions:
        off = center[p.camera] - p.point
        sigmas = math.sqrt(float((off / p.sigma).square().mean()))
        meters = float(torch.linalg.vector_norm(off))
        out.append(ItemResidual(source="positions", name=data.names[p.camera], meters=meters, sigmas=sigmas))
    return out


def places(work: Adjustment) -> dict[Source, dict[str, Tensor]]:
    """Positions (3,) of boards (their middle), landmarks and features in the local frame, by name."""
    data, state, found = work.data, work.state, dict[Source, dict[str, Tensor]]()
    if data.boards is not None:
        middle = data.boards.points.mean(0)
        where = state.board_rotation @ middle + state.board_translation
        found["boards"] = dict(zip(data.boards.names, where, strict=True))
    if data.landmarks is not None:
        found["landmarks"] = dict(zip(data.landmarks.names, state.points, strict=True))
    if data.features is not None:
        far = work.anchor + state.direction / state.inverse_range.clamp_min(_LEAST_INVERSE_RANGE)[:, None]
        found["features"] = dict(zip(data.features.names, far, strict=True))
    return found
