"""Judge any camera on views that it was not fitted to, by nothing but its projection.

The camera is held. Poses are solved again, and with them the board's 28 modes of bending and print errors (a prior of
1e-3 of its extent): a camera that was fitted with a flat board is not blamed for the board. If asked to, the judge also
lets each view move while its rows are read: a twist about the board's center, of first and second order in the row,
with a prior of 2e-3 for each component. The same is done for every camera, whatever it was fitted with.

Derivatives are central differences of the projection. Start: both solutions of the planar pose (T. Collins and A.
Bartoli, "Infinitesimal plane-based pose estimation", 2014; OpenCV's IPPE) on rays about the middle of the view.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import cv2
import numpy as np
import torch
from torch import Tensor

from kcal import Observations
from kcal.calibrate.hybrid.board_modes import board_modes

BOARD_PRIOR, TWIST_PRIOR = 1e-3, 2e-3  # of the board's extent; radians, and distances of the board
NOISE = 0.1  # pixels: how much priors weigh against corners, the same for all cameras and captures
_STEP = 1e-5  # of a corner's distance, for differences
_ITERATIONS, _GAIN = 60, 1e-9  # of the cost, per iteration


class Projection(Protocol):
    """What is asked of a camera."""

    size: tuple[int, int]

    def project(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (..., N, 2) and valid (..., N)."""

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Rays (..., N, 3) and valid (..., N), for the start only."""


class HeldOut(NamedTuple):
    """How a camera predicts views.

    Attributes:
        still: sum of w² ‖r‖² over all corners after poses and board were refitted.
        moved: likewise after each view's own motion was refitted as well.
        corners: how many.
        lost: how many of them the camera has no image of, in the one case or the other; they are not in the sums.
    """

    still: float
    moved: float
    corners: int
    lost: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class _State:
    rotation: np.ndarray  # (V, 3, 3) cam_from_board
    middle: np.ndarray  # (V, 3) the board's centroid
    board: np.ndarray  # (28,) amplitudes
    twist: np.ndarray  # (V, 12): turn and shift of first order in the row, then of second order


class _Problem:
    """Views of one board by one camera that is held."""

    def __init__(self, camera: Projection, points: Tensor, pixels: Tensor, weight: Tensor) -> None:
        self.camera = camera
        self.seen = (torch.isfinite(pixels).all(-1) & (weight > 0)).numpy()
        self.pixels = np.where(self.seen[..., None], torch.nan_to_num(pixels).numpy(), 0.0)
        self.weight = np.where(self.seen, weight.numpy(), 0.0)
        modes = board_modes(points)
        self.points = (points - points.mean(0)).numpy()
        self.shapes = modes.shapes.numpy().transpose(0, 2, 1)  # (28, N, 3)
        self.deviation = BOARD_PRIOR * modes.unit.numpy()
        row = self.pixels[..., 1] / camera.size[1] - 0.5
        self.times = np.stack([row, row**2], 1)  # (V, 2, N)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with torch.no_grad():
            pixels, valid = self.camera.project(torch.from_numpy(points))
        return pixels.numpy(), valid.numpy()

    def places(self, state: _State, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Corners (V, N, 3) in the camera's frame; them about the middle, still; the turn of each (V, N, 3, 3)."""
        board = self.points + np.tensordot(state.board, self.shapes, 1)
        about = board @ state.rotation.transpose(0, 2, 1)
        turn, shift = (
            np.einsum("vkn,vkc->vnc", self.times, part) for part in np.split(state.twist.reshape(-1, 2, 6), 2, -1)
        )
        matrix = np.eye(3) + _cross(turn)
        moved = np.einsum("vnij,vnj->vni", matrix, about) + distance[:, None, None] * shift
        return moved + state.middle[:, None], about, matrix

    def residuals(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weighted (V, N, 2), and which seen corners have no image; their residual is 0."""
        pixels, valid = self.project(points)
        kept = self.seen & valid
        return self.weight[..., None] * np.where(kept[..., None], pixels - self.pixels, 0.0), self.seen & ~valid

    def squares(self, state: _State, distance: np.ndarray) -> np.ndarray:
        """(V, N + 1) squared residuals, NaN where a seen corner has no image, and the prior of each view's motion."""
        errors, lost = self.residuals(self.places(state, distance)[0])
        prior = ((NOISE / TWIST_PRIOR * state.twist) ** 2).sum(1)
        return np.concatenate([np.where(lost, np.nan, (errors**2).sum(-1)), prior[:, None]], 1)

    def board_cost(self, state: _State) -> float:
        return float(((NOISE / self.deviation * state.board) ** 2).sum())

    def slopes(self, points: np.ndarray) -> np.ndarray:
        """(V, N, 2, 3) of weighted pixels by points; zero where a side of the difference has no image."""
        step = _STEP * np.linalg.norm(points, axis=-1)
        out = np.zeros((*points.shape[:2], 2, 3))
        for axis in range(3):
            off = np.eye(3)[axis] * step[..., None]
            (high, good), (low, fine) = self.project(points + off), self.project(points - off)
            out[..., axis] = np.where((good & fine)[..., None], (high - low) / (2 * step[..., None]), 0.0)
        return self.weight[..., None, None] * out

    def linear(self, state: _State, distance: np.ndarray, moves: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals (V, 2N), their slopes by each view's 6 or 18 numbers (V, q, 2N) and by the board (V, 28, 2N)."""
        points, about, matrix = self.places(state, distance)
        errors, _ = self.residuals(points)
        slopes = self.slopes(points)
        turns = -_cross(about)  # (V, N, 3, 3): by each axis of a turn, in columns
        own = [slopes @ matrix @ turns, slopes]
        if moves:
            # The order of `_State.twist`.
            for order in range(2):
                time = self.times[:, order, :, None, None]
                own += [time * (slopes @ turns), time * distance[:, None, None, None] * slopes]
        view = np.concatenate(own, -1)
        shapes = np.einsum("vij,knj->vnik", state.rotation, self.shapes)
        board = slopes @ (matrix @ shapes)
        count = len(errors)
        return (
            errors.reshape(count, -1),
            view.reshape(count, -1, view.shape[-1]).transpose(0, 2, 1),
            board.reshape(count, -1, board.shape[-1]).transpose(0, 2, 1),
        )


def held_out(camera: Projection, points: Tensor, pixels: Tensor, weight: Tensor | None = None) -> HeldOut:
    """Judge a camera on views (V, N, 2) of a board (N, 3); weights (V, N) multiply residuals, all 1 if left out.

    Views with fewer than eight corners are not judged.

    Example:
        >>> from kcal import Board, Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
        >>> points = Board(columns=5, rows=4, square=0.1).points
        >>> tilted = torch.tensor([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]).double()
        >>> pixels, _ = camera.project(points @ tilted.T + torch.tensor([-0.2, -0.1, 1.5]).double())
        >>> found = held_out(camera, points, pixels[None])
        >>> found.still < 1e-6, found.corners
        (True, 20)
    """
    weight = torch.ones_like(pixels[..., 0]) if weight is None else weight
    enough = (torch.isfinite(pixels).all(-1) & (weight > 0)).sum(1) >= 8
    problem = _Problem(camera, points, pixels[enough], weight[enough])
    state = _start(problem)
    if state is None:
        return HeldOut(math.inf, math.inf, int(problem.seen.sum()), int(problem.seen.sum()))
    distance = np.linalg.norm(state.middle, axis=1)
    sums, without = [], np.zeros_like(problem.seen)
    for moves in (False, True):
        state = _solve(problem, state, distance, moves=moves, shared=True)
        errors, lost = problem.residuals(problem.places(state, distance)[0])
        sums.append(float((errors**2).sum()))
        without |= lost
    return HeldOut(sums[0], sums[1], int(problem.seen.sum()), int(without.sum()))


def of_halves(cameras: Sequence[Projection], halves: Sequence[tuple[Observations, Tensor | None]]) -> dict[str, float]:
    """RMS of each half's camera on the other half, both together, pixels; corners, and how many have no image."""
    found = [
        held_out(camera, seen.board.points, seen.pixels(), weight)
        for camera, (seen, weight) in zip(cameras, halves[::-1], strict=True)
    ]
    corners, lost = sum(one.corners for one in found), sum(one.lost for one in found)
    rms = {
        key: math.sqrt(sum(getattr(one, key) for one in found) / max(1, corners - lost)) for key in ("still", "moved")
    }
    return {**rms, "lost": lost, "corners": corners}


def _start(problem: _Problem) -> _State | None:
    """The better of both planar poses of each view; None if a view has hardly a ray."""
    rays, valid = problem.camera.unproject(torch.from_numpy(problem.pixels))
    pairs = []
    for ray, seen in zip(rays.detach().numpy(), valid.numpy() & problem.seen, strict=True):
        if seen.sum() < 4:
            return None
        axis = ray[seen].sum(0)
        turn = _to_axis(axis / np.linalg.norm(axis))
        ahead = ray @ turn.T
        seen = seen & (ahead[:, 2] > 0.05)
        if seen.sum() < 4:
            return None
        plane = ahead[seen, :2] / ahead[seen, 2:]
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            problem.points[seen], plane, np.eye(3), np.zeros(0), flags=cv2.SOLVEPNP_IPPE
        )
        pairs.append([(turn.T @ cv2.Rodrigues(turns[k])[0], turn.T @ shifts[k].ravel()) for k in (0, len(turns) - 1)])
    best: tuple[_State, np.ndarray] | None = None
    for k in (0, 1):
        state = _State(
            rotation=np.stack([pair[k][0] for pair in pairs]),
            middle=np.stack([pair[k][1] for pair in pairs]),
            board=np.zeros(len(problem.shapes)),
            twist=np.zeros((len(pairs), 12)),
        )
        distance = np.linalg.norm(state.middle, axis=1)
        state = _solve(problem, state, distance, moves=False, shared=False)
        cost = np.nan_to_num(problem.squares(state, distance), nan=math.hypot(*problem.camera.size) ** 2).sum(1)
        if best is not None:
            state = _chosen(best[1] <= cost, best[0], state)
            cost = np.minimum(cost, best[1])
        best = state, cost
    return best[0] if best else None


def _solve(problem: _Problem, state: _State, distance: np.ndarray, *, moves: bool, shared: bool) -> _State:
    """Levenberg-Marquardt, each view's numbers eliminated; without `shared` each view is damped by itself.

    Costs are compared over the corners that have an image in both states: nothing is gained by losing a corner, and a
    corner at the edge of what a camera shows does not stop the others.
    """
    damping = np.full(len(distance), 1e-4)
    own_prior = np.concatenate([np.zeros(6), np.full(12 if moves else 0, (NOISE / TWIST_PRIOR) ** 2)])
    board_prior = (NOISE / problem.deviation) ** 2
    unit = np.eye(len(own_prior))
    squares = problem.squares(state, distance)
    for _ in range(_ITERATIONS):
        errors, view, board = problem.linear(state, distance, moves)
        own = np.concatenate([np.zeros((len(view), 6)), state.twist], 1)[:, : len(own_prior)]
        inner = view @ view.transpose(0, 2, 1) + np.diag(own_prior)
        right = np.einsum("vqm,vm->vq", view, errors) + own_prior * own
        mixed = view @ board.transpose(0, 2, 1)
        outer = np.einsum("vsm,vtm->st", board, board) + np.diag(board_prior)
        down = np.einsum("vsm,vm->s", board, errors) + board_prior * state.board
        for _ in range(12):
            damped = inner + (damping[:, None] * np.einsum("vqq->vq", inner) + 1e-12)[..., None] * unit
            solved = np.linalg.solve(damped, np.concatenate([mixed, right[..., None]], -1))
            step = np.zeros(len(down))
            if shared:
                whole = outer + damping.max() * np.diag(outer.diagonal())
                whole = whole - np.einsum("vqs,vqt->st", mixed, solved[..., :-1])
                step = -np.linalg.solve(whole, down - np.einsum("vqs,vq->s", mixed, solved[..., -1]))
            trial = _moved(state, -(solved[..., -1] + solved[..., :-1] @ step), step)
            tried = problem.squares(trial, distance)
            gain = np.nansum(squares - tried, 1)
            if shared:
                gain = np.full(len(gain), gain.sum() + problem.board_cost(state) - problem.board_cost(trial))
            better = gain >= 0.0
            damping = np.where(better, damping, np.maximum(10 * damping, 1e-6))
            if better.any():
                break
        if not better.any():
            return state
        small = gain <= _GAIN * (np.nansum(squares) if shared else np.nansum(squares, 1))
        state = trial if shared else _chosen(better, trial, state)
        squares = np.where(better[:, None], tried, squares)
        damping = np.where(better, np.maximum(damping / 10, 1e-10), damping)
        if (small & better).all():
            break
    return state


def _moved(state: _State, own: np.ndarray, board: np.ndarray) -> _State:
    turns = np.stack([cv2.Rodrigues(vector)[0] for vector in own[:, :3]])
    twist = state.twist if own.shape[1] == 6 else state.twist + own[:, 6:]
    return _State(
        rotation=turns @ state.rotation, middle=state.middle + own[:, 3:6], board=state.board + board, twist=twist
    )


def _chosen(better: np.ndarray, new: _State, old: _State) -> _State:
    return _State(
        rotation=np.where(better[:, None, None], new.rotation, old.rotation),
        middle=np.where(better[:, None], new.middle, old.middle),
        board=old.board,
        twist=old.twist,
    )


def _cross(vectors: np.ndarray) -> np.ndarray:
    """(..., 3, 3) matrices whose products are cross products of vectors (..., 3)."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)


def _to_axis(direction: np.ndarray) -> np.ndarray:
    """The smallest rotation (3, 3) that turns a direction to the z axis."""
    axis = np.cross(direction, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    angle = math.atan2(sine, direction[2])
    return cv2.Rodrigues(axis / sine * angle if sine > 1e-12 else np.zeros(3))[0]
