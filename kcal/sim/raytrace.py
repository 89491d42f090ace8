"""Lens prescriptions, and rays traced through them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError
from kcal.lens.pose import rotation_from_vector

# Lens prescriptions: radii, thicknesses and refractive indices of real designs, and their paraxial properties.
#
# A prescription is what a lens designer publishes. Scaled to a focal length and traced ray by ray
# , it distorts like a real lens, without any lens model of kcal. Lengths are millimeters and light
# travels along +z, as in the literature; indices are those of the helium d line (587.6 nm).


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


# Trace rays through tilted and decentered surfaces, in float64 and for any number of rays at once.
#
# Each surface has its own frame: its vertex and a rotation. A ray is moved into that frame, intersected with the conic
# in closed form (aspheres by Newton's method) and refracted by Snell's law in vector form: with unit direction d, unit
# normal n against which the light travels (n · d > 0) and the ratio m of the indices before and behind,
#
#     d' = m d + (sqrt(1 - m² (1 - (n · d)²)) - m n · d) n
#
# (G. Spencer and M. Murty, "General ray-tracing procedure", J. Opt. Soc. Am. 52, 1962). Light travels along +z or,
# where `backward` is said, along -z from the last surface to the first. Lengths are those of the surfaces.

_ASPHERE_STEPS = 30
_ASPHERE_GOAL = 1e-15
# Tilt that goes with a decentering of one focal length, radians.
_TILT_PER_DECENTER = 0.436


class Placed(NamedTuple):
    """A surface where it stands: `points = rotation @ local + vertex`; indices before and behind it, along +z."""

    surface: Surface
    vertex: Tensor
    rotation: Tensor
    before: float
    behind: float


class Rays(NamedTuple):
    """Points (..., 3) on rays, unit directions (..., 3), and valid (...): the ray passed every surface."""

    points: Tensor
    directions: Tensor
    valid: Tensor


@dataclass(frozen=True, kw_only=True)
class Misalignment:
    """Errors of a lens's assembly, one entry per piece of glass in the order of `Prescription.elements`.

    Args:
        decenter: shift of each piece along x and y, in shares of the focal length.
        tilt: turn of each piece about x and y through its first vertex, radians.

    Example:
        >>> from kcal.sim.raytrace import PRESCRIPTIONS
        >>> drawn = Misalignment.draw(PRESCRIPTIONS["surveillance"], 1.0, torch.Generator().manual_seed(0))
        >>> len(drawn.decenter), len(drawn.tilt)
        (7, 7)
    """

    decenter: tuple[tuple[float, float], ...] = ()
    tilt: tuple[tuple[float, float], ...] = ()

    @staticmethod
    def draw(prescription: Prescription, strength: float, generator: torch.Generator) -> Misalignment:
        """Draw Gaussian errors of assembly: `strength` times the prescription's tolerance.

        For the surveillance lens of 2.8 mm and a strength of 1 that is 22 µm and 0.2 degrees, one sigma of each axis.
        """
        if not 0 <= strength < math.inf:
            raise InputError(f"misalignment strength {strength}: a number that is not negative is needed")
        shape = (2, len(prescription.elements), 2)
        drawn = strength * prescription.tolerance * torch.randn(shape, dtype=torch.float64, generator=generator)
        shifts, turns = drawn[0].tolist(), (_TILT_PER_DECENTER * drawn[1]).tolist()
        return Misalignment(decenter=tuple(map(tuple, shifts)), tilt=tuple(map(tuple, turns)))


def place(prescription: Prescription, focal: float, scale: float, misalignment: Misalignment) -> list[Placed]:
    """Place the surfaces of a lens with its front vertex at the origin.

    Args:
        prescription: of the lens.
        focal: focal length after scaling; decenterings are shares of it.
        scale: millimeters of the prescription are multiplied by it.
        misalignment: empty, or one entry for each piece of glass.

    Raises:
        InputError: a misalignment for another number of pieces.
    """
    elements = prescription.elements
    for name, entries in (("decenter", misalignment.decenter), ("tilt", misalignment.tilt)):
        if entries and len(entries) != len(elements):
            raise InputError(f"misalignment {name}: {len(entries)} entries for {len(elements)} pieces of glass")
    placed, z, before = [], 0.0, 1.0
    for surface in prescription.surfaces:
        scaled = Surface(
            radius=surface.radius * scale,
            thickness=surface.thickness * scale,
            index=surface.index,
            conic=surface.conic,
            even=tuple(value / scale ** (2 * i + 3) for i, value in enumerate(surface.even)),
        )
        vertex = torch.tensor([0.0, 0.0, z], dtype=torch.float64)
        placed.append(Placed(scaled, vertex, torch.eye(3, dtype=torch.float64), before, surface.index))
        z += scaled.thickness
        before = surface.index
    for i, (first, last) in enumerate(elements):
        shift = torch.tensor([*misalignment.decenter[i], 0.0] if misalignment.decenter else [0.0] * 3).double() * focal
        turn = torch.tensor([*misalignment.tilt[i], 0.0] if misalignment.tilt else [0.0] * 3).double()
        rotation, pivot = rotation_from_vector(turn), placed[first].vertex
        for k in range(first, last + 1):
            vertex = pivot + rotation @ (placed[k].vertex - pivot) + shift
            placed[k] = placed[k]._replace(vertex=vertex, rotation=rotation @ placed[k].rotation)
    return placed


def trace(surfaces: Sequence[Placed], points: Tensor, directions: Tensor, *, backward: bool = False) -> Rays:
    """Trace rays through surfaces, one after the other; they end on the last one, refracted by it.

    Args:
        surfaces: in the order of `place`.
        points: (..., 3) any point of each ray.
        directions: (..., 3) unit vectors of the light's travel.
        backward: from the last surface to the first, along -z.

    Example:
        >>> from kcal.sim.raytrace import PRESCRIPTIONS
        >>> lens = place(PRESCRIPTIONS["surveillance"], 1.0, 1.0, Misalignment())
        >>> axis = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
        >>> trace(lens, 0.0 * axis, axis).directions.tolist()  # along the axis nothing is bent
        [[0.0, 0.0, 1.0]]
    """
    points, directions = as_points("points", points, 3), as_points("directions", directions, 3)
    valid = torch.ones(torch.broadcast_shapes(points.shape, directions.shape)[:-1], dtype=torch.bool)
    for placed in reversed(surfaces) if backward else surfaces:
        ratio = placed.behind / placed.before if backward else placed.before / placed.behind
        local, heading = (points - placed.vertex) @ placed.rotation, directions @ placed.rotation
        local, met = meet(placed.surface, local, heading)
        heading, passed = refract(heading, normals(placed.surface, local), ratio)
        valid = valid & met & passed
        points, directions = local @ placed.rotation.T + placed.vertex, heading @ placed.rotation.T
    return Rays(points, directions, valid)


def meet(surface: Surface, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Intersect lines with a surface near its vertex, in its frame: points (..., 3), and whether they meet."""
    c, k = surface.curvature, surface.conic
    # From the plane through the vertex, so that the roots are small and lose no digits.
    start = points - directions * (points[..., 2:] / directions[..., 2:])
    forward = torch.where(directions[..., 2:] < 0, -directions, directions)
    x, y, _ = start.unbind(-1)
    L, M, N = forward.unbind(-1)
    a, b, squared = c * (1 + k * N**2), N - c * (x * L + y * M), c * (x**2 + y**2)
    under = b**2 - a * squared
    met = under > 0
    t = squared / (b + torch.sqrt(torch.where(met, under, 1.0)))
    at = start + t[..., None] * forward
    if surface.even:
        # From the plane, not from the conic: where the asphere is far from it, another root may be nearer.
        at, longest = start, 0.2 * abs(surface.radius)
        for _ in range(_ASPHERE_STEPS):
            height, slope = _sag(surface, (at[..., :2] ** 2).sum(-1))
            across = 2 * slope * (at[..., 0] * L + at[..., 1] * M)
            step = (height - at[..., 2]) / (N - across)
            step = step.clamp(-longest, longest)
            at = at + step[..., None] * forward
            if not bool((step.abs() > _ASPHERE_GOAL).any()):
                break
        # A line may miss the conic and still meet the asphere.
        met = step.abs() < 1e-12
    return at, met & torch.isfinite(at).all(-1)


def normals(surface: Surface, at: Tensor) -> Tensor:
    """Unit normals (..., 3) of a surface at points on it, along +z."""
    _, slope = _sag(surface, (at[..., :2] ** 2).sum(-1))
    gradient = torch.stack([-2 * slope * at[..., 0], -2 * slope * at[..., 1], torch.ones_like(slope)], -1)
    return gradient / torch.linalg.vector_norm(gradient, dim=-1, keepdim=True)


def refract(directions: Tensor, normal: Tensor, ratio: float) -> tuple[Tensor, Tensor]:
    """Apply Snell's law: directions behind a surface, and whether there are any (no total reflection)."""
    if ratio == 1.0:
        return directions, torch.ones(directions.shape[:-1], dtype=torch.bool)
    cosine = (directions * normal).sum(-1, keepdim=True)
    normal, cosine = torch.where(cosine < 0, -normal, normal), cosine.abs()
    under = 1 - ratio**2 * (1 - cosine**2)
    passed = under > 0
    bent = ratio * directions + (torch.sqrt(torch.where(passed, under, 1.0)) - ratio * cosine) * normal
    return bent / torch.linalg.vector_norm(bent, dim=-1, keepdim=True), passed[..., 0]


def _sag(surface: Surface, r2: Tensor) -> tuple[Tensor, Tensor]:
    """Height of the surface at squared radii, and its derivative by the squared radius."""
    c, k = surface.curvature, surface.conic
    root = torch.sqrt((1 - (1 + k) * c**2 * r2).clamp_min(1e-12))
    height, slope = c * r2 / (1 + root), 0.5 * c / root
    power = r2
    for i, value in enumerate(surface.even):
        slope = slope + (i + 2) * value * power
        power = power * r2
        height = height + value * power
    return height, slope
