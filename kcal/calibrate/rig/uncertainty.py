"""Tell how well the data determine a rig: goodness of fit, joint covariances, names for what the data leave open."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.rig.problem import RigProblem
from kcal.calibrate.rig.source import RigState
from kcal.gaussian import Covariance

# A motion gives an open direction its name if it lies in the open directions but for this share.
_NAMED_SHARE = 0.02
_IDENTITY = torch.eye(3, dtype=torch.float64)


class RigSolution(Covariance):
    """A rig at a solution, with the covariance of its shared unknowns, all others free.

    Args:
        problem: the problem.
        state: its solution.
        variance: by which the covariance is multiplied: 1 where the stated sigmas are right.
    """

    def __init__(self, problem: RigProblem, state: RigState, variance: float = 1.0) -> None:
        self.problem, self.state, self.variance = problem, state, variance
        super().__init__(*problem.linearize(state).information(), variance)

    def open_directions(self, names: Sequence[str], *, absolute: bool) -> tuple[str, ...]:
        """Names of what the data leave open, plainest first."""
        left, found = self.open, []
        motions = _named_motions(self.problem, self.state, names, absolute=absolute)
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
                label = f"a mixture of {_largest_parts(self.problem, left[:, 0], names)}"
                inside = torch.eye(left.shape[1], dtype=left.dtype)[0]
            found.append(label)
            # What is left of the open directions without the one that has a name now.
            rest = torch.linalg.svd(inside[None] / torch.linalg.vector_norm(inside)).Vh[1:]
            left = left @ rest.T
        return tuple(found)

    def relative_rows(self, first: int, second: int) -> Tensor:
        """(6, S): the step (ω, v) of second_from_first (see `apply_twist`) by a step of the shared unknowns."""
        rotation, center = self.state.rotation, self.state.center
        shift = rotation[second] @ (center[first] - center[second])
        by_second = self.turn_rows(second)
        turned = by_second - rotation[second] @ rotation[first].T @ self.turn_rows(first)
        moved = rotation[second] @ (self.shift_rows(first) - self.shift_rows(second))
        # ω × shift, column by column.
        return torch.cat([turned, moved + torch.linalg.cross(by_second, shift[:, None].expand_as(by_second), dim=0)])

    def mounting_rows(self, camera: int) -> Tensor:
        """(7, S): shift of a camera's center, its turn about the world's axes, and the coefficient of refraction."""
        unknowns, bending = self.problem.unknowns, self._rows(1)
        if unknowns.by_refraction is not None:
            bending[0, : len(unknowns)] = unknowns.by_refraction
        return torch.cat([self.shift_rows(camera), -self.state.rotation[camera].T @ self.turn_rows(camera), bending])

    def parameter_rows(self, camera: int) -> Tensor:
        """(5 + P, S): all parameters of a camera, held ones with zeros."""
        by_unknown = self.problem.unknowns.cameras[camera]
        rows = self._rows(len(by_unknown))
        rows[:, : by_unknown.shape[1]] = by_unknown
        return rows

    def turn_rows(self, camera: int) -> Tensor:
        """(3, S): the turn of a camera about its own axes; zeros if it is held."""
        return self._slot_rows(self.problem.turn[camera])

    def shift_rows(self, camera: int) -> Tensor:
        """(3, S): the shift of a camera's center; zeros if it is held."""
        return self._slot_rows(self.problem.shift[camera])

    def _slot_rows(self, slot: slice | None) -> Tensor:
        rows = self._rows(3)
        if slot is not None:
            rows[:, slot] = _IDENTITY
        return rows

    def _rows(self, count: int) -> Tensor:
        return torch.zeros(count, self.problem.shared_size, dtype=torch.float64)


def _named_motions(
    problem: RigProblem, state: RigState, names: Sequence[str], *, absolute: bool
) -> list[tuple[str, Tensor]]:
    """Motions (S,) of the cameras that people have a name for."""
    rotation, center = state.rotation, state.center
    middle = center.mean(0)
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
        for axis, word in zip(_IDENTITY, ("east", "north", "up"), strict=True):
            rig_motion(f"where the rig stands ({word})", zero, axis.expand_as(center))
        along = center[min(1, len(center) - 1)] - center[0]
        axes_of_turns = [(_IDENTITY[2], "the heading (a turn about the vertical)")]
        axes_of_turns += [
            (axis, f"a tilt of the rig about the {word} axis")
            for axis, word in zip(_IDENTITY[:2], ("east", "north"), strict=True)
        ]
        if bool(along.any()):
            axes_of_turns.append((along / torch.linalg.vector_norm(along), "a turn of the rig about its baseline"))
        for axis, label in axes_of_turns:
            for pivot in (middle, *center):
                rig_motion(label, axis, torch.linalg.cross(axis.expand_as(center), center - pivot))
    fixed = center[0] if problem.shift[0] is None else middle
    rig_motion("the scale (how far apart the cameras stand)", zero, center - fixed)
    for c, name in enumerate(names):
        turns = [f"the {word} of {name}" for word in ("pitch", "yaw", "roll")]
        shifts = [f"where {name} stands ({word})" for word in ("sideways", "up and down", "along its axis")]
        for slot, labels, axes in ((problem.turn[c], turns, _IDENTITY), (problem.shift[c], shifts, rotation[c])):
            for label, axis in zip(labels if slot else (), axes, strict=False):
                motion = torch.zeros(problem.shared_size, dtype=torch.float64)
                motion[slot] = axis
                out.append((label, motion))
    single = torch.eye(problem.shared_size, dtype=torch.float64)
    return out + [(label, axis) for label, axis in zip(_labels(problem), single, strict=True) if label]


def _labels(problem: RigProblem) -> list[str]:
    """A name for each unknown that has one by itself; empty for turns and shifts."""
    known = list(problem.unknowns.labels)
    return known + [""] * (problem.shared_size - len(known))


def _largest_parts(problem: RigProblem, direction: Tensor, names: Sequence[str]) -> str:
    labels = _labels(problem)
    for c, name in enumerate(names):
        turn_slot, shift_slot = problem.turn[c], problem.shift[c]
        if turn_slot is not None:
            labels[turn_slot] = [f"the attitude of {name}"] * 3
        if shift_slot is not None:
            labels[shift_slot] = [f"where {name} stands"] * 3
    order = direction.abs().argsort(descending=True)[:4].tolist()
    return ", ".join(dict.fromkeys(labels[i] for i in order))
