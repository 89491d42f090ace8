"""The least-squares problem of a rig: its unknowns, its blocks, and what ties views."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.motion import CameraRows, summed_products
from kcal.calibrate.rig.source import LOCAL_SIZE, Block, Measurement, PosedCamera, RigState
from kcal.calibrate.rig.unknowns import SharedUnknowns
from kcal.checks import variance_factor
from kcal.gaussian import Covariance
from kcal.lens.camera import Camera
from kcal.lens.pose import nearest_rotation, rotation_from_vector
from kcal.solve.lm import RobustLoss, State
from kcal.solve.schur import EliminatedItems, PartlyEliminated, SchurLinearization

# The least-squares problem of a rig: cameras that move or are held, what they see, and what was measured besides.
#
# Shared unknowns: those of lenses, board and air, then for each camera its rotation and
# its center. Those of boards, landmarks and features are eliminated item by item (`kcal.solve.schur`).

# Share of a residual that the others must leave open for an item to be tested by them; less is rounding.
_LEAST_LEFT = 1e-9
# Share of what is known of a combination of unknowns that boards must tell for it to be compared between them.
_LEAST_TOLD = 0.01


class RigProblem:
    """Everything that a rig is solved from, as one problem whose state is a `RigState`.

    Args:
        cameras: the cameras; what is not free keeps the state's values.
        blocks: what is seen, one block for each kind.
        terms: what was measured of the cameras besides.
        unknowns: what may change of lenses and board.
        turning: which cameras' rotations are unknown.
        moving: which cameras' centers are unknown.
        loss: of the root of each item's mean square, in sigmas; None: plain least squares.
    """

    batch: tuple[int, ...] = ()

    def __init__(
        self,
        cameras: Sequence[Camera],
        blocks: Sequence[Block],
        terms: Sequence[Measurement],
        unknowns: SharedUnknowns,
        turning: Sequence[bool],
        moving: Sequence[bool],
        loss: RobustLoss | None = None,
    ) -> None:
        self.cameras, self.blocks, self.unknowns, self.loss = tuple(cameras), tuple(blocks), unknowns, loss
        self.terms = tuple(terms)
        # Whether cost and derivatives are computed together: for few marks per item, derivatives cost little more.
        self.joint = not any(block.many for block in self.blocks)
        self.turn: list[slice | None] = []
        self.shift: list[slice | None] = []
        end = len(unknowns)
        for turns, moves in zip(turning, moving, strict=True):
            self.turn.append(slice(end, end := end + 3) if turns else None)
            self.shift.append(slice(end, end := end + 3) if moves else None)
        self.shared_size = end
        self.residual_count = int(sum(int(block.counts.sum()) for block in self.blocks)) + 1

    def parameters(self, state: RigState) -> tuple[Tensor, ...]:
        """Parameters (5 + P) of each camera."""
        return state.parameters.split([camera.params.shape[-1] for camera in self.cameras])

    def posed(self, state: RigState) -> list[PosedCamera]:
        """The cameras as they stand, with the places of their unknowns in a step."""
        columns = self.cameras, self.parameters(state), state.rotation, state.center
        slots = self.unknowns.cameras, self.turn, self.shift
        return [PosedCamera(*values) for values in zip(*columns, *slots, strict=True)]

    def item_squares(self, state: RigState) -> list[Tensor]:
        """For each block (V,) the sum of squared residuals of each item."""
        posed = self.posed(state)
        return [block.residuals(posed, own).square().sum(-1) for block, own in self.parts(state)]

    def parts(self, state: RigState) -> list[tuple[Block, RigState]]:
        """Each block, and the state with its items alone."""
        items = state.items.split([len(block) for block in self.blocks])
        return [(block, state._replace(items=own)) for block, own in zip(self.blocks, items, strict=True)]

    def squares_px(self, state: RigState) -> list[tuple[Tensor, Tensor]]:
        """For each block (V, C) squared distances between projected and seen marks, px², and how many marks."""
        posed = self.posed(state)
        return [(block.errors(posed, own).square().sum((2, 3)), block.seen.sum(-1)) for block, own in self.parts(state)]

    def term_rows(self, state: RigState) -> Tensor:
        """(S + 1, Q) of what was measured of the cameras besides, and of what is known of lenses, board and air."""
        posed = self.posed(state)
        return torch.cat([self.prior_rows(state), *(term.rows_at(posed, self.shared_size) for term in self.terms)], -1)

    def prior_rows(self, state: RigState) -> Tensor:
        """(S + 1, Q) of what is known beforehand of lenses, board and air."""
        known = self.unknowns.known.nonzero()[:, 0]
        prior = state.center.new_zeros((self.shared_size + 1, len(known)))
        prior[known, range(len(known))] = 1.0
        prior[-1] = state.unknown[known] if len(known) else 0.0
        return prior

    def cost(self, state: State) -> Tensor:
        """See `Problem.cost`."""
        state = RigState(*state)
        return self._cost_of(self.term_rows(state)[-1], self.item_squares(state))

    def _cost_of(self, terms: Tensor, squares: Sequence[Tensor]) -> Tensor:
        """Half the sum of squared terms (Q,) and of items' squares, as the loss counts these."""
        total = terms.square().sum()
        for block, own in zip(self.blocks, squares, strict=True):
            if self.loss is None:
                total = total + own.sum()
            else:
                count = block.counts.clamp_min(1)
                total = total + (count * self.loss.value(own / count)).sum()
        return 0.5 * total

    def deletions(self, state: RigState) -> list[Tensor]:
        """For each block (V,) by how much χ² would fall without each item, at a minimum and to first order.

        An item with leverage bends the solution towards itself and shows a small residual. With N the reduced normal
        matrix, N_i and g_i the item's parts of it and of the gradient, χ² falls by the item's own squares and by
        g_iᵀ (N - N_i)⁻¹ g_i of the others'; for a single residual that is its squared external Studentized value
        (Baarda 1968; Cook and Weisberg 1982).
        """
        terms, (found, squares) = self.term_rows(state), self._rows(state)
        grams = [self._gram(block, parts) for block, parts in zip(self.blocks, found, strict=True)]
        total, falls = terms @ terms.T + sum(grams, torch.zeros(())), []
        for block, parts, own in zip(self.blocks, found, squares, strict=True):
            if block.many:
                others = torch.stack([_others_fall(total, gram) for gram in self._each_gram(block, parts)])
            else:
                others = _few_others_fall(
                    total, EliminatedItems(block.joined(parts, self.shared_size), block.size).rows
                )
            falls.append(own + others)
        return falls

    def field_products(self, state: RigState, basis: Callable[[Tensor], Tensor]) -> Tensor:
        """(S + F + 1, S + F + 1) products of all rows, with the F amplitudes of a field of errors in each image.

        Boards have none: what bends them from view to view would be taken for a field.

        Args:
            state: where.
            basis: (V, K) values of K functions at places (V, 2) in an image, whose sides are -½ and ½. Each camera has
                amplitudes of all of them, along columns and along rows of pixels.
        """
        terms, posed, size, each = self.term_rows(state), self.posed(state), self.shared_size, 0
        found = []
        for block, own in self.parts(state):
            parts = []
            for camera, columns, rows in block.camera_rows(posed, own):
                if camera is None or block.many:
                    parts.append(CameraRows(camera, columns, rows))
                    continue
                sides = torch.tensor(self.cameras[camera].size, dtype=torch.float64)
                values = basis((block.pixels[:, camera, 0].nan_to_num() + 0.5) / sides - 0.5)
                field = (values[:, :, None, None] * torch.eye(2, dtype=torch.float64)).flatten(1, 2)[..., None]
                each = field.shape[1]
                columns = torch.cat([columns, size + camera * each + torch.arange(each)])
                own_rows = [rows[:, :-1], block.weighted(camera, field), rows[:, -1:]]
                parts.append(CameraRows(camera, columns, torch.cat(own_rows, 1)))
            found.append((block, parts))
        whole = size + each * len(posed)
        total = sum((self._gram(block, parts, whole) for block, parts in found), terms.new_zeros(whole + 1, whole + 1))
        known = torch.tensor([*range(size), whole])
        return total.index_put((known[:, None], known), terms @ terms.T, accumulate=True)

    def block_grams(self, state: RigState) -> list[Tensor]:
        """For each block (S + 1, S + 1) products of the rows of all its items, their own unknowns eliminated."""
        found, _ = self._rows(state)
        return [self._gram(block, parts) for block, parts in zip(self.blocks, found, strict=True)]

    def scatter(self, state: RigState) -> tuple[float, float]:
        """How far boards contradict each other: a χ² and its degrees of freedom, of corners with independent errors.

        With N the reduced normal matrix and H_i the part of board i in units of it, scores g_i of two boards have the
        covariance δ_ij H_i - H_i H_j at the minimum. The sum of their squares has the mean Σ tr (H_i - H_i²), and is
        like a multiple of the χ² that has its mean and variance (Satterthwaite 1946).
        """
        terms, (found, _) = self.term_rows(state), self._rows(state)
        both = list(zip(self.blocks, found, strict=True))
        seen, others = (
            sum((self._gram(block, parts) for block, parts in both if block.many == many), terms.new_zeros(()))
            for many in (True, False)
        )
        total = (terms @ terms.T + seen + others)[:-1, :-1]
        unit = total.diagonal().clamp_min(1e-300).rsqrt()
        values, vectors = torch.linalg.eigh(total * unit[:, None] * unit)
        told = values > _LEAST_LEFT
        root = (vectors[:, told] * values[told].rsqrt()).T * unit
        values, vectors = torch.linalg.eigh(root @ seen[:-1, :-1] @ root.T)
        root = vectors[:, values > _LEAST_TOLD].T @ root
        squares, mean, spread, shares = 0.0, 0.0, 0.0, total.new_zeros(())
        for gram in (gram for block, parts in both for gram in self._each_gram(block, parts)):
            share = root @ gram[:-1, :-1] @ root.T
            twice = share @ share
            squares += float((root @ gram[:-1, -1]).square().sum())
            mean += float((share - twice).trace())
            spread += float((share - twice).square().sum() - twice.square().sum())
            shares = shares + twice
        spread += float(shares.square().sum())
        return (squares * mean / spread, mean**2 / spread) if mean > _LEAST_TOLD else (0.0, 0.0)

    def _each_gram(self, block: Block, parts: Sequence[CameraRows]) -> Iterator[Tensor]:
        """`_gram` of each board alone."""
        return (self._gram(block, _of_item(parts, i)) for i in range(len(block) if block.many else 0))

    def response(self, state: RigState, block: Block) -> tuple[Tensor, Tensor]:
        """How the best unknowns of a block's items depend on the shared ones; see `EliminatedItems.response`.

        Returns:
            (V, L, S) and (V, L, L).
        """
        own = next(own for one, own in self.parts(state) if one is block)
        return EliminatedItems(block.rows(self.posed(state), own, self.shared_size), block.size).response()

    def _rows(self, state: RigState) -> tuple[list[list[CameraRows]], list[Tensor]]:
        """`Block.camera_rows` of all blocks with the loss's weights, and `item_squares`."""
        posed, found, squares = self.posed(state), list[list[CameraRows]](), list[Tensor]()
        for block, own in self.parts(state):
            parts = list(block.camera_rows(posed, own))
            square = state.center.new_zeros(len(block))
            for part in parts:
                square = square + part.rows[:, -1].square().sum(-1)
            if self.loss is not None:
                count = block.counts.clamp_min(1)
                weight = self.loss.weight(square / count).sqrt()[:, None, None]
                parts = [part._replace(rows=part.rows * weight) for part in parts]
            squares.append(square)
            found.append(parts)
        return found, squares

    def _gram(self, block: Block, parts: Sequence[CameraRows], size: int | None = None) -> Tensor:
        """(S + 1, S + 1) products of rows, summed over the items, without what the items' own unknowns can do."""
        size = self.shared_size if size is None else size
        if block.by_rows:
            return EliminatedItems(block.joined(parts, size), block.size).gram
        return summed_products(parts, block.size, size).off(block.size).total

    def linearize(self, state: State) -> SchurLinearization | PartlyEliminated:
        """See `Problem.linearize`."""
        state = RigState(*state)
        terms, (found, squares) = self.term_rows(state), self._rows(state)
        total, cost = terms @ terms.T, self._cost_of(terms[-1], squares)
        local, right = [total.new_zeros(0, LOCAL_SIZE, LOCAL_SIZE)], [total.new_zeros(0, LOCAL_SIZE, len(total))]
        matched: tuple[EliminatedItems, int] | None = None
        for block, parts in zip(self.blocks, found, strict=True):
            if block.by_rows:
                own = EliminatedItems(block.joined(parts, self.shared_size), block.size)
                matched, total = (own, sum(map(len, local))), total + own.gram
                continue
            products, missing = summed_products(parts, block.size, self.shared_size), LOCAL_SIZE - block.size
            # Unknowns that smaller items do not have: with a one on the diagonal they change nothing.
            square = torch.nn.functional.pad(products.local, (missing, 0, missing, 0))
            square[:, range(missing), range(missing)] = 1.0
            local.append(square)
            right.append(torch.nn.functional.pad(products.right, (0, 0, missing, 0)))
            total = total + products.total
        linear = SchurLinearization(torch.cat(local), torch.cat(right), total)
        if matched is not None:
            return PartlyEliminated(linear, *matched, cost)
        linear.cost = cost
        return linear

    def select(self, elements: Tensor) -> None:
        """See `Problem.select`: there is one element only."""

    def retract(self, state: State, step: State) -> RigState:
        """See `Problem.retract`."""
        state = RigState(*state)
        shared, local = step
        change = shared[: len(self.unknowns)]
        turns = torch.stack([shared.new_zeros(3) if slot is None else shared[slot] for slot in self.turn])
        shifts = torch.stack([shared.new_zeros(3) if slot is None else shared[slot] for slot in self.shift])
        if len(change):
            parameters = [
                values + by_unknown @ change
                for values, by_unknown in zip(self.parameters(state), self.unknowns.cameras, strict=True)
            ]
            state = state._replace(
                parameters=torch.cat(parameters),
                unknown=state.unknown + change,
                board=state.board + self.unknowns.board @ change,
            )
            if self.unknowns.by_refraction is not None:
                state = state._replace(refraction=state.refraction + self.unknowns.by_refraction @ change)
        state = state._replace(rotation=rotation_from_vector(turns) @ state.rotation, center=state.center + shifts)
        steps = local.split([len(block) for block in self.blocks])
        moved = [
            block.moved(own.items, step[:, LOCAL_SIZE - block.size :])
            for (block, own), step in zip(self.parts(state), steps, strict=True)
        ]
        return state._replace(items=torch.cat([state.items[:0], *moved]))

    @staticmethod
    def tidy(state: State) -> RigState:
        """The state with its cameras' rotations made orthonormal again after many small steps."""
        found = RigState(*state)
        return found._replace(rotation=nearest_rotation(found.rotation))


def _of_item(parts: Sequence[CameraRows], number: int) -> list[CameraRows]:
    """The rows of one item."""
    return [part._replace(rows=part.rows[number : number + 1]) for part in parts]


def _others_fall(total: Tensor, part: Tensor) -> Tensor:
    """() by how much the others' χ² would fall without an item, from its products (S + 1, S + 1)."""
    rest = (total - part)[:-1, :-1]
    unit = rest.diagonal().clamp_min(1e-300).rsqrt()
    root, info = torch.linalg.cholesky_ex(rest * unit[:, None] * unit)
    pull = torch.linalg.solve_triangular(root, (part[:-1, -1] * unit)[:, None], upper=False)
    # An item without which the rest would determine nothing cannot be tested.
    return torch.where(info == 0, pull.square().sum(), 0.0)


def _few_others_fall(total: Tensor, rows: Tensor) -> Tensor:
    """(V,) what `_others_fall` gives for V items of few rows (V, S + 1, k), residuals e and derivatives B.

    It is eᵀ H (1 - H)⁻¹ e with H = Bᵀ N⁻¹ B (Woodbury 1950).
    """
    unit = total[:-1, :-1].diagonal().clamp_min(1e-300).rsqrt()
    root, info = torch.linalg.cholesky_ex(total[:-1, :-1] * unit[:, None] * unit)
    if int(info):
        return rows.new_zeros(len(rows))
    scaled = (rows[:, :-1] * unit[:, None]).transpose(0, 1).flatten(1)
    thrown = torch.linalg.solve_triangular(root, scaled, upper=False).unflatten(1, (len(rows), -1)).transpose(0, 1)
    values, vectors = torch.linalg.eigh(thrown.mT @ thrown)
    along = (vectors.mT @ rows[:, -1, :, None])[..., 0]
    testable = values[:, -1] < 1.0 - _LEAST_LEFT
    return torch.where(testable, (along.square() * values / (1.0 - values).clamp_min(_LEAST_LEFT)).sum(-1), 0.0)


class GoodnessOfFit(NamedTuple):
    """How residuals compare with their sigmas.

    Attributes:
        chi2: sum of squares of all residuals over their sigmas.
        freedom: degrees of freedom.
    """

    chi2: float
    freedom: int

    @property
    def variance(self) -> float:
        """By which covariances are to be multiplied: χ² / freedom where chance does not explain that, otherwise 1."""
        return variance_factor(self.chi2, self.freedom)


def goodness_of_fit(problem: RigProblem, state: RigState) -> GoodnessOfFit:
    """Compare the residuals at a minimum with their sigmas."""
    counted = sum(int(block.freedom.sum()) for block in problem.blocks)
    freedom = counted + problem.term_rows(state).shape[1] - problem.shared_size
    return GoodnessOfFit(2.0 * float(problem.cost(state)), freedom)


# Eigenvalues of a scaled normal matrix below this share of the largest are rounding.
_RANK_TOLERANCE = 1e-10


class Least(NamedTuple):
    """The least χ² of some rows, how many unknowns they determine, and where it is.

    Attributes:
        chi2: the least.
        rank: number of unknowns that are determined.
        step: (S,) to the minimum.
        root: (S, R) of the covariance there.
    """

    chi2: float
    rank: int
    step: Tensor
    root: Tensor


def least(gram: Tensor) -> Least:
    """The minimum of rows whose products (S + 1, S + 1) are given, residuals last."""
    N, g = gram[:-1, :-1], gram[:-1, -1]
    scale = torch.where(N.diagonal() > 0, N.diagonal(), 1.0).rsqrt()
    root = Covariance(N * scale[:, None] * scale, scale, tolerance=_RANK_TOLERANCE).root
    pull = g @ root
    return Least(float(gram[-1, -1] - pull.square().sum()), root.shape[1], -root @ pull, root)


# A solved rig: what its data determine of the shared unknowns, and names for what they leave open.

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
        motions = self._named_motions(names, absolute=absolute)
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
                label = f"a mixture of {self._largest_parts(left[:, 0], names)}"
                inside = torch.eye(left.shape[1], dtype=left.dtype)[0]
            found.append(label)
            # What is left of the open directions without the one that has a name now.
            rest = torch.linalg.svd(inside[None] / torch.linalg.vector_norm(inside)).Vh[1:]
            left = left @ rest.T
        return tuple(found)

    def _named_motions(self, names: Sequence[str], *, absolute: bool) -> list[tuple[str, Tensor]]:
        """Motions (S,) of the cameras that people have a name for."""
        rotation, center = self.state.rotation, self.state.center
        middle, each, out = center.mean(0), range(len(names)), list[tuple[str, Tensor]]()

        def rig_motion(label: str, turn: Tensor, shift: Tensor) -> None:
            turned = [-(rotation[c] @ turn) @ self.turn_rows(c) + shift[c] @ self.shift_rows(c) for c in each]
            if bool((motion := torch.stack(turned).sum(0)).any()):
                out.append((label, motion))

        zero = torch.zeros(3, dtype=torch.float64)
        if absolute:
            for axis, word in zip(_IDENTITY, ("east", "north", "up"), strict=True):
                rig_motion(f"where the rig stands ({word})", zero, axis.expand_as(center))
            along = center[min(1, len(center) - 1)] - center[0]
            turns = [(_IDENTITY[2], "the heading (a turn about the vertical)")]
            turns += [
                (axis, f"a tilt of the rig about the {word} axis")
                for axis, word in zip(_IDENTITY[:2], ("east", "north"), strict=True)
            ]
            if bool(along.any()):
                turns.append((along / torch.linalg.vector_norm(along), "a turn of the rig about its baseline"))
            for axis, label in turns:
                for pivot in (middle, *center):
                    rig_motion(label, axis, torch.linalg.cross(axis.expand_as(center), center - pivot))
        fixed = center[0] if self.problem.shift[0] is None else middle
        rig_motion("the scale (how far apart the cameras stand)", zero, center - fixed)
        for c, name in enumerate(names):
            labels = [f"the {word} of {name}" for word in ("pitch", "yaw", "roll")]
            labels += [f"where {name} stands ({word})" for word in ("sideways", "up and down", "along its axis")]
            motions = torch.cat([self.turn_rows(c), rotation[c] @ self.shift_rows(c)])
            out += [(label, motion) for label, motion in zip(labels, motions, strict=True) if bool(motion.any())]
        single = torch.eye(self.problem.shared_size, dtype=torch.float64)
        return out + [(label, axis) for label, axis in zip(self.problem.unknowns.labels, single, strict=False) if label]

    def _largest_parts(self, direction: Tensor, names: Sequence[str]) -> str:
        labels = list(self.problem.unknowns.labels)
        for name, turn, shift in zip(names, self.problem.turn, self.problem.shift, strict=True):
            labels += [f"the attitude of {name}"] * (3 * (turn is not None))
            labels += [f"where {name} stands"] * (3 * (shift is not None))
        order = direction.abs().argsort(descending=True)[:4].tolist()
        return ", ".join(dict.fromkeys(labels[i] for i in order))

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
