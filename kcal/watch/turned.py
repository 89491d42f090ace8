"""A rig has turned since it was solved: measure it, tell what it does to ranges, and correct the rig."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

import kcal.calibrate.rig.adjustment as adjustment
from kcal.calibrate.rig.marks import Features, Landmarks
from kcal.calibrate.rig.problem import RigSolution, goodness_of_fit
from kcal.calibrate.rig.result import records
from kcal.calibrate.rig.source import Start
from kcal.calibrate.rig.sources import RigData
from kcal.calibrate.rig.unknowns import by_errors, held
from kcal.checks import as_points, beyond_chance
from kcal.errors import DegenerateError, InputError
from kcal.gaussian import half_of_covariance
from kcal.lens.calibration import ItemResidual
from kcal.lens.pose import rotation_from_vector, vector_from_rotation
from kcal.lens.rig import REFRACTION, REFRACTION_SIGMA, Rig
from kcal.locate.budget import measured_ranges, right_turned, usual_ranges
from kcal.locate.marks import PAIR, Marks
from kcal.locate.mounting import attitude
from kcal.locate.stereo import PositionStatus, sight_lines
from kcal.solve.lm import LMOptions
from kcal.texts import brief
from kcal.threads import in_one_thread
from kcal.watch.marked_twice import camera_turns

# Measure how the cameras of a rig have turned since it was solved, from points that do not move (`kcal rig check`).
#
# Masts bend in the sun and mounts settle: the cameras stay where they are and turn by thousandths of a degree, which at
# long range is all that matters (0.01° of relative yaw is 436 m at 5 km with 10 m of baseline). Only rotations are
# unknown here.

_SOLVER = LMOptions(residual_floor=1e-8)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Drift:
    """How the cameras have turned, in radians about their own axes: pitch (x), yaw (y), roll (z).

    Args:
        left: (3,) turn of the left camera; None where only the relative attitude can be told.
        right: (3,) of the right camera; likewise.
        relative: (3,) of right_from_left about the right camera's axes, as in
            `kcal.lens.pose.apply_twist`.
        left_covariance: (3, 3), None as above.
        right_covariance: (3, 3), None as above.
        relative_covariance: (3, 3).
        chi2: of the relative turn: with three degrees of freedom, if there was none.
        old: the rig as it was solved.
        rig: the rig as it stands now: the same cameras in the same places, turned.
        root: (K, P) what was not known of the rig, and is not known of it as it stands now, as `Rig.relative_root`;
            None: nothing.
        pose_covariance: (6, 6) what the measurement adds for the relative pose.
        attitude_covariance: (3, 3) what it adds for the left camera's attitude, about its own axes; None as above.
        cam_from_local: (3, 3) of the left camera now, where a pose was given.
        items: residuals by item, those left out included: what moved, or is not the same point.
        variance: by which covariances were multiplied, because residuals were larger than stated.
        moved: what near points tell of cameras that are elsewhere now, a sentence each: their turns are wrong then.
    """

    __repr__ = brief

    left: Tensor | None
    right: Tensor | None
    relative: Tensor
    left_covariance: Tensor | None
    right_covariance: Tensor | None
    relative_covariance: Tensor
    chi2: float
    old: Rig
    rig: Rig
    root: Tensor | None
    pose_covariance: Tensor
    attitude_covariance: Tensor | None
    cam_from_local: Tensor | None
    items: tuple[ItemResidual, ...]
    variance: float
    moved: tuple[str, ...] = ()

    @property
    def significant(self) -> bool:
        """Whether chance alone would show so large a relative turn in less than one of a thousand checks."""
        return beyond_chance(self.chi2, 3)

    @property
    def left_significant(self) -> bool:
        """The same of the left camera's turn; False where that cannot be told."""
        if self.left is None or self.left_covariance is None:
            return False
        return beyond_chance(float(self.left @ torch.linalg.solve(self.left_covariance, self.left)), 3)

    @property
    def left_out(self) -> tuple[ItemResidual, ...]:
        """What is not part of the answer."""
        return tuple(item for item in self.items if not item.used)

    @property
    def turns(self) -> tuple[tuple[str, Tensor, Tensor], ...]:
        """What has turned, by how much (3,) and with which covariance (3, 3); without what cannot be told."""
        every = (
            ("left camera", self.left, self.left_covariance), ("right camera", self.right, self.right_covariance),
            ("right from left", self.relative, self.relative_covariance),
        )  # fmt: skip
        return tuple((name, turn, cov) for name, turn, cov in every if turn is not None and cov is not None)

    def effect(self, distances: Sequence[float] | None = None) -> DriftEffect:
        """Ranges that the old rig finds, in the direction in which both cameras look.

        Args:
            distances: D true ones, meters; `usual_ranges` if left out.

        Raises:
            InputError: a distance that is not positive, or cameras that do not look the same way.

        Example:
            >>> from kcal.rig import planned_rig
            >>> turns = torch.tensor([0.0, 0.0, 0.0, 0.0, 1.745329e-4, 0.0], dtype=torch.float64)  # 0.01°
            >>> found = drift_of_turns(planned_rig(), turns, 1e-12 * torch.eye(6).double()).effect().found
            >>> [round(value) for value in found.tolist()]
            [251, 1018, 5478]
        """
        old, new = self.old, self.rig
        far = torch.tensor(usual_ranges(old) if distances is None else list(distances), dtype=torch.float64)
        if not bool(((far > 0) & torch.isfinite(far)).all()):
            raise InputError("distances: positive numbers of meters are needed")
        with torch.no_grad():
            axis = new.right_from_left_rotation[2] + new.right_from_left_rotation.new_tensor([0.0, 0.0, 1.0])
            points = far[:, None] * axis / torch.linalg.vector_norm(axis)
            left, ahead = new.left.project(points)
            right, beside = new.right.project(new.right_from_left(points))
            if not bool((ahead & beside).all()):
                raise InputError("the cameras do not look the same way: the effect of a drift cannot be computed")
            found = measured_ranges(old, right, left)
            # Turning the right camera by ω about its x, y, z moves a point's image; the range follows the disparity.
            rows = torch.stack([_range_slope(new, points, axis) for axis in torch.eye(3, dtype=torch.float64)], -1)
        sigma = (rows @ self.relative_covariance * rows).sum(-1).clamp_min(0.0).sqrt()
        # A turn changes 1 / range alike at all ranges, and the old rig finds the point at another one.
        return DriftEffect(far, found, sigma * (found / far).square())

    @in_one_thread
    def relocked(self, note: str) -> Rig:
        """The old rig with the present attitudes; cameras and their places stay.

        The errors of the first solution are still in it, but for those of attitudes that landmarks tell anew; those of
        the check come on top. What counted as exact has the latter alone.

        Args:
            note: when and from what, for the record.

        Raises:
            InputError: a camera has moved.

        Example:
            >>> from kcal.rig import planned_rig
            >>> turned = drift_of_turns(planned_rig(), 1e-4 * torch.ones(6).double(), 1e-10 * torch.eye(6).double())
            >>> float(turned.relocked("Monday").baseline)
            10.0
        """
        if self.moved:
            raise InputError(f"{' and '.join(self.moved)}: turns alone do not correct the rig; solve it anew")
        rig = self.old
        new = Rig.pair(rig.left, rig.right, self.rig.right_from_left_rotation, self.rig.right_from_left_translation)
        stands, pad = rig.mounting, torch.nn.functional.pad
        more = [pad(half_of_covariance(self.pose_covariance), (rig.quantities - 13, 7))]
        if stands is not None and self.cam_from_local is not None and self.attitude_covariance is not None:
            heading, pitch, roll = attitude(self.cam_from_local.T)
            stands = dataclasses.replace(stands, heading_deg=heading, pitch_deg=pitch, roll_deg=roll)
            half = half_of_covariance(self.attitude_covariance) @ self.cam_from_local
            more.append(pad(half, (rig.quantities - 4, 1)))
        new.mounting = stands
        # The same number of shared errors at every time, for filters.
        more = [pad(half, (0, 0, 0, most - len(half))) for half, most in zip(more, (6, 3), strict=False)]
        new.relative_root = torch.cat(more if self.root is None else [self.root, *more])
        if rig.calibration is not None:
            new.calibration = dataclasses.replace(rig.calibration, relocked=note)
        return new


class DriftEffect(NamedTuple):
    """Errors of the old rig's positions after a turn, (D,) meters for D distances.

    Attributes:
        distance: true range from the left camera.
        found: range by the old rig; infinite where its rays no longer meet.
        sigma: one sigma of the shift, from the covariance of the turn, to first order.
    """

    distance: Tensor
    found: Tensor
    sigma: Tensor


def _range_slope(rig: Rig, points: Tensor, axis: Tensor) -> Tensor:
    """Meters of range by a radian of the right camera about one of its axes (3,)."""
    ends = []
    for step in (-1e-8, 1e-8):
        left, right = right_turned(rig, step * axis)(points)[0].unbind(-2)
        ends.append(torch.linalg.vector_norm(sight_lines(rig, left, right).points, dim=-1))
    return (ends[1] - ends[0]) / 2e-8


@in_one_thread
def measure_drift(
    rig: Rig,
    *,
    features: Features | None = None,
    landmarks: Landmarks | None = None,
    pose: tuple[Tensor, Tensor] | None = None,
    root: Tensor | None = None,
    refraction: tuple[float, float] = (REFRACTION, REFRACTION_SIGMA),
) -> Drift:
    """Find how the cameras of a rig have turned.

    From static features that were marked when the rig was good and are marked again (what they are and how far away
    does not matter): errors of the rig and its lenses cancel, and equal marks give exactly no drift. Or from surveyed
    landmarks, or from far features of known range; the last tell only how the right camera has turned if the left one
    has not. What moved, or contradicts the rest, is left out.

    Args:
        rig: as it was solved.
        features: pixels (F, 4, 2): left and right then, left and right now. If any has a mark then, only those with a
            mark then and now in the same camera are used; otherwise those of known range.
        landmarks: pixels (L, 2, 2), left and right now; not with features that have a mark then.
        pose: rotation cam_from_local (3, 3) and center (3,) of the left camera when the rig was solved, in the frame of
            the landmarks; needed with these.
        root: (K, P) errors of the rig when it was solved, `Rig.root`: part of what a turn is compared with, unless
            features have marks then. Errors of lenses and places were in the attitudes then, and are in those now: as
            far as they move both alike, they are no turn.
        refraction: coefficient of refraction of the light from landmarks now, and its standard deviation.

    Raises:
        InputError: nothing to measure with, landmarks without a pose or together with features that have marks then, or
            many features that moved.
        DegenerateError: too little to tell the turn.

    Example:
        >>> from kcal import Camera
        >>> from kcal.lens import rotation_from_vector
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> turn = rotation_from_vector(torch.tensor([0.0, 2e-4, 0.0], dtype=torch.float64))
        >>> later = Rig.pair(camera, camera, turn, turn @ rig.right_from_left_translation)
        >>> points = torch.tensor([[-900.0, 200, 3000], [800, -90, 2500], [40, 60, 4000], [300, 200, 2000]]).double()
        >>> pixels = torch.stack([*rig(points)[0].unbind(-2), *later(points)[0].unbind(-2)], 1)
        >>> known = torch.zeros(4).double(), torch.full((4,), torch.inf).double()
        >>> static = Features(names=tuple("abcd"), pixels=pixels, inverse_range=known[0], inverse_range_sigma=known[1])
        >>> round(float(measure_drift(rig, features=static).relative[1]), 9)
        0.0002
    """
    if features is None and landmarks is None:
        raise InputError("drift: features or landmarks are needed")
    if landmarks is not None and pose is None:
        raise InputError("drift: landmarks need the left camera's pose in their frame")
    if features is not None and bool(torch.isfinite(features.pixels[:, :2]).all(-1).any()):
        if landmarks is not None:
            raise InputError("drift: features with marks then tell the turn without errors of a survey; give either")
        return _since(rig, features, None if pose is None else as_points("pose rotation", pose[0], 3))
    # How the cameras stand now against how the rig was solved, from landmarks or features of known range. Without
    # landmarks the left camera holds the frame.
    loose = landmarks is not None
    rotation, center = pose or (torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    rotation, center = as_points("pose rotation", rotation, 3), as_points("pose center", center, 3)
    right_center = center - rotation.T @ rig.right_from_left_rotation.T @ rig.right_from_left_translation
    start = Start(
        rotation=torch.stack([rotation, rig.right_from_left_rotation @ rotation]),
        center=torch.stack([center, right_center]),
    )
    if features is not None:
        features = dataclasses.replace(features, pixels=features.pixels[:, 2:])
    cameras = (rig.left, rig.right)
    data = RigData(cameras=cameras, names=PAIR, features=features, landmarks=landmarks)
    unknowns = held(cameras).and_refraction(*refraction) if loose else held(cameras)
    turning = [loose, True]
    work = adjustment.Adjustment(data, start, unknowns, 1.0, turning=turning, moving=[False] * 2)
    mask = _telling(data)
    reasons = dict.fromkeys((~mask).nonzero()[:, 0].tolist(), "too few of the images have a mark of it")
    if int(mask.sum()) < 2:
        raise DegenerateError("drift: two features or landmarks at least are needed; more let wrong ones be found")
    work.solve(mask, adjustment.ROUGHLY, adjustment.LOSS)
    mask = adjustment.without_wrong(work, mask, _SOLVER)
    problem, _ = work.solve(mask, _SOLVER)
    state = work.part(mask)
    fit = goodness_of_fit(problem, state)
    known = RigSolution(problem, state, fit.variance)
    covariance, determined = known.of(known.relative_rows(0, 1))
    if not bool(determined[:3].all()):
        left_open = "; ".join(known.open_directions(PAIR, absolute=True))
        raise DegenerateError(f"drift: what was seen does not determine how the cameras have turned ({left_open})")
    relative = state.rotation[1] @ state.rotation[0].T
    drift = vector_from_rotation(relative @ rig.right_from_left_rotation.T)
    own = [vector_from_rotation(now @ then.T) for now, then in zip(state.rotation, start.rotation, strict=True)]
    alone = [known.of(known.turn_rows(c))[0] for c in (0, 1)]
    compared = covariance[:3, :3]
    spreads, standing = alone, rig.relative_root
    if root is not None:
        now = _turned_by_errors(work, mask, rig, root, turning, rotation.T)
        then = torch.stack([-root[:, rig.pose_columns(c)][:, 3:] @ rig.rotation[c].T for c in (0, 1)])
        changed = now - then
        spreads = [spread + each.T @ each for spread, each in zip(alone, changed, strict=True)]
        between = now[1] - now[0] @ relative.T - then[1] + then[0] @ rig.right_from_left_rotation.T
        compared = compared + between.T @ between
        if loose and standing is not None:
            moved = torch.linalg.cross(changed[1], rig.right_from_left_translation.expand_as(changed[1]))
            standing[:, -13:-7] += torch.cat([between, moved], 1)
            standing[:, -4:-1] = -now[0] @ state.rotation[0]
    return Drift(
        left=own[0] if loose else None,
        right=own[1] if loose else None,
        relative=drift,
        left_covariance=spreads[0] if loose else None,
        right_covariance=spreads[1] if loose else None,
        relative_covariance=compared,
        chi2=float(drift @ torch.linalg.solve(compared, drift)),
        old=rig,
        rig=Rig.pair(rig.left, rig.right, relative, state.rotation[1] @ (state.center[0] - state.center[1])),
        root=standing,
        pose_covariance=covariance,
        attitude_covariance=alone[0] if loose else None,
        cam_from_local=state.rotation[0] if pose is not None else None,
        items=records(work, mask, reasons).items,
        variance=fit.variance,
    )


def _turned_by_errors(
    work: adjustment.Adjustment, mask: Tensor, rig: Rig, root: Tensor, turning: Sequence[bool], local_from_rig: Tensor
) -> Tensor:
    """(2, K, 3) how the cameras are found to be turned, about their own axes, by each of K errors of the rig."""
    count, lenses = len(root), root[:, : sum(rig.sizes)].split(rig.sizes, 1)
    errors = by_errors(work.data.cameras, [own.T for own in lenses])
    if (light := work.unknowns.by_refraction) is not None:
        errors = errors.and_refraction(work.unknowns.refraction, float(light))
    start = Start(rotation=work.state.rotation, center=work.state.center)
    wide = adjustment.Adjustment(work.data, start, errors, 1.0, turning=turning, moving=[True] * 2)
    wide.state = work.state._replace(unknown=torch.cat([torch.zeros(count).double(), work.state.unknown]))
    wide.widened = work.widened
    problem = wide.problem(mask)
    scaled, scale = problem.linearize(wide.part(mask)).information()
    # Normal equations with lenses and places free as well: where these are off, turns give way.
    information = scaled / scale / scale[:, None]
    turns = [torch.arange(slot.start, slot.stop) for slot in problem.turn if slot is not None]
    found = torch.cat([torch.arange(count, len(errors)), *turns])
    pull = information[found, :count]
    for camera, slot in enumerate(problem.shift):
        moved = root[:, rig.pose_columns(camera)][:, :3] @ local_from_rig.T
        pull = pull + information[found, slot] @ moved.T
    by_error = -torch.linalg.solve(information[found][:, found], pull)[len(errors) - count :]
    turned = by_error.unflatten(0, (-1, 3)).transpose(1, 2)
    return torch.cat([turned.new_zeros(2 - len(turned), count, 3), turned])


def _since(rig: Rig, features: Features, cam_from_local: Tensor | None) -> Drift:
    """How the cameras have turned since the marks of then, with the left camera's attitude then, if it is known."""
    then, now = features.pixels.unflatten(1, (2, 2)).unbind(1)
    sigma = features.each_sigma.unflatten(1, (2, 2)).norm(dim=1)
    # Roughly how far away points are, from the marks of then.
    lines = sight_lines(rig, *then.unbind(1))
    apart = torch.stack([lines.points, rig.right_from_left(lines.points)], 1).norm(dim=-1)
    inverse = torch.where((lines.status == int(PositionStatus.OK))[:, None], apart.reciprocal(), 0.0)
    found = camera_turns((rig.left, rig.right), PAIR, then, now, sigma, inverse)
    items = []
    for i, feature in enumerate(features.names):
        off = {name: float(turn.off[i].norm()) for name, turn in zip(PAIR, found.each, strict=True)}
        sigmas = [length / one for length, one in zip(off.values(), sigma[i].tolist(), strict=True)]
        sigmas = [one for one in sigmas if math.isfinite(one)]
        off = {name: length for name, length in off.items() if math.isfinite(length)}
        moved = ", ".join(f"{length:.1f} px ({name})" for name, length in off.items())
        reason = f"it has moved by {moved}" if off else "no camera has a mark of it both then and now"
        typical = math.hypot(*sigmas) / math.sqrt(2 * len(sigmas)) if sigmas else math.inf
        over, used = float(found.over_limit[i]), bool(found.used[i])
        items.append(ItemResidual(
            source="features", name=feature, pixels=tuple(off.get(name) for name in PAIR), sigmas=typical,
            over_limit=over, used=used, reason="" if used else reason,
        ))  # fmt: skip
    turns = torch.cat([turn.vector for turn in found.each])
    covariance = torch.block_diag(*(turn.covariance for turn in found.each))
    drift = drift_of_turns(rig, turns, covariance, cam_from_local, items=tuple(items), variance=found.variance)
    return dataclasses.replace(drift, moved=found.moved)


def drift_of_turns(
    rig: Rig,
    turns: Tensor,
    covariance: Tensor,
    cam_from_local: Tensor | None = None,
    *,
    items: tuple[ItemResidual, ...] = (),
    variance: float = 1.0,
) -> Drift:
    """The drift of a rig whose cameras have turned where they stand.

    Args:
        rig: as it was solved.
        turns: (6,) radians of the left and the right camera about their own axes.
        covariance: (6, 6).
        cam_from_local: (3, 3) of the left camera when the rig was solved, if it is known.
        items: see `Drift`.
        variance: see `Drift`.

    Example:
        >>> from kcal.locate.budget import planned_rig
        >>> turns = torch.tensor([0.0, 1e-4, 0.0, 0.0, 3e-4, 0.0], dtype=torch.float64)
        >>> round(float(drift_of_turns(planned_rig(), turns, 1e-10 * torch.eye(6).double()).relative[1]), 9)
        0.0002
    """
    left, right = turns[:3], turns[3:]
    relative, shift = rig.right_from_left_rotation, rig.right_from_left_translation
    turn = rotation_from_vector(right)
    change = turn @ rotation_from_vector(-(relative @ left))
    # By turns of the left and of the right camera, the change and the shift of the relative pose.
    identity = torch.eye(3, dtype=torch.float64)
    taken_along = torch.linalg.cross(identity, shift.expand(3, 3)).T
    slope = torch.cat([torch.cat([-relative, identity], 1), torch.cat([torch.zeros_like(identity), taken_along], 1)])
    pose = slope @ covariance @ slope.T
    drift = vector_from_rotation(change)
    return Drift(
        left=left,
        right=right,
        relative=drift,
        left_covariance=covariance[:3, :3],
        right_covariance=covariance[3:, 3:],
        relative_covariance=pose[:3, :3],
        chi2=float(drift @ torch.linalg.solve(pose[:3, :3], drift)),
        old=rig,
        rig=Rig.pair(rig.left, rig.right, change @ relative, turn @ shift),
        root=rig.relative_root,
        pose_covariance=pose,
        attitude_covariance=covariance[:3, :3],
        cam_from_local=None if cam_from_local is None else rotation_from_vector(left) @ cam_from_local,
        items=items,
        variance=variance,
    )


def _telling(data: RigData) -> Tensor:
    """Which landmarks have a mark, and which features of known range both cameras see."""
    found = [torch.zeros(0, dtype=torch.bool)]
    if data.landmarks is not None:
        found.append(data.landmarks.marked.any(-1))
    if data.features is not None:
        found.append(data.features.marked.all(-1) & torch.isfinite(data.features.inverse_range_sigma))
    return torch.cat(found)


def check_rig(rig: Rig, *, features: Features | None = None, landmarks: Landmarks | None = None) -> Drift:
    """Measure how the cameras of a rig have turned (`measure_drift`), with the rig's own covariance.

    Its mounting gives the left camera's pose for landmarks, and its covariance says how well the attitudes were known.

    Args:
        rig: as it was solved, with its `covariance` and, for landmarks, its `mounting`.
        features: see `measure_drift`.
        landmarks: see `measure_drift`; in the frame of `rig.mounting.origin`.

    Raises:
        InputError: nothing to measure with, or landmarks for a rig without mounting.
        DegenerateError: too little to tell the turn.

    Example:
        >>> from kcal.rig import planned_rig
        >>> rig, rows = planned_rig(), torch.tensor([[-90.0, 2, 300], [80, -9, 250], [4, 6, 400], [30, 20, 200]])
        >>> pixels = torch.cat([rig(rows.double())[0]] * 2, 1)  # the same then and now
        >>> unknown = torch.zeros(4).double(), torch.full((4,), torch.inf).double()
        >>> static = Features(names=tuple("abcd"), pixels=pixels, inverse_range=unknown[0],
        ...                   inverse_range_sigma=unknown[1])
        >>> check_rig(rig, features=static).significant
        False
    """
    pose: tuple[Tensor, Tensor] | None = None
    refraction = REFRACTION, REFRACTION_SIGMA
    if (stands := rig.mounting) is not None:
        pose = stands.enu_from_cam.T, torch.zeros(3, dtype=torch.float64)
        if stands.covariance is not None:
            # Light that was held straight stays so; otherwise another day has another coefficient.
            refraction = stands.refraction, REFRACTION_SIGMA if bool(stands.covariance[6, 6]) else 0.0
    root = rig.root
    if landmarks is None:
        # The left camera holds the frame: what is not known of its place and attitude does not count.
        alone = Rig.pair(rig.left, rig.right, rig.right_from_left_rotation, rig.right_from_left_translation)
        alone.covariance = rig.covariance
        root = alone.root
    return measure_drift(rig, features=features, landmarks=landmarks, pose=pose, root=root, refraction=refraction)


def seen_again(then: Marks, now: Marks, sigma: float) -> Features:
    """Points of unknown range that are marked in old and new images, for `check_rig`; `sigma` px where none is stated.

    Raises:
        InputError: no name is in both.

    Example:
        >>> pixels = torch.tensor([[10.0, 20.0], [30.0, 40.0]], dtype=torch.float64)
        >>> both = torch.stack([pixels, pixels], 1)
        >>> found = seen_again(Marks(("a", "b"), both), Marks(("b", "c"), both), 0.3)
        >>> found.names, found.pixels[0].tolist()
        (('b',), [[30.0, 40.0], [30.0, 40.0], [10.0, 20.0], [10.0, 20.0]])
    """
    common = tuple(name for name in then.names if name in now.names)
    if not common:
        raise InputError("no name is in both files of marks; give the same points the same names")
    both = [(marks, [marks.names.index(name) for name in common]) for marks in (then, now)]
    unknown = torch.zeros(len(common), dtype=torch.float64)
    return Features(
        names=common,
        pixels=torch.cat([marks.pixels[rows] for marks, rows in both], 1),
        inverse_range=unknown,
        inverse_range_sigma=torch.full_like(unknown, torch.inf),
        pixel_sigma=torch.cat([marks.sigmas(sigma)[rows] for marks, rows in both], 1),
    )


# What a rig that was right once still knows of its relative yaw: masts bend with the sun, and creep with time.

_PART = re.compile(r"([0-9.]+)\s*([hK])\s*:\s*([0-9.eE+-]+)")


def forgotten_yaw(*, hours: float = 0.0, per_hour: float = 0.0, kelvin: float = 0.0, per_kelvin: float = 0.0) -> float:
    """Standard deviation in degrees of the relative yaw that a rig has lost since it was solved.

    A random walk of `per_hour` degrees after an hour, which grows with the root of time, and a turn of `per_kelvin`
    degrees for each kelvin by which it is warmer or colder. Both must be known of the mast: from nights that were
    solved one after the other, or from `kcal rig check`.

    Raises:
        InputError: a negative number.

    Example:
        >>> forgotten_yaw(hours=9, per_hour=0.0004, kelvin=8, per_kelvin=0.0002)  # 0.0012 and 0.0016 degrees
        0.002
    """
    if min(hours, per_hour, kelvin, per_kelvin) < 0 or not math.isfinite(hours + per_hour + kelvin + per_kelvin):
        raise InputError("what a rig forgets: hours, kelvin and degrees from 0 on are needed")
    return math.hypot(per_hour * math.sqrt(hours), per_kelvin * kelvin)


def parse_aging(text: str, name: str) -> float:
    """`forgotten_yaw` of a text like 9h:0.0004,8K:0.0002.

    Raises:
        InputError: another text.

    Example:
        >>> parse_aging("9h:0.0004,8K:0.0002", "--aged"), parse_aging("4h:0.001", "--aged")
        (0.002, 0.002)
    """
    parts, known = [_PART.fullmatch(part.strip()) for part in text.split(",")], dict[str, tuple[float, float]]()
    with contextlib.suppress(AttributeError, ValueError):
        for count, unit, degrees in (found.groups() for found in parts):  # type: ignore[union-attr]
            known[unit] = float(count), float(degrees)
    # A unit that is given twice is as wrong as none.
    if len(known) < len(parts):
        raise InputError(
            f"{name} {text}: write hours and degrees in an hour, kelvin and degrees per kelvin, like "
            "9h:0.0004,8K:0.0002"
        )
    (hours, per_hour), (kelvin, per_kelvin) = known.get("h", (0.0, 0.0)), known.get("K", (0.0, 0.0))
    return forgotten_yaw(hours=hours, per_hour=per_hour, kelvin=kelvin, per_kelvin=per_kelvin)
