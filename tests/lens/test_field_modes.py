"""Fields of Gaussian units and of a network's last layer: derivatives, batches, cameras, graphs, files."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor
from wrong_files import assert_refused

from kcal.errors import InputError
from kcal.io.camera_file import camera_to_file, load_camera, save_camera
from kcal.lens.camera import Camera
from kcal.lens.field_modes import FieldModes, GaussianModes, NetworkModes
from kcal.lens.hybrid_terms import HybridForm
from kcal.lens.model import LensModel
from kcal.lens.projection import project_components
from kcal.lens.zernike import RADIAL, ZernikeModes

KINDS: dict[str, FieldModes] = {
    "gaussian": GaussianModes(widths=(1.0, 0.45)),
    "network": NetworkModes.random(20, seed=3),
    "zernike": ZernikeModes(radial=7, decentered=4, astigmatic=3, other=2),
}
both = pytest.mark.parametrize("kind", ["gaussian", "network"])
every = pytest.mark.parametrize("kind", KINDS)


def draw(shape: tuple[int, ...], seed: int) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def camera(kind: str, amplitude: float = 2e-3) -> Camera:
    modes = KINDS[kind]
    model = LensModel(hybrid=HybridForm(shape=0.5, radius=1.05, modes=modes))
    weights = (amplitude * draw((len(modes),), 1)).tolist()
    return Camera.build(
        focal=(800, 800), center=(642, 475), size=(1280, 960), coefficients=[0.01, 2e-3, 1e-3, *weights], model=model
    )


@both
def test_the_field_is_the_sum_of_its_columns(kind: str) -> None:
    modes, weights = KINDS[kind], draw((3, len(KINDS[kind])), 2)
    x, y = 0.5 * draw((2, 3, 7), 4)
    columns = modes.columns(x, y)
    assert columns.shape == (len(modes), 2, 3, 7)
    wanted = torch.einsum("vm,mcvn->cvn", weights, columns)
    found = modes.field(weights, x, y)
    torch.testing.assert_close(torch.stack(found[:2]), wanted, rtol=1e-12, atol=1e-13)
    plain = modes.field(weights, x, y, slopes=False)
    assert len(plain) == 2
    torch.testing.assert_close(torch.stack(plain), wanted, rtol=1e-12, atol=1e-13)
    # One vector of weights for all views.
    again = modes.field(weights[0], x, y)
    torch.testing.assert_close(again[0][0], found[0][0], rtol=1e-12, atol=1e-13)


@every
def test_columns_in_memory_that_is_given(kind: str) -> None:
    """Times a scale for each place and axis; memory may be part of other memory."""
    modes, scale = KINDS[kind], draw((3, 2, 7), 6)
    x, y = 0.5 * draw((2, 3, 7), 4)
    memory = draw((len(modes) + 2, 3, 2, 7), 7)
    kept = memory.clone()
    modes.fill_columns(memory[1:-1], x, y, scale)
    wanted = modes.columns(x, y).movedim(1, -2) * scale
    torch.testing.assert_close(memory[1:-1], wanted, rtol=1e-12, atol=1e-13)
    assert torch.equal(memory[[0, -1]], kept[[0, -1]])


@both
def test_slopes_against_autograd(kind: str) -> None:
    modes, weights = KINDS[kind], draw((len(KINDS[kind]),), 2)
    x, y = (0.5 * draw((2, 7), 5)).requires_grad_().unbind()
    f, g, *slopes = modes.field(weights, x, y)
    wanted = [torch.autograd.grad(value.sum(), place, retain_graph=True)[0] for value in (f, g) for place in (x, y)]
    for found, true in zip(slopes, wanted, strict=True):
        torch.testing.assert_close(found, true, rtol=1e-12, atol=1e-12)
    places = (0.5 * draw((2, 2), 6)).requires_grad_()
    few = weights.clone().requires_grad_()
    assert torch.autograd.gradgradcheck(lambda w, p: torch.stack(modes.field(w, p[0], p[1], False)), (few, places))


@both
def test_derivatives_of_pixels(kind: str) -> None:
    own = camera(kind)
    points = torch.stack([0.3 * draw((6,), 1), 0.3 * draw((6,), 2), 1.0 + 0.1 * draw((6,), 3)])
    found = project_components(points, own.params, own.model, range(len(own.names)))
    wanted = torch.func.jacfwd(lambda p: project_components(points, p, own.model).pixels)(own.params)
    torch.testing.assert_close(found.by_camera, wanted.permute(2, 0, 1), rtol=1e-10, atol=1e-9)


@both
def test_round_trip_and_batches(kind: str) -> None:
    own = camera(kind)
    pixels = own.grid(17, 13).reshape(-1, 2)
    rays, valid = own.unproject(pixels)
    assert bool(valid.all())
    again, seen = own.project_rays(rays)
    assert bool(seen.all())
    assert float((again - pixels).abs().max()) < 1e-8
    other = own.params.detach().clone()
    other[8:] *= -0.5
    pair = Camera(torch.stack([own.params.detach(), other]), size=own.size, model=own.model)
    found, _ = pair.project(rays.expand(2, -1, -1))
    one = Camera(other, size=own.size, model=own.model).project(rays)[0]
    torch.testing.assert_close(found[1], one, rtol=1e-12, atol=1e-9)
    values = torch.func.vmap(lambda p: project_components(rays.T, p, own.model).pixels)(pair.params.detach())
    torch.testing.assert_close(values.transpose(-1, -2), found, rtol=1e-12, atol=1e-9)


@pytest.mark.slow
@both
def test_state_and_compiled_graph(kind: str) -> None:
    own = camera(kind)
    blank = Camera(torch.zeros_like(own.params) + camera(kind, 0.0).params, size=own.size, model=own.model)
    blank.load_state_dict(own.state_dict())
    assert blank.fingerprint == own.fingerprint
    rays, _ = own.unproject(own.grid(5, 4).reshape(-1, 2))
    torch.compiler.reset()
    module = own
    compiled = torch.compile(module, fullgraph=True, backend="eager", dynamic=True)
    torch.testing.assert_close(compiled(rays)[0], module(rays)[0], rtol=0, atol=1e-9)


@both
def test_files(kind: str, tmp_path: Path) -> None:
    own = camera(kind)
    path = save_camera(own, tmp_path / "camera.json")
    after = load_camera(path)
    assert after.fingerprint == own.fingerprint
    assert after.model == own.model
    assert hash(after.model) == hash(own.model)
    assert torch.equal(after.project(draw((9, 3), 0).abs())[0], own.project(draw((9, 3), 0).abs())[0])
    content = json.loads(path.read_text())
    hybrid = content["model"]["hybrid"]
    assert set(hybrid) == {"shape", "radius", kind}
    zernike = {"radial": 1, "decentered": 0, "astigmatic": 0, "other": 0}
    for change, complaint in (
        ({kind: None}, "one kind.*got none"),
        ({"modes": zernike}, f"got modes and {kind}"),
        ({kind: {"widths": [0.5, 1.0]} if kind == "gaussian" else {"hidden": [[0, 0, 1]]}}, "widths must|each must"),
    ):
        assert_refused(load_camera, tmp_path, content, ["model", "hybrid"], {**hybrid, **change}, complaint)


def test_files_of_zernike_modes_are_as_before() -> None:
    assert set(camera_to_file(camera("zernike")).dump()["model"]["hybrid"]) == {"shape", "radius", "modes"}


@every
def test_names_priors_and_peaks_are_of_the_weights(kind: str) -> None:
    modes = KINDS[kind]
    assert len(set(modes.names)) == len(modes.names) == len(modes) == len(modes.weight_priors) == len(modes.peaks)
    used = {index for prior in modes.weight_priors for index in prior[:2] if index is not None}
    assert used == set(range(len(modes.hyperprior)))
    # On a fine grid of the disc: no feature exceeds its peak by much.
    angle, radius = torch.meshgrid(torch.linspace(0, 6.2, 40), torch.linspace(0, 1, 30), indexing="ij")
    x, y = (radius * angle.cos()).double().flatten(), (radius * angle.sin()).double().flatten()
    highest = modes.columns(x, y).norm(dim=1).amax(-1)
    assert bool((highest <= 1.001 * torch.tensor(modes.peaks)).all())


def test_priors_of_zernike_modes() -> None:
    modes = ZernikeModes(radial=7, decentered=4, astigmatic=3, other=2)
    assert [round(math.exp(mean), 6) for mean, _, _ in modes.hyperprior] == [5e-4, 3e-4, 5e-5, 4e-5, 3e-4, 0.5, 0.6]
    assert [sd for _, sd, _ in modes.hyperprior] == [1.75, 1.5, 1.75, 1.75, 1.5, 0.7, 0.5]
    # Radial modes cannot stand for the focal length.
    assert [round(math.exp(most), 6) for *_, most in modes.hyperprior] == [0.01, *6 * [math.inf]]
    found = dict(zip(modes.names, modes.weight_priors, strict=True))
    assert found["z5+1"] == (0, 5, 0)
    assert found["z7+1"] == (0, 5, 2)
    assert found["z2+0"] == (4, 6, 0)
    assert found["z4+0"] == (1, 6, 2)
    assert found["z1-1"] == (None, None, 0.0)
    assert found["z3+1i"] == (3, 6, 1)
    names = {name for name, (*_, family, _) in zip(modes.names, modes.real_modes, strict=True) if family == RADIAL}
    assert modes.radial_names == names == {"z5+1", "z7+1"}


def test_units_cover_the_disc() -> None:
    """Any smooth field can be approximated: each of a wave's places lies near a unit, at the edge too."""
    modes = GaussianModes(widths=(0.8, 0.4))
    angle = torch.linspace(0, 2 * math.pi, 60, dtype=torch.float64)
    radius = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None]
    x, y = (radius * angle.cos()).flatten(), (radius * angle.sin()).flatten()
    units = modes.columns(x, y)[: len(modes) // 2, 0]
    goal = torch.sin(2.5 * x + 1.0) * torch.cos(2.0 * y)
    fit = units.T @ torch.linalg.lstsq(units.T, goal[:, None], driver="gelsd").solution
    assert float((fit[:, 0] - goal).abs().max()) < 5e-3


@pytest.mark.parametrize("widths", [(), (0.5, 0.5), (0.25, 0.5), (0.01,), (5.0,), (math.nan,)])
def test_bad_widths(widths: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="widths must decrease"):
        GaussianModes(widths=widths)


@pytest.mark.parametrize("hidden", [(), ((0.0, 0.0, 1.0),), ((1.0, math.inf, 0.0),)])
def test_bad_features(hidden: tuple[tuple[float, float, float], ...]) -> None:
    with pytest.raises(InputError, match=r"at least one feature|finite"):
        NetworkModes.hidden_layer(hidden)
