"""Features whose marks share an error: derivatives, what the adjustment finds of it, and what it does to the pose."""

import dataclasses

import pytest
import torch
from torch import Tensor

from kcal import Baseline, Camera, Features, InputError, Landmarks, RigData, RigOptions, solve_rig
from kcal.calibrate.rig.result import RigResult
from kcal.lens import vector_from_rotation
from kcal.rig import Effect

CAMERA = Camera.build(focal=(800, 800), center=(479.5, 269.5), size=(960, 540), model="pinhole")
CENTERS = torch.tensor([[0.0, 0, 0], [10.0, 0, 0]], dtype=torch.float64)
COUNT = 80
NOISE = 0.05


def seen_points(seed: int) -> tuple[Tensor, Tensor]:
    """Points (COUNT, 3) ahead of two parallel cameras, and their pixels (COUNT, 2, 2)."""
    draw = torch.rand(COUNT, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    depth = 40.0 * 20.0 ** draw[:, :1]
    points = torch.cat([depth * (draw[:, 1:2] - 0.5) + 5.0, depth * 0.6 * (draw[:, 2:] - 0.5), depth], 1)
    return points, torch.stack([CAMERA.project(points - center)[0] for center in CENTERS], 1)


def features(shift: Tensor, amount: float, seed: int = 0, name: str = "shared") -> Features:
    """Marks that are off by `amount` times shifts (COUNT, 2, 2), beside noise."""
    random = torch.Generator().manual_seed(100 + seed)
    _, pixels = seen_points(seed)
    noise = NOISE * torch.randn(pixels.shape, generator=random, dtype=torch.float64)
    nothing = torch.zeros(COUNT, dtype=torch.float64)
    return Features(
        names=tuple(f"{name} {i}" for i in range(COUNT)), pixels=pixels + amount * shift + noise, inverse_range=nothing,
        inverse_range_sigma=torch.full_like(nothing, torch.inf), pixel_sigma=NOISE,
        effects=(Effect(name=name, shift=shift),),
    )  # fmt: skip


def scattered(size: float) -> Tensor:
    """(COUNT, 2, 2) px: shifts that no pose makes."""
    return size * torch.randn(COUNT, 2, 2, generator=torch.Generator().manual_seed(9), dtype=torch.float64)


def solved(data: Features) -> RigResult:
    tape = Baseline(first=0, second=1, length=10.0, sigma=0.001)
    return solve_rig(RigData(cameras=(CAMERA, CAMERA), names=("left", "right"), features=data, baselines=(tape,)))


@pytest.mark.parametrize("amount", [0.0, 0.8, -1.5])
def test_effect_is_found_with_its_sigma(amount: float) -> None:
    found, sigma = solved(features(scattered(0.5), amount)).effects()["shared"]
    assert 0.0 < sigma < 0.05
    assert abs(found - amount) < 4 * sigma


def test_derivatives_are_those_of_differences() -> None:
    result = solved(features(scattered(0.5), 0.8))
    problem, state = result._solution.problem, result._solution.state
    block = problem.blocks[0]
    rows = block.rows(problem.posed(state), state, problem.shared_size)[:, block.size]
    step = 1e-4

    def moved(sign: float) -> Tensor:
        other = state._replace(unknown=state.unknown + sign * step)
        return block.residuals(problem.posed(other), other)

    torch.testing.assert_close(rows, (moved(1.0) - moved(-1.0)) / (2.0 * step), rtol=1e-6, atol=1e-6)


def test_pose_is_as_uncertain_as_the_shared_error_makes_it() -> None:
    """What looks like a roll: its σ becomes that of the effect, and other turns keep theirs."""
    _, pixels = seen_points(0)
    # 0.1 px per 480 px down, in one image more than in the other, by how far it is to the right.
    lean = 0.1 * (pixels[:, :1, 0] - 479.5) / 480.0
    shift = torch.stack([torch.zeros_like(lean), lean], -1) * torch.tensor([[0.0], [1.0]])
    with_it, without = (
        solved(dataclasses.replace(features(shift, 0.0), effects=effects)).relative_covariance(0, 1)
        for effects in ((Effect(name="lean", shift=shift),), ())
    )
    more = (with_it - without).diagonal()[:3].clamp_min(0.0).sqrt()
    assert float(more[2]) == pytest.approx(0.1 / 480.0, rel=0.05)
    assert float(more[:2].max()) < 0.1 * float(more[2])


def test_rotation_is_right_despite_a_shared_error() -> None:
    result = solved(features(scattered(1.0), 2.0))
    sigma = result.relative_covariance(0, 1).diagonal()[:3].sqrt()
    assert (vector_from_rotation(result.rotation[1] @ result.rotation[0].T).abs() < 4.0 * sigma).all()
    # Of effects that are not told, shifts of 2 px would be wrong matches.
    assert float(sigma.max()) < 3e-4


def test_each_source_keeps_its_own_effects() -> None:
    """Effects of landmarks and of features are told apart, and features that are added have those of their own."""
    points, pixels = seen_points(3)
    turn = torch.tensor([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]], dtype=torch.float64)
    way = torch.randn(COUNT, 1, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64).expand(-1, 2, -1)
    landmarks = Landmarks(
        names=tuple(f"l{i}" for i in range(COUNT)), points=points @ turn.T,
        sigma=torch.full((COUNT, 3), 0.02, dtype=torch.float64), pixels=pixels, pixel_sigma=NOISE,
        effects=(Effect(name="clock", shift=way),),
    )  # fmt: skip
    first, second = features(scattered(0.5), 1.0, 1, "first"), features(scattered(0.5), -1.0, 2, "second")
    both = first + second
    shifts = both.shifts()
    assert shifts.shape == (2, 2 * COUNT, 2, 2)
    assert not shifts[0, COUNT:].any()
    assert not shifts[1, :COUNT].any()
    data = RigData(cameras=(CAMERA, CAMERA), names=("left", "right"), landmarks=landmarks, features=both)
    assert data.effects == ("clock", "first", "second")
    found = solve_rig(data, RigOptions(refraction=0.0, refraction_sigma=0.0)).effects()
    for name, amount in (("clock", 0.0), ("first", 1.0), ("second", -1.0)):
        assert found[name][1] < 0.1
        assert abs(found[name][0] - amount) < 4.0 * found[name][1]


@pytest.mark.parametrize("shift", [torch.zeros(COUNT, 2).double(), torch.full((COUNT, 2, 2), torch.nan).double()])
def test_shifts_of_another_shape_or_not_finite_are_refused(shift: Tensor) -> None:
    with pytest.raises(InputError, match=r"the effect of odd needs finite shifts \(F, C, 2\)"):
        dataclasses.replace(features(scattered(0.5), 0.0), effects=(Effect(name="odd", shift=shift),))
