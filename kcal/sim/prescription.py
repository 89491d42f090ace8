"""Lens prescriptions: radii, thicknesses and refractive indices of real designs, and their paraxial properties.

A prescription is what a lens designer publishes. Scaled to a focal length and traced ray by ray
(`kcal.sim.raytrace`), it distorts like a real lens, without any lens model of kcal. Lengths are millimeters and light
travels along +z, as in the literature; indices are those of the helium d line (587.6 nm).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from kcal.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Surface:
    """One refracting surface, z = c r² / (1 + sqrt(1 - (1 + conic) c² r²)) + even[0] r⁴ + even[1] r⁶ + ...

    Args:
        radius: of curvature at the vertex, millimeters; positive if the center lies behind it; infinite for a plane.
        thickness: distance along the axis to the next surface, millimeters.
        index: refractive index behind the surface.
        conic: conic constant; 0 is a sphere.
        even: aspheric coefficients of r⁴, r⁶ and on, in millimeters to the power of -3, -5 and on.
    """

    radius: float
    thickness: float
    index: float = 1.0
    conic: float = 0.0
    even: tuple[float, ...] = ()

    @property
    def curvature(self) -> float:
        """1 / radius; 0 for a plane."""
        return 0.0 if math.isinf(self.radius) else 1.0 / self.radius


@dataclass(frozen=True, kw_only=True)
class Prescription:
    """A lens from its front surface to its last, whose thickness is the distance to the sensor.

    Args:
        name: in kcal.
        source: where the numbers come from.
        surfaces: in the order in which light meets them; the aperture stop is one of them, a plane between equal
            media.
        stop: its place in `surfaces`.
        focal: focal length in pixels with which its image covers 1920 x 1080.
        tolerance: error of assembly: decentering of each piece of glass, one sigma along each axis, as a share of the
            focal length. Strong aspheres tolerate far less than spheres.

    Raises:
        InputError: a stop that is no plane in one medium.

    Example:
        >>> wide = PRESCRIPTIONS["surveillance"]
        >>> len(wide.elements), round(focal_length(wide), 3)
        (7, 0.656)
    """

    name: str
    source: str
    surfaces: tuple[Surface, ...]
    stop: int
    focal: float = 1600.0
    tolerance: float = 0.008

    def __post_init__(self) -> None:
        media = [1.0, *(surface.index for surface in self.surfaces)]
        if not 0 <= self.stop < len(self.surfaces):
            raise InputError(f"prescription {self.name}: the stop is none of its {len(self.surfaces)} surfaces")
        if media[self.stop] != media[self.stop + 1] or self.surfaces[self.stop].curvature:
            raise InputError(f"prescription {self.name}: the stop must be a plane between equal media")

    @property
    def elements(self) -> tuple[tuple[int, int], ...]:
        """First and last surface of each piece of glass; cemented lenses are one piece."""
        return tuple(self._pieces())

    def _pieces(self) -> Iterator[tuple[int, int]]:
        first = None
        for i, surface in enumerate(self.surfaces):
            if first is None and surface.index != 1.0:
                first = i
            elif first is not None and surface.index == 1.0:
                yield first, i
                first = None


def system_matrix(prescription: Prescription) -> tuple[float, float, float, float]:
    """Compute the paraxial matrix (A, B, C, D) from the front vertex to the last one.

    It turns a height h and a slope s into (A h + B s, C h + D s). Slopes
    are those of the ray in air (E. Hecht, *Optics*, section 6.2, for the reduced angles used inside).
    """
    a, b, c, d = 1.0, 0.0, 0.0, 1.0
    before = 1.0
    last = len(prescription.surfaces) - 1
    for i, surface in enumerate(prescription.surfaces):
        power = (surface.index - before) * surface.curvature
        c, d = c - power * a, d - power * b
        if i < last:
            gap = surface.thickness / surface.index
            a, b = a + gap * c, b + gap * d
        before = surface.index
    return a, b, c, d


def focal_length(prescription: Prescription) -> float:
    """Effective focal length, millimeters."""
    return -1.0 / system_matrix(prescription)[2]


_PLANE = math.inf
# Refractive indices at the d line, from the makers' catalogs.
_N_SK4, _SF1 = 1.61272, 1.71736
_N_SK10, _SK15, _BASF2, _FK3, _SF15, _N_LAK12 = 1.62278, 1.62299, 1.66446, 1.46450, 1.69895, 1.67790


def _spheres(*rows: tuple[float, float] | tuple[float, float, float]) -> tuple[Surface, ...]:
    return tuple(Surface(radius=row[0], thickness=row[1], index=row[2] if len(row) > 2 else 1.0) for row in rows)


def _parabolas(*rows: tuple[float, float, float, tuple[float, ...]]) -> tuple[Surface, ...]:
    return tuple(Surface(radius=row[0], thickness=row[1], index=row[2], conic=-1.0, even=row[3]) for row in rows)


PRESCRIPTIONS: dict[str, Prescription] = {
    prescription.name: prescription
    for prescription in (
        Prescription(
            name="surveillance",
            source="M. Laikin, Lens Design, 4th edition, CRC Press 2007, p. 108: wide angle, 100 degrees",
            surfaces=_spheres(
                (8.0107, 0.2500, _N_SK4),
                (1.1856, 0.9613),
                (1.6747, 0.3578, _SF1),
                (-7.5157, 0.2136, _N_SK4),
                (0.9411, 0.4146),
                (-1.7688, 0.3333, _SF1),
                (-1.5531, 0.3863, _N_SK4),
                (-2.2281, 0.9842),
                (_PLANE, 0.1000),
                (13.6803, 0.1400, _N_SK4),
                (-3.4279, 0.0605),
                (20.0257, 0.3332, _N_SK4),
                (-0.9258, 0.4374, _SF1),
                (-3.2233, 0.2679),
                (10.3847, 0.1400, _SF1),
                (2.4272, 0.2609, _N_SK4),
                (-3.8828, 0.0150),
                (3.3650, 0.3167, _N_SK4),
                (-14.7547, 1.5604),
            ),
            stop=8,
        ),
        Prescription(
            name="machine-vision",
            source="reverse telephoto, 60 degrees, a sample of optiland (MIT): samples.objectives.ReverseTelephoto",
            surfaces=_spheres(
                (1.69111096, 0.08259680, _N_SK10),
                (0.94414496, 0.8),
                (4.32100401, 0.080256, _SK15),
                (1.78117621, 0.5),
                (2.64050282, 0.27638160, _BASF2),
                (-3.86177348, 0.1),
                (1.05627661, 0.2, _FK3),
                (-4.06933311, 0.2001384),
                (_PLANE, 0.06688),
                (-2.61246583, 0.064372, _SF15),
                (0.99117409, 0.3),
                (9.03045960, 0.18743120, _N_LAK12),
                (-1.35680743, 2.35130547),
            ),
            stop=8,
            tolerance=0.003,
        ),
        Prescription(
            name="webcam",
            source="US patent 7,535,658: four plastic aspheres and a filter; its profiles, published with odd powers "
            "too, fitted with even ones to 1.3 µm",
            surfaces=(
                *_spheres((_PLANE, 0.0)),
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
                *_spheres((_PLANE, 0.40, 1.516), (_PLANE, 0.64)),
            ),
            stop=0,
            focal=2000.0,
            tolerance=0.0003,
        ),
    )
}
