"""Small rotations and rigid steps: identities of the rotation group, and derivatives near zero and near π."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from kcal.lens.pose import nearest_rotation, rotation_from_vector, step_rows, vector_from_rotation

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
