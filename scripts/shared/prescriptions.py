"""More lenses for simulations than kcal's own: a machine vision lens of spheres, and a webcam's of aspheres."""

from __future__ import annotations

import dataclasses
import math
from typing import Self

import torch
from torch import Tensor

from kcal.sim.raytrace import SURVEILLANCE, Prescription, Surface, spheres

_STEPS, _GOAL = 30, 1e-15


@dataclasses.dataclass(frozen=True, kw_only=True)
class Asphere(Surface):
    """z = c r² / (1 + sqrt(1 - (1 + conic) c² r²)) + even[0] r⁴ + even[1] r⁶ + ..., met by Newton's method.

    Args:
        conic: conic constant; 0 is a sphere.
        even: aspheric coefficients of r⁴, r⁶ and on, in millimeters to the power of -3, -5 and on.
    """

    conic: float = 0.0
    even: tuple[float, ...] = ()

    def scaled(self, scale: float) -> Self:
        """See `Surface`."""
        even = tuple(value / scale ** (2 * i + 3) for i, value in enumerate(self.even))
        return dataclasses.replace(super().scaled(scale), even=even)

    def meet(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """See `Surface`; a line may miss the conic and still meet the asphere."""
        # From the plane, not from the conic: where the asphere is far from it, another root may be nearer.
        at, forward = self._from_vertex(points, directions)
        L, M, N = forward.unbind(-1)
        longest = 0.2 * abs(self.radius)
        for _ in range(_STEPS):
            height, slope = self.sag((at[..., :2] ** 2).sum(-1))
            across = 2 * slope * (at[..., 0] * L + at[..., 1] * M)
            step = ((height - at[..., 2]) / (N - across)).clamp(-longest, longest)
            at = at + step[..., None] * forward
            if not bool((step.abs() > _GOAL).any()):
                break
        return at, (step.abs() < 1e-12) & torch.isfinite(at).all(-1)

    def sag(self, r2: Tensor) -> tuple[Tensor, Tensor]:
        """See `Surface`."""
        c, k = self.curvature, self.conic
        root = torch.sqrt((1 - (1 + k) * c**2 * r2).clamp_min(1e-12))
        height, slope = c * r2 / (1 + root), 0.5 * c / root
        power = r2
        for i, value in enumerate(self.even):
            slope = slope + (i + 2) * value * power
            power = power * r2
            height = height + value * power
        return height, slope


# Refractive indices at the d line, from the makers' catalogs.
_N_SK10, _SK15, _BASF2, _FK3, _SF15, _N_LAK12 = 1.62278, 1.62299, 1.66446, 1.46450, 1.69895, 1.67790


def _parabolas(*rows: tuple[float, float, float, tuple[float, ...]]) -> tuple[Asphere, ...]:
    return tuple(Asphere(radius=row[0], thickness=row[1], index=row[2], conic=-1.0, even=row[3]) for row in rows)


MACHINE_VISION = Prescription(
    name="machine-vision",
    source="reverse telephoto, 60 degrees, a sample of optiland (MIT): samples.objectives.ReverseTelephoto",
    surfaces=spheres(
        (1.69111096, 0.08259680, _N_SK10),
        (0.94414496, 0.8),
        (4.32100401, 0.080256, _SK15),
        (1.78117621, 0.5),
        (2.64050282, 0.27638160, _BASF2),
        (-3.86177348, 0.1),
        (1.05627661, 0.2, _FK3),
        (-4.06933311, 0.2001384),
        (math.inf, 0.06688),
        (-2.61246583, 0.064372, _SF15),
        (0.99117409, 0.3),
        (9.03045960, 0.18743120, _N_LAK12),
        (-1.35680743, 2.35130547),
    ),
    stop=8,
    tolerance=0.003,
)

WEBCAM = Prescription(
    name="webcam",
    source="US patent 7,535,658: four plastic aspheres and a filter; its profiles, published with odd powers "
    "too, fitted with even ones to 1.3 µm",
    surfaces=(
        *spheres((math.inf, 0.0)),
        *_parabolas(
            (1.97378, 1.19, 1.471, (-0.012078, 0.181459, -0.69462, 1.28702, -0.930784)),
            (34.29, 0.93, 1.0, (-0.0327156, 0.0711206, -0.27758, 0.516964, -0.406918)),
            (-2.11766, 0.75, 1.603, (-0.118339, 0.107778, -0.119367, 0.0667901, -0.0231792)),
            (-4.66183, 0.1, 1.0, (-0.171663, 0.155596, -0.0719066, 0.0172037, -1.43605e-3)),
            (9.57112, 0.89, 1.51, (-0.0505526, 0.0350105, -0.0141519, 2.35332e-3, -1.59633e-4)),
            (8.5927, 0.16, 1.0, (3.22416e-3, -4.72162e-3, 5.23296e-4, -3.73407e-05, -4.22958e-08)),
            (1.6689, 0.85, 1.51, (-0.104593, 0.0143573, -1.51141e-3, 1.14048e-4, -3.70705e-06)),
            (1.59731, 0.7, 1.0, (-0.0887896, 0.0121398, -1.27989e-3, 8.19958e-05, -2.39836e-06)),
        ),
        *spheres((math.inf, 0.40, 1.516), (math.inf, 0.64)),
    ),
    stop=0,
    focal=2000.0,
    tolerance=0.0003,
)

PRESCRIPTIONS = {lens.name: lens for lens in (SURVEILLANCE, MACHINE_VISION, WEBCAM)}
