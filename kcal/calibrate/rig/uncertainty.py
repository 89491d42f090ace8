"""How well the data determine a rig: joint covariances, and names for what they leave open."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.rig.problem import RigProblem
from kcal.lens.projection import parameter_names
from kcal.solve.result import State

# Eigenvalues of the scaled information below this share of the largest are rounding, not information.
_RANK_TOLERANCE = 1e-12
# What has more than this share of its length in directions that nothing determines is not determined.
_LOST_SHARE = 1e-6
# A motion is named if it lies in the open directions but for this share.
_NAMED_SHARE = 0.02


class SharedSpread:
    """Covariance of the cameras' unknowns at a solution, the eliminated ones free.

    Args:
        problem: the problem.
        state: its solution.
        variance: by which the covariance is multiplied: 1 where the stated sigmas are right.
    """

    def __init__(self, problem: RigProblem, state: State, variance: float = 1.0) -> None:
        self._problem, self._state = problem, state
        information, self._scale = problem.linearize(state).information()
        values, vectors = torch.linalg.eigh(information)
        open_ends = values <= _RANK_TOLERANCE * values[-1:].sum()
        self._open = vectors[:, open_ends]
        inverse = torch.where(open_ends, 0.0, 1.0 / torch.where(open_ends, 1.0, values))
        self._root = self._scale[:, None] * vectors * (inverse * variance).sqrt()

    def of(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Covariance (K, K) of K linear functions (K, S) of a step, and which of them are determined.

        What is not determined has infinite variance, and no covariance with anything.
        """
        factor = rows @ self._root
        scaled = rows * self._scale
        length = scaled.square().sum(-1)
        lost = (scaled @ self._open).square().sum(-1) > _LOST_SHARE * torch.where(length > 0, length, 1.0)
        matrix = factor @ factor.T
        matrix = torch.where(lost[:, None] | lost[None, :], 0.0, 0.5 * (matrix + matrix.T))
        return matrix + torch.diag(torch.where(lost, torch.inf, 0.0)), ~lost

    def open_directions(self, names: Sequence[str], *, absolute: bool) -> tuple[str, ...]:
        """Names of what the data leave open, plainest first."""
        left, found = self._open, []
        motions = _motions(self._problem, self._state, names, absolute=absolute)
        while left.shape[1]:
            best: tuple[float, str, Tensor] = (0.0, "", left[0])
            for label, motion in motions:
                scaled = motion / self._scale
                inside = left.T @ (scaled / torch.linalg.vector_norm(scaled))
                share = float(inside.square().sum())
                # Of names that say the same, the first.
                if share > best[0] + 1e-6:
                    best = (share, label, inside)
            share, label, inside = best
            if share <= 1.0 - _NAMED_SHARE:
                label = f"a mixture of {_largest(self._problem, left[:, 0], names)}"
                inside = torch.eye(left.shape[1], dtype=left.dtype)[0]
            found.append(label)
            # What is left of the open directions without the one that has a name now.
            rest = torch.linalg.svd(inside[None] / torch.linalg.vector_norm(inside)).Vh[1:]
            left = left @ rest.T
        return tuple(found)


def _motions(problem: RigProblem, state: State, names: Sequence[str], *, absolute: bool) -> list[tuple[str, Tensor]]:
    """Motions (S,) of the cameras that people have a name for."""
    rotation, center = state[1], state[2]
    middle = center.mean(0)
    axes = torch.eye(3, dtype=torch.float64)
    out: list[tuple[str, Tensor]] = []

    def rig_motion(label: str, turn: Tensor, shift: Tensor) -> None:
        motion = torch.zeros(problem.shared_size, dtype=torch.float64)
        for c, (turn_slot, shift_slot) in enumerate(zip(problem.turn, problem.shift, strict=True)):
            if turn_slot is not None:
                motion[turn_slot] = -rotation[c] @ turn
            if shift_slot is not None:
                motion[shift_slot] = shift[c]
        if bool(motion.any()):
            out.append((label, motion))

    zero = torch.zeros(3, dtype=torch.float64)
    if absolute:
        for axis, word in zip(axes, ("east", "north", "up"), strict=True):
            rig_motion(f"where the rig stands ({word})", zero, axis.expand_as(center))
        along = center[1] - center[0]
        turns = [(axes[2], "the heading (a turn about the vertical)")]
        turns += [
            (axis, f"a tilt of the rig about the {word} axis")
            for axis, word in zip(axes[:2], ("east", "north"), strict=True)
        ]
        if bool(along.any()):
            turns.append((along / torch.linalg.vector_norm(along), "a turn of the rig about its baseline"))
        for axis, label in turns:
            for pivot in (middle, *center):
                rig_motion(label, axis, torch.linalg.cross(axis.expand_as(center), center - pivot))
    held = 0 if problem.shift[0] is None else None
    rig_motion("the scale (how far apart the cameras stand)", zero, center - (middle if held is None else center[0]))
    for c, name in enumerate(names):
        turn_slot, shift_slot = problem.turn[c], problem.shift[c]
        for k, word in enumerate(("pitch", "yaw", "roll")):
            if turn_slot is not None:
                motion = torch.zeros(problem.shared_size, dtype=torch.float64)
                motion[turn_slot.start + k] = 1.0
                out.append((f"the {word} of {name}", motion))
        for k, word in enumerate(("sideways", "up and down", "along its axis")):
            if shift_slot is not None:
                motion = torch.zeros(problem.shared_size, dtype=torch.float64)
                motion[shift_slot] = rotation[c][k]
                out.append((f"where {name} stands ({word})", motion))
    out += [(label, axis) for label, axis in _coordinates(problem, names) if label]
    return out


def _coordinates(problem: RigProblem, names: Sequence[str]) -> list[tuple[str, Tensor]]:
    """Every unknown by itself."""
    axes = torch.eye(problem.shared_size, dtype=torch.float64)
    labels = [""] * problem.shared_size
    for c, name in enumerate(names):
        known = parameter_names(problem.models[c])
        for index, slot in zip(problem.free[c].indices, problem.free[c].slots, strict=True):
            labels[problem.inner[c].start + slot] = f"{known[index]} of {name}"
    return list(zip(labels, axes, strict=True))


def _largest(problem: RigProblem, direction: Tensor, names: Sequence[str]) -> str:
    labels = [label for label, _ in _coordinates(problem, names)]
    for c, name in enumerate(names):
        turn_slot, shift_slot = problem.turn[c], problem.shift[c]
        if turn_slot is not None:
            labels[turn_slot] = [f"the attitude of {name}"] * 3
        if shift_slot is not None:
            labels[shift_slot] = [f"where {name} stands"] * 3
    order = (direction.abs()).argsort(descending=True).tolist()
    named: list[str] = []
    for i in order[:4]:
        if labels[i] not in named:
            named.append(labels[i])
    return ", ".join(named)


def relative_rows(problem: RigProblem, state: State, first: int, second: int) -> Tensor:
    """(6, S): the step (ω, v) of second_from_first (see `apply_twist`) by a step of the shared unknowns."""
    rotation, center = state[1], state[2]
    relative = rotation[second] @ rotation[first].T
    translation = rotation[second] @ (center[first] - center[second])
    rows = torch.zeros(6, problem.shared_size, dtype=torch.float64)
    cross = _cross_matrix(translation)
    for camera, turned in ((second, torch.eye(3, dtype=torch.float64)), (first, -relative)):
        slot = problem.turn[camera]
        if slot is not None:
            rows[:3, slot] = turned
            if camera == second:
                rows[3:, slot] = -cross
    for camera, sign in ((first, 1.0), (second, -1.0)):
        slot = problem.shift[camera]
        if slot is not None:
            rows[3:, slot] = sign * rotation[second]
    return rows


def mounting_rows(problem: RigProblem, state: State, camera: int) -> Tensor:
    """(6, S): shift of a camera's center and turn of the camera about the world's axes."""
    rows = torch.zeros(6, problem.shared_size, dtype=torch.float64)
    shift, turn = problem.shift[camera], problem.turn[camera]
    if shift is not None:
        rows[:3, shift] = torch.eye(3, dtype=torch.float64)
    if turn is not None:
        rows[3:, turn] = -state[1][camera].T
    return rows


def parameter_rows(problem: RigProblem, camera: int) -> Tensor:
    """(5 + P, S): all parameters of a camera, held ones with zeros."""
    free = problem.free[camera]
    rows = torch.zeros(len(parameter_names(problem.models[camera])), problem.shared_size, dtype=torch.float64)
    for index, slot in zip(free.indices, free.slots, strict=True):
        rows[index, problem.inner[camera].start + slot] = 1.0
    return rows


def _cross_matrix(v: Tensor) -> Tensor:
    x, y, z = v.unbind()
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).unflatten(0, (3, 3))
