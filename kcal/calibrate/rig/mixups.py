"""Recognize cameras that were mixed up: the same one given twice, or left and right swapped throughout.

A swap of cameras against their data contradicts itself (`kcal.calibrate.rig.board_consensus.check_cameras`). A swap of
everything does not: the rig is solved as well as any, with the right camera on the left side. Only the names tell.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.rig.blocks import KINDS, FeatureBlock, RigState
from kcal.calibrate.rig.problem import RigProblem
from kcal.calibrate.rig.sources import RigData
from kcal.calibrate.rig.uncertainty import SharedCovariance
from kcal.errors import InputError

# The right camera is on the wrong side if it is to the left by more than this share of the baseline: cameras above each
# other have no left and right.
_SIDEWAYS = 0.5
# A feature is behind the cameras if its inverse range is negative by so many of its standard deviations.
_BEHIND_SIGMAS = 4.0
# A single wrong match counts no more than an item that is three times worse than its sigmas.
_MOST_BEHIND = 9.0
# Fewer equal pixels may be equal by chance.
_EQUAL_PIXELS = 4


def refuse_same_camera(data: RigData) -> None:
    """Raise `InputError` if two cameras have the same pixels of everything that both saw."""
    for one in range(len(data.cameras)):
        for other in range(one):
            pairs = [
                source.pixels[:, [other, one]].movedim(1, -2).flatten(0, -3)
                for kind in KINDS
                if (source := getattr(data, kind)) is not None
            ]
            # Skylines and measured positions have no pixels in common.
            if not pairs:
                continue
            both = torch.cat([pair[torch.isfinite(pair).all(-1).all(-1)] for pair in pairs])
            if len(both) >= _EQUAL_PIXELS and torch.equal(both[:, 0], both[:, 1]):
                raise InputError(
                    f"{data.names[other]} and {data.names[one]} have the same pixels everywhere: this is the same "
                    "camera twice; give the observations and marks of two cameras"
                )


def swap_warnings(data: RigData, problem: RigProblem, state: RigState, covariance: SharedCovariance) -> list[str]:
    """Warn if left and right are swapped: by the side on which the right camera is, and by features behind both.

    Args:
        data: only cameras named `left` and `right` have sides.
        problem: the problem.
        state: its solution.
        covariance: of the solution.
    """
    found = []
    if {"left", "right"} <= set(data.names):
        left, right = data.names.index("left"), data.names.index("right")
        shift = state.center[right] - state.center[left]
        side = float(shift @ _rightward(data, state, left, right))
        length = float(torch.linalg.vector_norm(shift))
        if side < -_SIDEWAYS * length:
            # Without a vertical, right is where the left camera has it.
            otherwise = "" if data.absolute else " (or both cameras hang upside down)"
            found.append(
                f"the right camera is {-side:.3g} m to the left of the left camera: left and right are swapped"
                f"{otherwise}; exchange their cameras, observations and marks"
            )
    behind, seen = _features_behind(problem, state, covariance)
    if behind > seen / 2:
        found.append(
            f"{behind} of {seen} features have negative parallax, as if they were behind the cameras: left and right "
            "marks are swapped, or are not of the same things"
        )
    return found


def cost_of_features_behind(problem: RigProblem, state: RigState) -> float:
    """Half the squares, in sigmas, of how far marks of features behind the cameras are from those at infinity.

    A rig and its mirror image, in which the baseline is reversed and inverse ranges are negative, fit features of
    unknown range alike. This cost tells them apart.
    """
    posed, cost = problem.posed(state), 0.0
    for block in problem.blocks:
        if isinstance(block, FeatureBlock):
            by_inverse_range = block.rows(posed, state, problem.shared_size)[:, block.size - 1]
            squares = (state.inverse_range.clamp_max(0.0)[:, None] * by_inverse_range).square().sum(-1)
            cost += 0.5 * float(squares.clamp_max(_MOST_BEHIND).sum())
    return cost


def _rightward(data: RigData, state: RigState, left: int, right: int) -> Tensor:
    """To the right of where both cameras look, level where the frame knows what is up."""
    if not data.absolute:
        return state.rotation[left, 0]
    ahead = state.rotation[[left, right], 2].mean(0)
    # Ahead × up.
    across = torch.stack([ahead[1], -ahead[0], torch.zeros_like(ahead[0])])
    return across / torch.linalg.vector_norm(across)


def _features_behind(problem: RigProblem, state: RigState, covariance: SharedCovariance) -> tuple[int, int]:
    """How many features have an inverse range that is negative beyond chance, and how many there are."""
    for block in problem.blocks:
        if isinstance(block, FeatureBlock):
            # The last local unknown is the inverse range; what the cameras' errors make of it is added.
            follow, own = (value[:, -1] for value in problem.response(state, block))
            variance = covariance.variances(follow) + own[:, -1]
            return int((state.inverse_range < -_BEHIND_SIGMAS * variance.sqrt()).sum()), len(block)
    return 0, 0
