"""Ray tracing obeys the laws it is made of: Snell, reversibility, and the paraxial limit."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kcal.errors import InputError
from kcal.sim.raytrace import (
    SURVEILLANCE,
    Misalignment,
    Prescription,
    Surface,
    focal_length,
    place,
    refract,
    system_matrix,
    trace,
)
from scripts.shared.prescriptions import PRESCRIPTIONS, Asphere

NAMES = sorted(PRESCRIPTIONS)


def unit(values: list[list[float]]) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.tensor(values, dtype=torch.float64), dim=-1)


@given(
    angle=st.floats(0.0, 1.5), turn=st.floats(-math.pi, math.pi), ratio=st.floats(0.4, 2.5).filter(lambda r: r != 1.0)
)
def test_refraction_is_snells_law(angle: float, turn: float, ratio: float) -> None:
    normal = unit([[0.3, -0.2, 1.0]])
    across = torch.nn.functional.normalize(torch.linalg.cross(normal, unit([[math.cos(turn), math.sin(turn), 0.1]])))
    light = math.cos(angle) * normal + math.sin(angle) * across
    bent, passed = refract(light, normal, ratio)
    if ratio * math.sin(angle) > 1 + 1e-9:
        assert not bool(passed)
    elif ratio * math.sin(angle) < 1 - 1e-9:
        assert bool(passed)
        assert float(bent.norm()) == pytest.approx(1.0, abs=1e-14)
        # n sin(angle) is kept, with its direction: the part across the normal is scaled by the ratio.
        part = bent - (bent * normal).sum() * normal
        torch.testing.assert_close(part, ratio * math.sin(angle) * across, atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    "surface",
    [
        Surface(radius=1.3, thickness=0.1),
        Asphere(radius=-2.0, thickness=0.1, conic=0.7),
        Surface(radius=math.inf, thickness=0.1),
        Asphere(radius=1.67, thickness=0.1, conic=-1.0, even=(-0.1, 0.014, -1.5e-3)),
    ],
    ids=["sphere", "ellipsoid", "plane", "asphere"],
)
def test_rays_meet_the_surface_and_its_normal_stands_on_it(surface: Surface) -> None:
    generator = torch.Generator().manual_seed(3)
    points = torch.rand((50, 3), dtype=torch.float64, generator=generator) - 0.5
    heading = unit((torch.rand((50, 3), generator=generator) - 0.5 + torch.tensor([0.0, 0.0, 1.5])).tolist())
    at, met = surface.meet(points, heading)
    assert bool(met.all())

    def sag(xy: torch.Tensor) -> torch.Tensor:
        r2, c = (xy**2).sum(-1), surface.curvature
        conic, even = getattr(surface, "conic", 0.0), getattr(surface, "even", ())
        height = c * r2 / (1 + torch.sqrt(1 - (1 + conic) * c**2 * r2))
        return height + sum(value * r2 ** (i + 2) for i, value in enumerate(even))

    torch.testing.assert_close(at[:, 2], sag(at[:, :2]), atol=1e-13, rtol=0)
    # On the ray, and the one that is met from behind is the same place.
    assert float(torch.linalg.cross(at - points, heading).abs().max()) < 1e-13
    torch.testing.assert_close(surface.meet(points, -heading)[0], at, atol=1e-13, rtol=0)
    xy = at[:, :2].clone().requires_grad_()
    slope = torch.autograd.grad(sag(xy).sum(), xy)[0]
    expected = torch.nn.functional.normalize(torch.cat([-slope, torch.ones(50, 1)], -1), dim=-1)
    torch.testing.assert_close(surface.normals(at), expected, atol=1e-12, rtol=0)


def test_a_ray_that_passes_a_sphere_is_not_valid() -> None:
    _, met = Surface(radius=1.0, thickness=0.1).meet(torch.tensor([[0.0, 1.5, 0.0]]).double(), unit([[0, 0, 1]]))
    assert not bool(met)


def test_total_reflection_is_not_valid() -> None:
    rays = Prescription(
        name="block",
        source="",
        surfaces=(Surface(radius=math.inf, thickness=1.0), Surface(radius=math.inf, thickness=1.0, index=1.5)),
        stop=0,
    )
    back = trace(place(rays, 1.0, 1.0, Misalignment()), torch.zeros(1, 3).double(), unit([[1, 0, -0.5]]), backward=True)
    assert not bool(back.valid)


@pytest.mark.parametrize("name", NAMES)
def test_paraxial_rays_meet_the_matrix_method(name: str) -> None:
    lens, height = PRESCRIPTIONS[name], 1e-5
    rays = trace(place(lens, 1.0, 1.0, Misalignment()), torch.tensor([[0, height, 0]]).double(), unit([[0, 0, 1]]))
    slope = float(rays.directions[0, 1] / rays.directions[0, 2])
    assert -height / slope == pytest.approx(focal_length(lens), rel=1e-6)
    a, _, c, _ = system_matrix(lens)
    assert -float(rays.points[0, 1]) / slope == pytest.approx(-a / c, rel=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_light_comes_back_the_way_it_went(name: str) -> None:
    lens = PRESCRIPTIONS[name]
    placed = place(lens, focal_length(lens), 1.0, Misalignment.draw(lens, 3.0, torch.Generator().manual_seed(1)))
    start = torch.tensor([[0.02, -0.01, -1.0]], dtype=torch.float64) * focal_length(lens)
    heading = unit([[0.05, 0.1, 1.0]])
    there = trace(placed, start, heading)
    back = trace(placed, there.points, -there.directions, backward=True)
    assert bool(there.valid & back.valid)
    torch.testing.assert_close(back.directions, -heading, atol=1e-12, rtol=0)
    assert float(torch.linalg.cross(back.points - start, heading).abs().max()) < 1e-11


# Rays from (x, y, -1) mm with slopes (a, b), and where optiland 0.6.3 has them on the image plane, x, y, L, M
# (aspheres with tol=1e-15, max_iter=200).
# fmt: off
RAYS = ((0.02, -0.03, 0.05, 0.1), (-0.05, 0.02, -0.1, 0.02), (0.01, 0.04, 0.08, -0.12))
OPTILAND = {
    "surveillance": [(0.07369570274457, 0.12737694709939, -0.20657122148397, -0.30984280949685)],
    "machine-vision": [
        (0.09883435249064, 0.19800314785043, -0.03589075996423, -0.03670945774654),
        (-0.19598460585771, 0.03908342979135, 0.07719613309069, -0.02047063769068),
        (0.15722553326381, -0.23644894857965, -0.04575138481677, 0.04110607862647),
    ],
    "webcam": [
        (0.27936895208818, 0.55910670256236, 0.05264056832421, 0.11780128856756),
        (-0.55858057371511, 0.11168254297711, -0.1036428434514, 0.01894132485849),
        (0.44601186492501, -0.6695211643764, 0.08744689593979, -0.14103321960917),
    ],
}
# fmt: on


@pytest.mark.parametrize("name", NAMES)
def test_rays_are_those_of_optiland(name: str) -> None:
    lens, known = PRESCRIPTIONS[name], torch.tensor(OPTILAND[name], dtype=torch.float64)
    points = torch.tensor([[x, y, -1.0] for x, y, _, _ in RAYS[: len(known)]], dtype=torch.float64)
    rays = trace(
        place(lens, 1.0, 1.0, Misalignment()), points, unit([[a, b, 1.0] for _, _, a, b in RAYS[: len(known)]])
    )
    plane = sum(surface.thickness for surface in lens.surfaces)
    at = rays.points + rays.directions * ((plane - rays.points[:, 2:]) / rays.directions[:, 2:])
    assert bool(rays.valid.all())
    torch.testing.assert_close(torch.cat([at[:, :2], rays.directions[:, :2]], -1), known, atol=1e-12, rtol=0)


def test_a_tilted_piece_of_glass_turns_as_one_about_its_first_vertex() -> None:
    """A turn of α about x lowers what lies behind the pivot: (0, -sin α, cos α) times its distance."""
    lens, alpha = SURVEILLANCE, 0.1
    first, last = lens.elements[1]
    tilt = tuple((alpha, 0.0) if i == 1 else (0.0, 0.0) for i in range(len(lens.elements)))
    straight, tilted = (place(lens, 1.0, 1.0, Misalignment(tilt=turns)) for turns in ((), tilt))
    for k, (before, after) in enumerate(zip(straight, tilted, strict=True)):
        turned = first <= k <= last
        depth = before.vertex[2] - straight[first].vertex[2] if turned else torch.zeros(()).double()
        axis = torch.tensor([0.0, -math.sin(alpha), math.cos(alpha)] if turned else [0.0, 0.0, 1.0]).double()
        moved = depth * (axis - torch.tensor([0.0, 0.0, 1.0]).double())
        torch.testing.assert_close(after.vertex - before.vertex, moved, atol=1e-7, rtol=0)
        torch.testing.assert_close(after.rotation[:, 2], axis, atol=1e-7, rtol=0)


def test_pieces_of_glass_are_counted_and_checked() -> None:
    lens = SURVEILLANCE
    assert lens.elements[1] == (2, 4)  # cemented
    with pytest.raises(InputError, match="1 entries for 7"):
        place(lens, 1.0, 1.0, Misalignment(decenter=((0.0, 0.0),)))
    with pytest.raises(InputError, match="not negative"):
        Misalignment.draw(lens, -1.0, torch.Generator())
    with pytest.raises(InputError, match="equal media"):
        Prescription(name="x", source="", surfaces=(Surface(radius=1.0, thickness=1.0, index=1.5),), stop=0)
