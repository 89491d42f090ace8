"""Modules that are one operation of a compiled graph: results, derivatives, shapes, copies; all steps if asked for."""

import copy
from collections.abc import Sequence

import pytest
import torch
from torch import Tensor
from torch._dynamo.testing import CompileCounterWithBackend
from whole_graphs import traced_whole

from kcal import Camera, Localizer, Origin, Rig
from kcal.checks import expanded
from kcal.lens import LensModel, Unproject
from kcal.lens.model import HybridForm
from kcal.lens.zernike import ZernikeModes
from kcal.nets import NetworkModes
from kcal.rig import RigCovariance

pytestmark = traced_whole


@pytest.fixture(autouse=True)
def _fresh_compiler() -> None:
    torch.compiler.reset()


def camera(modes: ZernikeModes | NetworkModes | None = None) -> Camera:
    modes = ZernikeModes(radial=5, decentered=4, astigmatic=2, other=2) if modes is None else modes
    model = LensModel(hybrid=HybridForm(shape=0.4, radius=1.2, modes=modes))
    weights = 1e-3 * torch.randn(len(modes), generator=torch.Generator().manual_seed(1)).double()
    lens = [0.05, 0.003, -0.001, *weights.tolist()]
    return Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), coefficients=lens, model=model)


def stereo(modes: ZernikeModes | NetworkModes | None = None) -> Rig:
    return Rig.pair(camera(modes), camera(modes), torch.eye(3), torch.tensor([-10.0, 0.1, 0.0]))


def localizer() -> Localizer:
    rig = stereo()
    rig.covariance = RigCovariance.of(rig, pose=1e-8 * torch.eye(6).double())
    origin = Origin(lat=19.0, lon=72.0, height=10.0)
    return Localizer(rig.placed(origin=origin, heading_deg=20.0, covariance=1e-6 * torch.eye(6).double()))


def marks(rig: Rig, count: int = 5) -> tuple[Tensor, Tensor]:
    place = torch.linspace(-0.3, 0.3, count).double()
    depth = torch.linspace(300, 2000, count).double()
    left, right = rig(torch.stack([place, 0.5 * place, torch.ones_like(place)], -1) * depth[:, None])[0].unbind(-2)
    return left.detach() + 0.05, right.detach()


def compiled(module: torch.nn.Module, backend: str = "aot_eager") -> tuple[torch.nn.Module, CompileCounterWithBackend]:
    counter = CompileCounterWithBackend(backend)
    return torch.compile(module, fullgraph=True, dynamic=True, backend=counter), counter


def assert_equal(found: Sequence[Tensor], wanted: Sequence[Tensor]) -> None:
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


@pytest.mark.slow
def test_localizer_compiles_in_seconds_for_all_shapes() -> None:
    """With the real compiler; unrolled it has some 25,000 steps."""
    module = localizer()
    run, counter = compiled(module, "inductor")
    compilations = []
    for count in (5, 3, 70):
        pair = marks(module.rig, count)
        pair[0][0] = torch.nan
        assert_equal(run(*pair), module(*pair))
        compilations.append(counter.frame_count)
    assert compilations[0] == compilations[-1]
    assert len(counter.graphs[-1].graph.nodes) < 100


def gradients(call: torch.nn.Module, module: Localizer) -> list[Tensor]:
    left, right = marks(module.rig)
    cov = (0.04 * torch.eye(4).double()).repeat(5, 1, 1)
    inputs = [value.requires_grad_() for value in (left, right, cov)]
    found = call(*inputs, torch.tensor([True, True, False, True, True]))
    loss = found.enu.square().sum() + found.covariance[found.status == 0].sum() + found.range_low.sum()
    return list(torch.autograd.grad(loss, [*inputs, module.rig.left.params, module.rig.right.params]))


def test_gradients_by_marks_covariances_and_cameras() -> None:
    module = localizer()
    for each in (module.rig.left, module.rig.right):
        each.free()
    wanted = gradients(module, module)
    assert all(bool(one.abs().amax() > 0) for one in wanted)
    for one, other in zip(gradients(compiled(module)[0], module), wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


def test_an_earlier_call_runs_once_more() -> None:
    """Only the last call is kept: of two, the first is repeated in the backward pass."""
    module = camera()
    run, _ = compiled(module)
    one, two = (torch.rand(4, 3, generator=torch.Generator().manual_seed(i)).double() + 0.5 for i in (1, 2))
    found, wanted = (
        torch.autograd.grad(first.sum() + 2.0 * second.sum(), leaves)
        for call in (run, module)
        for leaves in [[one.clone().requires_grad_(), two.clone().requires_grad_()]]
        for first, second in [[call(leaf)[0] for leaf in leaves]]
    )
    for a, b in zip(found, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def test_positions_of_rays_through_a_network() -> None:
    module = Localizer(stereo(NetworkModes.random(6)))
    assert_equal(compiled(module)[0](*marks(module.rig)), module(*marks(module.rig)))
    one = module.rig.left
    for other, points in ((one, torch.rand(4, 3).double() + 0.5), (Unproject(one), 900.0 * torch.rand(4, 2).double())):
        assert_equal(compiled(other)[0](points), other(points))


def test_gradients_by_a_network() -> None:
    module = camera(NetworkModes.random(6)).free("field")
    points = torch.tensor([[0.1, 0.2, 1.0], [-0.3, 0.1, 2.0]], dtype=torch.float64)
    weights = [one for one in module.parameters() if one.requires_grad]
    found, wanted = (torch.autograd.grad(run(points)[0].sum(), weights) for run in (compiled(module)[0], module))
    assert all(bool(one.abs().amax() > 0) for one in wanted[1:])
    assert_equal(found, wanted)


def test_a_changed_copy_is_another_module() -> None:
    module = camera()
    other = copy.deepcopy(module)
    with torch.no_grad():
        other.params += 0.01
    points, run = torch.rand(4, 3).double() + 0.5, compiled(module)[0]
    run(points)
    assert_equal(compiled(other)[0](points), other(points))
    with torch.no_grad():
        module.params += 0.1
    assert_equal(run(points), module(points))


@pytest.mark.slow
def test_over_cameras() -> None:
    """`vmap` in a compiled graph: other parameters than those of the module."""
    several = [camera(), camera()]
    with torch.no_grad():
        several[1].params += 0.02
    points = torch.rand(2, 4, 3).double() + 0.5
    state = torch.func.stack_module_state(several)

    def each(points: Tensor) -> tuple[Tensor, Tensor]:
        def one(parameters: dict[str, Tensor], buffers: dict[str, Tensor], points: Tensor) -> tuple[Tensor, Tensor]:
            return torch.func.functional_call(several[0], (parameters, buffers), (points,))

        return torch.vmap(one)(*state, points)

    found = torch.compile(each, fullgraph=True, backend="aot_eager")(points)
    for i, module in enumerate(several):
        assert_equal([value[i] for value in found], module(points[i]))


@pytest.mark.slow
def test_all_steps_if_asked_for() -> None:
    module = camera()
    module.whole_graph = True
    run, counter = compiled(module, "eager")
    points = torch.rand(4, 3).double() + 0.5
    torch.testing.assert_close(run(points)[0], module(points)[0], rtol=0, atol=1e-9)
    assert len(counter.graphs[0].graph.nodes) > 100


@pytest.mark.slow
def test_forward_derivatives_take_all_steps() -> None:
    """An operation has none: they would be zero."""
    module = camera(ZernikeModes(radial=0, decentered=2, astigmatic=0, other=0))
    points = torch.rand(1, 3).double() + 0.5
    slope = torch.func.jacfwd(lambda points: module(points)[0])
    torch.testing.assert_close(torch.compile(slope, backend="eager")(points), slope(points), rtol=0, atol=1e-8)


def test_a_mask_fits_where_the_number_of_rows_is_a_symbol() -> None:
    """A size that a compiler leaves open is no member of a tuple."""
    fit = torch.compile(
        lambda mask, rows: expanded("mask", mask, rows.shape[:-1]), fullgraph=True, dynamic=True, backend="eager"
    )
    for count in (5, 7, 9):
        assert fit(torch.ones(count, dtype=torch.bool), torch.zeros(count, 2)).shape == (count,)
