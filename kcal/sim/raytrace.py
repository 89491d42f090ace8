"""Trace rays through tilted and decentered surfaces, in float64 and for any number of rays at once.

Each surface has its own frame: its vertex and a rotation. A ray is moved into that frame, intersected with the conic in
closed form (aspheres by Newton's method) and refracted by Snell's law in vector form: with unit direction d, unit
normal n against which the light travels (n · d > 0) and the ratio m of the indices before and behind,

    d' = m d + (sqrt(1 - m² (1 - (n · d)²)) - m n · d) n

(G. Spencer and M. Murty, "General ray-tracing procedure", J. Opt. Soc. Am. 52, 1962). Light travels along +z or, where
`backward` is said, along -z from the last surface to the first. Lengths are those of the surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError
from kcal.lens.pose import rotation_from_vector
from kcal.sim.prescription import Prescription, Surface

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
        >>> from kcal.sim.prescription import PRESCRIPTIONS
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
        >>> from kcal.sim.prescription import PRESCRIPTIONS
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
