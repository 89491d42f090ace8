"""Matches are eliminated one by one, and nothing else changes."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from kcal import Baseline, Camera, Features, InputError, Landmarks, RigData
from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.problem import RigProblem, _few_others_fall, _others_fall
from kcal.calibrate.rig.source import LOCAL_SIZE, Start
from kcal.calibrate.rig.unknowns import held
from kcal.solve import LMOptions
from kcal.solve.schur import SchurLinearization

CAMERA = Camera.build(focal=(800, 801), center=(318, 242), size=(640, 480), coefficients=[-0.1, 0.02, 1e-4, 2e-4])
CENTER = torch.tensor([[0.0, 0, 0], [2.0, 0.1, -0.05]], dtype=torch.float64)


def seen(points: Tensor) -> Tensor:
    return torch.stack([CAMERA.project(points - center)[0] for center in CENTER], 1)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def features(count: int = 40) -> Features:
    share = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    points = 10.0 * 100.0 ** share[:, :1] * torch.cat([0.6 * (share[:, 1:] - 0.5), torch.ones(count, 1)], -1)
    nothing = torch.zeros(count, dtype=torch.float64)
    return Features(
        names=tuple(map(str, range(count))),
        pixels=seen(points) + 0.1 * normal(count, 2, 2),
        inverse_range=nothing,
        inverse_range_sigma=torch.full_like(nothing, math.inf),
        pixel_sigma=0.1,
    )


def adjustment(matches: Features, *, landmarks: bool = True) -> tuple[Adjustment, Tensor]:
    points = torch.tensor([[-4.0, 1, 20], [5, -2, 30], [1, 3, 15], [-9, -4, 60]], dtype=torch.float64)
    survey = Landmarks(
        names=tuple("abcd"), points=points, sigma=torch.full((4, 3), 0.01).double(),
        pixels=seen(points) + 0.1 * normal(4, 2, 2, seed=1), pixel_sigma=0.1,
    )  # fmt: skip
    tape = Baseline(first=0, second=1, length=2.003, sigma=0.01)
    data = RigData(
        cameras=(CAMERA, CAMERA.with_parameters(CAMERA.params + 0.0)), names=("left", "right"), features=matches,
        landmarks=survey if landmarks else None, baselines=(tape,),
    )  # fmt: skip
    start = Start(rotation=torch.eye(3, dtype=torch.float64).repeat(2, 1, 1), center=CENTER + 0.01)
    work = Adjustment(data, start, held(data.cameras), 1.0)
    return work, ~work.none()


def by_products(problem: RigProblem, work: Adjustment, masks: Tensor) -> SchurLinearization:
    """The same normal equations from the products of all rows of each item."""
    state = work.part(masks)
    posed, grams = problem.posed(state), []
    for block, own in problem.parts(state):
        rows = block.rows(posed, own, problem.shared_size)
        missing = LOCAL_SIZE - block.size
        gram = torch.nn.functional.pad(rows @ rows.mT, (missing, 0, missing, 0))
        gram[:, range(missing), range(missing)] = 1.0
        grams.append(gram)
    terms = problem.term_rows(state)
    return SchurLinearization.of_gram(torch.cat(grams), LOCAL_SIZE, terms @ terms.T)


def test_a_step_is_the_same_as_from_all_products() -> None:
    work, masks = adjustment(features())
    problem = work.problem(masks)
    linear, plain = problem.linearize(work.part(masks)), by_products(problem, work, masks)
    torch.testing.assert_close(linear.cost, plain.cost)
    (shared, local), predicted = linear.step(torch.tensor(1e-12).double())
    (other, others), expected = plain.step(torch.tensor(1e-12).double())
    torch.testing.assert_close(shared, other, rtol=1e-6, atol=1e-10)
    torch.testing.assert_close(local, others, rtol=1e-5, atol=1e-9)
    torch.testing.assert_close(predicted, expected, rtol=1e-8, atol=0.0)
    matrix, scale = linear.information()
    reference, unit = plain.information()
    torch.testing.assert_close(
        matrix / (scale[:, None] * scale), reference / (unit[:, None] * unit), rtol=1e-6, atol=1e-3
    )


def test_a_much_damped_step_goes_downhill_by_what_it_predicts() -> None:
    work, masks = adjustment(features())
    problem, state = work.problem(masks), work.part(masks)
    linear = problem.linearize(state)
    for damping in (1e3, 1e6):
        step, predicted = linear.step(torch.tensor(damping).double())
        fall = linear.cost - problem.cost(problem.retract(state, step))
        assert float(fall) > 0
        assert float(fall / predicted) == pytest.approx(1.0, abs=0.2)


def test_the_fall_without_an_item_is_that_of_a_new_solution() -> None:
    matches = features(12)
    matches.pixels[5, 1, 1] += 1.0
    work, masks = adjustment(matches)
    problem, _ = work.solve(masks, LMOptions(residual_floor=1e-8))
    features_at = work.at("features")
    falls = work.deletions(masks)[features_at]
    whole = float(problem.cost(work.part(masks)))
    for i in (0, 5):
        some = masks.clone()
        some[features_at.start + i] = False
        fewer, _ = work.solve(some, LMOptions(residual_floor=1e-8))
        assert 2.0 * (whole - float(fewer.cost(work.part(some)))) == pytest.approx(float(falls[i]), rel=0.02)
    assert int(falls.argmax()) == 5


def test_both_ways_to_leave_an_item_out_agree() -> None:
    rows = normal(7, 5, 2)
    part = rows @ rows.mT
    total = part.sum(0) + torch.eye(5).double()
    torch.testing.assert_close(_few_others_fall(total, rows), torch.stack([_others_fall(total, one) for one in part]))
    # Without the only item that tells an unknown nothing can be tested.
    alone = torch.zeros(1, 5, 1, dtype=torch.float64)
    alone[0, 0, 0] = alone[0, 4, 0] = 1.0
    total = alone[0] @ alone[0].T + torch.diag(torch.tensor([0.0, 1, 1, 1, 1]).double())
    assert _few_others_fall(total, alone).tolist() == [0.0]


def test_covariances_of_marks() -> None:
    plain = features()
    alike = dataclasses.replace(plain, covariance=0.01 * torch.eye(2).double().expand(40, 2, 2, 2))
    torch.testing.assert_close(*(adjustment(f)[0].squares(adjustment(f)[1]) for f in (plain, alike)))
    both = plain + dataclasses.replace(alike, names=tuple(f"again {i}" for i in range(40)))
    torch.testing.assert_close(both.covariance[:40], both.covariance[40:])
    # What is uncertain along the lines alone tells as much of the epipolar geometry.
    long = plain.pixels.new_zeros(40, 2, 2, 2)
    long[..., 0, 0], long[..., 1, 1] = 1.0, 0.01
    squares = [
        float(work.squares(masks)[work.at("features")].sum())
        for work, masks in (
            adjustment(f, landmarks=False) for f in (alike, dataclasses.replace(plain, covariance=long))
        )
    ]
    assert squares[1] < squares[0]
    with pytest.raises(InputError, match="covariance"):
        dataclasses.replace(plain, covariance=torch.eye(2).double())
