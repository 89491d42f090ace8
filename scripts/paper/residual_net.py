"""The paper's residual net read literally (Eq. 11): from the distortion vector to corrections of all parameters.

    (δA, δK) = net(K*),  A = A* + δA,  K = K* + δK

For one camera K* is a constant, and so is the network's value. The corrected camera has the same lens model, and the
weights are only another way to write its parameters, so this net can fit nothing that the parameters cannot (tests
prove it). It is here for comparison. The correction drawn in the paper's Fig. 8, which depends on the position, is the
field of a hybrid lens (`kcal.lens.hybrid_terms`).
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BoardState
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.projection import INTRINSICS
from kcal.nets.fit import fit_weights
from kcal.nets.mlp import Network, evaluate, evaluate_with_slopes, initial_weights
from kcal.solve.lm import LMOptions
from kcal.solve.result import Result, State
from kcal.solve.schur import SchurProblem

_SKEW = INTRINSICS.index("skew")


class ResidualNet(Network):
    """Corrections of a camera's parameters by a network of three layers that sees its distortion vector (Eq. 11).

    Convention: parameters in the order of `Camera.names`; skew is not corrected. The network's input is K* divided by
    its largest coefficient. Its outputs are scaled to thousandths of the focal length (fx, fy, cx, cy) and hundredths
    of each coefficient, because coefficients differ by powers of ten. A new network corrects nothing: its last layer is
    zero. Float64; the weights do not require gradients until asked.

    Args:
        camera: a single camera: A* and K*.
        hidden: number of features in each of the two hidden layers.
        seed: seed of the initial weights.

    Raises:
        InputError: a batch of cameras, or a lens without coefficients.

    Example:
        >>> start = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.2, 0.05])
        >>> net = ResidualNet(start)
        >>> bool((net.camera().params == start.params).all())
        True
    """

    start: Tensor
    inputs: Tensor
    units: Tensor

    def __init__(self, camera: Camera, *, hidden: int = 8, seed: int = 0) -> None:
        start = camera.params.detach()
        if start.ndim != 1:
            raise InputError("ResidualNet: a single camera is needed")
        if camera.model.size == 0:
            raise InputError("ResidualNet: a lens without coefficients has no distortion vector")
        corrected = tuple(i for i in range(len(start)) if i != _SKEW)
        widths = (camera.model.size, hidden, hidden, len(corrected))
        super().__init__(widths, initial_weights(widths, seed).to(start.device))
        self.size, self.model, self.corrected = camera.size, camera.model, corrected
        lens = start[len(INTRINSICS) :]
        # The floors keep the scales of zero coefficients finite.
        units = (1e-2 * start.abs()).clamp(min=1e-9)
        units[: len(INTRINSICS)] = 1e-3 * start[:2].mean()
        self.register_buffer("start", start.clone())
        self.register_buffer("inputs", (lens / lens.abs().max().clamp(min=1e-12))[:, None])
        self.register_buffer("units", units[list(corrected)])

    def forward(self) -> Tensor:
        """Corrected parameters (5 + P,): A* + δA and K* + δK."""
        return self.parameters_at(self.weights)

    def parameters_at(self, weights: Tensor) -> Tensor:
        """The corrected parameters (5 + P,) for other weights (W,)."""
        correction = self.units * evaluate(self.inputs, weights, self.widths)[:, 0]
        place = torch.tensor(self.corrected, device=correction.device)
        return self.start + torch.zeros_like(self.start).index_put((place,), correction)

    def slopes(self, weights: Tensor) -> Tensor:
        """Derivatives (C, W) of the C corrected parameters by the weights."""
        return self.units[:, None] * evaluate_with_slopes(self.inputs, weights, self.widths).by_weights[..., 0].T

    def camera(self) -> Camera:
        """The corrected camera: an ordinary one."""
        return Camera(self().detach(), size=self.size, model=self.model)


class ResidualProblem(SchurProblem):
    """Reprojection residuals as functions of a residual net's weights, the board's warp and the board poses.

    A state is the weights (W,), then the state of the board problem, whose camera parameters follow from the weights.

    Args:
        board: the board problem of one camera; its free parameters are those that the net corrects.
        net: the network.
    """

    def __init__(self, board: BoardProblem, net: ResidualNet) -> None:
        self.batch, self.local_size, self.residual_count = board.batch, board.local_size, board.residual_count
        self._board, self._net = board, net

    def start(self, state: State) -> State:
        """A state of the board problem, with the camera parameters replaced by those of the net."""
        return self._joined(self._net.weights.detach(), state)

    def residuals(self, state: State) -> Tensor:
        """See `SchurProblem.residuals`."""
        return self._board.residuals(BoardState(*state[1:]))

    def rows(self, state: State) -> Tensor:
        """See `SchurProblem.rows`."""
        return self._chain(state, self.local_size).T @ self._board.rows(BoardState(*state[1:]))

    def gram(self, state: State) -> Tensor:
        """See `SchurProblem.gram`; from the products of the board problem's rows, which are far fewer."""
        chain = self._chain(state, self.local_size)
        return chain.T @ self._board.gram(BoardState(*state[1:])) @ chain

    def shared_gram(self, state: State) -> Tensor:
        """See `SchurProblem.shared_gram`."""
        chain = self._chain(state, 0)
        return chain.T @ self._board.shared_gram(BoardState(*state[1:])) @ chain

    def retract(self, state: State, step: State) -> State:
        """See `SchurProblem.retract`."""
        shared, local = step
        weights = state[0] + shared[: len(state[0])]
        # The board problem itself moves only the warp and the poses.
        still = shared.new_zeros(len(self._net.corrected))
        board_step = torch.cat([still, shared[len(weights) :]]), local
        return self._joined(weights, self._board.retract(BoardState(*state[1:]), board_step))

    def _joined(self, weights: Tensor, board_state: State) -> State:
        return (weights, self._net.parameters_at(weights), *board_state[1:])

    def _chain(self, state: State, local: int) -> Tensor:
        """Derivatives of the board problem's columns (`local` ones, parameters, warp, residual) by this problem's."""
        others = self._board.shared_size - len(self._net.corrected) + 1
        before, after = (torch.eye(n, dtype=torch.float64, device=state[0].device) for n in (local, others))
        return torch.block_diag(before, self._net.slopes(state[0]), after)


def train_residual(net: ResidualNet, board: BoardProblem, state: State, options: LMOptions | None = None) -> Result:
    """Minimize the reprojection error over a residual net's weights, the board's warp and the board poses.

    Args:
        net: receives the weights found.
        board: the board problem of one camera; its free parameters are those that the net corrects.
        state: of the board problem: the initial warp and poses.
        options: of the solver.

    Returns:
        The solver's result; its state is (weights, *state of the board problem).
    """
    problem = ResidualProblem(board, net)
    return fit_weights(net, problem, problem.start(state), options)
