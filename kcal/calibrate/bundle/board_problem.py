"""Bundle adjustment of one camera and the boards that it sees (Eq. 5, 7 of the paper).

Shared parameters: the camera's free parameters and the board's warp. Local ones: the board pose of each view.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.bundle.parameters import FreeParameters
from kcal.calibrate.bundle.priors import GaussianPrior, Term
from kcal.calibrate.bundle.twist import apply_twist
from kcal.lens.model import LensModel
from kcal.lens.pose import nearest_rotation, step_rows
from kcal.lens.projection import project_components
from kcal.solve.result import State
from kcal.solve.robust import RobustLoss
from kcal.solve.schur import SchurLinearization, SchurProblem, without_local

_ALL = slice(None)
# Numbers in the rows of derivatives that are formed at a time: as many as fit into the cache of one core.
_CHUNK = 600_000


class BoardState(NamedTuple):
    """What a `BoardProblem` is solved for; all tensors may have leading batch dimensions.

    Args:
        parameters: (..., 5 + P) fx, fy, cx, cy, skew, coefficients.
        warp: (..., 2) meters, see `warp_shape`.
        rotation: (..., V, 3, 3) cam_from_board.
        translation: (..., V, 3) cam_from_board, meters.
    """

    parameters: Tensor
    warp: Tensor
    rotation: Tensor
    translation: Tensor

    @classmethod
    def flat(cls, parameters: Tensor, rotation: Tensor, translation: Tensor) -> BoardState:
        """The state of a board without warp."""
        return cls(parameters, parameters.new_zeros((*parameters.shape[:-1], 2)), rotation, translation)

    def views(self, chosen: Sequence[int] | slice | Tensor) -> BoardState:
        """The state of some views only."""
        return self._replace(rotation=self.rotation[..., chosen, :, :], translation=self.translation[..., chosen, :])


def warp_shape(board_points: Tensor) -> Tensor:
    """How a warped board bulges: two parabolas (2, N) that are 1 in the middle and 0 at the outer corners.

    The board's height above its plane is warp_x (1 - x²) + warp_y (1 - y²), with x and y scaled to ±1 at the outermost
    corners. So the warp is the greatest deflection in meters along each direction (as mrcal's first warp model).
    """
    low, high = board_points[:, :2].amin(0), board_points[:, :2].amax(0)
    scaled = (2.0 * board_points[:, :2] - low - high) / (high - low)
    return (1.0 - scaled**2).T


class BoardProblem(SchurProblem[BoardState]):
    """Reprojection residuals (pixels) of one camera's views of a board, for `kcal.solve.lm.minimize`.

    Args:
        board_points: (N, 3) meters, z = 0.
        pixels: (..., V, N, 2) observed corners; NaN where not seen. Leading dimensions broadcast with `batch`.
        model: the lens model.
        free: indices of the camera's free parameters, or which of them are tied.
        free_warp: whether the board's warp is estimated.
        whitening: (..., V, N, 2, 2) by which each corner's residual is multiplied (`kcal.calibrate.bundle.weights`), or
            None: all corners count alike.
        loss: of the length of each corner's residual (after whitening), or None for plain least squares.
        terms: priors and barriers on the camera's parameters and the warp, as further residuals.
        batch: leading shape of the states, () for one solve.

    Example:
        >>> from kcal import Camera
        >>> from kcal.lens import rotation_from_vector
        >>> from kcal.solve.lm import minimize
        >>> camera = Camera.build(focal=(800, 805), center=(322, 238), size=(640, 480), model="pinhole")
        >>> board = 0.05 * torch.cartesian_prod(torch.arange(6.0), torch.arange(5.0), torch.zeros(1)).double()
        >>> tilts = torch.tensor([[0.5, 0.0, 0.0], [-0.5, 0.1, 0.0], [0.0, 0.5, 0.2]], dtype=torch.float64)
        >>> rotation, translation = rotation_from_vector(tilts), torch.tensor([[-0.1, -0.1, 0.6]] * 3).double()
        >>> pixels, _ = camera.project(board @ rotation.mT + translation[:, None])
        >>> problem = BoardProblem(board, pixels, camera.model, free=[0, 1, 2, 3])  # fx, fy, cx, cy
        >>> guess = torch.tensor([700.0, 700.0, 320.0, 240.0, 0.0], dtype=torch.float64)
        >>> result = minimize(problem, BoardState.flat(guess, rotation, translation))
        >>> [round(float(value), 6) for value in result.state.parameters[:4]], bool(result.converged)
        ([800.0, 805.0, 322.0, 238.0], True)
    """

    local_size = 6
    joint = True

    def __init__(
        self,
        board_points: Tensor,
        pixels: Tensor,
        model: LensModel,
        free: Sequence[int] | FreeParameters = (),
        *,
        free_warp: bool = False,
        whitening: Tensor | None = None,
        loss: RobustLoss | None = None,
        terms: Sequence[Term] = (),
        batch: tuple[int, ...] = (),
    ) -> None:
        self.model, self.loss, self.terms = model, loss, tuple(terms)
        self.free, self.free_warp = FreeParameters.of(free), free_warp
        self.batch = batch
        self.board_points = board_points
        self._board = board_points.T.contiguous()
        self._shape = warp_shape(board_points)
        self.seen = torch.isfinite(pixels).all(-1)
        self._all_seen = bool(self.seen.all())
        self._target = torch.where(self.seen[..., None], pixels, 0.0).transpose(-1, -2).contiguous()
        self.whitening: Tensor | None = None  # (..., V, 2, 2, N)
        if whitening is not None:
            self.whitening = torch.where(self.seen[..., None, None], whitening, 0.0).movedim(-3, -1).contiguous()
        self.residual_count = 2 * int(self.seen.sum((-2, -1)).max())
        self.shared_size = len(self.free) + 2 * free_warp

    @property
    def pixels(self) -> Tensor:
        """(..., V, N, 2) observed corners; NaN where not seen."""
        return torch.where(self.seen[..., None], self._target.transpose(-1, -2), torch.nan)

    @property
    def elements(self) -> int:
        """How many states are solved side by side."""
        return math.prod(self.batch)

    @property
    def prior_count(self) -> int:
        """Number of scalar residuals that are priors."""
        return sum(len(term.index) for term in self.terms if isinstance(term, GaussianPrior))

    def select(self, elements: Tensor) -> BoardProblem | None:
        """See `Problem.select`."""
        if len(self.batch) != 1:
            return None
        part = copy.copy(self)
        part.batch = (len(elements),)
        if self.seen.ndim > 2:
            part.seen, part._target = self.seen[elements], self._target[elements]
            part._all_seen = bool(part.seen.all())
        if self.whitening is not None and self.whitening.ndim > 4:
            part.whitening = self.whitening[elements]
        return part

    def points(self, state: BoardState) -> tuple[Tensor, Tensor]:
        """Board points rotated into the camera's frame (..., V, 3, N), and moved there."""
        flat = self._board
        if self.free_warp or bool(state.warp.any()):
            height = flat[2] + (state.warp[..., None, :] @ self._shape)[..., None, :, :]
            plane = flat[:2].expand(*height.shape[:-2], -1, -1)
            flat = torch.cat([plane, height], -2)
        rotated = state.rotation @ flat
        return rotated, rotated + state.translation[..., None]

    def pixel_errors(self, state: BoardState) -> Tensor:
        """Projected minus observed, (..., V, 2, N) pixels, not weighted; 0 where not seen.

        NaN where a seen corner lies behind the camera, or beyond a pole or a fold of the lens.
        """
        _, points = self.points(state)
        projected = project_components(points, state.parameters[..., None, :], self.model)
        bad = torch.where(projected.regular, 0.0, torch.nan)[..., None, :]
        return torch.where(self.seen[..., None, :], projected.pixels - self._target + bad, 0.0)

    def residuals(self, state: BoardState) -> Tensor:
        """See `SchurProblem.residuals`: weighted `pixel_errors`, u of all corners, then v."""
        return self.whiten(self.pixel_errors(state)[..., None, :, :])[..., 0, :, :].flatten(-2)

    def corner_residuals(self, state: BoardState, *, weighted: bool = False) -> Tensor:
        """(..., V, N, 2) residuals by corner; NaN where not seen."""
        errors = self.residuals(state).unflatten(-1, (2, -1)) if weighted else self.pixel_errors(state)
        return torch.where(self.seen[..., None], errors.transpose(-1, -2), torch.nan)

    def view_cost(self, state: BoardState) -> Tensor:
        """See `SchurProblem.view_cost`."""
        if self.loss is None:
            return super().view_cost(state)
        squared = self.residuals(state).unflatten(-1, (2, -1)).square().sum(-2)
        return 0.5 * self.loss.value(squared).sum(-1)

    def linearize(self, state: BoardState) -> SchurLinearization:
        """See `Problem.linearize`."""
        linear = super().linearize(state)
        if self.loss is not None:
            linear.cost = self.cost(state)
        return linear

    def gram(self, state: BoardState) -> Tensor:
        """See `SchurProblem.gram`; a few views at a time, so that their rows stay in the cache."""
        count = state.rotation.shape[-3]
        row = 2 * self._board.shape[-1] * (6 + self.shared_size + 1) * max(1, self.elements)
        size = max(1, _CHUNK // row)
        if count <= size:
            return super().gram(state)
        out = []
        for start in range(0, count, size):
            views = slice(start, start + size)
            rows = self.rows(state.views(views), views)
            out.append(rows @ rows.transpose(-1, -2))
        return torch.cat(out, -3)

    def rows_off_poses(self, state: BoardState) -> Tensor:
        """(R, S + 1) derivatives of weighted residuals by the shared parameters, and residuals, off what poses can do.

        Triangular for each chunk of views, so that R does not grow with the corners; terms are not among them.
        """
        count = state.rotation.shape[-3]
        size = max(1, _CHUNK // (2 * self._board.shape[-1] * (6 + self.shared_size + 1)))
        out = []
        for start in range(0, count, size):
            views = slice(start, start + size)
            flat = without_local(self.rows(state.views(views), views), 6).transpose(0, 1).flatten(1).T
            out.append(torch.linalg.qr(flat, mode="r")[1])
        return torch.cat(out)

    def whiten(self, vectors: Tensor, views: slice = _ALL) -> Tensor:
        """Vectors (..., V, Q, 2, N) of pixels, multiplied by the corners' weights."""
        if self.whitening is None:
            return vectors
        return torch.einsum("...uwn,...qwn->...qun", self.whitening[..., views, :, :, :], vectors)

    def rows(self, state: BoardState, views: slice = _ALL) -> Tensor:
        """See `SchurProblem.rows`; with `views` given, of a state that has the poses of these views only."""
        seen, target = self.seen[..., views, :], self._target[..., views, :, :]
        rotated, points = self.points(state)
        normal = state.rotation[..., 2]  # along which a warped board bulges
        projected = project_components(points, state.parameters[..., None, :], self.model, self.free.indices)
        parts = [step_rows(projected.by_point, rotated), self.free.collapse(projected.by_camera, -3)]
        if self.free_warp:
            along = torch.einsum("...vkun,...vk->...vun", projected.by_point, normal)
            parts.append(along[..., None, :, :] * self._shape[:, None])
        bad = torch.where(projected.regular, 0.0, torch.nan)[..., None, :]
        rows = torch.cat([*parts, (projected.pixels - target + bad)[..., None, :, :]], -3)
        if not self._all_seen:
            rows = torch.where(seen[..., None, None, :], rows, 0.0)
        rows = self.whiten(rows, views)
        if self.loss is not None:
            squared = rows[..., -1, :, :].square().sum(-2)
            rows = rows * self.loss.weight(squared).sqrt()[..., None, None, :]
        return rows.flatten(-2)

    def shared_rows(self, state: BoardState) -> Tensor | None:
        """See `SchurProblem.shared_rows`."""
        if not self.terms:
            return None
        values = torch.cat([state.parameters, state.warp], -1)
        found = torch.cat([term.rows(values) for term in self.terms], -1)
        if not found.shape[-1]:
            return None
        by_camera = self.free.collapse(found[..., list(self.free), :], -2)
        return torch.cat([by_camera, found[..., -3 : -3 + 2 * self.free_warp, :], found[..., -1:, :]], -2)

    def retract(self, state: BoardState, step: State) -> BoardState:
        """See `SchurProblem.retract`."""
        shared, local = step
        parameters = state.parameters.clone()
        parameters[..., list(self.free)] += self.free.expand(shared[..., : len(self.free)])
        warp = state.warp + shared[..., len(self.free) :] if self.free_warp else state.warp
        return BoardState(parameters, warp, *apply_twist(state.rotation, state.translation, local))

    def tidy(self, state: BoardState) -> BoardState:
        """The state with its rotations made orthonormal again after many small steps."""
        return state._replace(rotation=nearest_rotation(state.rotation))
