"""Training of `GlobalResidual` by Levenberg-Marquardt, with board poses and warp (Eq. 11; compare Eq. 12)."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.nets.residual import GlobalResidual
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.result import Result, State
from kcal.solve.schur import SchurLinearization, SchurProblem


class GlobalProblem(SchurProblem):
    """Reprojection residuals as functions of a global residual's weights, the board's warp and its poses.

    A state is the weights (W,), then the state of the board problem, whose camera parameters follow from the weights.

    Args:
        board: the problem in the camera's own parameters; it must free those that the residual corrects.
        residual: the network.
    """

    def __init__(self, board: BoardProblem, residual: GlobalResidual) -> None:
        self.batch, self.local_size, self.residual_count = board.batch, board.local_size, board.residual_count
        self._board, self._residual = board, residual
        self._warp = board.shared_size - len(residual.corrected)

    def start(self, state: State) -> State:
        """A state of the board problem, its camera parameters replaced by those of the residual as it is."""
        weights = self._residual.weights.detach()
        return (weights, self._residual.parameters_at(weights), *state[1:])

    def residuals(self, state: State) -> Tensor:
        """See `SchurProblem.residuals`."""
        return self._board.residuals(BoardState(*state[1:]))

    def rows(self, state: State) -> Tensor:
        """See `SchurProblem.rows`; by the camera's parameters, see `linearize`."""
        return self._board.rows(BoardState(*state[1:]))

    def shared_rows(self, state: State) -> Tensor | None:
        """See `SchurProblem.shared_rows`."""
        return self._board.shared_rows(BoardState(*state[1:]))

    def linearize(self, state: State) -> SchurLinearization:
        """See `Problem.linearize`: derivatives by the parameters times those of the parameters by the weights."""
        warp = torch.eye(self._warp, dtype=torch.float64, device=state[0].device)
        slopes = torch.block_diag(self._residual.slopes(state[0]), warp)
        return SchurLinearization(
            self._board.gram(BoardState(*state[1:])), self.local_size, self.shared_rows(state), slopes
        )

    def retract(self, state: State, step: State) -> State:
        """See `SchurProblem.retract`."""
        weights, _, *board = state
        shared, local = step
        count = weights.shape[-1]
        weights = weights + shared[..., :count]
        parameters = self._residual.parameters_at(weights)
        # Only the warp and the poses move by a step of the board problem itself.
        still = shared.new_zeros((*shared.shape[:-1], len(self._residual.corrected)))
        moved = self._board.retract(
            BoardState(parameters, *board), (torch.cat([still, shared[..., count:]], -1), local)
        )
        return (weights, *moved)


@torch.no_grad()
def train_global(
    board: BoardProblem, state: State, residual: GlobalResidual, options: LMOptions | None = None
) -> Result:
    """Minimize the reprojection error over a global residual's weights together with warp and poses.

    Args:
        board: the problem of one camera, its free parameters being those that the residual corrects.
        state: of the board problem: warp and poses to begin with.
        residual: is given the weights found.
        options: of the solver.

    Returns:
        The solver's result; its state is (weights, *state of the board problem).
    """
    problem = GlobalProblem(board, residual)
    result = minimize(problem, problem.start(state), options or LMOptions())
    residual.weights.copy_(result.state[0])
    return result
