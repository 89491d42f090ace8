"""Lenses that the tests of this folder share."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.lens.distortion import distort_components
from kcal.lens.model import LensModel

MODELS = ("opencv4", "opencv5", "opencv8", "opencv12", "opencv14", "ext20", "ext24")

# Strong, but before any fold or pole for |x|, |y| <= 0.6.
_STRONG = {
    "k1": -0.35, "k2": 0.12, "k3": -0.03, "k7": 0.02, "k8": -0.015, "k11": 0.01, "k13": -0.007,
    "k4": 0.15, "k5": -0.06, "k6": 0.025, "k9": -0.02, "k10": 0.012, "k12": -0.008, "k14": 0.006,
    "p1": 0.012, "p2": -0.017, "tau_x": 0.11, "tau_y": -0.14,
    "s1": 0.013, "s2": -0.011, "s3": -0.009, "s4": 0.014, "s5": 0.007, "s6": -0.008,
}  # fmt: skip


def strong(model: str) -> Tensor:
    """Large coefficients for a preset, all of them different from zero."""
    return torch.tensor([_STRONG[name] for name in LensModel.named(model).names], dtype=torch.float64)


def parameters(model: str, lens: Tensor) -> Tensor:
    """A small camera with all intrinsics unlike: derivatives of order one, so that tolerances bite."""
    head = torch.tensor([2.1, 1.7, 0.3, -0.2, 0.05], dtype=torch.float64)
    assert lens.shape == (LensModel.named(model).size,)
    return torch.cat([head, lens])


def distort_with_jacobian(normalized: Tensor, lens: Tensor, model: str | LensModel) -> tuple[Tensor, Tensor, Tensor]:
    """Distorted positions (..., N, 2), and derivatives by point (..., N, 2, 2) and coefficients (..., N, 2, P)."""
    model = LensModel.named(model)
    found = distort_components(normalized[..., 0], normalized[..., 1], lens, model, range(model.size))
    by_lens = found.x.new_empty((*found.x.shape, 2, model.size))
    for i, (du, dv) in enumerate(found.coefficients):
        by_lens[..., 0, i], by_lens[..., 1, i] = du, dv
    by_point = torch.stack(found.point, -1).unflatten(-1, (2, 2))
    return torch.stack([found.x, found.y], -1), by_point, by_lens
