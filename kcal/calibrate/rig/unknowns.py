"""What a rig's adjustment may change of its cameras, its board and the air, and what calibrations know of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import CLEAR, BoardModes, board_modes, mode_turn, turned, turned_deviation
from kcal.calibrate.hybrid.families import BOARD, typical_hyperprior
from kcal.calibrate.hybrid.measured_board import printed_board, printed_prior
from kcal.calibrate.problem.state import warp_modes
from kcal.calibrate.problem.views import free_parameters
from kcal.corners.board import Board
from kcal.errors import InputError
from kcal.gaussian import Gaussian, Slots, stacked, unit_scale, whitened
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.projection import FAR, project_components
from kcal.lens.rig import check_refraction

# What a rig's adjustment may change of its cameras, its board and the air: linear functions of a few unknowns.


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SharedUnknowns:
    """Unknowns y (K,): parameters of camera c change with them by cameras[c] y, the board by shapes · (board y).

    Args:
        cameras: (5 + P, K) of each.
        shapes: (B, 3, N) displacements of the board's corners, meters.
        board: (B, K).
        begin: (K,) what they are for cameras and board as given.
        known: (K,) whether an unknown is a standard normal beforehand; nothing is known of the others.
        labels: (K,) names of those that have one.
        refraction: coefficient of refraction of light for the unknowns as they begin.
        by_refraction: (K,) of it by each unknown; None: it is held.
        by_effects: (E, K) amount of each `Effect` of stars, then landmarks, and then features, by each unknown; None:
            there are none.
    """

    cameras: tuple[Tensor, ...]
    shapes: Tensor
    board: Tensor
    begin: Tensor
    known: Tensor
    labels: tuple[str, ...]
    refraction: float = 0.0
    by_refraction: Tensor | None = None
    by_effects: Tensor | None = None

    @property
    def refine_lenses(self) -> bool:
        """Whether lenses or board may change within what is known of them."""
        return bool(torch.cat([*self.cameras, self.board])[:, self.known].any())

    def __len__(self) -> int:
        """How many unknowns there are."""
        return len(self.known)

    def none(self) -> SharedUnknowns:
        """None of these: cameras, board and air keep the values of a state."""
        cameras, nothing = tuple(by[:, :0] for by in self.cameras), held(())
        return dataclasses.replace(nothing, cameras=cameras, shapes=self.shapes, board=self.board[:, :0])

    def and_warp(self, board_points: Tensor) -> SharedUnknowns:
        """These, and two parabolas by which the board bends."""
        labels = "the board's warp along its rows", "the board's warp along its columns"
        more, added = self._and(*labels, known=False)
        return dataclasses.replace(more, shapes=warp_modes(board_points), board=added)

    def and_refraction(self, refraction: float, sigma: float) -> SharedUnknowns:
        """These, and the coefficient of refraction with its standard deviation; with none, it is held."""
        check_refraction(refraction, sigma)
        if not sigma:
            return dataclasses.replace(self, refraction=refraction)
        more, added = self._and("the coefficient of refraction", known=True)
        return dataclasses.replace(more, refraction=refraction, by_refraction=sigma * added[0])

    def and_effects(self, *names: str) -> SharedUnknowns:
        """These, and amounts of what shifts items together, in standard deviations."""
        more, added = self._and(*names, known=True)
        return dataclasses.replace(more, by_effects=added)

    def _and(self, *labels: str, known: bool) -> tuple[SharedUnknowns, Tensor]:
        """These, and M more that change nothing yet; and (M, K) the new ones by all."""

        def wider(part: Tensor) -> Tensor:
            return torch.nn.functional.pad(part, (0, len(labels)))

        more = dataclasses.replace(
            self,
            cameras=tuple(map(wider, self.cameras)),
            board=wider(self.board),
            begin=wider(self.begin),
            known=torch.cat([self.known, torch.full((len(labels),), known)]),
            labels=(*self.labels, *labels),
            by_refraction=None if self.by_refraction is None else wider(self.by_refraction),
            by_effects=None if self.by_effects is None else wider(self.by_effects),
        )
        return more, torch.eye(len(more), dtype=torch.float64)[len(self) :]


def held(cameras: Sequence[Camera]) -> SharedUnknowns:
    """No unknowns: cameras and board keep their values, and light is straight."""
    return SharedUnknowns(
        cameras=tuple(torch.zeros(camera.params.shape[-1], 0, dtype=torch.float64) for camera in cameras),
        shapes=torch.zeros(0, 3, 0, dtype=torch.float64),
        board=torch.zeros(0, 0, dtype=torch.float64),
        begin=torch.zeros(0, dtype=torch.float64),
        known=torch.zeros(0, dtype=torch.bool),
        labels=(),
    )


def by_errors(cameras: Sequence[Camera], errors: Sequence[Tensor]) -> SharedUnknowns:
    """K unknowns that are standard normal beforehand, each of which moves the parameters (5 + P, K) of all cameras."""
    found, _ = held(cameras)._and(*[""] * errors[0].shape[1], known=True)
    return dataclasses.replace(found, cameras=tuple(errors))


def free(cameras: Sequence[Camera], names: Sequence[str]) -> SharedUnknowns:
    """All parameters of all cameras; nothing is known of them.

    Raises:
        InputError: hybrid cameras, whose parameters have meaning only with what their calibrations know.
    """
    if any(camera.model.hybrid for camera in cameras):
        raise InputError(
            "hybrid cameras cannot be refined without what their own calibrations know: hold them, take what their "
            "calibrations know as prior, or calibrate parametric cameras"
        )
    chosen = [(camera, free_parameters(camera.model), name) for camera, name in zip(cameras, names, strict=True)]
    labels = [f"{camera.names[index]} of {name}" for camera, own, name in chosen for index in own]
    maps = torch.block_diag(*(torch.eye(len(camera.names), dtype=torch.float64)[:, own] for camera, own, _ in chosen))
    found, _ = held(cameras)._and(*labels, known=False)
    return dataclasses.replace(found, cameras=maps.split([len(camera.names) for camera in cameras]))


# What the calibrations of a rig's cameras know, together: lenses, and the board that they saw, as one Gaussian.
#
# Each camera brings square-root information on its parameters and its board. Rows of cameras that saw one board are
# stacked over the same board, whose prior counts once. Views of a calibration that take part in the rig as well are
# taken out of it first, so that no corner counts twice.

# px that a direction must move something seen, for it to be an unknown of the rig.
_FELT = 1e-3
# Meters of a nearby point, where the movement of the entrance pupil shows, and px that a meter of board is there.
_NEAR, _PX_PER_METER = 1.0, 1000.0


def gathered(
    cameras: Sequence[Camera], known: Sequence[CameraInformation | None], board: Board | None
) -> tuple[tuple[CameraInformation | None, ...], tuple[tuple[int, int], ...]]:
    """What is known of each camera, and of one board by those that saw it, by the evidence of both.

    Args:
        cameras: with their calibrations.
        known: what each knows.
        board: in the rig, if there is any; else that of the first camera that has one.

    Returns:
        For each camera what is known; of the camera alone if it saw another board; None if nothing is known and it is
        held. And pairs of cameras whose boards have one name, and shapes that contradict each other.
    """
    out: list[CameraInformation | None] = []
    first: CameraInformation | None = None
    begun = 0
    apart: list[tuple[int, int]] = []
    for number, (camera, own) in enumerate(zip(cameras, known, strict=True)):
        record = None if camera.calibration is None else camera.calibration.record
        sharing = None
        if own is not None and own.board_size and record is not None:
            board = board or Board.of(record.board)
            if record.board == board.record:
                sharing = own if first is None else _agreeing(first, own, board)
                if sharing is None:
                    apart.append((begun, number))
                elif first is None:
                    first, begun = sharing, number
        out.append(sharing or (None if own is None else own.without_board()))
    return tuple(out), tuple(apart)


def _agreeing(first: CameraInformation, other: CameraInformation, board: Board) -> CameraInformation | None:
    """The other camera's information with its board turned as the first camera's; None if they saw two boards."""
    modes = board_modes(board.points)
    one, two = first.board_message, other.board_message
    apart = printed_board(modes, [one])[1] + printed_board(modes, [two])[1]
    together = {turns: printed_board(modes, [one, turned(two, turns)])[1] - apart for turns in board.quarter_turns}
    best = max(together, key=lambda turns: together[turns])
    return _board_turned(other, best) if together[best] > -CLEAR else None


def _board_turned(known: CameraInformation, turns: int) -> CameraInformation:
    """What is known of a camera and its board, with the modes of the board turned."""
    lens, turn = known.lens_size, mode_turn(turns)
    estimate = torch.cat([known.estimate[:lens], turn @ known.estimate[lens:]])
    out = dataclasses.replace(
        known,
        estimate=estimate,
        mean=torch.cat([known.mean[:lens], turn @ known.mean[lens:]]),
        sigma=torch.cat([known.sigma[:lens], turn.abs() @ known.sigma[lens:]]),
        others=None if known.others is None else turned(known.told, turns).placed(known.board, estimate[lens:]).rows,
    )
    return out.with_data(turned(known.data, turns))


def less(known: CameraInformation, rows: Tensor) -> CameraInformation:
    """What is left of the data without some of them.

    Args:
        known: the whole.
        rows: (R, U + 1) of the data that are taken out, in standard deviations, off all other unknowns; the last column
            holds their residuals at the estimate.
    """
    scale = unit_scale(known.whole.rows[:, :-1])
    gone, whole = rows[:, :-1] * scale, known.rows * scale
    gradient = whole.T @ known.residuals - gone.T @ rows[:, -1]
    values, vectors = torch.linalg.eigh(whole.T @ whole - gone.T @ gone)
    # Weights differ a little between a calibration and a rig: what is left of directions taken out may be negative.
    kept = values > 1e-10 * values[-1:].sum()
    root = values[kept].sqrt()
    return dataclasses.replace(
        known, rows=root[:, None] * vectors[:, kept].T / scale, residuals=vectors[:, kept].T @ gradient / root
    )


def joint_unknowns(
    cameras: Sequence[Camera], parts: Sequence[CameraInformation | None], board: Board | None, *, measured: bool = False
) -> tuple[SharedUnknowns, Tensor | None]:
    """Unknowns that are standard normal beforehand, and the deviation (N, 3) of the board where they begin.

    A board that no camera knows is one as printers make them, if a camera is hybrid and the board was not `measured`
    otherwise; None: it is as it is given.

    Args:
        cameras: of the rig.
        parts: what is known of each and of the board (`gathered`).
        board: of the rig, or of the cameras.
        measured: the board's shape is known.
    """
    shared = [part for part in parts if part is not None and part.board_size]
    lenses = sum(part.lens_size for part in parts if part is not None)
    modes = None
    printed = not measured and any(camera.model.hybrid for camera in cameras)
    if board is not None and (shared or printed):
        modes = board_modes(board.points)
    elif not shared and not lenses:
        return held(cameras), None
    prior, amplitudes = _board_beforehand(shared, modes)
    said, given = [prior], list[_GivenBoard]()
    for camera, part in zip(cameras, parts, strict=True):
        if part is None:
            nothing = torch.zeros(len(camera.names), 0, dtype=torch.float64)
            by_board = nothing.new_zeros(len(nothing), len(amplitudes))
            given.append(_GivenBoard(nothing, nothing[0], nothing[0] > 0, by_board))
            continue
        own = part.data + part.lens_prior
        if len(shared) == 1:
            # What other cameras told of the board counts only if none of the rig's brings rows of its own.
            own = own + part.told
        said.append(own.marginal(part.board))
        given.append(_given_board(part, own, prior.slots, amplitudes))
    told = stacked([one.placed(prior.slots, amplitudes) for one in said])
    shape = whitened(told.rows[:, :-1], told.rows[:, -1])
    given = [lens._replace(by_board=lens.by_board @ shape.change) for lens in given]
    # Without a board in view, its unknowns matter only through what calibrations know of it; no corner moves.
    shapes = torch.zeros(0, 3, 0, dtype=torch.float64) if modes is None else modes.shapes
    of_board = shape.change[:0] if modes is None else shape.change
    parts_begin, parts_known = ([getattr(one, name) for one in (*given, shape)] for name in ("begin", "known"))
    turns = [torch.eye(len(known), dtype=torch.float64) for known in parts_known]
    if any(camera.model.hybrid for camera in cameras):
        corners = torch.einsum("bk,bcn->kcn", of_board, shapes).flatten(1)
        turns = _felt(cameras, given, _PX_PER_METER * corners, parts_known)
    # The unknowns of each camera, one after the other, and the board's: through these, lenses depend on each other.
    *columns, last = torch.block_diag(*turns).split([len(known) for known in parts_known])
    found = SharedUnknowns(
        cameras=tuple(lens.own @ own + lens.by_board @ last for lens, own in zip(given, columns, strict=True)),
        shapes=shapes,
        board=of_board @ last,
        begin=torch.cat([turn.T @ begin for turn, begin in zip(turns, parts_begin, strict=True)]),
        known=torch.cat([(turn[known] != 0).any(0) for turn, known in zip(turns, parts_known, strict=True)]),
        labels=("",) * sum(turn.shape[1] for turn in turns),
    )
    if modes is None:
        return found, None
    sharing = [camera for camera, part in zip(cameras, parts, strict=True) if part is not None and part.board_size]
    found_by = None if board is None else board_deviation(sharing, board)
    if found_by is None:
        return found, torch.einsum("b,bcn->nc", amplitudes, shapes)
    # Single corners are off beside the modes, by the mean of what the cameras found.
    middle = torch.stack([part.estimate[part.lens_size :] for part in shared]).mean(0)
    return found, found_by + torch.einsum("b,bcn->nc", amplitudes - middle, shapes)


def board_deviation(cameras: Sequence[Camera], board: Board) -> Tensor | None:
    """(N, 3) meters by which the corners lie elsewhere than ordered: the mean of what the cameras' calibrations found.

    A board that looks alike from several ends may have been read from any: what follows the first camera's deviation
    best counts.
    """
    found: list[Tensor] = []
    for camera in cameras:
        record = None if camera.calibration is None else camera.calibration.record
        if record is None or record.board_deviation is None or record.board != board.record:
            continue
        own = torch.tensor(record.board_deviation, dtype=torch.float64)
        ends = [turned_deviation(own, board, turns) for turns in board.quarter_turns]
        found.append(min(ends, key=lambda end: float((end - (found or ends)[0]).norm())))
    return torch.stack(found).mean(0) if found else None


class _GivenBoard(NamedTuple):
    """A camera's parameters as functions of unknowns y that are independent of its board, and of the board.

    Attributes:
        own: (5 + P, Y) derivatives by y.
        begin: (Y,) what y is for the camera and the board as given.
        known: (Y,) whether y is a standard normal; nothing is known of the others.
        by_board: (5 + P, B) derivatives by the board's unknowns while y is held.
    """

    own: Tensor
    begin: Tensor
    known: Tensor
    by_board: Tensor


def _given_board(part: CameraInformation, own: Gaussian, board: Slots, amplitudes: Tensor) -> _GivenBoard:
    """Write the parameters of a camera as functions of the board's unknowns and of unknowns independent of these."""
    size = part.lens_size
    rows = own.placed((*part.lens, *board), torch.cat([part.estimate[:size], amplitudes])).rows
    change, pull, known = whitened(rows[:, :size], rows[:, size:])
    selection = part.selection()[:, :size]
    return _GivenBoard(selection @ change, pull[:, -1], known, -selection @ change @ pull[:, :-1])


def _board_beforehand(shared: Sequence[CameraInformation], modes: BoardModes | None) -> tuple[Gaussian, Tensor]:
    """The prior of a board's modes, and amplitudes to begin with; of no unknowns for no board."""
    if shared:
        # Each camera's evidence set its own amplitudes; the geometric mean of their sigmas is used.
        sigma = torch.stack([part.sigma[part.lens_size :].log() for part in shared]).mean(0).exp()
        mean = torch.stack([part.mean[part.lens_size :] for part in shared]).mean(0)
        return Gaussian.independent(shared[0].board, mean, sigma), shared[0].estimate[shared[0].lens_size :]
    if modes is None:
        nothing = torch.zeros(0, dtype=torch.float64)
        return Gaussian.independent((), nothing, nothing), nothing
    prior = printed_prior(modes, typical_hyperprior().mean[BOARD:])
    return prior, torch.zeros_like(prior.at)


def _felt(
    cameras: Sequence[Camera], lenses: Sequence[_GivenBoard], by_corners: Tensor, known: Sequence[Tensor]
) -> list[Tensor]:
    """For the unknowns of each camera, and last of the board, orthonormal directions (K, F) that matter.

    A direction of unknowns with a prior is kept if it moves anything seen by `_FELT` px; unknowns without one all stay.

    Args:
        cameras: of the rig.
        lenses: their parameters by the unknowns.
        by_corners: (B, 3 N) movements of the board by its unknowns, px.
        known: of each camera's unknowns and of the board's, which are standard normals.
    """
    found, effects = list[Tensor](), [by_corners]
    for camera, lens, standard in zip(cameras, lenses, known, strict=False):
        rays, valid = camera.unproject(camera.grid(25, 17).reshape(-1, 2))
        own = list[Tensor]()
        for distance in (FAR, _NEAR):
            points = (rays[valid] * distance).T
            seen = project_components(points, camera.params.detach(), camera.model, list(range(len(lens.own))))
            good = torch.where(seen.regular, seen.by_camera, 0.0).flatten(1)
            own.append(lens.own.T @ good)
            effects.append(lens.by_board.T @ good)
        found.append(_moving(torch.cat(own, 1), standard))
    return [*found, _moving(torch.cat(effects, 1), known[-1])]


def _moving(effects: Tensor, known: Tensor) -> Tensor:
    """(K, F) directions of K unknowns that move anything, by effects (K, N), and all unknowns without a prior."""
    moved = effects[known]
    _, vectors = torch.linalg.eigh(moved @ moved.T)
    # By the largest movement of any one place.
    felt = vectors[:, (vectors.T @ moved).abs().amax(1) > _FELT].flip(-1)
    unit = torch.eye(len(known), dtype=felt.dtype)
    return torch.cat([unit[:, known] @ felt, unit[:, ~known]], 1)
