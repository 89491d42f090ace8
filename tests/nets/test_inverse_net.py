"""The inverse network and its chart."""

import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import onnxruntime
import pytest
import torch
from lenses import hybrid_camera
from torch import Tensor

import kcal.lens.inverse
from kcal import Camera, DegenerateError, InputError
from kcal.lens import Unproject, save_onnx
from kcal.nets.inverse import (
    InverseFit,
    InverseNet,
    InverseNetOptions,
    RegressionProblem,
    evaluate,
    initial_weights,
    train_inverse,
)

# Inverse nets: good alone, a start that saves work, and never a word in the answer.


_BARREL = [-0.28, 0.1, 5e-4, -3e-4, 0.02, 0.05, 0.02, 0.01, 4e-4, -2e-4, -3e-4, 1e-4, 0.004, -0.006]

_WIDE = [0.4749, 0.02579, 3e-5, -9e-6, 8.2e-5, 0.7623, 0.09433, 1.329e-3, 3.1e-5, -2e-7, -2.6e-5, 3e-8, 1.1e-3, 1e-3]

_HD: dict[str, Any] = {"focal": (1600, 1605), "center": (957, 541), "size": (1920, 1080)}

CAMERAS: dict[str, Callable[[], Camera]] = {
    "opencv5": lambda: Camera.build(**_HD, coefficients=_BARREL[:5], model="opencv5"),
    "opencv14": lambda: Camera.build(**_HD, coefficients=_BARREL, model="opencv14"),
    "ext20": lambda: Camera.build(
        **_HD, coefficients=[*_BARREL, 0.004, -0.002, 0.003, 0.001, 1e-4, -1e-4], model="ext20"
    ),
    # Some 150 degrees, as fitted to a real lens.
    "wide": lambda: Camera.build(
        focal=(2073.8, 2077.7),
        center=(3003.5, 2001.4),
        size=(6016, 4016),
        coefficients=_WIDE,
        model="opencv14",
    ),
    # Corners beyond the fold (kornia issue 3273).
    "folding": lambda: Camera.build(
        focal=(1917.36, 1917.36),
        center=(1920, 1080),
        size=(3840, 2160),
        coefficients=[-0.2535, 0.0924, -0.0006, 0.0007, -0.0191],
    ),
    "fisheye": lambda: Camera.build(
        focal=(400, 402), center=(637, 481), size=(1280, 960), coefficients=[0.02, -0.01, 0.003], model="fisheye4"
    ),
    "hybrid": lambda: hybrid_camera("webcam"),
}


@functools.cache
def trained(name: str) -> tuple[Camera, InverseFit]:
    camera = CAMERAS[name]()
    return camera, train_inverse(camera, InverseNetOptions())


def pixels_around(camera: Camera, count: int = 6000) -> Tensor:
    """Inside the image, beyond its edges by half its size, and along the outline of what is valid."""
    generator = torch.Generator().manual_seed(7)
    size = torch.tensor(camera.size, dtype=torch.float64)
    spread = torch.rand(count, 2, generator=generator, dtype=torch.float64) * 2 - 0.5
    edge = camera.valid_polygon()
    middle = edge.mean(0)
    beside = [middle + (edge - middle) * factor for factor in (0.99, 0.999, 1 - 1e-5, 1.0, 1 + 1e-5, 1.001, 1.01)]
    return torch.cat([spread * size, *beside, torch.full((1, 2), torch.nan, dtype=torch.float64)])


def assert_same_answers(camera: Camera, start: Any) -> None:
    pixels = pixels_around(camera)
    rays, valid = camera.unproject(pixels)
    again, valid_again = camera.unproject(pixels, start=start)
    assert torch.equal(valid_again, valid)
    assert int(valid.sum()) > 1000
    # Both stop within 1e-13 on the plane; beside a fold the ray is that much less determined than its pixel.
    torch.testing.assert_close(camera.project_rays(again)[0], camera.project_rays(rays)[0], rtol=0, atol=2e-9)
    torch.testing.assert_close(again, rays, rtol=0, atol=1e-6)
    plain = torch.linalg.vector_norm(again - rays, dim=-1).sort().values
    assert float(plain[int(0.95 * len(plain))]) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_the_answer_does_not_depend_on_the_start(name: str) -> None:
    camera, fit = trained(name)
    assert_same_answers(camera, fit.net.guess)


@pytest.mark.parametrize("name", ["opencv14", "wide", "folding"])
def test_nor_on_a_start_that_is_nonsense(name: str) -> None:
    camera, fit = trained(name)
    wild = InverseNet(camera)
    wild.load_state_dict(fit.net.state_dict())
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        wild.weights.copy_(10.0 * torch.randn(wild.weights.shape, generator=generator, dtype=torch.float64))
        wild.amplitude.fill_(1.0)
    assert_same_answers(camera, wild.guess)
    assert_same_answers(camera, lambda x, y: (torch.full_like(x, torch.nan), y))


@pytest.mark.parametrize("name", ["opencv14", "ext20"])
def test_it_saves_an_evaluation_of_the_lens(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    camera, fit = trained(name)
    evaluations = Mock(wraps=kcal.lens.inverse.distort_components)
    monkeypatch.setattr(kcal.lens.inverse, "distort_components", evaluations)
    pixels = camera.grid(65, 37).reshape(-1, 2)
    camera.unproject(pixels)
    without = evaluations.call_count
    camera.unproject(pixels, start=fit.net.guess)
    assert evaluations.call_count - without < without


@pytest.mark.parametrize("name", ["opencv14", "ext20"])
def test_alone_it_is_better_than_what_it_corrects(name: str) -> None:
    camera, fit = trained(name)
    assert fit.largest < 0.2 * fit.start_largest
    assert fit.rms < 0.1 * fit.start_rms
    # The stated error is that of the module itself, at pixels of one's own choice.
    pixels = camera.grid(50, 31).reshape(-1, 2)
    distorted = (pixels - camera.center) / camera.focal
    plane = torch.cat([fit.net(distorted), torch.ones(len(pixels), 1, dtype=torch.float64)], -1)
    error = torch.linalg.vector_norm(camera.project(plane)[0] - pixels, dim=-1)
    assert float(error.max()) < 1.3 * fit.largest
    assert float(error.square().mean().sqrt()) == pytest.approx(fit.rms, rel=0.2)


def test_as_in_the_paper_it_learns_the_whole_inverse() -> None:
    camera = CAMERAS["opencv5"]()
    fit = train_inverse(camera, InverseNetOptions(radial=False))
    # What is corrected is the distorted position itself: off by many pixels.
    assert fit.start_largest > 10
    assert fit.largest < 0.05 * fit.start_largest
    assert_same_answers(camera, fit.net.guess)


def test_training_is_repeatable_and_seeded() -> None:
    camera = CAMERAS["opencv5"]()
    options = InverseNetOptions(hidden=4, iterations=15)
    first, again = train_inverse(camera, options), train_inverse(camera, options)
    assert first.rms == pytest.approx(again.rms, rel=1e-3)
    other = train_inverse(camera, InverseNetOptions(hidden=4, iterations=15, seed=1))
    assert not torch.allclose(first.net.weights, other.net.weights)


def test_no_lens_needs_no_correction() -> None:
    camera = Camera.build(**_HD, model="pinhole")
    fit = train_inverse(camera)
    assert fit.largest < 1e-9
    assert_same_answers(camera, fit.net.guess)


def test_gradients_are_those_of_the_inverse() -> None:
    camera, fit = trained("opencv14")
    camera = CAMERAS["opencv14"]().free()
    pixels = camera.grid(5, 4).reshape(-1, 2).requires_grad_()
    found = []
    for start in (None, fit.net.guess):
        rays, _ = camera.unproject(pixels, start=start)
        found.append(torch.autograd.grad(rays[:, 0].sum() + rays[:, 1].prod(), (pixels, camera.params)))
    for got, wanted in zip(found[1], found[0], strict=True):
        torch.testing.assert_close(got, wanted, rtol=1e-9, atol=1e-12)
    assert not fit.net.weights.requires_grad


def test_gradients_of_the_net_itself() -> None:
    net = InverseNet(CAMERAS["opencv14"](), hidden=3)
    net.requires_grad_(True)
    with torch.no_grad():
        net.weights.copy_(0.5 * initial_weights((*net.widths, 1))[: len(net.weights)] + 0.1)
    distorted = torch.tensor([[0.3, -0.2], [-0.1, 0.25]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda d, w: torch.func.functional_call(net, {"weights": w}, (d,)), (distorted, net.weights)
    )


def test_jacobian_of_the_training_problem() -> None:
    widths = (2, 3, 3, 2)
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(len(initial_weights(widths)), generator=generator, dtype=torch.float64)
    inputs, targets = torch.randn(2, 2, 5, generator=generator, dtype=torch.float64)
    problem = RegressionProblem(inputs, targets, widths)

    def residuals(w: Tensor) -> Tensor:
        return (evaluate(inputs, w, widths) - targets).flatten()

    damping = torch.tensor(1e-2, dtype=torch.float64)
    (step,), _ = problem.linearize((weights,)).step(damping)
    r, jacobian = residuals(weights), torch.func.jacfwd(residuals)(weights)
    normal = jacobian.T @ jacobian
    wanted = -torch.linalg.solve(normal + damping * torch.diag(normal.diagonal()), jacobian.T @ r)
    torch.testing.assert_close(step, wanted, rtol=1e-8, atol=1e-10)


class TestModule:
    def test_state_and_precision(self) -> None:
        camera, fit = trained("opencv14")
        other = InverseNet(camera)
        other.load_state_dict(fit.net.state_dict())
        points = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
        wanted = fit.net(points)
        assert torch.equal(other.half()(points.float()), other(points.float().double()))
        assert torch.equal(other(points), wanted)
        assert {t.dtype for t in (*other.parameters(), *other.buffers())} == {torch.float64}

    @pytest.mark.slow
    def test_compiles_as_one_graph(self) -> None:
        torch.compiler.reset()
        camera, fit = trained("opencv14")
        pixels = camera.grid(9, 7).reshape(-1, 2)
        wanted = Unproject(camera)(pixels)
        module = Unproject(camera, start=fit.net)
        rays, valid = torch.compile(module, fullgraph=True, backend="eager", dynamic=True)(pixels)
        assert torch.equal(valid, wanted[1])
        torch.testing.assert_close(rays, wanted[0], rtol=0, atol=1e-12)

    @pytest.mark.slow
    def test_the_guess_runs_as_onnx(self, tmp_path: Path) -> None:
        """The rest of the graph is that of `Unproject` without a net."""

        class Guess(torch.nn.Module):
            def __init__(self, net: InverseNet) -> None:
                super().__init__()
                self.net = net

            def forward(self, distorted: Tensor) -> Tensor:
                return torch.stack(self.net.guess(distorted[:, 0], distorted[:, 1]), -1)

        camera, fit = trained("opencv14")
        distorted = (camera.grid(9, 7).reshape(-1, 2) - camera.center) / camera.focal
        module = Guess(fit.net)
        session = onnxruntime.InferenceSession(save_onnx(module, distorted, tmp_path / "guess.onnx"))
        (ran,) = session.run(None, {session.get_inputs()[0].name: distorted.numpy()})
        # The correction is float32.
        torch.testing.assert_close(torch.from_numpy(ran), module(distorted), rtol=0, atol=1e-8)


def test_bad_input_is_refused() -> None:
    camera = CAMERAS["opencv5"]()
    with pytest.raises(InputError, match="batch"):
        InverseNet(Camera(camera.params.expand(2, -1), size=camera.size, model=camera.model))
    with pytest.raises(InputError, match="hidden"):
        InverseNetOptions(hidden=0)
    with pytest.raises(InputError, match="floating"):
        InverseNet(camera)(torch.tensor([[1, 2]]))
    # A lens that folds at once: hardly a pixel has a ray.
    hopeless = Camera.build(focal=(100, 100), center=(5000, 5000), size=(640, 480), coefficients=[-50.0, 0, 0, 0, 0])
    with pytest.raises(DegenerateError, match="ray"):
        train_inverse(hopeless)


# The chart on which the inverse net works, and its units: what the net sees and answers has a length of one.


BARREL = Camera.build(focal=(300, 300), center=(320, 240), size=(640, 480), coefficients=[-0.2, 0.03, 1e-3, 0, 0])


def test_the_chart_is_undone_up_to_89_9_degrees() -> None:
    net = InverseNet(BARREL)
    direction = math.cos(0.7), math.sin(0.7)
    tangents = torch.tensor([math.tan(math.radians(angle)) for angle in (0, 30, 80, 89.85, 89.99)], dtype=torch.float64)
    x, y = tangents * direction[0], tangents * direction[1]
    back = net.from_chart(*net.to_chart(x, y))
    # 2 tan(angle / 2): stereographic.
    torch.testing.assert_close(
        net.to_chart(x, y)[0][1], torch.tensor(2 * math.tan(math.radians(15)) * direction[0]).double()
    )
    torch.testing.assert_close(back[0][:4], x[:4], rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(back[1][:4], y[:4], rtol=1e-9, atol=1e-12)
    beyond = torch.stack(back)[:, 4]
    assert abs(math.degrees(math.atan(float(beyond.norm()))) - 89.9) < 1e-3
    assert math.isclose(float(beyond[1] / beyond[0]), math.tan(0.7), rel_tol=1e-9)


def test_the_net_sees_and_answers_lengths_of_one_at_most() -> None:
    net = train_inverse(BARREL, InverseNetOptions(hidden=2, samples=(6, 5), iterations=1)).net
    nodes = [-torch.cos(math.pi * (torch.arange(n, dtype=torch.float64) + 0.5) / n) for n in (6, 5)]
    pixels = torch.cartesian_prod(319.5 + 336 * nodes[0], 239.5 + 252 * nodes[1])  # with a margin of 5 %
    rays, valid = BARREL.unproject(pixels)
    assert bool(valid.all())
    distorted = (pixels - torch.tensor([320.0, 240.0])) / 300
    guess = net.closed_form(*distorted.unbind(-1))
    truth = torch.stack(net.to_chart(rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]))
    assert math.isclose(float(guess.norm(dim=0).max()), float(net.reach), rel_tol=1e-9)
    assert math.isclose(float((truth - guess).norm(dim=0).max()), float(net.amplitude), rel_tol=1e-6)


def test_a_fisheye_has_its_own_chart() -> None:
    fisheye = Camera.build(
        focal=(300, 300), center=(320, 240), size=(640, 480), coefficients=[0.02, 0, 0, 0], model="fisheye4"
    )
    net = InverseNet(fisheye)
    x, y = torch.tensor([[0.3, 2.0], [0.1, -0.4]], dtype=torch.float64)
    for mapped in (net.to_chart(x, y), net.from_chart(x, y)):
        assert torch.equal(torch.stack(mapped), torch.stack([x, y]))


@pytest.mark.parametrize(
    ("name", "least", "less"), [("hidden", 1, 0), ("iterations", 1, 0), ("samples", (2, 2), (1, 2))]
)
def test_the_least_that_options_may_be(name: str, least: object, less: object) -> None:
    InverseNetOptions(**{name: least})  # type: ignore[arg-type]
    with pytest.raises(InputError, match="must be at least 1, samples at least 2 x 2"):
        InverseNetOptions(**{name: less})  # type: ignore[arg-type]
