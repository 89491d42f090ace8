import itertools
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from kcal import Camera, InputError, Rig
from kcal.lens import rotation_from_vector
from kcal.locate.views import fit_views
from kcal.pipeline.assignment import assign_groups, best_assignment
from kcal.pipeline.association import (
    Association,
    AssociationOptions,
    _costs,
    _nearest,
    _unplaced,
    associate,
    near_lines,
)
from kcal.rig import RigCovariance
from kcal.track import Detections

SIZE = (1920, 1080)


def rig_of(baseline: float = 10.0) -> Rig:
    camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=SIZE, coefficients=[-0.1, 0.02])
    turn = rotation_from_vector(torch.tensor([0.003, -0.01, 0.004], dtype=torch.float64))
    return Rig.pair(camera, camera, turn, torch.tensor([-baseline, 0.2, 0.1]))


def seen(pixels: Tensor, half: float = 6.0, **more: object) -> Detections:
    boxes = torch.cat([pixels - half, pixels + half], -1)
    count = len(boxes)
    given = {"category": ("car",) * count, "track": (None,) * count} | more
    return Detections(boxes=boxes, score=torch.ones(count), size=SIZE, **given)  # type: ignore[arg-type]


def site(count: int, seed: int, sigma: float = 1.0) -> tuple[Rig, Detections, Detections, Tensor]:
    """Targets from 100 m to 5 km, and boxes whose middles err; right ones in another order."""
    random = torch.Generator().manual_seed(seed)
    rig = rig_of()
    distance = 10 ** torch.empty(count, dtype=torch.float64).uniform_(2.0, 3.7, generator=random)
    place = torch.stack([torch.empty(count).uniform_(-low, low, generator=random) for low in (0.4, 0.2)], -1).double()
    left, right = rig(torch.cat([place, torch.ones(count, 1)], -1) * distance[:, None])[0].unbind(-2)
    order = torch.randperm(count, generator=random)
    noise = sigma * torch.randn(2, count, 2, dtype=torch.float64, generator=random)
    return rig, seen(left + noise[0]), seen((right + noise[1])[order]), order


def costs_of(
    rig: Rig, left: Detections, right: Detections, options: AssociationOptions, among: Tensor | None = None
) -> Tensor:
    """(N, M) of one moment."""
    among = torch.ones(len(left), len(right), dtype=torch.bool) if among is None else among
    rows, columns = among.nonzero(as_tuple=True)
    pixels = torch.stack([left.anchors()[rows], right.anchors()[columns]], 1)
    boxes = torch.stack([left.boxes[rows], right.boxes[columns]], 1)
    cost = torch.full(among.shape, torch.inf, dtype=torch.float64)
    cost[rows, columns] = _costs(_unplaced(rig), pixels, boxes, options, _nearest(rig, options))
    return cost


def test_targets_find_each_other() -> None:
    right_ones = total = 0
    for seed in range(5):
        rig, left, right, order = site(20, seed)
        found = associate(rig, left, right, AssociationOptions(box_sigma=1.0))
        assert len(set(found.right.tolist())) == len(found.right)
        right_ones += int((order[found.right] == found.left).sum())
        total += len(found.left)
    assert total >= 97
    assert right_ones >= total - 1


def brute(cost: Tensor, alone: float) -> float:
    """The least sum over all one-to-one assignments, by trying them."""
    rows, columns = cost.shape
    best = float("inf")
    for choice in itertools.product(range(-1, columns), repeat=rows):
        taken = [c for c in choice if c >= 0]
        if len(taken) == len(set(taken)):
            pairs = sum(float(cost[i, c]) for i, c in enumerate(choice) if c >= 0)
            best = min(best, pairs + 0.5 * alone * (rows + columns - 2 * len(taken)))
    return best


def total(found: Association, shape: tuple[int, int], alone: float) -> float:
    return float(found.cost.sum()) + 0.5 * alone * (sum(shape) - 2 * len(found.left))


def test_the_assignment_is_the_best_one() -> None:
    random = torch.Generator().manual_seed(5)
    rig = rig_of()
    for _ in range(5):
        points = torch.cat([0.01 * torch.randn(4, 2, generator=random), torch.ones(4, 1)], -1).double() * 800
        left, right = rig(points)[0].unbind(-2)
        left, right = seen(left), seen((right + torch.randn(4, 2, generator=random))[:3])
        options = AssociationOptions(box_sigma=2.0)
        found = associate(rig, left, right, options)
        cost = torch.where(found.possible, costs_of(rig, left, right, options), torch.inf)
        assert total(found, (4, 3), 16.0) == pytest.approx(brute(cost, 16.0))


def fisheye_rig(offset: float) -> Rig:
    """Two fisheyes 2 m apart that look past each other, with errors of lenses and pose."""
    camera = Camera.build(
        focal=(600, 600), center=(959.5, 539.5), size=SIZE, coefficients=[0.02, -0.01], model="fisheye4"
    )
    turn = rotation_from_vector(torch.tensor([0.02, -0.3, 0.1], dtype=torch.float64))
    rig = Rig.pair(camera, camera, turn, torch.tensor([-2.0, 0.2, offset]))
    lens = torch.diag(torch.tensor([1.0, 1.0, 2.0, 2.0, 0.0, 1e-3, 1e-3, 0, 0], dtype=torch.float64) ** 2)
    pose = torch.diag(torch.tensor([1e-3, 2e-3, 1e-3, 0.01, 0.01, 0.01], dtype=torch.float64) ** 2)
    rig.covariance = RigCovariance.of(rig, left=lens, right=lens, pose=pose)
    return rig


@pytest.mark.parametrize(("kind", "share"), [("ordinary", 0.05), ("errors", 0.1), ("fisheye", 0.5), ("ahead", 0.7)])
def test_the_band_leaves_out_no_pair_that_is_possible(kind: str, share: float) -> None:
    """Gated and exhaustive comparison agree, also near the epipoles, which are in both images of the last rig."""
    random = torch.Generator().manual_seed(3)
    rig = rig_of() if kind in {"ordinary", "errors"} else fisheye_rig(0.0 if kind == "fisheye" else 2.0)
    if kind == "errors":
        sigma = torch.tensor([5e-4, 5e-4, 1e-3, 1e-2, 1e-2, 1e-2], dtype=torch.float64)
        rig.covariance = RigCovariance.of(rig, pose=torch.diag(sigma**2))
    options = AssociationOptions(box_sigma=2.0, nearest=5.0)
    size = torch.tensor(SIZE, dtype=torch.float64)
    left, right = (seen(torch.rand(120, 2, generator=random, dtype=torch.float64) * size) for _ in range(2))
    (near,) = near_lines(_unplaced(rig), (left.anchors()[None], right.anchors()[None]), options, 5.0)
    every = costs_of(rig, left, right, options)
    possible = every < options.gate**2
    assert not bool((possible & ~near).any())
    assert int(possible.sum()) > 30
    assert float(near.double().mean()) < share
    gated = costs_of(rig, left, right, options, near)
    assert torch.allclose(gated[possible], every[possible], rtol=1e-9, atol=1e-9)
    assert bool(gated[~near].isinf().all())


def test_groups_are_assigned_as_the_whole_is() -> None:
    """Costs of three groups in one matrix: columns, ambiguity and sum are those of one large problem."""
    random = np.random.default_rng(0)
    for _ in range(20):
        cost = np.full((9, 8), np.inf)
        for rows, columns in ((slice(0, 4), slice(0, 3)), (slice(4, 7), slice(3, 7)), (slice(8, 9), slice(7, 8))):
            part = random.uniform(0.0, 16.0, cost[rows, columns].shape)
            cost[rows, columns] = np.where(random.random(part.shape) < 0.7, part, np.inf)
        chosen, ambiguous = assign_groups(cost, 16.0, 2.0 * np.log(20.0))
        whole, least = best_assignment(cost, 16.0)
        assert chosen.tolist() == whole.tolist()
        for i in np.flatnonzero(chosen >= 0):
            without = cost.copy()
            without[i, chosen[i]] = np.inf
            other, more = best_assignment(without, 16.0)
            rival = other[i] >= 0 or chosen[i] in other
            assert ambiguous[i] == (rival and more - least < 2.0 * np.log(20.0))


def test_one_that_stays_alone_costs_half_of_what_two_do() -> None:
    """Where some pairs cost more than staying alone, the columns and the sum are those of trying everything."""
    random = np.random.default_rng(1)
    for shape in ((3, 3), (4, 2), (2, 4), (4, 3)):
        for _ in range(10):
            cost = random.uniform(0.0, 9.0, shape)
            chosen, least = best_assignment(cost, 4.0)
            pairs = [(i, j) for i, j in enumerate(chosen.tolist()) if j >= 0]
            assert least == pytest.approx(brute(torch.from_numpy(cost), 4.0))
            assert least == pytest.approx(sum(cost[pair] for pair in pairs) + 2.0 * (sum(shape) - 2 * len(pairs)))
            assert all(cost[pair] < 4.0 for pair in pairs)


def test_a_pair_has_no_rival_where_staying_alone_is_likelier_than_another_partner() -> None:
    """A second left detection is near the right one's: a rival if it costs little more than the first, alone or not."""
    for second, rival in ((5.0, True), (9.0, False)):
        assert assign_groups(np.array([[1.0], [second]]), 16.0, 6.0)[1].tolist() == [rival, False]
    # Both alone, at 4 more, is likelier than the exchange, at 5 more; where neither is likely, the exchange counts.
    costs = np.array([[12.0, 14.6], [14.6, 12.2]])
    assert assign_groups(costs, 16.0, 6.0)[1].tolist() == [False, False]
    assert assign_groups(costs - 2.0, 16.0, 6.0)[1].tolist() == [True, True]


def test_a_crowd_takes_bounded_time_and_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """400 boxes in one row, of which most could be most: 6.8 CPU seconds when every rival was an assignment."""
    random = torch.Generator().manual_seed(0)
    rows = [torch.rand(400, 2, generator=random).double() * torch.tensor([1800.0, 20.0]) + 500.0 for _ in range(2)]
    left, right = (seen(row - torch.tensor([440.0, 0.0])) for row in rows)
    fitted, solved = Mock(wraps=fit_views), Mock(wraps=linear_sum_assignment)
    monkeypatch.setattr("kcal.pipeline.association.fit_views", fitted)
    monkeypatch.setattr("kcal.pipeline.assignment.linear_sum_assignment", solved)
    found = associate(rig_of(), left, right)
    assert solved.call_count == 1
    assert len(found.left) > 300
    assert found.ambiguous.double().mean() > 0.8
    # Pairs that diverge or are too near are not fitted, and others some at a time.
    sizes = [len(call.args[1]) for call in fitted.call_args_list]
    assert sum(sizes) < 0.3 * 400**2
    assert max(sizes) < 40_000
    with pytest.raises(InputError, match="2,100 left detections in one image"):
        associate(rig_of(), seen(torch.full((2100, 2), 500.0).double()), right)


def test_two_that_could_be_swapped_are_ambiguous() -> None:
    """Side by side at one height: both pairings have a range, and neither is likelier by its epipolar error."""
    rig = rig_of()
    near = rig(torch.tensor([[0.0, 0, 1000.0]]).double())[0][..., 0, :]
    left, right = rig(torch.tensor([[0.0, 0, 1000.0], [2.0, 0, 1000.0], [0, 200.0, 1000.0]]).double())[0].unbind(-2)
    found = associate(rig, seen(left), seen(right))
    assert found.left.tolist() == [0, 1, 2]
    assert found.ambiguous.tolist() == [True, True, False]
    assert near.shape == (1, 2)
    # Category or size settles it.
    for more in ({"category": ("car", "bus", "car")}, {}):
        half = torch.tensor([[6.0], [14.0], [6.0]]) if not more else 6.0
        first, second = seen(left, half, **more), seen(right, half, **more)  # type: ignore[arg-type]
        assert associate(rig, first, second).ambiguous.tolist() == [False] * 3


def test_looks_settle_what_geometry_leaves_open() -> None:
    rig = rig_of()
    left, right = rig(torch.tensor([[0.0, 0, 400.0], [5.0, 0, 400.0]]).double())[0].unbind(-2)
    random = torch.Generator().manual_seed(0)
    textures = [80 * torch.rand(12, 12, dtype=torch.float64, generator=random) for _ in range(2)]
    images = []
    for pixels in (left, right):
        image = torch.full(SIZE[::-1], 100.0, dtype=torch.float64)
        for (u, v), texture in zip(pixels.round().int().tolist(), textures, strict=True):
            image[v - 6 : v + 6, u - 6 : u + 6] = texture
        images.append(image)
    first, second = seen(left.round() - 0.5), seen(right.round() - 0.5)
    assert associate(rig, first, second).ambiguous.tolist() == [True, True]
    settled = associate(rig, first, second, images=(images[0], images[1]))
    assert settled.ambiguous.tolist() == [False, False]
    assert settled.right.tolist() == [0, 1]


def test_range_gate() -> None:
    rig = rig_of()
    left, right = rig(torch.tensor([[0.0, 0, 300.0]]).double())[0].unbind(-2)
    options = {"box_sigma": 1.0}
    assert len(associate(rig, seen(left), seen(right), AssociationOptions(**options)).left) == 1  # type: ignore[arg-type]
    for limits in ({"nearest": 400.0}, {"farthest": 250.0}):
        assert len(associate(rig, seen(left), seen(right), AssociationOptions(**options, **limits)).left) == 0  # type: ignore[arg-type]
    # Diverging rays are no object.
    assert len(associate(rig, seen(right), seen(left), AssociationOptions(**options)).left) == 0  # type: ignore[arg-type]


def test_the_epipolar_cost_is_chi_square_with_the_errors_of_the_rig() -> None:
    """Over rigs drawn from the covariance and noisy pixels, its mean is one; without the covariance far more."""
    truth = rig_of()
    sigma = torch.tensor([5e-4, 5e-4, 1e-3, 1e-2, 1e-2, 1e-2], dtype=torch.float64)
    known = RigCovariance.of(truth, pose=torch.diag(sigma**2))
    random = torch.Generator().manual_seed(7)
    points = torch.tensor([[20.0, 30, 400], [-100, 50, 900], [0, -40, 200]]).double()
    believed = Rig.pair(truth.left, truth.right, truth.right_from_left_rotation, truth.right_from_left_translation)
    marks = []
    for _ in range(60):
        step = sigma * torch.randn(6, dtype=torch.float64, generator=random)
        drawn = Rig.pair(
            truth.left, truth.right, rotation_from_vector(step[:3]) @ truth.right_from_left_rotation,
            truth.right_from_left_translation + step[3:],
        )  # fmt: skip
        noise = 0.5 * torch.randn(2, 3, 2, dtype=torch.float64, generator=random)
        marks.append(torch.stack(drawn(points)[0].unbind(-2)) + noise)
    # Boxes so small that their sizes tell nothing.
    left, right = (seen(both, 1e-3) for both in torch.cat(marks, 1))
    mean = []
    for believed.covariance in (known, None):
        costs = costs_of(believed, left, right, AssociationOptions(box_sigma=0.5), torch.eye(180) > 0)
        mean.append(float(costs.diagonal().mean()))
    assert mean[0] == pytest.approx(1.0, abs=0.35)
    assert mean[1] > 2.0


def test_nothing_to_pair() -> None:
    rig = rig_of()
    none, some = seen(torch.zeros(0, 2).double()), seen(torch.tensor([[900.0, 500.0]]).double())
    for left, right in ((none, some), (some, none), (none, none)):
        found = associate(rig, left, right)
        assert len(found.left) == len(found.cost) == 0
        assert found.possible.shape == (len(left), len(right))


def test_what_cannot_be_is_refused() -> None:
    rig = rig_of()
    some = seen(torch.tensor([[900.0, 500.0]]).double())
    wrong = Detections.read(torch.tensor([[9.0, 5.0, 20.0, 30.0]]), size=(640, 480))
    with pytest.raises(InputError, match="right detections are of an image"):
        associate(rig, some, wrong)
    with pytest.raises(InputError, match="images of the cameras' sizes"):
        associate(rig, some, some, images=(torch.zeros(4, 5), torch.zeros(4, 5)))
    for options in ({"box_sigma": 0.0}, {"odds": 0.5}, {"nearest": 9.0, "farthest": 3.0}):
        with pytest.raises(InputError, match="association"):
            AssociationOptions(**options)  # type: ignore[arg-type]
