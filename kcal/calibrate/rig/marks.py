"""What the images of a rig show besides boards: surveyed landmarks, features of unknown place, stars, skylines."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from torch import Tensor

from kcal.calibrate.rig.resection import consensus_pose, consensus_rotation
from kcal.calibrate.rig.source import (
    Block,
    Context,
    Effect,
    Effects,
    ItemSource,
    MarkBlock,
    MarkSource,
    Measurement,
    PosedCamera,
    RigState,
    Start,
    as_items,
    first_rays,
    require_positive,
)
from kcal.checks import as_points, require_finite
from kcal.errors import InputError
from kcal.lens.calibration import ItemResidual
from kcal.lens.camera import Camera
from kcal.lens.pose import Pose, side_axes, vector_from_rotation
from kcal.texts import brief

# Surveyed landmarks, marked in the images, as a source of a rig.


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Landmarks(MarkSource):
    """Surveyed points, marked in the images.

    Args:
        names: one for each.
        points: (L, 3) meters in the local frame.
        sigma: (L, 3) meters along the frame's axes, of the survey; independent from point to point.
        pixels: (L, C, 2) marks.
        pixel_sigma: of a mark along an axis, px; one number for all, or (L, C) for each mark.
        effects: what shifts many of them together, beyond `sigma`.
    """

    __repr__ = brief
    kind = "landmarks"
    absolute: ClassVar[bool] = True
    few: ClassVar[str] = "no camera has a mark of it"

    names: tuple[str, ...]
    points: Tensor
    sigma: Tensor
    pixels: Tensor
    pixel_sigma: float | Tensor = 0.3
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.names)
        if self.points.shape != (count, 3) or self.sigma.shape != (count, 3):
            raise InputError(
                f"landmarks: points and sigma ({count}, 3) are needed, got {tuple(self.points.shape)} and "
                f"{tuple(self.sigma.shape)}"
            )
        self.check_marks()
        require_finite("landmarks: points", as_points("landmarks: points", self.points, 3))
        if not bool((torch.isfinite(self.sigma) & (self.sigma > 0)).all()):
            raise InputError("landmarks: every sigma must be a positive number of meters; nothing is surveyed exactly")

    def enough(self, cameras: Sequence[Camera]) -> Tensor:
        """See `ItemSource.enough`."""
        return self.marked.any(-1)

    def poses(self, cameras: Sequence[Camera], places: Mapping[int, Tensor]) -> dict[int, Pose]:
        """See `Source.poses`."""
        found = {}
        for c, camera in enumerate(cameras):
            rays, valid = camera.unproject(self.pixels[:, c])
            pose = consensus_pose(rays[valid], self.points[valid], places.get(c))
            if pose is not None:
                found[c] = Pose.at(*pose[:2])
        return found

    def begin(self, cameras: Sequence[Camera], start: Start) -> Tensor:
        """See `ItemSource.begin`."""
        return as_items(self.points)

    def block(self, mask: Tensor, given: Context) -> Block:
        """See `ItemSource.block`."""
        return LandmarkBlock(self, mask, given)

    def doubt(self, off: str, sigmas: float, over: float) -> str:
        """See `ItemSource.doubt`."""
        return f"its marks are off the surveyed place by {off} ({sigmas:.0f} sigma): a wrong mark or survey"

    def as_given(self, items: Tensor) -> Tensor:
        """See `ItemSource.as_given`."""
        return as_items(self.points)

    def meters(self, items: Tensor) -> Tensor:
        """See `ItemSource.meters`."""
        return torch.linalg.vector_norm(items[:, :3] - self.points, dim=-1)

    def places(self, items: Tensor, anchor: Tensor) -> Tensor:
        """See `ItemSource.places`."""
        return items[:, :3]


# Light bends downward: a landmark at the horizontal distance d is seen k d² / 2R higher than it stands, k being the
# coefficient of refraction and R the Earth's radius.

# 1/m: half the curvature of the Earth, of the mean radius (IUGG) everywhere: a third of a percent of the bending.
_HALF_CURVATURE = 0.5 / 6_371_008.8
_UP = 2


class LandmarkBlock(MarkBlock):
    """Surveyed points, whose adjusted positions (V, 3), meters, are the unknowns; the third axis is up."""

    size = 3
    surveyed: ClassVar[bool] = True

    def __init__(self, source: Landmarks, mask: Tensor, given: Context) -> None:
        super().__init__(source, mask, given, 3)
        self._surveyed, self._sigma = source.points[mask], given.times * source.sigma[mask]
        self._by_refraction = given.unknowns.by_refraction

    @property
    def added(self) -> Tensor:
        """See `Block.added`."""
        return 2 * self.seen.sum((0, 2))

    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        return state.items[:, :3, None], state.items.new_ones(len(self), 1, 1)

    def _bent(self, state: RigState, offset: Tensor) -> Tensor:
        level, up = offset[:, :_UP], offset[:, _UP:]
        return torch.cat([level, up + state.refraction * _HALF_CURVATURE * level.square().sum(1, keepdim=True)], 1)

    def _by_offset(self, state: RigState, by_q: Tensor, offset: Tensor) -> Tensor:
        slope = 2.0 * state.refraction * _HALF_CURVATURE * offset[:, :_UP, None]
        return torch.cat([by_q[:, :_UP] + slope * by_q[:, _UP:], by_q[:, _UP:]], 1)

    def _by_shared(self, state: RigState, by_q: Tensor, offset: Tensor) -> tuple[Tensor, Tensor] | None:
        if self._by_refraction is None:
            return None
        lift = _HALF_CURVATURE * offset[:, :_UP, None].square().sum(1, keepdim=True)
        return lift * by_q[:, _UP:], self._by_refraction[None]

    def _by_own(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        return by_q

    def _prior(self, state: RigState) -> Tensor | None:
        # The survey.
        error = (state.items[:, :3] - self._surveyed) / self._sigma
        return torch.cat([torch.diag_embed(1.0 / self._sigma), error[:, None]], 1)

    def moved(self, items: Tensor, step: Tensor) -> Tensor:
        """See `Block.moved`."""
        return as_items(items[:, :3] + step)


# Points matched between the images whose position nobody surveyed, as a source of a rig.

# 1/m: features are drawn no farther away than 100 km.
_LEAST_INVERSE_RANGE = 1e-5


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Features(MarkSource):
    """Points matched between the images whose positions are not surveyed.

    A feature alone determines the epipolar geometry: relative pitch and roll. It determines relative yaw if something
    is known of its range, and the farther away it is, the less need be known: a summit 20 km ± 2 km away is
    0.8 ± 0.08 px of disparity with 10 m of baseline and f 1600 px; a star has none.

    Args:
        names: one for each.
        pixels: (F, C, 2) marks.
        inverse_range: (F,) one over meters from the middle of the rig; 0 at infinity.
        inverse_range_sigma: (F,) its standard deviation; infinite where the range is not known.
        pixel_sigma: of a mark along an axis, px; one number for all, or (F, C) for each mark.
        covariance: (F, C, 2, 2) px² of marks, in place of `pixel_sigma`.
        effects: errors that marks of many of them share, beyond these.
    """

    __repr__ = brief
    kind = "features"
    told_by: ClassVar[int] = 2
    turns: ClassVar[bool] = True
    axes: ClassVar[int] = 2

    names: tuple[str, ...]
    pixels: Tensor
    inverse_range: Tensor
    inverse_range_sigma: Tensor
    pixel_sigma: float | Tensor = 0.3
    covariance: Tensor | None = None
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.names)
        self.check_marks()
        if self.inverse_range.shape != (count,) or self.inverse_range_sigma.shape != (count,):
            raise InputError(f"features: inverse_range and its sigma ({count},) are needed")
        if not bool((torch.isfinite(self.inverse_range) & (self.inverse_range_sigma > 0)).all()):
            raise InputError("features: inverse ranges must be finite and their sigmas positive")

    def by_mark(self) -> Features:
        """See `MarkSource.by_mark`."""
        alike = torch.diag_embed(self.each_sigma.square()[..., None].expand_as(self.pixels))
        covariance = alike if self.covariance is None else self.covariance
        return dataclasses.replace(self, pixel_sigma=self.each_sigma, covariance=covariance)

    def begin(self, cameras: Sequence[Camera], start: Start) -> Tensor:
        """See `ItemSource.begin`; along the ray of the first camera that has one, at the range that is expected."""
        inverse = torch.where(torch.isfinite(self.inverse_range_sigma), self.inverse_range, 0.0)
        return as_items(first_rays(cameras, start, self.pixels, inverse, start.center.mean(0)), inverse[:, None])

    def block(self, mask: Tensor, given: Context) -> Block:
        """See `ItemSource.block`."""
        return FeatureBlock(self, mask, given)

    def doubt(self, off: str, sigmas: float, over: float) -> str:
        """See `ItemSource.doubt`."""
        return f"its marks do not meet: off by {off} ({sigmas:.0f} sigma): not the same point, or it moved"

    def places(self, items: Tensor, anchor: Tensor) -> Tensor:
        """See `ItemSource.places`; as far away as their inverse range says, at most 100 km."""
        return anchor + items[:, :3] / items[:, 3:4].clamp_min(_LEAST_INVERSE_RANGE)


def inverse_range_beyond(meters: float) -> tuple[float, float]:
    """Inverse range and its standard deviation of what is known to be farther than `meters`.

    Any inverse range from 0 to 1 / meters is taken as equally likely: the mean and the spread of that.

    Example:
        >>> inverse_range_beyond(1000.0)[0]
        0.0005
    """
    require_positive("range", meters)
    return 0.5 / meters, 1.0 / (meters * math.sqrt(12.0))


class FeatureBlock(MarkBlock):
    """Points of unknown position: a unit vector (V, 3) and an inverse range (V, 1), 1/m, from the anchor each."""

    size = 3
    by_rows: ClassVar[bool] = True

    def __init__(self, source: Features, mask: Tensor, given: Context) -> None:
        sigma = given.times * source.inverse_range_sigma[mask]
        weight = torch.where(torch.isfinite(sigma), 1.0 / sigma, 0.0)
        super().__init__(source, mask, given, (weight > 0).long())
        self._mean, self._weight, self._anchor = source.inverse_range[mask], weight, given.anchor

    @property
    def added(self) -> Tensor:
        """See `Block.added`."""
        # What nobody else sees tells a camera nothing; what one other sees has a direction from it.
        seen = self.seen.sum(-1)
        by_others = seen.sum(1, keepdim=True) - seen
        beyond = (self.counts - 2 * seen.sum(1) - self.size)[:, None]
        before, after = (2 * count + beyond for count in (by_others, by_others + seen))
        return torch.where(seen > 0, after.clamp_min(0) - before.clamp_min(0), 0).sum(0)

    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        direction, inverse = state.items[:, :3], state.items[:, 3:4]
        return (direction + inverse * self._anchor)[..., None], inverse[..., None]

    def _by_own(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        # By two steps across the direction, then by ρ.
        direction = state.items[:, :3]
        along = (self._anchor - center).expand_as(direction)
        moves = torch.stack([*side_axes(direction), along], 1)
        rows = torch.einsum("vjun,vlj->vlun", by_q, moves)
        if by_w is not None:
            rows[:, 2] += by_w
        return rows

    def _prior(self, state: RigState) -> Tensor | None:
        # What is known of the range.
        if not bool(self._weight.any()):
            return None
        zero = torch.zeros_like(self._weight)
        error = (state.items[:, 3] - self._mean) * self._weight
        return torch.stack([zero, zero, self._weight, error], 1)[..., None]

    def moved(self, items: Tensor, step: Tensor) -> Tensor:
        """See `Block.moved`."""
        return as_items(_moved_across(items, step), items[:, 3:4] + step[:, 2:3])


def _moved_across(items: Tensor, step: Tensor) -> Tensor:
    """(V, 3) unit vectors (V, 3, ...) after steps (V, 2, ...) along both axes across them."""
    first, second = side_axes(items[:, :3])
    moved = items[:, :3] + step[:, :1] * first + step[:, 1:2] * second
    return moved / torch.linalg.vector_norm(moved, dim=-1, keepdim=True)


# Stars that several cameras of a rig saw at the same moments, as a source of a rig.


def star_turns(effects: Sequence[Effect], stars: int, cameras: int) -> Tensor:
    """(E, C, S, 3) radians by which each camera sees each star turned at one sigma of each effect."""
    found = torch.zeros(len(effects), cameras, stars, 3, dtype=torch.float64)
    for own, effect in zip(found, effects, strict=True):
        if effect.turn is not None:
            own += effect.turn[:, None] * (1.0 if effect.factor is None else effect.factor[:, None])
    return found


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StarSource(MarkSource):
    """Stars that cameras of a rig saw at the same moments, each with its own sigma.

    A star is at infinity: it tells how the cameras are turned against each other, yaw included, and where it has a
    name, how they stand on the Earth. It tells nothing of where they stand. `kcal.stars.star_source` makes it from
    images.

    Args:
        names: one for each star in each pair of images.
        pixels: (S, C, 2), NaN where a camera did not see it.
        pixel_sigma: (S, C) of a star along an axis, px.
        direction: (S, 3) unit vectors in the local frame, refracted; NaN for stars without a name.
        direction_sigma: (S,) radians, of the catalog and of the model of refraction; infinite without a name.
        effects: what shifts all stars together: the clocks, the air.

    Raises:
        InputError: shapes that do not fit, or sigmas that are not positive.
    """

    __repr__ = brief

    kind = "stars"
    checks: ClassVar[str] = f"{ItemSource.checks}, and time, zone and place of the night images"
    turns: ClassVar[bool] = True

    names: tuple[str, ...]
    pixels: Tensor
    pixel_sigma: Tensor
    direction: Tensor
    direction_sigma: Tensor
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.names)
        self.check_marks()
        if self.direction.shape != (count, 3) or self.direction_sigma.shape != (count,):
            raise InputError(f"stars: directions ({count}, 3) and a sigma ({count},) are needed")
        if not bool((self.direction_sigma > 0).all()):
            raise InputError("stars: every direction_sigma must be positive; it is infinite without a name")
        require_finite("stars: directions", self.direction[self.named])

    @property
    def named(self) -> Tensor:
        """(S,) whether a star's direction is known."""
        return torch.isfinite(self.direction_sigma)

    def check(self, cameras: int, *, absolute: bool) -> None:
        """See `Source.check`."""
        super().check(cameras, absolute=absolute)
        if bool(self.named.any()) and not absolute:
            raise InputError("stars with names need a frame on the Earth: landmarks, or a camera's measured position")

    def enough(self, cameras: Sequence[Camera]) -> Tensor:
        """See `ItemSource.enough`; a star without a name tells only how two cameras are turned against each other."""
        return self.marked.sum(-1) >= 2 - self.named.long()

    def poses(self, cameras: Sequence[Camera], places: Mapping[int, Tensor]) -> dict[int, Pose]:
        """See `Source.poses`; of cameras whose centers are measured."""
        found = {}
        for c, place in places.items():
            rays, valid = cameras[c].unproject(self.pixels[:, c])
            use = valid & self.named
            if int(use.sum()) >= 2:
                found[c] = Pose.at(consensus_rotation(rays[use], self.direction[use])[0], place)
        return found

    def begin(self, cameras: Sequence[Camera], start: Start) -> Tensor:
        """See `ItemSource.begin`; as the catalog has it, or along the ray of the first camera that sees it."""
        nothing = torch.zeros(len(self.names), dtype=torch.float64)
        seen = first_rays(cameras, start, self.pixels, nothing, start.center[0])
        direction = torch.where(self.named[:, None], self.direction, seen)
        return as_items(direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True))

    def block(self, mask: Tensor, given: Context) -> Block:
        """See `ItemSource.block`."""
        return StarBlock(self, mask, given)

    def doubt(self, off: str, sigmas: float, over: float) -> str:
        """See `ItemSource.doubt`."""
        return f"off by {off} ({sigmas:.0f} sigma): not that star, or an aircraft or satellite"


class StarBlock(MarkBlock):
    """Stars, each with a unit vector (V, 3) that the catalog knows, if the star has a name.

    Camera c sees star i in the direction d_i + Σ_e u_e (t_eci × d_i + s_eic) with the unknowns u_e of clocks and air,
    which are standard normal beforehand.
    """

    size = 2

    def __init__(self, source: StarSource, mask: Tensor, given: Context) -> None:
        sigma, named = given.times * source.direction_sigma[mask], source.named[mask]
        super().__init__(source, mask, given, 2 * named.long())
        self._weight = torch.where(named, 1.0 / sigma, 0.0)
        self._turns = star_turns(source.effects, *source.pixels.shape[:2])[:, :, mask]
        self._known = torch.where(named[:, None], source.direction[mask], 0.0)

    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        return state.items[:, :3, None], state.items.new_zeros(len(self), 1, 1)

    def _shift(self, effects: Effects, state: RigState, camera: int) -> Tensor:
        turned = torch.linalg.cross(self._turns[:, camera], state.items[:, :3].expand(len(self._turns), -1, -1))
        return turned + super()._shift(effects, state, camera)

    def _by_own(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        return torch.einsum("vjun,vlj->vlun", by_q, torch.stack(side_axes(state.items[:, :3]), 1))

    def _prior(self, state: RigState) -> Tensor | None:
        # The catalog: along the two axes across the star's direction.
        star = state.items[:, :3]
        axes = torch.stack(side_axes(star), 1)
        error = torch.einsum("vlj,vj->vl", axes, star - self._known) * self._weight[:, None]
        rows = torch.diag_embed(self._weight[:, None].expand(-1, 2))
        return torch.cat([rows, torch.where(self._weight[:, None] > 0, error, 0.0)[:, None]], 1)

    def moved(self, items: Tensor, step: Tensor) -> Tensor:
        """See `Block.moved`."""
        return as_items(_moved_across(items, step))


# What skylines tell of a rig: attitudes of its cameras, with the errors that they share, as one Gaussian.


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SkylineSource(Measurement):
    """What the skylines in images of a rig determine of its cameras' attitudes.

    They are one Gaussian, near the attitudes that fit the skylines alone: images of one camera, and cameras that stand
    side by side, share the errors of the terrain raster and of refraction. `kcal.rig.skyline_source` makes it.

    Args:
        cameras: number of the camera of each image.
        names: of the images.
        rotation: (C, 3, 3) cam_from_world by the skyline alone; NaN for cameras without one.
        center: (C, 3) meters where the cameras were taken to be; NaN for cameras without a skyline.
        parameters: (C) parameters of each camera's lens, as they were taken to be.
        rows: (Q, 6 C + P) whitened derivatives by turns of the cameras about their own axes, by their centers, and by
            the parameters of all lenses one after the other.
        residual: (Q,) whitened, there.
        columns: (I,) columns of each image that were used.
        rms_px: (I,) of their residuals.
        sigmas: (I,) root of χ² over the degrees of freedom of each image, by its skyline alone.

    Raises:
        InputError: shapes that do not fit each other.
    """

    __repr__ = brief
    kind = "skyline"

    cameras: tuple[int, ...]
    names: tuple[str, ...]
    rotation: Tensor
    center: Tensor
    parameters: tuple[Tensor, ...]
    rows: Tensor
    residual: Tensor
    columns: tuple[int, ...]
    rms_px: tuple[float, ...]
    sigmas: tuple[float, ...]

    def __post_init__(self) -> None:
        count, lens = len(self.rotation), sum(map(len, self.parameters))
        if self.center.shape != (count, 3) or len(self.parameters) != count:
            raise InputError("skyline: a rotation, a center and parameters for each camera are needed")
        if self.rows.shape != (len(self.residual), 6 * count + lens):
            raise InputError(f"skyline: rows (Q, {6 * count + lens}) are needed, got {tuple(self.rows.shape)}")
        images = len(self.cameras)
        if not images or {len(self.names), len(self.columns), len(self.rms_px), len(self.sigmas)} != {images}:
            raise InputError("skyline: a camera, a name, columns and residuals for each image are needed")
        if any(not 0 <= camera < count for camera in self.cameras):
            raise InputError(f"skyline: cameras 0 to {count - 1} are there")
        require_finite("skyline: rows", self.rows)
        require_finite("skyline: residual", self.residual)
        require_finite("skyline: rotation", self.rotation[list(self.about)])

    def check(self, cameras: int, *, absolute: bool) -> None:
        """See `Source.check`."""
        if len(self.rotation) != cameras:
            raise InputError(f"skyline: attitudes of {len(self.rotation)} cameras, the rig has {cameras}")
        if not absolute:
            raise InputError("a skyline needs a frame on the Earth: landmarks, or a camera's measured position")

    def poses(self, cameras: Sequence[Camera], places: Mapping[int, Tensor]) -> dict[int, Pose]:
        """See `Source.poses`; where the cameras were taken to be."""
        return {c: Pose.at(self.rotation[c], self.center[c]) for c in self.cameras}

    @property
    def about(self) -> tuple[int, ...]:
        """See `Measurement.about`."""
        return tuple(sorted(set(self.cameras)))

    @property
    def count(self) -> int:
        """See `Measurement.count`."""
        return len(self.residual)

    def rows_at(self, cameras: Sequence[PosedCamera], shared_size: int) -> Tensor:
        """See `Measurement.rows_at`."""
        number = len(self.rotation)
        parts = self.rows.split([3] * (2 * number) + [len(one) for one in self.parameters], 1)
        out = self.residual.new_zeros((shared_size + 1, self.count))
        out[-1] = self.residual
        for c in self.about:
            posed, (turn, center, lens) = cameras[c], (parts[c], parts[number + c], parts[2 * number + c])
            out[-1] += turn @ vector_from_rotation(posed.rotation @ self.rotation[c].T)
            out[-1] += center @ (posed.center - self.center[c]) + lens @ (posed.parameters - self.parameters[c])
            out[: posed.by_unknown.shape[1]] += (lens @ posed.by_unknown).T
            if posed.turn is not None:
                out[posed.turn] += turn.T
            if posed.shift is not None:
                out[posed.shift] += center.T
        return out

    def label(self, names: Sequence[str]) -> str:
        """See `Measurement.label`."""
        return "the skyline"

    def against(self, off: Tensor, sigma: Tensor) -> str:
        """See `Measurement.against`."""
        times = float((off.square() / (1.0 + sigma.square())).mean().sqrt())
        return f"without it the cameras look elsewhere than their skylines say, by {times:.1f} times its sigmas"

    def told(self, center: Tensor, names: Sequence[str]) -> list[ItemResidual]:
        """See `Measurement.told`."""
        own = zip(self.names, self.cameras, self.rms_px, self.sigmas, strict=True)
        return [
            ItemResidual(
                source=self.kind,
                name=name,
                pixels=tuple(rms if c == camera else None for c in range(len(names))),
                sigmas=sigmas,
            )
            for name, camera, rms, sigmas in own
        ]

    def squares_px(self) -> tuple[Tensor, Tensor]:
        """See `Measurement.squares_px`."""
        squares, counts = (torch.zeros(len(self.rotation), dtype=torch.float64) for _ in range(2))
        for camera, columns, rms in zip(self.cameras, self.columns, self.rms_px, strict=True):
            squares[camera] += columns * rms**2
            counts[camera] += columns
        return squares, counts
