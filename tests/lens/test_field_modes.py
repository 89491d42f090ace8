"""Fields of modes, Zernike modes, and poses."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from differences import numeric
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from wrong_files import assert_refused

from kcal import Camera, InputError
from kcal.io.camera_file import camera_to_file, load_camera, save_camera
from kcal.lens import LensModel
from kcal.lens.field_modes import FieldModes, GaussianModes, NetworkModes
from kcal.lens.model import HybridForm
from kcal.lens.pose import nearest_rotation, rotation_from_vector, step_rows, vector_from_rotation
from kcal.lens.projection import project_components
from kcal.lens.zernike import ASPECT, ASTIGMATIC, DECENTERED, OTHER, RADIAL, TILTED, ZernikeModes

# Fields of Gaussian units and of a network's last layer: derivatives, batches, cameras, graphs, files.


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


@every
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
    torch.testing.assert_close(modes.field(weights[0], x, y)[0][0], found[0][0], rtol=1e-12, atol=1e-13)


@every
def test_columns_in_memory_that_is_given(kind: str) -> None:
    """Times a scale for each place and axis; memory may be part of other memory."""
    modes, scale = KINDS[kind], draw((3, 2, 7), 6)
    x, y = 0.5 * draw((2, 3, 7), 4)
    memory = draw((len(modes) + 2, 3, 2, 7), 7)
    kept = memory.clone()
    modes.fill_columns(memory[1:-1], x, y, scale)
    torch.testing.assert_close(memory[1:-1], modes.columns(x, y).movedim(1, -2) * scale, rtol=1e-12, atol=1e-13)
    assert torch.equal(memory[[0, -1]], kept[[0, -1]])


@every
def test_slopes_against_autograd(kind: str) -> None:
    modes, weights = KINDS[kind], draw((len(KINDS[kind]),), 2)
    # The last place is the center.
    x, y = (0.5 * draw((2, 7), 5) * (torch.arange(7) < 6)).requires_grad_().unbind()
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
    compiled = torch.compile(own, fullgraph=True, backend="eager", dynamic=True)
    torch.testing.assert_close(compiled(rays)[0], own(rays)[0], rtol=0, atol=1e-9)


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
    for change, complaint in (
        ({kind: None}, "one kind.*got none"),
        ({"modes": {"radial": 1, "decentered": 0, "astigmatic": 0, "other": 0}}, f"got modes and {kind}"),
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


# Zernike modes and poses.


# Zernike modes are what they are said to be: orthogonal, of the stated turn, and summed with the right slopes.
MODES = ZernikeModes()

FEW = ZernikeModes(radial=5, decentered=4, astigmatic=3, other=3)


def disc(rings: int = 40, directions: int = 64) -> tuple[Tensor, Tensor, Tensor]:
    """x, y and weights of a quadrature rule that is exact for polynomials of degree 63 on the unit disc; mean of 1."""
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    # In s = r² the area element is constant.
    radius = torch.from_numpy(np.sqrt((nodes + 1) / 2))[:, None]
    angle = torch.arange(directions, dtype=torch.float64) * (2 * math.pi / directions)
    weight = torch.from_numpy(weights)[:, None].expand(-1, directions) / (2 * directions)
    return (radius * torch.cos(angle)).flatten(), (radius * torch.sin(angle)).flatten(), weight.flatten()


def test_orthogonal_with_mean_square_one() -> None:
    x, y, weight = disc(40, 80)
    columns = MODES.columns(x, y)
    gram = torch.einsum("acn,bcn,n->ab", columns, columns, weight)
    torch.testing.assert_close(gram, torch.eye(len(MODES), dtype=torch.float64), rtol=0, atol=1e-10)


def test_turns_with_the_azimuth() -> None:
    """Rotating the place by an angle rotates the displacement by it, and m = j - 1 times more."""
    generator = torch.Generator().manual_seed(1)
    radius, azimuth = (reach * torch.rand(7, generator=generator).double() for reach in (0.9, 6.0))
    turn = 0.7
    before = MODES.columns(radius * torch.cos(azimuth), radius * torch.sin(azimuth))
    after = MODES.columns(radius * torch.cos(azimuth + turn), radius * torch.sin(azimuth + turn))
    for number, (i, _, family, degree) in enumerate(MODES.real_modes):
        j, n = MODES.complex_modes[i]
        assert degree == n
        value, turned = torch.complex(*before[number]), torch.complex(*after[number])
        m = j - 1
        torch.testing.assert_close(turned, value * np.exp(1j * turn * (m + 1)), rtol=0, atol=1e-12)
        expected = {0: (RADIAL, OTHER), 1: (TILTED if n == 2 else DECENTERED,), 2: (ASTIGMATIC, ASPECT)}
        assert family in expected.get(abs(m), (OTHER,))


def test_radial_modes_point_outward_and_swirls_around() -> None:
    x, y = torch.tensor([0.3, -0.5], dtype=torch.float64), torch.tensor([0.4, 0.2], dtype=torch.float64)
    columns = MODES.columns(x, y)
    for number, (i, part, family, _) in enumerate(MODES.real_modes):
        u, v = columns[number]
        if family == RADIAL:
            assert float((u * y - v * x).abs().max()) < 1e-14
        if MODES.complex_modes[i][0] == 1 and part == 1:
            assert float((u * x + v * y).abs().max()) < 1e-14


def test_left_out() -> None:
    """Constants, focal length, roll and the shape of the base projection are other parameters of the lens."""
    assert not {"z0+0", "z0+0i", "z1+1", "z1+1i", "z3+1"} & set(MODES.names)
    assert {"z3+1i", "z5+1", "z33+1", "z33+1i", "z18+2", "z18+0", "z9+3", "z9-1", "z1-1", "z8-8i"} <= set(MODES.names)
    assert len(set(MODES.names)) == len(MODES.names) == len(MODES)


def test_a_low_mode_written_out() -> None:
    """Z_2,0 = √3 (2 r² - 1): a displacement along x, the same in all directions."""
    x, y = torch.tensor([0.6], dtype=torch.float64), torch.tensor([0.3], dtype=torch.float64)
    column = MODES.columns(x, y)[MODES.names.index("z2+0")]
    torch.testing.assert_close(column, torch.tensor([[math.sqrt(3) * -0.1], [0.0]], dtype=torch.float64))


def test_inputs_and_weights_are_not_overwritten() -> None:
    x, y, _ = disc(3, 5)
    weights = torch.randn(len(FEW), generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    kept = x.clone(), y.clone(), weights.clone()
    assert all(torch.equal(a, b) for a, b in zip(FEW.field(weights, x, y), FEW.field(weights, x, y), strict=True))
    assert all(torch.equal(a, b) for a, b in zip(kept, (x, y, weights), strict=True))


@pytest.mark.parametrize("degree", [-1, 41, 3.0, True])
def test_impossible_degrees(degree: int) -> None:
    with pytest.raises(InputError, match="astigmatic must be a whole number from 0 to 40"):
        ZernikeModes(astigmatic=degree)


def test_degrees_without_a_mode() -> None:
    for radial in (0, 1):
        with pytest.raises(InputError, match="no mode"):
            ZernikeModes(radial=radial, decentered=0, astigmatic=0, other=0)


@pytest.mark.parametrize("modes", [ZernikeModes(), ZernikeModes(radial=9, decentered=0, astigmatic=1, other=3)])
@pytest.mark.parametrize("slopes", [True, False])
def test_few_places_and_many(modes: ZernikeModes, slopes: bool) -> None:
    """Products of matrices, for few places, and Horner's rule, for many, are the same field; batches too."""
    generator = torch.Generator().manual_seed(6)
    weights = torch.randn(2, len(modes), generator=generator, dtype=torch.float64)
    x, y = 1.4 * torch.rand(2, 2, 5000, generator=generator, dtype=torch.float64) - 0.7
    few = modes.field(weights, x[:, :300], y[:, :300], slopes)
    many = modes.field(weights, x, y, slopes)
    assert len(few) == len(many) == (6 if slopes else 2)
    for one, other in zip(few, many, strict=True):
        # Powers of t lose six digits at degree 33.
        torch.testing.assert_close(one, other[:, :300], rtol=0, atol=1e-10 * float(other.abs().max()))
    by_columns = torch.einsum("bm,mkbn->kbn", weights, modes.columns(x[:, :300], y[:, :300]))
    torch.testing.assert_close(torch.stack(few[:2]), by_columns, rtol=1e-11, atol=1e-11)


def test_powers_of_few_places_are_those_of_many() -> None:
    """Below and above the number from which recurrences are faster, and while derivatives are recorded."""
    x, y = torch.linspace(-0.7, 0.7, 5000, dtype=torch.float64), torch.linspace(0.6, -0.5, 5000, dtype=torch.float64)
    many, few = MODES.columns(x, y), MODES.columns(x[:40], y[:40])
    torch.testing.assert_close(few, many[..., :40], rtol=1e-12, atol=1e-14)
    recorded = MODES.columns(x[:40].requires_grad_(True), y[:40])
    torch.testing.assert_close(recorded.detach(), few, rtol=1e-12, atol=1e-14)


# Small rotations and rigid steps: identities of the rotation group, and derivatives near zero and near π.
# Lengths of rotation vectors: none, far below the root of rounding, about it, moderate, almost half a turn.
LENGTHS = [0.0, 1e-12, 1e-8, 1e-6, 1e-4, 1e-2, 0.5, 2.0, 3.0, math.pi - 1e-3]


def axis(seed: int) -> Tensor:
    v = torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return v / torch.linalg.vector_norm(v)


def cross(w: Tensor) -> Tensor:
    x, y, z = w.tolist()
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)


@pytest.mark.parametrize("length", LENGTHS)
class TestRotation:
    def test_is_the_matrix_exponential(self, length: float) -> None:
        w = length * axis(1)
        # kornia adds 1e-6 to small angles in its own series; what is left must be far below a step that matters.
        torch.testing.assert_close(rotation_from_vector(w), torch.linalg.matrix_exp(cross(w)), rtol=0, atol=1e-12)

    def test_there_and_back(self, length: float) -> None:
        w = length * axis(3)
        back = vector_from_rotation(rotation_from_vector(w))
        # Near half a turn the sine of the angle is small: three digits go.
        torch.testing.assert_close(back, w, rtol=0, atol=1e-12 if length < 3 else 1e-9)

    def test_derivative_is_finite_and_right(self, length: float) -> None:
        w = length * axis(4)
        derivative = torch.func.jacfwd(rotation_from_vector)(w)
        torch.testing.assert_close(derivative, torch.func.jacrev(rotation_from_vector)(w), rtol=0, atol=1e-12)
        # Fourth-order differences leave rounding over the step.
        wanted = numeric(lambda v: torch.linalg.matrix_exp(cross(v)), w, 1e-4)
        torch.testing.assert_close(derivative, wanted, rtol=0, atol=1e-10)


def test_right_hand_rule() -> None:
    quarter = rotation_from_vector(torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64))
    turned = quarter @ torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(turned, torch.tensor([0.0, 1.0, 0.0]).double(), rtol=0, atol=1e-15)


def test_batches_of_any_shape() -> None:
    w = 0.7 * torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    r = rotation_from_vector(w)
    assert r.shape == (2, 4, 3, 3)
    torch.testing.assert_close(r[1, 2], rotation_from_vector(w[1, 2]), rtol=0, atol=0)
    assert vector_from_rotation(r).shape == (2, 4, 3)
    assert rotation_from_vector(torch.zeros(0, 3).double()).shape == (0, 3, 3)


class TestNearestRotation:
    @settings(max_examples=40, deadline=None)
    @given(seed=st.integers(0, 10_000), size=st.floats(1e-9, 0.3))
    def test_no_other_rotation_is_nearer(self, seed: int, size: float) -> None:
        noise = torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        m = rotation_from_vector(2.0 * axis(seed)) + size * noise
        r = nearest_rotation(m)
        assert float(torch.linalg.det(r)) == pytest.approx(1.0, abs=1e-12)
        torch.testing.assert_close(r @ r.T, torch.eye(3).double(), rtol=0, atol=1e-13)
        own = float(((r - m) ** 2).sum())
        for i in range(6):
            other = rotation_from_vector(10.0 ** (-i) * axis(seed + i)) @ r
            assert own <= float(((other - m) ** 2).sum()) + 1e-13

    def test_a_reflection_becomes_a_rotation(self) -> None:
        r = nearest_rotation(torch.diag(torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64)))
        torch.testing.assert_close(r, torch.eye(3).double(), rtol=0, atol=1e-14)

    def test_a_rotation_stays_and_scale_does_not_matter(self) -> None:
        r = rotation_from_vector(1.3 * axis(8))
        torch.testing.assert_close(nearest_rotation(r), r, rtol=0, atol=1e-14)
        torch.testing.assert_close(nearest_rotation(1e6 * r), r, rtol=0, atol=1e-14)


class TestStep:
    def test_rows_are_the_derivatives_of_a_moved_point(self) -> None:
        generator = torch.Generator().manual_seed(9)
        points = torch.randn(3, 5, generator=generator, dtype=torch.float64)
        weights = torch.randn(2, 3, 5, generator=generator, dtype=torch.float64)
        r, t = rotation_from_vector(0.9 * axis(5)), axis(6)

        def image(step: Tensor) -> Tensor:
            turned, moved = rotation_from_vector(step[:3]) @ r, t + step[3:]
            return torch.einsum("ukn,kn->un", weights, turned @ points + moved[:, None])

        expected = torch.func.jacfwd(image)(torch.zeros(6).double()).movedim(-1, 0)
        torch.testing.assert_close(step_rows(weights.transpose(0, 1), r @ points), expected, rtol=1e-13, atol=1e-13)
