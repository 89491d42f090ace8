"""The board problem: its rows are the derivatives of its residuals, and its residuals are those of the cameras."""

import itertools

import pytest
import torch
from differences import numeric
from torch import Tensor

from kcal import Board, Camera
from kcal.calibrate.problem import board_problem
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.parameters import GaussianPrior
from kcal.calibrate.problem.state import BoardState, warp_modes
from kcal.lens import LensModel, rotation_from_vector
from kcal.solve.lm import RobustLoss, SolverStatus, map_state, minimize
from kcal.solve.schur import SchurLinearization

BOARD = Board(columns=4, rows=3, square=0.1)
VIEWS = 3
MODELS = ("pinhole", "opencv4", "opencv5", "opencv8", "opencv12", "opencv14", "ext20", "ext24")
_LENS = {
    "k1": -0.2, "k2": 0.06, "p1": 0.004, "p2": -0.006, "k3": -0.02, "k4": 0.08, "k5": -0.03, "k6": 0.01,
    "s1": 0.006, "s2": -0.004, "s3": -0.005, "s4": 0.003, "tau_x": 0.03, "tau_y": -0.05, "k7": 0.01, "k8": -0.006,
    "k9": -0.007, "k10": 0.005, "s5": 0.002, "s6": -0.003, "k11": 0.004, "k12": 0.003, "k13": -0.002, "k14": 0.001,
}  # fmt: skip


def scene(
    name: str, *, kind: str = "strong", missing: bool = False, batch: tuple[int, ...] = ()
) -> tuple[Tensor, LensModel, BoardState]:
    """Pixels (V, N, 2), the model and a state near them. Focal lengths of order one, so that tolerances bite.

    `kind` "zero": all coefficients, the warp and all rotations are exactly zero.
    """
    generator = torch.Generator().manual_seed(11)
    strong = kind == "strong"

    def normal(*shape: int) -> Tensor:
        return torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)

    model = LensModel.named(name)
    head = torch.tensor([2.0, 1.8, 0.3, -0.2, 0.05], dtype=torch.float64)
    body = torch.tensor([_LENS[name] if strong else 0.0 for name in model.names], dtype=torch.float64)
    state = BoardState.still(
        parameters=torch.cat([head, body]).expand(*batch, -1) + (1e-3 * normal(5 + model.size) if batch else 0),
        board=strong * torch.tensor([0.02, -0.03], dtype=torch.float64).expand(*batch, -1),
        rotation=rotation_from_vector(strong * 0.3 * normal(VIEWS, 3)),
        translation=torch.tensor([-0.15, -0.1, 1.0]).double() + 0.05 * normal(VIEWS, 3),
    )
    pixels = torch.rand((VIEWS, BOARD.corners, 2), generator=generator, dtype=torch.float64)
    if missing:
        pixels[torch.rand(pixels.shape[:-1], generator=generator) < 0.3] = torch.nan
    return pixels, model, state


def zero_step(problem: BoardProblem) -> tuple[Tensor, Tensor]:
    shared = torch.zeros(*problem.batch, problem.shared_size, dtype=torch.float64)
    return shared, torch.zeros(*problem.batch, VIEWS, 6, dtype=torch.float64)


def by_autograd(problem: BoardProblem, state: BoardState) -> Tensor:
    """(V, 6 + S, R) derivatives of residuals(retract(state, step)) at step 0, one shared and one own block a view."""
    shared, local = zero_step(problem)
    by_shared, by_local = torch.func.jacfwd(lambda *step: problem.residuals(problem.retract(state, step)), (0, 1))(
        shared, local
    )
    # by_local is (V, R, V, 6): a view's residuals depend on its own pose alone.
    for v, w in itertools.permutations(range(VIEWS), 2):
        assert bool((by_local[v, :, w] == 0).all())
    return torch.cat([torch.stack([by_local[v, :, v].T for v in range(VIEWS)]), by_shared.transpose(-1, -2)], -2)


def by_differences(problem: BoardProblem, state: BoardState) -> Tensor:
    """As `by_autograd`; all views' poses are moved at once."""

    def moved(step: Tensor) -> Tensor:
        return problem.residuals(problem.retract(state, (step[6:], step[:6].expand(VIEWS, 6))))

    return numeric(moved, torch.zeros(6 + problem.shared_size, dtype=torch.float64), 1e-3).mT


def check_rows(problem: BoardProblem, state: BoardState, *, differences: bool = True) -> None:
    rows = problem.rows(state)
    assert rows.shape[-2] == 6 + problem.shared_size + 1
    assert bool(torch.isfinite(rows).all())
    assert torch.equal(rows[..., -1, :], problem.residuals(state))
    torch.testing.assert_close(rows[..., :-1, :], by_autograd(problem, state), rtol=1e-11, atol=1e-12)
    if differences:
        # Rounding 1e-16 / 1e-3 and a truncation of h⁴ times a fifth derivative.
        torch.testing.assert_close(rows[..., :-1, :], by_differences(problem, state), rtol=1e-7, atol=1e-8)


def free_all(model: LensModel) -> list[int]:
    return list(range(5 + model.size))


@pytest.mark.parametrize("kind", ["strong", "zero"])
class TestRows:
    @pytest.mark.parametrize("name", MODELS)
    def test_all_parameters(self, name: str, kind: str) -> None:
        pixels, model, state = scene(name, kind=kind)
        check_rows(BoardProblem(BOARD.points, pixels, model, free_all(model), free_board=True), state)

    @pytest.mark.parametrize("name", ["opencv5", "opencv14"])
    def test_every_subset_of_blocks(self, name: str, kind: str) -> None:
        """Blocks: focal lengths, center, skew, lens; the warp."""
        pixels, model, state = scene(name, kind=kind, missing=True)
        whole = BoardProblem(BOARD.points, pixels, model, free_all(model), free_board=True)
        check_rows(whole, state)
        size = 5 + model.size
        parts = [[0, 1], [2, 3], [4], list(range(5, size))]
        for *chosen, free_warp in itertools.product([False, True], repeat=5):
            free = [i for part, on in zip(parts, chosen, strict=True) if on for i in part]
            problem = BoardProblem(BOARD.points, pixels, model, free, free_board=free_warp)
            wanted = [*range(6), *(6 + i for i in free), *([6 + size, 7 + size] if free_warp else []), 8 + size]
            # The warp is applied alike whether it is free or not.
            torch.testing.assert_close(problem.rows(state), whole.rows(state)[..., wanted, :], rtol=0, atol=0)
            # What is not free does not move.
            after = problem.retract(state, tuple(torch.ones_like(part) for part in zero_step(problem)))
            held = [i for i in range(size) if i not in free]
            assert torch.equal(after.parameters[held], state.parameters[held])
            assert torch.equal(after.parameters[free], state.parameters[free] + 1.0)
            assert torch.equal(after.board, state.board + (1.0 if free_warp else 0.0))

    @pytest.mark.parametrize("order", [[7, 0, 3], [1, 0]])
    def test_order_of_free_parameters_is_kept(self, order: list[int], kind: str) -> None:
        pixels, model, state = scene("opencv5", kind=kind)
        check_rows(BoardProblem(BOARD.points, pixels, model, order), state)

    def test_no_shared_parameter_at_all(self, kind: str) -> None:
        pixels, model, state = scene("opencv5", kind=kind, missing=True)
        check_rows(BoardProblem(BOARD.points, pixels, model), state)

    def test_batch(self, kind: str) -> None:
        pixels, model, state = scene("opencv5", kind=kind, missing=True, batch=(2, 2))
        together = BoardProblem(BOARD.points, pixels, model, free_all(model), free_board=True, batch=(2, 2))
        alone = BoardProblem(BOARD.points, pixels, model, free_all(model), free_board=True)
        for element in itertools.product(range(2), range(2)):
            one = map_state(lambda tensor, element=element: tensor[element], state)
            torch.testing.assert_close(together.rows(state)[element], alone.rows(one), rtol=1e-13, atol=1e-14)
            torch.testing.assert_close(together.cost(state)[element], alone.cost(one), rtol=1e-13, atol=0)


class TestResiduals:
    @pytest.mark.parametrize("missing", [False, True])
    @pytest.mark.parametrize("name", ["opencv8", "opencv5"])
    def test_are_those_of_the_camera(self, name: str, missing: bool) -> None:
        """Through `Camera.project`, corner by corner; u of all corners, then v."""
        pixels, model, state = scene(name, missing=missing)
        problem = BoardProblem(BOARD.points, pixels, model)
        bent = BOARD.points.clone()
        bent[:, 2] = state.board @ warp_modes(BOARD.points)[:, 2]
        residuals = problem.residuals(state).unflatten(-1, (2, -1))
        camera = Camera(state.parameters, size=(4, 3), model=model)
        for v in range(VIEWS):
            projected, valid = camera.project(bent @ state.rotation[v].T + state.translation[v])
            assert bool(valid.all())
            expected = torch.nan_to_num(projected - pixels[v]).T
            torch.testing.assert_close(residuals[v], expected, rtol=1e-12, atol=1e-13)
        assert torch.equal(problem.corner_residuals(state).isnan(), pixels.isnan())
        assert problem.residual_count == 2 * int(torch.isfinite(pixels[..., 0]).sum())

    @pytest.mark.parametrize("where", ["behind", "on the image plane", "beyond the fold"])
    def test_a_seen_corner_without_projection_is_nan_an_unseen_one_is_not(self, where: str) -> None:
        pixels, model, state = scene("opencv5", kind="zero")
        turned = rotation_from_vector(torch.tensor([0.0, 1.2, 0.0], dtype=torch.float64))
        if where == "beyond the fold":
            # k1 alone: r (1 + k1 r²) folds at r² = 1 / 0.9, and the board's last column lies at x / z = 1.2.
            state.parameters[5] = -0.3
            state.translation[1] = torch.tensor([0.9, -0.1, 1.0])
        else:
            # The board leans towards the camera, its last column behind or in the plane of the camera.
            state.rotation[1] = turned
            depth = 0.3 * float(torch.sin(torch.tensor(1.2).double()))
            state.translation[1] = torch.tensor([0.0, 0.0, depth - (0.02 if where == "behind" else 0.0)]).double()
            if where == "on the image plane":
                state.translation[1, 2] = -float(turned[2, 0]) * float(BOARD.points[3, 0])
        points = BOARD.points @ state.rotation[1].T + state.translation[1]
        radius = points[:, :2].norm(dim=-1) / points[:, 2]
        lost = radius**2 * 0.9 > 1.0 if where == "beyond the fold" else points[:, 2] <= 0
        assert lost.any()
        assert not lost.all()
        problem = BoardProblem(BOARD.points, pixels, model)
        residuals = problem.residuals(state).unflatten(-1, (2, -1))
        assert torch.equal(torch.isnan(residuals[1]), lost.expand(2, -1))
        assert bool(torch.isfinite(residuals[[0, 2]]).all())
        assert bool(torch.isnan(problem.cost(state)))
        # A start there is told as such.
        assert bool(torch.isnan(problem.linearize(state).cost))
        assert int(minimize(problem, state).status) == SolverStatus.BAD_START
        hidden = pixels.clone()
        hidden[1, lost] = torch.nan
        problem = BoardProblem(BOARD.points, hidden, model)
        assert bool(torch.isfinite(problem.residuals(state)).all())
        assert bool(torch.isfinite(problem.rows(state)).all())

    def test_warp_is_the_deflection_at_the_middle(self) -> None:
        shape = warp_modes(Board(columns=5, rows=3, square=0.1).points)[:, 2]
        middle = 1 * 5 + 2
        assert shape[:, middle].tolist() == [1.0, 1.0]
        for corner in (0, 4, 10, 14):
            assert shape[:, corner].abs().max() < 1e-15
        # On the middle row the bend along y is whole, along x a parabola.
        torch.testing.assert_close(shape[1, 5:10], torch.ones(5).double(), rtol=0, atol=1e-15)
        torch.testing.assert_close(shape[0, 5:10], torch.tensor([0, 0.75, 1, 0.75, 0]).double(), rtol=0, atol=1e-15)


def test_tidy_only_rounds() -> None:
    pixels, model, state = scene("opencv5")
    tidied = BoardProblem(BOARD.points, pixels, model).tidy(state._replace(rotation=state.rotation * (1 - 1e-9)))
    for before, after in zip(state, tidied, strict=True):
        torch.testing.assert_close(after, before, rtol=0, atol=1e-14)


def corner_weights(count: int = 1) -> Tensor:
    """(V, N), of which some are zero; of `count` elements."""
    generator = torch.Generator().manual_seed(7)
    weights = 0.3 + 2.0 * torch.rand(count, VIEWS, BOARD.corners, generator=generator, dtype=torch.float64)
    weights[:, 0, ::4] = 0.0
    return weights if count > 1 else weights[0]


def priors() -> tuple[GaussianPrior, ...]:
    one = torch.ones(2, dtype=torch.float64)
    return GaussianPrior(torch.tensor([0, 5]), 1.5 * one, 3.0 * one), GaussianPrior(torch.tensor([2]), one[:1], one[:1])


def test_a_weight_multiplies_its_corner() -> None:
    pixels, model, state = scene("opencv5", missing=True)
    weights, free = corner_weights(), free_all(model)
    plain, weighed = (BoardProblem(BOARD.points, pixels, model, free, weights=w) for w in (None, weights))
    seen = torch.isfinite(pixels[..., 0]) & (weights > 0)
    factor = torch.where(seen, weights, 0.0)
    expected = plain.residuals(state).unflatten(-1, (2, -1)) * factor[:, None]
    torch.testing.assert_close(weighed.residuals(state), expected.flatten(-2), rtol=1e-14, atol=0)
    expected = plain.rows(state).unflatten(-1, (2, -1)) * factor[:, None, None]
    # A column of a turn is a difference of products, each of which is weighted: rounding of a difference near zero.
    torch.testing.assert_close(weighed.rows(state), expected.flatten(-2), rtol=1e-14, atol=1e-16)
    assert weighed.residual_count == 2 * int(seen.sum())
    assert torch.equal(weighed.pixels.isnan()[..., 0], ~seen)
    torch.testing.assert_close(weighed.pixels[seen], pixels[seen])
    later = plain.with_weights(weights)
    torch.testing.assert_close(later.rows(state), weighed.rows(state), rtol=0, atol=0)
    torch.testing.assert_close(later.cost(state), weighed.cost(state), rtol=0, atol=0)
    # Residuals of corners in pixels are not weighted unless it is asked for.
    own = torch.where(seen[:, None], plain.residuals(state).unflatten(-1, (2, -1)), torch.nan).mT
    torch.testing.assert_close(weighed.corner_residuals(state), own, equal_nan=True, rtol=1e-14, atol=0)
    own = own * weights[..., None]
    torch.testing.assert_close(weighed.corner_residuals(state, weighted=True), own, equal_nan=True, rtol=1e-14, atol=0)


def test_a_matrix_of_weights_mixes_the_axes_of_its_corner() -> None:
    pixels, model, state = scene("opencv5", missing=True)
    root = torch.randn(*pixels.shape, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weights = torch.where(pixels.isnan()[..., None], torch.nan, root)
    problem = BoardProblem(BOARD.points, pixels, model, [0, 1, 2, 3, 5, 6], weights=weights)
    by_hand = (weights.nan_to_num() @ problem.pixel_errors(state).mT[..., None])[..., 0]
    torch.testing.assert_close(problem.residuals(state), by_hand.mT.flatten(-2), rtol=1e-12, atol=1e-12)
    check_rows(problem, state)


@pytest.mark.parametrize(("chunk", "few"), [(1_200_000, False), (1, False), (1, True)])
@pytest.mark.parametrize("loss", [None, RobustLoss(kind="huber", scale=1.0)], ids=["squares", "huber"])
@pytest.mark.parametrize("held", [False, True])
def test_normal_equations_are_products_of_the_rows(
    chunk: int, few: bool, loss: RobustLoss | None, held: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of corners and priors, view by view or all at once; unknowns that are held take no part and do not move.

    Of a board of which each view shows less than half, the rest costs nothing.
    """
    monkeypatch.setattr(board_problem, "_CHUNK", chunk)
    pixels, model, state = scene("opencv5", missing=True)
    if few:
        number = torch.arange(pixels.shape[1])
        pixels = torch.where(((number + torch.arange(VIEWS)[:, None]) % 3 == 0)[..., None], pixels, torch.nan)
    free = free_all(model)
    still = torch.zeros(len(free) + 2, dtype=torch.bool)
    still[[1, 6]] = held
    problem = BoardProblem(
        BOARD.points, pixels, model, free, free_board=True, held=still if held else None, weights=corner_weights(),
        loss=loss, terms=priors(),
    )  # fmt: skip
    whole = problem.rows(state)
    sizes = {part._board.shape[-1] for part, *_ in problem._parts(state)}
    assert (max(sizes) <= pixels.shape[1] // 2) == few
    moving = [i for i in range(len(still)) if not bool(still[i])]
    assert problem.moving.tolist() == moving
    rows = whole[:, [*range(6), *(6 + i for i in moving), -1]]
    assert bool((whole[:, 6:-1][:, still] == 0).all())
    values, size = problem.values(state), len(moving) + 1
    assert problem.slots.tolist() == [moving.index(i) if i in moving else -1 for i in range(len(still))]
    gram = torch.zeros(size, size, dtype=torch.float64)
    for prior in priors():
        there = prior.rows(values)[[*moving, -1]]
        gram += there @ there.T
    torch.testing.assert_close(problem.shared_gram(state), gram)
    assert float(problem.shared_cost(state)) == pytest.approx(0.5 * float(gram[-1, -1]))
    assert problem.prior_count == 3
    expected = SchurLinearization.of_gram(rows @ rows.mT, 6, gram)
    linear = problem.linearize(state)
    if loss is None:
        torch.testing.assert_close(linear.cost, expected.cost)
        torch.testing.assert_close(problem.view_cost(state), 0.5 * rows[:, -1].square().sum(-1))
    torch.testing.assert_close(linear.cost, problem.cost(state))
    lam = torch.tensor(0.1, dtype=torch.float64)
    for own, other in zip(linear.step(lam)[0], expected.step(lam)[0], strict=True):
        torch.testing.assert_close(own, other, rtol=1e-8, atol=1e-10)
    off = whole[:, 6:] - whole[:, 6:] @ torch.linalg.pinv(whole[:, :6]) @ whole[:, :6]
    torch.testing.assert_close(problem.off_poses(state), off, rtol=1e-8, atol=1e-10)
    flat, reduced = off.transpose(0, 1).flatten(1), problem.reduced_rows(state)
    torch.testing.assert_close(reduced.T @ reduced, flat @ flat.T, rtol=1e-8, atol=1e-8)
    step = torch.arange(1.0, size, dtype=torch.float64), torch.zeros(VIEWS, 6, dtype=torch.float64)
    after = problem.retract(state, step)
    moved = torch.cat([after.parameters - state.parameters, after.board - state.board])
    torch.testing.assert_close(moved[moving], step[0])
    assert bool((moved[still] == 0).all())
    torch.testing.assert_close(problem.unknowns(after) - problem.unknowns(state), moved)


@pytest.mark.parametrize("kind", ["huber", "cauchy", "tukey"])
def test_a_robust_cost_is_by_corner(kind: str) -> None:
    """ρ of the squared length of each corner's weighted residual, and its gradient in the rows."""
    pixels, model, state = scene("opencv5", missing=True)
    loss = RobustLoss(kind=kind, scale=1.0)  # type: ignore[arg-type]
    problem = BoardProblem(BOARD.points, pixels, model, free_all(model), weights=corner_weights(), loss=loss)
    squared = problem.residuals(state).unflatten(-1, (2, -1)).square().sum(-2)
    assert bool((squared > 1.0).any())
    assert bool(((squared < 1.0) & (squared > 0)).any())
    torch.testing.assert_close(problem.view_cost(state), 0.5 * loss.value(squared).sum(-1))
    rows = problem.rows(state)
    shared, local = zero_step(problem)
    slope = torch.func.grad(lambda *step: problem.cost(problem.retract(state, step)), (0, 1))(shared, local)
    torch.testing.assert_close((rows[:, 6:-1] @ rows[:, -1:].mT).sum(0)[:, 0], slope[0], rtol=1e-9, atol=1e-10)
    torch.testing.assert_close((rows[:, :6] @ rows[:, -1:].mT)[..., 0], slope[1], rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("own_pixels", [False, True])
def test_selected_elements_are_their_own_problem(own_pixels: bool) -> None:
    pixels, model, state = scene("opencv5", missing=True, batch=(3,))
    own = torch.stack([pixels, pixels + 0.1, pixels - 0.2])
    weights = corner_weights(3) if own_pixels else corner_weights()
    target = own if own_pixels else pixels
    together = BoardProblem(BOARD.points, target, model, free_all(model), weights=weights, batch=(3,))
    chosen = torch.tensor([2, 0])
    part = together.select(chosen)
    assert part.batch == (2,)
    some = map_state(lambda tensor: tensor[chosen], state)
    torch.testing.assert_close(part.rows(some), together.rows(state)[chosen], rtol=1e-13, atol=1e-14)
    torch.testing.assert_close(part.cost(some), together.cost(state)[chosen])
    assert BoardProblem(BOARD.points, pixels, model).select(chosen) is None


def test_a_bent_step_is_right_to_second_order() -> None:
    """From twice as far off exact corners, the cost that a straight step leaves grows 2⁴ times, of a bent one 2⁶."""
    pixels, model, state = scene("opencv4")
    shown = Camera(state.parameters, model=model, size=(1, 1)).project(
        BoardProblem(BOARD.points, pixels, model).points(state)
    )
    problem = BoardProblem(BOARD.points, shown[0], model, [0, 1, 5, 6])
    left = []
    for size in (0.02, 0.04):
        away = torch.full((4,), size, dtype=torch.float64), torch.full((VIEWS, 6), size, dtype=torch.float64)
        begun, damping = problem.retract(state, away), torch.tensor(1e-12, dtype=torch.float64)
        linear = problem.linearize(begun)
        step, _ = linear.step(damping)
        bent = problem.bent(begun, step, linear, damping)
        assert bent is not None
        left.append([float(problem.cost(problem.retract(begun, way))) for way in (step, bent)])
    (straight, curved), (straight_twice, curved_twice) = left
    assert straight_twice > 15.0 * straight
    assert curved_twice > 60.0 * curved
    assert curved_twice < 0.05 * straight_twice


def test_a_step_beyond_the_lens_is_not_bent() -> None:
    pixels, model, state = scene("opencv4")
    problem = BoardProblem(BOARD.points, pixels, model, [0, 1, 5, 6])
    linear, damping = problem.linearize(state), torch.tensor(0.0, dtype=torch.float64)
    behind = torch.zeros(VIEWS, 6, dtype=torch.float64)
    behind[0, 5] = -20.0
    assert problem.bent(state, (torch.zeros(4, dtype=torch.float64), behind), linear, damping) is None
