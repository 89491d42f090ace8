"""Lenses that the tests of this folder share."""

import math

import torch
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.model import PRESETS, HybridForm, LensModel, distort_components, radius_over_angle
from kcal.lens.zernike import ASPECT, ASTIGMATIC, DECENTERED, OTHER, RADIAL, TILTED, ZernikeModes

MODELS = ("opencv4", "opencv5", "opencv8", "opencv12", "opencv14", "ext20", "ext24")
# A hybrid lens with modes of every family; points with |x|, |y| <= 0.6 are well inside its disc.
FEW_MODES = ZernikeModes(radial=5, decentered=4, astigmatic=3, other=3)
HYBRID = LensModel(hybrid=HybridForm(shape=0.7, radius=1.4, modes=FEW_MODES))

# Strong, but before any fold or pole for |x|, |y| <= 0.6.
_STRONG = {
    "k1": -0.35, "k2": 0.12, "k3": -0.03, "k7": 0.02, "k8": -0.015, "k11": 0.01, "k13": -0.007,
    "k4": 0.15, "k5": -0.06, "k6": 0.025, "k9": -0.02, "k10": 0.012, "k12": -0.008, "k14": 0.006,
    "p1": 0.012, "p2": -0.017, "tau_x": 0.11, "tau_y": -0.14,
    "s1": 0.013, "s2": -0.011, "s3": -0.009, "s4": 0.014, "s5": 0.007, "s6": -0.008,
}  # fmt: skip


def strong(model: str | LensModel) -> Tensor:
    """Large coefficients for a model, all of them different from zero."""
    model = LensModel.named(model)
    if model.hybrid:
        weights = torch.sin(torch.arange(1.0, model.size - 2.0, dtype=torch.float64)) * 0.01
        return torch.cat([torch.tensor([0.2, 0.011, -0.004], dtype=torch.float64), weights])
    return torch.tensor([_STRONG[name] for name in model.names], dtype=torch.float64)


# Amplitude in radii of the disc, decay per degree and first degree of each family of modes, as in calibrated lenses.
_TYPICAL = {
    RADIAL: (5e-4, 0.5, 5), DECENTERED: (3e-4, 0.6, 2), ASTIGMATIC: (5e-5, 0.6, 3), OTHER: (4e-5, 0.6, 2),
    TILTED: (3e-4, 0.0, 2), ASPECT: (1e-4, 0.0, 1),
}  # fmt: skip
# Shape of the base projection and angle of the image's corner off axis, degrees.
KINDS = {"webcam": (0.9, 36.0), "wide": (0.2, 75.0), "pinhole": (1.0, 30.0), "tanh": (-0.3, 60.0)}


def hybrid_camera(kind: str, seed: int = 0, modes: ZernikeModes | None = None) -> Camera:
    """A camera with a hybrid lens such as a calibration finds: random weights of typical size, decaying with degree."""
    size, (shape, corner) = (1920, 1080), KINDS[kind]
    half, angle = 0.5 * math.hypot(*size), math.radians(corner)
    focal = half / (float(radius_over_angle(torch.tensor(shape * angle * angle, dtype=torch.float64))) * angle)
    form = HybridForm(shape=shape, radius=1.08 * half / focal, modes=modes or ZernikeModes())
    deviations = []
    for _, _, family, degree in form.modes.real_modes:
        amplitude, decay, first = _TYPICAL[family]
        deviations.append(amplitude * math.exp(-decay * (degree - first)) * form.radius)
    noise = torch.randn(len(form.modes), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    head = [focal, 1.0005 * focal, 963.0, 536.0, 0.0, 0.01, 2e-3, 1e-3]
    parameters = torch.cat([torch.tensor(head, dtype=torch.float64), noise * torch.tensor(deviations).double()])
    return Camera(parameters, size=size, model=LensModel(hybrid=form))


def parameters(model: str | LensModel, lens: Tensor) -> Tensor:
    """A small camera with all intrinsics unlike: derivatives of order one, so that tolerances bite."""
    head = torch.tensor([2.1, 1.7, 0.3, -0.2, 0.05], dtype=torch.float64)
    assert lens.shape == (LensModel.named(model).size,)
    return torch.cat([head, lens])


# Every preset, and the model that has none because its constants are chosen for each camera.
NAMED = {**PRESETS, "hybrid": HYBRID}


def camera_of(preset: str, scale: float, focal: float = 1600.0) -> Camera:
    """An HD camera with coefficients that are this share of strong ones; a fisheye's are always the same."""
    model = NAMED[preset]
    lens = torch.tensor([0.02, -0.01, 0.003, -0.0005]) if model.fisheye else scale * strong(model)
    head = torch.tensor([focal, focal + 10.0, 955.0, 541.0, 2.0])
    return Camera(torch.cat([head, lens]).double(), size=(1920, 1080), model=model)


def distort_with_jacobian(normalized: Tensor, lens: Tensor, model: str | LensModel) -> tuple[Tensor, Tensor, Tensor]:
    """Distorted positions (..., N, 2), and derivatives by point (..., N, 2, 2) and coefficients (..., N, 2, P)."""
    model = LensModel.named(model)
    found = distort_components(normalized[..., 0], normalized[..., 1], lens, model, range(model.size))
    by_lens = found.coefficients.movedim(-1, -3).transpose(-1, -2)
    return torch.stack([found.x, found.y], -1), torch.stack(found.point, -1).unflatten(-1, (2, 2)), by_lens
