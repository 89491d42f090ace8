"""Zernike modes and poses."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.func import jacfwd

from kcal.errors import InputError
from kcal.lens.pose import nearest_rotation, rotation_from_vector, step_rows, vector_from_rotation
from kcal.lens.zernike import ASPECT, ASTIGMATIC, DECENTERED, OTHER, RADIAL, TILTED, ZernikeModes

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
    radius, azimuth = (
        0.9 * torch.rand(7, generator=generator).double(),
        6.0 * torch.rand(7, generator=generator).double(),
    )
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


@pytest.mark.parametrize("modes", [MODES, FEW, ZernikeModes(radial=5, decentered=0, astigmatic=0, other=0)])
@pytest.mark.parametrize("lead", [(), (2,), (2, 3)])
def test_field_is_the_sum_of_its_modes(modes: ZernikeModes, lead: tuple[int, ...]) -> None:
    x, y, _ = disc(5, 9)
    weights = torch.randn(*lead, len(modes), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    expected = torch.einsum("...m,mcn->c...n", weights, modes.columns(x, y))
    scale = float(expected.abs().max())
    f, g = modes.field(weights, x, y, slopes=False)
    # The highest modes by powers of t cancel by five digits, and all have weight one here.
    torch.testing.assert_close(torch.stack([f, g]), expected, rtol=0, atol=1e-11 * scale)
    again = modes.field(weights, x, y)
    assert torch.equal(torch.stack(again[:2]), torch.stack([f, g]))


@pytest.mark.parametrize("modes", [MODES, FEW])
def test_slopes(modes: ZernikeModes) -> None:
    x, y, _ = disc(4, 5)
    x, y = torch.cat([x, torch.zeros(1).double()]), torch.cat([y, torch.zeros(1).double()])
    weights = torch.randn(len(modes), generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def total(place: Tensor) -> Tensor:
        return torch.stack([part.sum() for part in modes.field(weights, place[0], place[1], slopes=False)])

    automatic = jacfwd(total)(torch.stack([x, y]))
    closed = torch.stack(modes.field(weights, x, y)[2:]).unflatten(0, (2, 2))
    torch.testing.assert_close(closed, automatic, rtol=1e-11, atol=1e-11)


def test_inputs_and_weights_are_not_overwritten() -> None:
    x, y, _ = disc(3, 5)
    weights = torch.randn(len(FEW), generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    kept = x.clone(), y.clone(), weights.clone()
    first = FEW.field(weights, x, y)
    second = FEW.field(weights, x, y)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
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

    def test_is_a_rotation(self, length: float) -> None:
        r = rotation_from_vector(length * axis(2))
        torch.testing.assert_close(r @ r.T, torch.eye(3).double(), rtol=0, atol=1e-12)
        assert float(torch.linalg.det(r)) == pytest.approx(1.0, abs=1e-12)

    def test_there_and_back(self, length: float) -> None:
        w = length * axis(3)
        back = vector_from_rotation(rotation_from_vector(w))
        # Near half a turn the sine of the angle is small: three digits go.
        torch.testing.assert_close(back, w, rtol=0, atol=1e-12 if length < 3 else 1e-9)

    def test_derivative_is_finite_and_right(self, length: float) -> None:
        w = length * axis(4)
        derivative = torch.func.jacfwd(rotation_from_vector)(w)
        reverse = torch.func.jacrev(rotation_from_vector)(w)
        torch.testing.assert_close(derivative, reverse, rtol=0, atol=1e-12)
        h = 1e-4
        columns = []
        for i in range(3):
            e = torch.zeros(3, dtype=torch.float64)
            e[i] = h
            near = torch.linalg.matrix_exp(cross(w + e)) - torch.linalg.matrix_exp(cross(w - e))
            far = torch.linalg.matrix_exp(cross(w + 2 * e)) - torch.linalg.matrix_exp(cross(w - 2 * e))
            columns.append((8.0 * near - far) / (12.0 * h))
        # Fourth-order differences leave rounding over the step.
        torch.testing.assert_close(derivative, torch.stack(columns, -1), rtol=0, atol=1e-10)


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
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(3, 3, generator=generator, dtype=torch.float64)
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
        found = step_rows(weights.transpose(0, 1), r @ points)
        torch.testing.assert_close(found, expected, rtol=1e-13, atol=1e-13)
