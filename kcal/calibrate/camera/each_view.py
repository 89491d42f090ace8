"""What each view tells of a scale and a principal point of its own, beside its pose, the lens and the board."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.hybrid.evidence import WORTH
from kcal.calibrate.problem.board_problem import POSE, BoardProblem
from kcal.calibrate.problem.state import BoardState
from kcal.solve.schur import matrix_product, products_of, without_local

# Numbers of θ = (ln scale, cx, cy).
SIZE = 3
# Share of the variances of motions with which the search for amplitudes begins: a lens that moves was taken for motion.
LESS = 0.01
# Share of captures in which lenses are taken to move, before anything is known.
_MOVING = 0.2
# Steps of the search for amplitudes; nats by which its last step raises the evidence; shares of a variance to which one
# step may lead; and the largest variance, in the widest ones that are expected.
_STEPS, _SETTLED, _STEP, _MOST = 60, 1e-2, (0.05, 4.0), 100.0
# Views of which rows are in memory together.
_TOGETHER = 256
# Share of a unit, squared, that the widest movements change of combinations of lens and board that are left out.
_UNFELT = 1e-3
# Share of the best known difference between groups, below which one is zero but for rounding.
_ALIKE = 1e-10


@dataclasses.dataclass(frozen=True, eq=False)
class ByView:
    """χ² by x of each view: its motion and bending over their deviations, θ, and how its board bends: 2 gᵀx + xᵀNx.

    And by the lens and board of all views, y, in combinations of unit weight: 2 (b + Σ Cᵀx)ᵀ y + yᵀy. They would hide
    a good part of what moves, were they held where one camera for all views has them.

    Attributes:
        N: (V, X, X).
        g: (V, X).
        C: (V, X, S).
        b: (V, S), to be summed.
        ties: which numbers of the motion and bending share an amplitude.
        begin: (6,) standard deviations of the rest, larger than any, with which the search for amplitudes begins.
    """

    N: Tensor
    g: Tensor
    C: Tensor
    b: Tensor
    ties: Sequence[int]
    begin: Tensor

    def lens(self, held: float = 1.0) -> ByView:
        """By θ alone, motions integrated out, with this share of their variances; the board as it is."""
        count = len(self.ties)
        own, inner = slice(count, count + SIZE), self.N[:, :count, :count]
        rest = torch.cat([self.N[:, :count, own], self.g[:, :count, None], self.C[:, :count]], 2)
        gone = torch.linalg.solve(inner + torch.eye(count, dtype=torch.float64) / held, rest)
        left = torch.cat([self.N[:, own, own], self.g[:, own, None], self.C[:, own]], 2) - rest[..., :SIZE].mT @ gone
        shared = rest[..., SIZE + 1 :].mT @ gone[..., SIZE:]
        N, g, C = left[..., :SIZE], left[..., SIZE], left[..., SIZE + 1 :]
        H = torch.eye(C.shape[-1], dtype=torch.float64) - shared[..., 1:].sum(0)
        return ByView(N, g, *unit_weight(H, C, self.b - shared[..., 0]), (), self.begin[:SIZE])

    @functools.cached_property
    def joint(self) -> _Joint:
        """By θ off its mean, lens and board at their best."""
        g, N, C = self.g - self.C @ self.b.sum(0), self.N, self.C - self.C.mean(0)
        # The mean is that of the camera, which hardly anything but its prior tells from the lens.
        one = torch.eye(SIZE, dtype=torch.float64).expand_as(N)
        off = (N - 0.5 * N.mean(0)) / len(N)
        return _Joint(N, torch.cat([one, off, C], 2), torch.cat([off, one, C], 2), g - g.mean(0))

    def score(self, own: list[int]) -> float:
        """Standard deviations by which the slopes by these numbers of θ are steeper than by noise alone."""
        N, F, G, g = self.joint
        N, F, G = N[:, own][..., own], F[:, own], G[:, own]
        noise = torch.einsum("vaa->", N) - (F * G).sum()
        square = N.square().sum() - 2.0 * ((N @ F) * G).sum()
        square += (products_of(F.flatten(0, 1).T) * products_of(G.flatten(0, 1).T)).sum()
        return float((g[:, own].square().sum() - noise) / (2.0 * square).sqrt())

    def later(self, most: Tensor) -> Tensor:
        """(3,) root of the mean square of θ in views to come, by all deviations up to `most` (3,) and their evidence.

        So it has room for the error of the likeliest deviation, and for a lens that moves though that is not proven.
        Zeros where the evidence is against it.
        """
        N, F, G, g = self.joint
        basis = _felt_by(F[..., 2 * SIZE :], most)
        F, G = (torch.cat([part[..., : 2 * SIZE], part[..., 2 * SIZE :] @ basis], 2) for part in (F, G))
        squares, nats = 4.0 ** -torch.arange(0.0, 6.5, 0.5, dtype=g.dtype), list[Tensor]()
        for root in squares.sqrt()[:, None] * most:
            own = torch.eye(SIZE, dtype=g.dtype) + root[:, None] * N * root
            at = torch.linalg.solve(own, root[:, None] * torch.cat([F, g[..., None]], 2))
            across = (root[:, None] * G).flatten(0, 1).T @ at.flatten(0, 1)
            left = torch.eye(F.shape[2], dtype=g.dtype) - across[:, :-1]
            gained = (root * g * at[..., -1]).sum()
            gained += (root * g).flatten() @ at[..., :-1].flatten(0, 1) @ torch.linalg.solve(left, across[:, -1])
            nats.append(0.5 * (gained - torch.logdet(own).sum() - torch.linalg.slogdet(left).logabsdet))
        odds = math.log(_MOVING / (1.0 - _MOVING) / len(squares))
        likely = torch.cat([g.new_zeros(1), odds + torch.stack(nats)]).softmax(0)
        return most * (likely[1:] @ squares).sqrt() * (likely[0] < 1.0 - _MOVING)

    def total(self, theta: Tensor) -> Tensor:
        """(...) the change of χ² by θ (..., V, 3)."""
        return ((self.joint.g + self.joint.slope(theta)) * theta).sum((-2, -1))

    def best(self, second: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The best θ of both groups (..., 2, 3), its covariance (..., 6, 6), and by how many nats it is likelier (...).

        `second` (..., V) tells which views are in the second group.
        """
        N, F, G, g = self.joint
        groups, unit = torch.stack([~second, second], -2).to(g.dtype), self.begin[:SIZE].repeat(2)
        summed, of_F, of_G = ((groups @ part.flatten(1)).unflatten(-1, part.shape[1:]) for part in (N, F, G))
        K = -of_F.flatten(-3, -2) @ of_G.flatten(-3, -2).mT
        K.unflatten(-1, (2, -1)).unflatten(-3, (2, -1)).diagonal(dim1=-4, dim2=-2).add_(summed.movedim(-3, -1))
        inverse = unit[:, None] * torch.linalg.pinv(unit[:, None] * K * unit, rtol=_ALIKE, hermitian=True) * unit
        slope = (groups @ g).flatten(-2)
        both = -(inverse @ slope[..., None])[..., 0]
        return both.unflatten(-1, (2, SIZE)), inverse, -0.5 * (slope * both).sum(-1)

    def by_group(self, second: Tensor) -> Tensor:
        """(..., V) of χ² with each view in the second group, less that with it in the first one."""
        joint, both = self.joint, self.best(second)[0]
        theta = torch.where(second[..., None], both[..., 1:, :], both[..., :1, :])
        apart = both[..., 1, :] - both[..., 0, :]
        bend = torch.einsum("...a,vab,...b->...v", apart, joint.N - joint.F @ joint.G.mT, apart)
        return 2.0 * (joint.slope(theta) @ apart[..., None])[..., 0] + torch.where(second, -bend, bend)

    def spread(self, tied: Sequence[int]) -> Spread:
        """Normal motions and others, whose amplitudes have the largest evidence; `tied` tells which are one.

        Variances become the mean squares over the number of views that tell of them (MacKay, 1992); where that lowers
        the evidence, those of expectation maximization, which is safe and slow.
        """
        count, tied = len(self.ties), tied[: len(self.begin)]
        ties = torch.tensor([*self.ties, *tied])
        index = (ties >= 0).nonzero()[:, 0]
        if not len(index):
            zeros = self.g.new_zeros(len(self.g), len(tied))
            return Spread(0.0, zeros[:, 0], zeros[0], zeros)
        N, g, one = self.N[:, index[:, None], index], self.g[:, index], torch.eye(len(index), dtype=torch.float64)
        C, widest = self.C[:, index], torch.cat([self.g.new_ones(count), self.begin.square()])[index]
        basis = _felt_by(C, widest.sqrt())
        C, each_b = matrix_product(C, basis), self.b @ basis
        b, free = each_b.sum(0), torch.eye(basis.shape[1], dtype=torch.float64)
        share = (ties[index] == ties[index, None]).double()
        share = share / share.sum(1)
        variance = safe = share @ torch.where(index < count, LESS, widest)
        least, found = math.inf, (g[:, 0], variance, g)
        for _ in range(_STEPS):
            root = variance.sqrt()
            inner = torch.linalg.cholesky(one + root[:, None] * N * root)
            half = torch.linalg.solve_triangular(inner, torch.diag(root), upper=False)
            by_shared, by_own = matrix_product(half, C), (half @ g[..., None])[..., 0]
            flat = by_shared.flatten(0, 1)
            M, unsolved = torch.linalg.cholesky_ex(free - products_of(flat.T))
            y = -torch.cholesky_solve((b - flat.T @ by_own.flatten())[:, None], M)[:, 0]
            mean = -(half.mT @ (by_own + by_shared @ y)[..., None])[..., 0]
            nats = -0.5 * ((mean * g).sum(-1) + each_b @ (y + b)) - inner.diagonal(dim1=1, dim2=2).log().sum(1)
            nats -= M.diagonal().log().sum() / len(nats)
            loss = -float(nats.sum())
            if unsolved or not loss <= least:
                variance, least = safe, math.inf
                continue
            found, gained, least = (nats, root, mean), least - loss, loss
            if gained < _SETTLED:
                break
            others = matrix_product(half.mT, by_shared).flatten(0, 1).T
            others = torch.linalg.solve_triangular(M, others, upper=False).square().sum(0)
            spread = share @ (half.square().sum(1) + others.view(mean.shape)).mean(0)
            squares = share @ mean.square().mean(0)
            safe, known = squares + spread, (variance - spread).clamp_min(1e-300)
            variance = torch.minimum(variance * (squares / known).clamp(*_STEP), _MOST * widest)
        nats, root, mean = found
        sigma, each = N.new_zeros(len(ties)), N.new_zeros(len(N), len(ties))
        sigma[index], each[:, index] = root, mean
        # A second amplitude must be worth it, and a scale, by which a lens that is not quite as modeled seems to move.
        paid = 0.5 * len(ties[index].unique()) * math.log(len(N)) + WORTH * (max(0, *tied) + (tied[0] >= 0))
        return Spread(float(nats.sum()) - paid, nats, sigma[count:][: len(tied)], each[:, count:])


class _Joint(NamedTuple):
    """χ² by θ of all views, 2 gᵀθ + θᵀKθ, K being block diagonal but for a matrix of low rank.

    Attributes:
        N: (V, 3, 3) of K = N - FGᵀ.
        F: (V, 3, R).
        G: (V, 3, R).
        g: (V, 3).
    """

    N: Tensor
    F: Tensor
    G: Tensor
    g: Tensor

    def slope(self, theta: Tensor) -> Tensor:
        """(..., V, 3) g + Kθ, of θ (..., V, 3)."""
        shared = theta.flatten(-2) @ self.G.flatten(0, 1)
        return self.g + (self.N @ theta[..., None])[..., 0] - (shared @ self.F.flatten(0, 1).T).view(theta.shape)


class Spread(NamedTuple):
    """Numbers of all views that are normal about zero.

    Attributes:
        nats: by which they are likelier than zeros, the choice of amplitudes paid for.
        by_view: (V,) nats of each view.
        sigma: (X,) standard deviations.
        mean: (V, X) of each view.
    """

    nats: float
    by_view: Tensor
    sigma: Tensor
    mean: Tensor

    def beyond(self, other: Spread) -> float:
        """Nats by which this is likelier than another one, without the view that tells most: it may be a wrong one."""
        return self.nats - other.nats - float((self.by_view - other.by_view).max().clamp_min(0.0))


def by_view(
    problem: BoardProblem,
    state: BoardState,
    noise: float,
    theta: Tensor,
    begin: Tensor,
    deviation: Tensor,
    spread: Tensor | float = 1.0,
    ties: Sequence[int] = (),
) -> ByView:
    """Of what a problem's views show; `deviation` (S,) of the priors of lens and board, zero where held."""
    local, slots, motion = problem.local_size, problem.free.slots, state.motion
    spread = torch.as_tensor(spread, dtype=torch.float64).expand_as(motion)
    grams, H = list[Tensor](), torch.eye(int((deviation > 0).sum()), dtype=torch.float64)
    for first in range(0, len(theta), _TOGETHER):
        views = slice(first, first + _TOGETHER)
        rows = problem.corner_rows(state, views)
        shared = rows[:, local:-1]
        zoom = state.parameters[0] * shared[:, slots[0]]
        if slots[1] != slots[0]:
            zoom = zoom + state.parameters[1] * shared[:, slots[1]]
        lens = torch.cat([zoom[:, None], shared[:, list(slots[2:4])]], 1)
        own, bends = rows[:, POSE:local] * spread[views, :, None], shared[:, len(problem.free) :][:, :SIZE]
        shared, size = (shared * deviation[:, None])[:, deviation > 0], local - POSE + SIZE + bends.shape[1]
        off = without_local(torch.cat([rows[:, :POSE], own, lens, bends, shared, rows[:, -1:]], 1), POSE) / noise
        grams.append(matrix_product(off[:, :size], off.mT))
        H += products_of(off[:, size:-1].transpose(0, 1).flatten(1))
    gram = torch.cat(grams)
    N, C = gram[..., : (size := gram.shape[1])], gram[..., size:-1]
    x = torch.cat([motion / spread.clamp_min(1e-30), theta], 1)
    x = torch.nn.functional.pad(x, (0, size - x.shape[1]))[..., None]
    g = gram[..., -1] - (N @ x)[..., 0]
    # There is no better lens and board than those of the state.
    return ByView(N, g, *unit_weight(H, C, -(C.mT @ x)[..., 0]), ties, begin)


def _felt_by(C: Tensor, widest: Tensor) -> Tensor:
    """(S, R) combinations of lens and board that the widest movements (X,) of views feel; C (V, X, S) are products."""
    felt, basis = torch.linalg.eigh(products_of((C * widest[:, None]).flatten(0, 1).T))
    return basis[:, felt > _UNFELT]


def unit_weight(H: Tensor, C: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """C (V, X, S) and b (V, S) by combinations of unit weight of unknowns whose products are H (S, S)."""
    both = torch.cat([C, b[:, None]], 1)
    flat = torch.linalg.solve_triangular(torch.linalg.cholesky(H), both.flatten(0, 1).T, upper=False)
    both = flat.T.view(both.shape)
    return both[:, :-1], both[:, -1]
