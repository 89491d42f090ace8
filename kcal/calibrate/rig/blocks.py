"""Blocks of rows of the rig problem: what each kind of source says, with derivatives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.problem.board_problem import apply_twist
from kcal.calibrate.problem.state import MOTION, Readout
from kcal.calibrate.rig.motion import CameraRows, WithoutMotion
from kcal.lens.camera import Camera
from kcal.lens.pose import side_axes, step_rows
from kcal.lens.projection import Projection, project_components

# What the cameras of a rig see, as blocks of least squares: boards, and features of unknown position.
#
# A camera with rotation R and center c sees the pixel of R q, q = y - w c. For points, w = 1 and y is the point. A
# feature in direction d at inverse range ρ from a place a near the rig has y = d + ρ a and w = ρ, so that q = d + ρ (a
# - c) is as regular at infinity as anywhere (Civera, Davison, Montiel 2008). In its units a meter is w, which entrance
# pupils that move depend on.
#
# Residuals are divided by their standard deviations: their squares add up to χ².

Kind = Literal["boards", "landmarks", "features", "stars"]
KINDS: tuple[Kind, ...] = ("boards", "landmarks", "features", "stars")
# Unknowns of the largest block, a board's pose.
LOCAL_SIZE = 6


class PerKind(NamedTuple):
    """One tensor (V,) for each kind of item: a mask, say, or each item's χ²; empty where there are none."""

    boards: Tensor
    landmarks: Tensor
    features: Tensor
    stars: Tensor = torch.zeros(0, dtype=torch.bool)


class RigState(NamedTuple):
    """Everything that a rig's adjustment estimates, and the parameters that it holds.

    Attributes:
        parameters: of all cameras, one after the other.
        unknown: (K,) of cameras, board and air together; see `kcal.calibrate.rig.problem`.
        refraction: () coefficient of refraction.
        rotation: (C, 3, 3) cam_from_world.
        center: (C, 3) meters, in the world.
        board: (B,) amplitudes of the board's displacements.
        board_rotation: (V, 3, 3) world_from_board.
        board_translation: (V, 3) meters.
        points: (L, 3) meters, adjusted positions of landmarks.
        direction: (F, 3) unit vectors towards features.
        inverse_range: (F,) 1/m, of features from the block's anchor.
        star: (S, 3) unit vectors towards stars.
    """

    parameters: Tensor
    unknown: Tensor
    refraction: Tensor
    rotation: Tensor
    center: Tensor
    board: Tensor
    board_rotation: Tensor
    board_translation: Tensor
    points: Tensor
    direction: Tensor
    inverse_range: Tensor
    star: Tensor = torch.zeros(0, 3, dtype=torch.float64)


class PosedCamera(NamedTuple):
    """A camera as it stands during a solve, and where its unknowns are in a step (None: held).

    Attributes:
        by_unknown: (5 + P, K) its parameters by the K unknowns of cameras, board and air, the first of a step.
    """

    camera: Camera
    parameters: Tensor
    rotation: Tensor
    center: Tensor
    by_unknown: Tensor
    turn: slice | None
    shift: slice | None


class Effects(NamedTuple):
    """Amounts u of E effects that shift many items together, as clocks and the air do.

    Attributes:
        of_state: (E, K) by which they are found among the unknowns of the state.
        of_step: (E, K) likewise of a step; None: they are held.
    """

    of_state: Tensor
    of_step: Tensor | None


class Block(ABC):
    """V items of one kind, each with its own unknowns that no other item shares.

    Args:
        pixels: (V, C, N, 2), NaN where not seen.
        whitening: (V, C, N, 2, 2) by which pixel residuals are multiplied.
        effects: that shift points by Σ_e u_e `_moves`, or marks by Σ_e u_e `_beside`; None: there are none.
    """

    kind: Kind
    size: int

    def __init__(self, pixels: Tensor, whitening: Tensor, effects: Effects | None = None) -> None:
        self._effects = effects
        self.seen = torch.isfinite(pixels).all(-1)
        self._used = self.seen.any(-1).any(0).tolist()
        self.target = torch.where(self.seen[..., None], pixels, 0.0).transpose(-1, -2).contiguous()
        self.whitening = torch.where(self.seen[..., None, None], whitening, 0.0).movedim(-3, -1).contiguous()

    def __len__(self) -> int:
        """How many items there are."""
        return len(self.target)

    @property
    def counts(self) -> Tensor:
        """(V,) residuals of each item."""
        return 2 * self.seen.sum((-2, -1)) + self._prior_count()

    def _prior_count(self) -> Tensor:
        """(V,) residuals besides the pixels."""
        return torch.zeros(len(self), dtype=torch.int64)

    @abstractmethod
    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        """Y (V, 3, N) and w (V, 1, 1)."""

    @abstractmethod
    def _by_local(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        """Derivatives (V, L, 2, N) of pixels by the unknowns, from those by q (V, 3, 2, N) and, at a given q, by w."""

    @abstractmethod
    def retract(self, state: RigState, step: Tensor) -> RigState:
        """Apply a step (V, L) to this block's part of the state."""

    def _through(self) -> Tensor | None:
        """(E, K) what of board or air the unknowns change, by these; None where they change nothing."""
        return None

    def _by_board_or_air(self, state: RigState, by_q: Tensor, offset: Tensor) -> Tensor:
        """Derivatives (V, E, 2, N) of pixels by what `_through` lists.

        Args:
            state: where.
            by_q: (V, 3, 2, N) of pixels by q in the world.
            offset: (V, 3, N) straight from the camera.
        """
        raise NotImplementedError

    def _moves(self, state: RigState, camera: int) -> Tensor:
        """(E, V, 3) by which one sigma of each effect shifts the items for a camera."""
        return state.unknown.new_zeros(0, len(self), 3)

    def _beside(self, camera: int) -> Tensor | None:
        """(E, V, 2, 1) px by which one sigma of each effect puts marks of a camera beside things; None: `_moves`."""
        return None

    def _bent(self, state: RigState, offset: Tensor, camera: int) -> Tensor:
        """Where things are seen (V, 3, N) that stand at `offset` from the camera."""
        return offset

    def _by_offset(self, state: RigState, by_q: Tensor, offset: Tensor) -> Tensor:
        """Derivatives by where things stand, from those by where they are seen."""
        return by_q

    def _white(self, camera: int, rows: Tensor) -> Tensor:
        """(V, P, 2 N) rows (V, P, 2, N) of pixels of one camera in units of their standard deviations."""
        return torch.einsum("vuwn,vpwn->vpun", self.whitening[:, camera], rows).flatten(-2)

    def _prior(self, state: RigState) -> Tensor | None:
        """(V, L + 1, Q): derivatives of Q residuals of what is known beforehand; the last row holds the residuals."""
        return None

    def _projected(
        self, cameras: Sequence[PosedCamera], state: RigState, derivatives: bool
    ) -> Iterator[tuple[int, PosedCamera, Tensor, Tensor, Tensor, Projection, Tensor]]:
        y, w = self._place(state)
        for c, posed in enumerate(cameras):
            if not self._used[c]:
                continue
            offset = y - w * posed.center[:, None]
            beside = offset.new_zeros(())
            if self._effects is not None:
                amounts = self._effects.of_state @ state.unknown
                if (marks := self._beside(c)) is None:
                    offset = offset + torch.einsum("e,evk->vk", amounts, self._moves(state, c))[..., None]
                else:
                    beside = torch.einsum("e,evun->vun", amounts, marks)
            q = posed.rotation @ self._bent(state, offset, c)
            wanted = posed.by_unknown.any(1).nonzero()[:, 0].tolist() if derivatives else None
            found = project_components(q, posed.parameters, posed.camera.model, wanted, w[..., 0])
            # NaN where a seen point has no projection, so that such a pose is never accepted.
            bad = torch.where(found.regular, 0.0, torch.nan)[..., None, :]
            error = torch.where(self.seen[:, c, None, :], found.pixels + beside - self.target[:, c] + bad, 0.0)
            yield c, posed, offset, q, w, found, error

    def errors(self, cameras: Sequence[PosedCamera], state: RigState) -> Tensor:
        """(V, C, 2, N) projected minus seen, pixels; 0 where not seen."""
        found = torch.zeros_like(self.target).unbind(1)
        used = {c: error for c, *_, error in self._projected(cameras, state, False)}
        return torch.stack([used.get(c, none) for c, none in enumerate(found)], 1)

    def residuals(self, cameras: Sequence[PosedCamera], state: RigState) -> Tensor:
        """(V, R) whitened residuals, pixels first."""
        errors = self.errors(cameras, state).unbind(1)
        white = torch.cat([self._white(c, error[:, None])[:, 0] for c, error in enumerate(errors)], -1)
        prior = self._prior(state)
        return white if prior is None else torch.cat([white, prior[:, -1]], -1)

    def camera_rows(self, cameras: Sequence[PosedCamera], state: RigState) -> Iterator[CameraRows]:
        """Rows of each camera that sees anything; last what is known of the items beforehand."""
        for c, posed, offset, q, w, found, error in self._projected(cameras, state, True):
            by_q = torch.einsum("vkun,kj->vjun", found.by_point, posed.rotation)
            by_offset = self._by_offset(state, by_q, offset)
            parts, maps = [self._by_local(state, by_offset, posed.center, found.by_meter)], list[Tensor]()
            moved = list[Tensor]()
            used = posed.by_unknown.any(1)
            if bool(used.any()):
                moved.append(found.by_camera)
                maps.append(posed.by_unknown[used])
            if (through := self._through()) is not None:
                moved.append(self._by_board_or_air(state, by_q, offset))
                maps.append(through)
            if self._effects is not None and self._effects.of_step is not None:
                marks = self._beside(c)
                if marks is None:
                    marks = torch.einsum("vjun,evj->evun", by_offset, self._moves(state, c))
                moved.append(marks.movedim(0, 1))
                maps.append(self._effects.of_step)
            columns = torch.zeros(0, dtype=torch.long)
            if maps:
                onto = torch.cat(maps)
                columns = onto.any(0).nonzero()[:, 0]
                by = torch.cat(moved, 1)
                own = (onto[:, columns].T @ by.flatten(2)).unflatten(2, by.shape[2:])
                parts.append(own)
            for slot in (posed.turn, posed.shift):
                if slot is not None:
                    columns = torch.cat([columns, torch.arange(slot.start, slot.stop)])
            if posed.turn is not None:
                parts.append(step_rows(found.by_point, q)[:, :3])
            if posed.shift is not None:
                parts.append(-w[..., None] * by_offset)
            rows = torch.cat([*parts, error[:, None]], 1)
            rows = torch.where(self.seen[:, c, None, None, :], rows, 0.0)
            yield CameraRows(c, columns, self._white(c, rows))
        prior = self._prior(state)
        if prior is not None:
            yield CameraRows(None, torch.zeros(0, dtype=torch.long), prior)

    def rows(self, cameras: Sequence[PosedCamera], state: RigState, shared_size: int) -> Tensor:
        """(V, L + S + 1, R) derivatives of whitened residuals by local and shared unknowns; last the residuals."""
        return self.joined(self.camera_rows(cameras, state), shared_size)

    def joined(self, parts: Iterable[CameraRows], shared_size: int) -> Tensor:
        """(V, L + S + 1, R) rows of all cameras and of what is known beforehand, with all columns."""
        (_, count, *_), width = self.seen.shape, self.size + shared_size + 1
        out = [self.target.new_zeros(len(self), width, self.target[0, 0].numel()) for _ in range(count)]
        for camera, columns, rows in parts:
            if camera is None:
                out.append(rows.new_zeros(len(self), width, rows.shape[-1]))
            wide = out[-1 if camera is None else camera]
            wide[:, : self.size], wide[:, self.size + columns] = rows[:, : self.size], rows[:, self.size : -1]
            wide[:, -1] = rows[:, -1]
        return torch.cat(out, -1)


class BoardBlock(Block):
    """Boards, of which each has a pose of its own; all have the same shape.

    Args:
        pixels: see `Block`.
        whitening: see `Block`.
        board_points: (N, 3) meters.
        shapes: (B, 3, N) by which the state's amplitudes displace the corners.
        by_unknown: (B, K) these amplitudes by the unknowns.
        motion: for each camera (V, 12, 2, N) what boards move while it reads its rows; None where they stand still.
    """

    kind: Kind = "boards"
    size = 6

    def __init__(
        self,
        pixels: Tensor,
        whitening: Tensor,
        board_points: Tensor,
        shapes: Tensor | None = None,
        by_unknown: Tensor | None = None,
        motion: Sequence[Tensor | None] = (),
    ) -> None:
        super().__init__(pixels, whitening)
        self._motion = [
            None if one is None else WithoutMotion(one, self.whitening[:, c]) for c, one in enumerate(motion)
        ]
        self._board, self._shapes, self._by_unknown = board_points.T.contiguous(), shapes, by_unknown

    def _white(self, camera: int, rows: Tensor) -> Tensor:
        white = super()._white(camera, rows)
        taken_out = self._motion[camera] if self._motion else None
        return white if taken_out is None else taken_out(white)

    def shaped(self, state: RigState) -> Tensor:
        """(3, N) the board, meters."""
        if self._shapes is None or not len(self._shapes):
            return self._board
        return self._board + torch.einsum("b,bkn->kn", state.board, self._shapes)

    def motion_columns(self, posed: PosedCamera, state: RigState, camera: int, *, reads: bool) -> tuple[Tensor, float]:
        """(V, M, 2, N) derivatives of a camera's pixels by motions, and how far a board reaches, in distances of it.

        Args:
            posed: the camera.
            state: where.
            camera: its number.
            reads: whether boards may move while its rows are read, too.
        """
        points, rotation = self.shaped(state), posed.rotation @ state.board_rotation
        translation = (state.board_translation - posed.center) @ posed.rotation.T
        found = project_components(rotation @ points + translation[..., None], posed.parameters, posed.camera.model, [])
        distance = float(translation.norm(dim=-1).median())
        readout = Readout(center=points.mean(-1), distance=distance, size=posed.camera.size)
        time = readout.time(self.target[:, camera].mT)
        columns = readout.columns_of(found.by_point, rotation, time, points, apart=True).nan_to_num(0.0)
        return columns if reads else columns[:, MOTION:], readout.reach(points.T)

    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        points = state.board_rotation @ self.shaped(state) + state.board_translation[..., None]
        return points, points.new_ones(len(self), 1, 1)

    def _by_local(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        # By ω through ω × (R x), then by v.
        return step_rows(by_q, state.board_rotation @ self.shaped(state))

    def _through(self) -> Tensor | None:
        return self._by_unknown if self._by_unknown is not None and bool(self._by_unknown.any()) else None

    def _by_board_or_air(self, state: RigState, by_q: Tensor, offset: Tensor) -> Tensor:
        assert self._shapes is not None
        by_point = torch.einsum("vjun,vjl->vlun", by_q, state.board_rotation)
        return torch.einsum("vlun,bln->vbun", by_point, self._shapes)

    def retract(self, state: RigState, step: Tensor) -> RigState:
        """See `Block.retract`."""
        rotation, translation = apply_twist(state.board_rotation, state.board_translation, step)
        return state._replace(board_rotation=rotation, board_translation=translation)


class FeatureBlock(Block):
    """Things of unknown position: a direction and an inverse range from `anchor` each.

    Args:
        pixels: (V, C, 2), see `Block`, as `whitening` (V, C, 2, 2) and `effects`.
        inverse_range: (V,) as known beforehand, with `sigma`.
        shifts: (E, V, C, 2) see `Effect`; needed with effects.
    """

    kind: Kind = "features"
    size = 3

    def __init__(
        self,
        pixels: Tensor,
        whitening: Tensor,
        inverse_range: Tensor,
        sigma: Tensor,
        anchor: Tensor,
        effects: Effects | None = None,
        shifts: Tensor | None = None,
    ) -> None:
        super().__init__(pixels[:, :, None], whitening[:, :, None], effects)
        self._shifts = shifts
        self._mean, self._weight = inverse_range, torch.where(torch.isfinite(sigma), 1.0 / sigma, 0.0)
        self._anchor = anchor

    def _prior_count(self) -> Tensor:
        return (self._weight > 0).long()

    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        inverse = state.inverse_range[:, None]
        return (state.direction + inverse * self._anchor)[..., None], inverse[..., None]

    def _beside(self, camera: int) -> Tensor | None:
        return None if self._shifts is None else self._shifts[:, :, camera, :, None]

    def _by_local(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        # By two steps across the direction, then by ρ.
        along = (self._anchor - center).expand_as(state.direction)
        moves = torch.stack([*side_axes(state.direction), along], 1)
        rows = torch.einsum("vjun,vlj->vlun", by_q, moves)
        if by_w is not None:
            rows[:, 2] += by_w
        return rows

    def _prior(self, state: RigState) -> Tensor | None:
        # What is known of the range.
        if not bool(self._weight.any()):
            return None
        zero = torch.zeros_like(self._weight)
        error = (state.inverse_range - self._mean) * self._weight
        return torch.stack([zero, zero, self._weight, error], 1)[..., None]

    def retract(self, state: RigState, step: Tensor) -> RigState:
        """See `Block.retract`."""
        first, second = side_axes(state.direction)
        moved = state.direction + step[:, :1] * first + step[:, 1:2] * second
        direction = moved / torch.linalg.vector_norm(moved, dim=-1, keepdim=True)
        return state._replace(direction=direction, inverse_range=state.inverse_range + step[:, 2])


# Surveyed landmarks as a block of least squares: positions that the survey knows, light that bends, shared effects.
#
# Light bends downward: a landmark at the level distance d is seen k d² / 2R higher than it stands, k being the
# coefficient of refraction and R the Earth's radius.

# 1/m: half the curvature of the Earth, of the mean radius (IUGG) everywhere: a third of a percent of the bending.
_HALF_CURVATURE = 0.5 / 6_371_008.8
_UP = 2


class LandmarkBlock(Block):
    """Surveyed points, whose adjusted positions are the unknowns.

    Args:
        pixels: (V, C, 2), see `Block`.
        whitening: (V, C, 2, 2), see `Block`.
        points: (V, 3) meters, as surveyed; the third axis is up.
        sigma: (V, 3) meters.
        by_refraction: (K,) of the coefficient of refraction by the unknowns; None: it is held.
        effects: see `Block`.
        shifts: (E, V, C, 3) see `Effect`; needed with effects.
    """

    kind: Kind = "landmarks"
    size = 3

    def __init__(
        self,
        pixels: Tensor,
        whitening: Tensor,
        points: Tensor,
        sigma: Tensor,
        by_refraction: Tensor | None = None,
        effects: Effects | None = None,
        shifts: Tensor | None = None,
    ) -> None:
        super().__init__(pixels[:, :, None], whitening[:, :, None], effects)
        self._surveyed, self._sigma, self._by_refraction, self._shifts = points, sigma, by_refraction, shifts

    def _prior_count(self) -> Tensor:
        return torch.full((len(self),), 3)

    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        return state.points[..., None], state.points.new_ones(len(self), 1, 1)

    def _moves(self, state: RigState, camera: int) -> Tensor:
        return super()._moves(state, camera) if self._shifts is None else self._shifts[:, :, camera]

    def _bent(self, state: RigState, offset: Tensor, camera: int) -> Tensor:
        level, up = offset[:, :_UP], offset[:, _UP:]
        return torch.cat([level, up + state.refraction * _HALF_CURVATURE * level.square().sum(1, keepdim=True)], 1)

    def _by_offset(self, state: RigState, by_q: Tensor, offset: Tensor) -> Tensor:
        slope = 2.0 * state.refraction * _HALF_CURVATURE * offset[:, :_UP, None]
        return torch.cat([by_q[:, :_UP] + slope * by_q[:, _UP:], by_q[:, _UP:]], 1)

    def _through(self) -> Tensor | None:
        return None if self._by_refraction is None else self._by_refraction[None]

    def _by_board_or_air(self, state: RigState, by_q: Tensor, offset: Tensor) -> Tensor:
        lift = _HALF_CURVATURE * offset[:, :_UP, None].square().sum(1, keepdim=True)
        return lift * by_q[:, _UP:]

    def _by_local(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        return by_q

    def _prior(self, state: RigState) -> Tensor | None:
        # The survey.
        error = (state.points - self._surveyed) / self._sigma
        return torch.cat([torch.diag_embed(1.0 / self._sigma), error[:, None]], 1)

    def retract(self, state: RigState, step: Tensor) -> RigState:
        """See `Block.retract`."""
        return state._replace(points=state.points + step)


# Stars as a block of least squares: directions at infinity, which clocks and the air shift together.


class StarBlock(Block):
    """Stars, each with a direction of its own that the catalogue knows, if the star has a name.

    Camera c sees star i in the direction d_i + Σ_e u_e (t_eci × d_i + s_eic) with the unknowns u_e of clocks and air,
    which are standard normal beforehand.

    Args:
        pixels: (V, C, 2), see `Block`.
        whitening: (V, C, 2, 2), see `Block`.
        direction: (V, 3) of the catalogue; anything for stars without a name.
        sigma: (V,) radians; infinite for these.
        turns: (E, C, V, 3) radians, see `kcal.calibrate.rig.sources.star_turns`.
        shifts: (E, V, C, 3), see `kcal.calibrate.rig.sources.shifts_of`.
        effects: see `Block`; its amounts are the u_e.
    """

    kind: Kind = "stars"
    size = 2

    def __init__(
        self,
        pixels: Tensor,
        whitening: Tensor,
        direction: Tensor,
        sigma: Tensor,
        turns: Tensor,
        shifts: Tensor,
        effects: Effects | None = None,
    ) -> None:
        super().__init__(pixels[:, :, None], whitening[:, :, None], effects)
        named = torch.isfinite(sigma)
        self._weight = torch.where(named, 1.0 / sigma, 0.0)
        self._known = torch.where(named[:, None], direction, 0.0)
        self._turns, self._shifts = turns, shifts

    def _prior_count(self) -> Tensor:
        return 2 * (self._weight > 0).long()

    def _place(self, state: RigState) -> tuple[Tensor, Tensor]:
        return state.star[..., None], state.star.new_zeros(len(self), 1, 1)

    def _moves(self, state: RigState, camera: int) -> Tensor:
        turned = torch.linalg.cross(self._turns[:, camera], state.star.expand(len(self._turns), -1, -1))
        return turned + self._shifts[:, :, camera]

    def _by_local(self, state: RigState, by_q: Tensor, center: Tensor, by_w: Tensor | None) -> Tensor:
        return torch.einsum("vjun,vlj->vlun", by_q, torch.stack(side_axes(state.star), 1))

    def _prior(self, state: RigState) -> Tensor | None:
        # The catalogue: along the two axes across the star's direction.
        axes = torch.stack(side_axes(state.star), 1)
        error = torch.einsum("vlj,vj->vl", axes, state.star - self._known) * self._weight[:, None]
        rows = torch.diag_embed(self._weight[:, None].expand(-1, 2))
        return torch.cat([rows, torch.where(self._weight[:, None] > 0, error, 0.0)[:, None]], 1)

    def retract(self, state: RigState, step: Tensor) -> RigState:
        """See `Block.retract`."""
        first, second = side_axes(state.star)
        moved = state.star + step[:, :1] * first + step[:, 1:2] * second
        return state._replace(star=moved / torch.linalg.vector_norm(moved, dim=-1, keepdim=True))
