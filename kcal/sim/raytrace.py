"""Lens prescriptions, and rays traced through them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError
from kcal.lens.pose import rotation_from_vector

# Lens prescriptions: radii, thicknesses and refractive indices of real designs, and their paraxial properties.
#
# A prescription is what a lens designer publishes. Scaled to a focal length and traced ray by ray, it distorts like a
# real lens, without any lens model of kcal. Lengths are millimeters and light travels along +z, as in the literature;
# indices are those of the helium d line (587.6 nm).


@dataclass(frozen=True, kw_only=True)
class Surface:
    """One refracting surface: a sphere or a plane.

    Args:
        radius: of curvature at the vertex, millimeters; positive if the center lies behind it; infinite for a plane.
        thickness: distance along the axis to the next surface, millimeters.
        index: refractive index behind the surface.
    """

    radius: float
    thickness: float
    index: float = 1.0

    @property
    def curvature(self) -> float:
        """1 / radius; 0 for a plane."""
        return 0.0 if math.isinf(self.radius) else 1.0 / self.radius

    def scaled(self, scale: float) -> Self:
        """The surface with all its lengths multiplied."""
        return replace(self, radius=self.radius * scale, thickness=self.thickness * scale)

    def meet(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Intersect lines with the surface near its vertex, in its frame: points (..., 3), and whether they meet."""
        start, forward = self._from_vertex(points, directions)
        x, y, _ = start.unbind(-1)
        L, M, N = forward.unbind(-1)
        c = self.curvature
        b, squared = N - c * (x * L + y * M), c * (x**2 + y**2)
        under = b**2 - c * squared
        met = under > 0
        t = squared / (b + torch.sqrt(torch.where(met, under, 1.0)))
        at = start + t[..., None] * forward
        return at, met & torch.isfinite(at).all(-1)

    @staticmethod
    def _from_vertex(points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Where lines cross the plane through the vertex, so that roots are small and lose no digits; and along +z."""
        start = points - directions * (points[..., 2:] / directions[..., 2:])
        return start, torch.where(directions[..., 2:] < 0, -directions, directions)

    def sag(self, r2: Tensor) -> tuple[Tensor, Tensor]:
        """Height of the surface at squared radii, and its derivative by the squared radius."""
        c = self.curvature
        root = torch.sqrt((1 - c**2 * r2).clamp_min(1e-12))
        return c * r2 / (1 + root), 0.5 * c / root

    def normals(self, at: Tensor) -> Tensor:
        """Unit normals (..., 3) at points on the surface, along +z."""
        _, slope = self.sag((at[..., :2] ** 2).sum(-1))
        gradient = torch.stack([-2 * slope * at[..., 0], -2 * slope * at[..., 1], torch.ones_like(slope)], -1)
        return gradient / torch.linalg.vector_norm(gradient, dim=-1, keepdim=True)


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
        >>> len(SURVEILLANCE.elements), round(focal_length(SURVEILLANCE), 3)
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
        glass = [False, *(surface.index != 1.0 for surface in self.surfaces)]
        between = [i for i, (before, behind) in enumerate(itertools.pairwise(glass)) if before != behind]
        return tuple(zip(between[::2], between[1::2], strict=False))


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


# Refractive indices at the d line, from the makers' catalogs.
_N_SK4, _SF1 = 1.61272, 1.71736


def spheres(*rows: tuple[float, float] | tuple[float, float, float]) -> tuple[Surface, ...]:
    """Surfaces of radius and thickness, and the index behind them where that is not air."""
    return tuple(Surface(radius=row[0], thickness=row[1], index=row[2] if len(row) > 2 else 1.0) for row in rows)


SURVEILLANCE = Prescription(
    name="surveillance",
    source="M. Laikin, Lens Design, 4th edition, CRC Press 2007, p. 108: wide angle, 100 degrees",
    surfaces=spheres(
        (8.0107, 0.2500, _N_SK4),
        (1.1856, 0.9613),
        (1.6747, 0.3578, _SF1),
        (-7.5157, 0.2136, _N_SK4),
        (0.9411, 0.4146),
        (-1.7688, 0.3333, _SF1),
        (-1.5531, 0.3863, _N_SK4),
        (-2.2281, 0.9842),
        (math.inf, 0.1000),
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
)


# Trace rays through tilted and decentered surfaces, in float64 and for any number of rays at once.
#
# Each surface has its own frame: its vertex and a rotation. A ray is moved into that frame, intersected with the sphere
# in closed form and refracted by Snell's law in vector form: with unit direction d, unit
# normal n against which the light travels (n · d > 0) and the ratio m of the indices before and behind,
#
#     d' = m d + (sqrt(1 - m² (1 - (n · d)²)) - m n · d) n
#
# (G. Spencer and M. Murty, "General ray-tracing procedure", J. Opt. Soc. Am. 52, 1962). Light travels along +z or,
# where `backward` is said, along -z from the last surface to the first. Lengths are those of the surfaces.

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
        >>> drawn = Misalignment.draw(SURVEILLANCE, 1.0, torch.Generator().manual_seed(0))
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
        scaled = surface.scaled(scale)
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
        >>> lens = place(SURVEILLANCE, 1.0, 1.0, Misalignment())
        >>> axis = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
        >>> trace(lens, 0.0 * axis, axis).directions.tolist()  # along the axis nothing is bent
        [[0.0, 0.0, 1.0]]
    """
    points, directions = as_points("points", points, 3), as_points("directions", directions, 3)
    valid = torch.ones(torch.broadcast_shapes(points.shape, directions.shape)[:-1], dtype=torch.bool)
    for placed in reversed(surfaces) if backward else surfaces:
        ratio = placed.behind / placed.before if backward else placed.before / placed.behind
        local, heading = (points - placed.vertex) @ placed.rotation, directions @ placed.rotation
        local, met = placed.surface.meet(local, heading)
        heading, passed = refract(heading, placed.surface.normals(local), ratio)
        valid = valid & met & passed
        points, directions = local @ placed.rotation.T + placed.vertex, heading @ placed.rotation.T
    return Rays(points, directions, valid)


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
