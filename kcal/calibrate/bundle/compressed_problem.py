"""The lens problem alone: all views compressed into one quadratic form, whose size does not grow with the views.

Near a solution a change of the lens moves corners by a smooth field over the image, and each board pose responds
linearly. So the field is written in a basis of smooth functions and the poses are eliminated, which turns V views into
one quadratic form in the field's coefficients. The lens, whose parameters make calibration ill-conditioned and
multi-modal, stays fully nonlinear. A search over its many minima costs the same for ten views and for a thousand. The
result is exact except for the curvature of the poses and the basis; a few steps on the whole problem remove both.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.calibrate.bundle.numpy_rows import node_rows, on_host
from kcal.calibrate.bundle.padding import joined_terms, lengthened, part_of
from kcal.calibrate.bundle.parameters import FreeParameters
from kcal.calibrate.bundle.priors import Term
from kcal.calibrate.bundle.twist import apply_twist
from kcal.lens.model import LensModel
from kcal.lens.pose import step_rows
from kcal.lens.projection import project_components
from kcal.solve.dense import DenseLinearization
from kcal.solve.result import Result, State, map_state

# The basis: products of a polynomial in the radius and a wave of the polar angle (Zernike's scheme), up to a degree and
# a number of periods. A lens with few tilted and decentered terms has only slow waves.
_DEGREE, _PERIODS = 14, 4
_RADII, _ANGLES = 20, 9
# Share of each pose's own information that is added as a prior along its six axes: the tilt of a board that is seen
# face-on would otherwise leave the range of the linear response.
_DAMPING = 1e-3
# Relative to the largest diagonal element, for directions of the field that no corner sees.
_JITTER = 1e-13
# Largest number of corners used to estimate where corners are.
_SAMPLE = 3000


def angle_coordinates(points: Tensor) -> Tensor:
    """Points (..., 3, N) of the camera frame to (..., 2, N): the angle off the axis, in the direction of (X, Y).

    In these coordinates the difference between two lenses is smooth for narrow and wide lenses alike.
    """
    across = points[..., :2, :]
    distance = torch.linalg.vector_norm(across, dim=-2, keepdim=True)
    angle = torch.atan2(distance, points[..., 2:, :])
    return across * (angle / distance.clamp_min(1e-12))


def disc_basis(place: Tensor) -> Tensor:
    """Smooth functions on the unit disc at points (..., 2, N): (..., F, N)."""
    x, y = place[..., 0, :], place[..., 1, :]
    s = x * x + y * y
    t = 2.0 * s - 1.0
    # Chebyshev polynomials of 2 r² - 1.
    radial = [torch.ones_like(t), t]
    while len(radial) <= _DEGREE // 2:
        radial.append(2.0 * t * radial[-1] - radial[-2])
    out = list(radial)
    cosine, sine = x, y
    for m in range(1, _PERIODS + 1):
        for n in range((_DEGREE - m) // 2 + 1):
            out += [cosine * radial[n], sine * radial[n]]
        cosine, sine = cosine * x - sine * y, cosine * y + sine * x
    return torch.stack(out, -2)


def _nodes() -> Tensor:
    """Points (2, K) of the unit disc from which the field's coefficients are found."""
    k = torch.arange(_RADII, dtype=torch.float64)
    radius = torch.sqrt(0.5 + 0.5 * torch.cos(math.pi * (k + 0.5) / _RADII))
    turn = 2.0 * math.pi * torch.arange(_ANGLES, dtype=torch.float64) / _ANGLES
    # Every second ring turned by half a step.
    turn = turn + (k % 2)[:, None] * math.pi / _ANGLES
    return torch.stack([(radius[:, None] * torch.cos(turn)).flatten(), (radius[:, None] * torch.sin(turn)).flatten()])


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompressedViews:
    """All views at one state: with optimal poses their squared residuals are ‖A c + offset‖².

    c are the shifts (pixels) of the nodes' images, then the change of the board's warp. Those of several cameras
    (`CompressedProblem.joined`) have leading dimensions (C, 1), `matrix` (C,), and cannot be expanded.

    Args:
        state: at which the views were compressed.
        warp: (2,) of this state.
        points: (3, K) directions of the nodes.
        pixels: (2, K) images of the nodes at `state`.
        matrix: (2 K + W, R), A transposed.
        offset: (R,).
        response: (V 6, 2 K + W + 1): the projections of c and of the present residuals on the poses.
        factor: (V, 6, 6) of the poses' damped normal matrices.
    """

    state: BoardState
    warp: Tensor
    points: Tensor
    pixels: Tensor
    matrix: Tensor
    offset: Tensor
    response: Tensor
    factor: Tensor


def compress(problem: BoardProblem, state: BoardState, radius: float) -> CompressedViews:
    """Compress the views of one camera.

    Args:
        problem: without free camera parameters; the warp is free if it is to be estimated.
        state: of this problem.
        radius: largest radius on the plane z = 1 at which a corner is seen.
    """
    rows = problem.rows(state)
    views = len(rows)
    top = math.atan(radius)
    points = angle_coordinates(problem.points(state)[1])
    basis = disc_basis(points / top) * problem.seen[:, None]
    size = basis.shape[-2]
    disc = _nodes()
    nodes = _directions(disc, top)
    coefficients = torch.linalg.pinv(disc_basis(disc).T)  # (F, K)

    by_pose, others = rows[:, :6], rows[:, 6:]
    gram = by_pose @ by_pose.transpose(-1, -2)
    gram = gram + torch.diag_embed(_DAMPING * gram.diagonal(dim1=-2, dim2=-1))
    factor = torch.linalg.cholesky(gram)
    across = torch.linalg.solve_triangular(factor, by_pose, upper=False)
    # Projections of the field (u and v), the warp and the residuals on the poses.
    field = across.unflatten(-1, (2, -1)).flatten(1, 2) @ basis.transpose(-1, -2)
    seen = torch.cat([field.reshape(views, 6, 2 * size), across @ others.transpose(-1, -2)], -1).flatten(0, 1)
    flat = basis.transpose(0, 1).reshape(size, -1)
    whole = -(seen.T @ seen)
    square = flat @ flat.T
    whole[:size, :size] += square
    whole[size : 2 * size, size : 2 * size] += square
    planes = others.unflatten(-1, (2, -1)).permute(1, 2, 0, 3)
    cross = (planes.flatten(-2) @ flat.T).flatten(1)
    whole[2 * size :, : 2 * size] += cross
    whole[: 2 * size, 2 * size :] += cross.T
    flat_others = planes.flatten(1)
    whole[2 * size :, 2 * size :] += flat_others @ flat_others.T

    normal, gradient, constant = whole[:-1, :-1], whole[:-1, -1], whole[-1, -1]
    normal.diagonal().add_(_JITTER * normal.diagonal().max())
    root = torch.linalg.cholesky(normal)
    offset = torch.linalg.solve_triangular(root, gradient[:, None], upper=False)
    left = (constant - (offset * offset).sum()).clamp_min(0.0).sqrt()
    to_field = torch.block_diag(coefficients, coefficients, torch.eye(len(normal) - 2 * size, dtype=flat.dtype))
    matrix = to_field.T @ root
    rough = _roughness(disc, coefficients, points / top, problem.seen)
    rough = torch.cat([rough, rough.new_zeros(len(matrix) - len(rough), rough.shape[1])])
    zero = matrix.new_zeros(len(matrix), 1)
    return CompressedViews(
        state=state,
        warp=state.warp,
        points=nodes,
        pixels=project_components(nodes, state.parameters, problem.model).pixels,
        matrix=torch.cat([matrix, zero, rough], 1),
        offset=torch.cat([offset[:, 0], left[None], offset.new_zeros(rough.shape[1])]),
        response=torch.cat([seen[:, :-1] @ to_field, seen[:, -1:]], 1),
        factor=factor,
    )


def _directions(disc: Tensor, top: float) -> Tensor:
    """Unit vectors (3, K) whose `angle_coordinates` are `top` times the points (2, K)."""
    angle = top * torch.linalg.vector_norm(disc, dim=0)
    return torch.cat([torch.sin(angle) / angle * top * disc, torch.cos(angle)[None]])


def _roughness(disc: Tensor, coefficients: Tensor, points: Tensor, seen: Tensor) -> Tensor:
    """What the basis cannot express, ring by ring, as residuals (2 K, Q) of the shifts of the nodes.

    A lens whose numerator and denominator nearly cancel has a bump that is narrower than the basis resolves, and would
    have no cost. The bump is a shift along the radius, the same at all angles. What the basis leaves of it counts once
    per corner near its ring.
    """
    radius = torch.linalg.vector_norm(disc, dim=0)
    outward = (disc / radius).unflatten(-1, (_RADII, _ANGLES))
    mean = torch.zeros(2, _RADII, _ANGLES, _RADII, dtype=disc.dtype)
    ring = torch.arange(_RADII)
    mean[:, ring, :, ring] = outward.transpose(0, 1) / _ANGLES
    corners = torch.linalg.vector_norm(points.transpose(-1, -2)[seen], dim=-1)
    some = corners[:: 1 + len(corners) // _SAMPLE]
    nearest = (some[:, None] - radius[::_ANGLES]).abs().argmin(1)
    count = torch.bincount(nearest, minlength=_RADII).to(disc.dtype) * (len(corners) / len(some))
    left = torch.eye(disc.shape[1], dtype=disc.dtype) - coefficients.T @ disc_basis(disc)
    return (left @ (mean.flatten(1, 2) * count.sqrt())).flatten(0, 1)


class LensState(NamedTuple):
    """What a `CompressedProblem` is solved for; all tensors may have leading batch dimensions.

    The rotation turns all boards about the camera's center. With it a lens may shift its axis far, as rich models do,
    without any response of the poses.

    Args:
        parameters: (..., 5 + P).
        warp: (..., 2) meters.
        rotation: (..., 3, 3).
    """

    parameters: Tensor
    warp: Tensor
    rotation: Tensor


class CompressedProblem:
    """The lens and the warp on compressed views, for a batch of states at once.

    Args:
        compressed: see `compress`.
        model: the lens model; need not be the one of `compressed`.
        free: indices of its free parameters.
        terms: priors and barriers.
        batch: leading shape of the states.
    """

    joint = True

    def __init__(
        self,
        compressed: CompressedViews,
        model: LensModel,
        free: Sequence[int] | FreeParameters,
        terms: Sequence[Term] = (),
        batch: tuple[int, ...] = (),
    ) -> None:
        self.batch = batch
        self.residual_count = compressed.offset.shape[-1]
        self.compressed, self.model, self.terms = compressed, model, tuple(terms)
        self.free = FreeParameters.of(free)
        self._nodes = 2 * compressed.points.shape[-1]
        self._warps = compressed.matrix.shape[-2] - self._nodes

    @property
    def elements(self) -> int:
        """How many states are solved side by side."""
        return math.prod(self.batch)

    @property
    def corner_slots(self) -> int:
        """As for `BoardProblem`; here nodes, and their share in the quadratic form."""
        return 2 * self._nodes

    @property
    def alike(self) -> Hashable:
        """Problems for which this is equal can be joined into one batch."""
        return self.model, self.free, self._warps, len(self.batch), tuple(term.alike for term in self.terms)

    def select(self, elements: Tensor) -> CompressedProblem | None:
        """See `Problem.select`."""
        if len(self.batch) != 1:
            return None
        terms = [term.select(elements) for term in self.terms]
        return CompressedProblem(self.compressed, self.model, self.free, terms, (len(elements),))

    @classmethod
    def joined(
        cls, problems: Sequence[CompressedProblem], starts: Sequence[LensState], device: torch.device
    ) -> tuple[CompressedProblem, LensState]:
        """One batch (cameras, starts) of problems that are `alike`; those with fewer starts repeat their last one."""
        first, most = problems[0], max(problem.elements for problem in problems)

        def of_all(tensors: Sequence[Tensor]) -> Tensor:
            return torch.stack(list(tensors)).to(device)

        parts = [problem.compressed for problem in problems]
        compressed = dataclasses.replace(
            first.compressed,
            warp=of_all([part.warp for part in parts])[:, None],
            points=of_all([part.points for part in parts])[:, None],
            pixels=of_all([part.pixels for part in parts])[:, None],
            matrix=of_all([part.matrix for part in parts]),
            offset=of_all([part.offset for part in parts])[:, None],
        )
        terms = joined_terms([problem.terms for problem in problems], [1] * len(problems), (len(problems), 1))
        batch = len(problems), most
        joined = cls(compressed, first.model, first.free, [term.to(device) for term in terms], batch)
        return joined, map_state(lambda *tensors: of_all([lengthened(t, most, 0) for t in tensors]), *starts)

    @staticmethod
    def split(result: Result[LensState], problems: Sequence[CompressedProblem]) -> list[Result[LensState]]:
        """The result of each problem of a batch made by `joined`, on the CPU."""
        return [part_of(part_of(result, i), slice(problem.elements)) for i, problem in enumerate(problems)]

    def start(self, parameters: Tensor) -> LensState:
        """The state at which the views were compressed, with other parameters (..., 5 + P)."""
        shape = parameters.shape[:-1]
        identity = torch.eye(3, dtype=parameters.dtype, device=parameters.device)
        return LensState(parameters, self.compressed.warp.expand(*shape, 2), identity.expand(*shape, 3, 3))

    def cost(self, state: LensState) -> Tensor:
        """See `Problem.cost`."""
        return self.linearize(state).cost

    def linearize(self, state: LensState) -> DenseLinearization:
        """See `Problem.linearize`."""
        parameters, warp, rotation = state
        compressed = self.compressed
        points = rotation @ compressed.points
        matrix = compressed.matrix[..., : self._nodes, :]
        rows = self._rows(points, parameters).flatten(-2)
        # The starts of a camera share its matrix: one product for all.
        rows = rows @ matrix if matrix.ndim == 2 else (rows.flatten(-3, -2) @ matrix).unflatten(-2, rows.shape[-3:-1])
        rows[..., -1, :] += compressed.offset
        if self._warps:
            by_warp = compressed.matrix[..., self._nodes :, :]
            rows[..., -1, :] += (warp - compressed.warp) @ by_warp
            by_warp = by_warp[:, None] if matrix.ndim > 2 else by_warp
            by_warp = by_warp.expand(*self.batch, -1, -1)
            rows = torch.cat([rows[..., :-1, :], by_warp, rows[..., -1:, :]], -2)
        if self.terms:
            values = torch.cat([parameters, warp], -1)
            found = torch.cat([term.rows(values) for term in self.terms], -1)
            if found.shape[-1]:
                by_value = [
                    self.free.collapse(found[..., list(self.free), :], -2),
                    found.new_zeros((*found.shape[:-2], 3, found.shape[-1])),
                    found[..., -3 : -3 + self._warps, :],
                    found[..., -1:, :],
                ]
                rows = torch.cat([rows, torch.cat(by_value, -2)], -1)
        return DenseLinearization.of_rows(rows)

    def _rows(self, points: Tensor, parameters: Tensor) -> Tensor:
        """(..., U + 3 + 1, 2, K): the shifts of the nodes' images, last, and their derivatives by lens and rotation."""
        if on_host(self.model, points, parameters):
            return node_rows(points, parameters, self.model, self.free, self.compressed.pixels)
        seen = project_components(points, parameters, self.model, self.free.indices)
        turn = step_rows(seen.by_point, points)[..., :3, :, :]
        shift = torch.where(seen.regular[..., None, :], seen.pixels - self.compressed.pixels, torch.nan)
        return torch.cat([self.free.collapse(seen.by_camera, -3), turn, shift[..., None, :, :]], -3)

    def retract(self, state: LensState, step: State) -> LensState:
        """See `Problem.retract`."""
        parameters, warp, rotation = state
        lens, turn, bend = step[0].split([len(self.free), 3, self._warps], -1)
        parameters = parameters.clone()
        parameters[..., list(self.free)] += self.free.expand(lens)
        rotation, _ = apply_twist(rotation, torch.zeros_like(turn), torch.cat([turn, torch.zeros_like(turn)], -1))
        return LensState(parameters, warp + bend if self._warps else warp, rotation)

    def expand(self, state: LensState) -> BoardState:
        """One solution (no batch), with the poses that respond to it, as a state of `BoardProblem`."""
        parameters, warp, rotation = state
        compressed = self.compressed
        pixels = project_components(rotation @ compressed.points, parameters, self.model).pixels
        shifts, bend = (pixels - compressed.pixels).flatten(), (warp - compressed.warp)[: self._warps]
        change = torch.cat([shifts, bend, torch.ones_like(warp[:1])])
        seen = (compressed.response @ change).unflatten(0, (-1, 6))
        step = -torch.linalg.solve_triangular(compressed.factor.transpose(-1, -2), seen[..., None], upper=True)[..., 0]
        board = apply_twist(compressed.state.rotation, compressed.state.translation, step)
        return BoardState(parameters, warp, rotation @ board[0], (rotation @ board[1][..., None])[..., 0])
