"""The true lens: tracing, its table and inverse, and the error at infinity."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kcal import Camera, InputError
from kcal.lens import rotation_from_vector
from kcal.sim.captures import drawn_lens
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
from kcal.sim.truth import TruthLens
from scripts.shared.captures import (
    MACHINE_VISION,
    PAPER_BOARD,
    PRESCRIPTIONS,
    WEBCAM,
    Asphere,
    capture_corners,
    error_at_infinity,
)

# The true lens: its table is the tracing, its inverse its inverse, and misplaced glass acts where it is.


NAMES = sorted(PRESCRIPTIONS)


@pytest.fixture(scope="module", params=NAMES)
def lens(request: pytest.FixtureRequest) -> TruthLens:
    return drawn_lens(PRESCRIPTIONS[request.param], 1.0, 4)


def some_pixels(lens: TruthLens, count: int = 200) -> torch.Tensor:
    share = torch.rand((count, 2), dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    return share * (torch.tensor(lens.size, dtype=torch.float64) - 1)


def test_table_equals_tracing(lens: TruthLens) -> None:
    assert lens.table_error < 1e-6
    pixels = some_pixels(lens)
    table, traced = lens.lines(pixels), lens.trace(pixels)
    assert float((table.slopes - traced.slopes).abs().max() * lens.focal[0]) < 1e-6
    assert float((table.origins - traced.origins).abs().max()) < 1e-9


@pytest.mark.parametrize("depth", [0.4, 3.0, 1e9])
def test_a_point_on_the_line_of_sight_is_seen_there(lens: TruthLens, depth: float) -> None:
    pixels = some_pixels(lens)
    lines = lens.lines(pixels)
    points = torch.cat(
        [lines.origins + depth * lines.slopes, torch.full((len(pixels), 1), depth, dtype=torch.float64)], -1
    )
    found, valid = lens.project(points)
    assert bool(valid.all())
    torch.testing.assert_close(found, pixels, atol=1e-8, rtol=0)


def test_rays_are_those_of_points_far_away(lens: TruthLens) -> None:
    pixels = some_pixels(lens).reshape(2, 100, 2)
    rays, valid = lens.unproject(pixels)
    assert rays.shape == (2, 100, 3)
    assert bool(valid.all())
    torch.testing.assert_close(lens.project(rays * 1e9)[0], pixels, atol=1e-6, rtol=0)


def test_what_is_not_seen_says_so(lens: TruthLens) -> None:
    points = torch.tensor([[0, 0, -1.0], [9.0, 0, 1.0], [0, torch.nan, 1.0], [0, 0, 0], [1e300, 1, 1]]).double()
    pixels, valid = lens.project(points)
    assert not bool(valid.any())
    assert bool(torch.isfinite(pixels).all())
    rays, valid = lens.unproject(torch.tensor([[-500.0, 0.0], [torch.nan, 0.0]]).double())
    assert not bool(valid.any())
    torch.testing.assert_close(rays, torch.tensor([[0, 0, 1.0]] * 2).double())
    assert lens.project(torch.zeros(0, 3).double())[0].shape == (0, 2)


def test_the_image_ends_half_a_pixel_beyond_its_outer_centers(lens: TruthLens) -> None:
    width, height = lens.size
    assert bool(lens.inside(torch.tensor([[-0.49, -0.49], [width - 0.51, height - 0.51]]).double()).all())
    out = torch.tensor([[-0.51, 9.0], [9.0, -0.51], [width - 0.49, 9.0], [9.0, height - 0.49]]).double()
    assert not bool(lens.inside(out).any())


def test_a_perfect_lens_is_round() -> None:
    lens = TruthLens(SURVEILLANCE, size=(800, 800), focal=700.0)
    around = torch.linspace(0, 6.2, 30, dtype=torch.float64)
    ring = torch.stack([torch.cos(around), torch.sin(around), torch.full_like(around, 2.0)], -1)
    radius = (lens.project(ring)[0] - 399.5).norm(dim=-1)
    assert float(radius.std()) < 1e-8
    # Barrel: nearer than the 350 px of a pinhole.
    assert 300 < float(radius.mean()) < 345


def test_turning_the_misplaced_glass_turns_the_picture() -> None:
    drawn = Misalignment.draw(SURVEILLANCE, 2.0, torch.Generator().manual_seed(2))
    turned = Misalignment(
        decenter=tuple((-y, x) for x, y in drawn.decenter), tilt=tuple((-y, x) for x, y in drawn.tilt)
    )
    straight, quarter = (
        TruthLens(SURVEILLANCE, size=(600, 600), focal=500.0, misalignment=each, sensor_tilt=tilt)
        for each, tilt in ((drawn, (0.004, -0.002)), (turned, (0.002, 0.004)))
    )
    points = torch.tensor([[0.4, 0.1, 1.0], [-0.2, 0.45, 1.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    rotate = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    before, after = straight.project(points)[0] - 299.5, quarter.project(points @ rotate.T)[0] - 299.5
    # The camera looks back along the light: its frame is mirrored, so that the other way round is tried as well.
    other = quarter.project(points @ rotate)[0] - 299.5
    errors = [(after - before @ rotate[:2, :2].T).abs().max(), (other - before @ rotate[:2, :2]).abs().max()]
    assert float(min(errors)) < 1e-7
    assert float(before[2].norm()) > 1.0  # and the glass does matter


def pupil_wander(lens: TruthLens) -> float:
    """Largest distance of any line of sight from the origin, meters."""
    u, v = (torch.linspace(-0.5, size - 0.5, 33, dtype=torch.float64) for size in lens.size)
    at, heading = lens.lines(torch.cartesian_prod(u, v)).spatial()
    return float(torch.linalg.vector_norm(torch.linalg.cross(at, heading), dim=-1).max())


def test_the_pupil_wanders_by_its_share() -> None:
    whole, tenth, none = (TruthLens(SURVEILLANCE, wander=share) for share in (1.0, 0.1, 0.0))
    assert 1e-4 < pupil_wander(whole) < 5e-4
    assert pupil_wander(tenth) == pytest.approx(0.1 * pupil_wander(whole), rel=1e-6)
    assert pupil_wander(none) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"focal": 0.0}, "positive"),
        ({"wander": 2.0}, "from 0 to 1"),
        ({"focal": 800.0}, "no chief ray"),
        ({"size": (0, 3)}, "positive"),
    ],
)
def test_bad_arguments(arguments: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        TruthLens(WEBCAM, **arguments)


def test_a_larger_lens_has_the_same_image_and_moves_its_pupil_farther() -> None:
    small, large = (drawn_lens(SURVEILLANCE, 1.0, 4, focal_mm=focal_mm, wander=1.0) for focal_mm in (2.8, 5.6))
    assert pupil_wander(large) == pytest.approx(2 * pupil_wander(small), rel=1e-6)
    pixels = torch.tensor([[0.0, 0.0], [1700.0, 300.0]], dtype=torch.float64)
    torch.testing.assert_close(large.unproject(pixels)[0], small.unproject(pixels)[0], atol=1e-11, rtol=0)


def test_captures_are_seeded_and_their_noise_scales() -> None:
    lens = drawn_lens(MACHINE_VISION, 1.0, 4)
    one, two = (capture_corners(lens, 6, sigma=sigma, seed=9) for sigma in (0.1, 0.2))
    torch.testing.assert_close(one.true_pixels, two.true_pixels, atol=0, rtol=0)
    torch.testing.assert_close(2 * (one.pixels - one.true_pixels), two.pixels - two.true_pixels, atol=1e-9, rtol=0)
    assert 0.085 < float((one.pixels - one.true_pixels).std()) < 0.115
    points = one.points @ one.rotation.transpose(-1, -2) + one.translation[:, None]
    torch.testing.assert_close(lens.project(points)[0], one.true_pixels, atol=1e-8, rtol=0)
    assert bool(lens.inside(one.true_pixels).all())
    assert len(one.points) == PAPER_BOARD.columns * PAPER_BOARD.rows
    with pytest.raises(InputError, match="not negative"):
        capture_corners(lens, 6, sigma=-1.0, seed=9)


# Ray tracing obeys the laws it is made of: Snell, reversibility, and the paraxial limit.


def unit(values: list[list[float]]) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.tensor(values, dtype=torch.float64), dim=-1)


@given(
    angle=st.floats(0.0, 1.5), turn=st.floats(-math.pi, math.pi), ratio=st.floats(0.4, 2.5).filter(lambda r: r != 1.0)
)
def test_refraction_is_snells_law(angle: float, turn: float, ratio: float) -> None:
    normal = unit([[0.3, -0.2, 1.0]])
    across = torch.nn.functional.normalize(torch.linalg.cross(normal, unit([[math.cos(turn), math.sin(turn), 0.1]])))
    bent, passed = refract(math.cos(angle) * normal + math.sin(angle) * across, normal, ratio)
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


# Error at infinity: nothing for a turned camera, the right number for a wrong one, NaN where nothing is seen.


SIZE = (640, 480)


def camera(**changes: object) -> Camera:
    arguments: dict = {"focal": (500, 500), "center": (319.5, 239.5), "coefficients": [-0.2, 0.05]} | changes
    return Camera.build(size=SIZE, **arguments)


class Turned:
    """A camera that looks elsewhere."""

    size = SIZE
    focal = torch.tensor([500.0, 500.0])

    def __init__(self, inner: Camera, rotation: torch.Tensor) -> None:
        self.inner, self.rotation = inner, rotation

    def unproject(self, pixels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        rays, valid = self.inner.unproject(pixels)
        return rays @ self.rotation.T, valid

    def project(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.inner.project(points @ self.rotation)

    def inside(self, pixels: torch.Tensor) -> torch.Tensor:
        return self.inner.inside(pixels)


def test_a_turned_camera_has_no_error() -> None:
    turn = rotation_from_vector(torch.tensor([0.02, -0.05, 0.1], dtype=torch.float64))
    found = error_at_infinity(camera(), Turned(camera(), turn))
    assert found.maximum < 1e-8
    torch.testing.assert_close(found.rotation, turn.T, atol=1e-10, rtol=0)
    assert found.valid == 1.0


def test_another_focal_length_is_a_zoom() -> None:
    found = error_at_infinity(camera(focal=(501, 501)), camera())
    centered = found.pixels - torch.tensor([319.5, 239.5])
    torch.testing.assert_close(found.errors, 0.002 * centered, atol=2e-6, rtol=0)
    assert found.rms == pytest.approx(float((0.002 * centered).pow(2).sum(-1).mean().sqrt()), rel=1e-6)
    assert found.maximum == pytest.approx(0.002 * float(centered.norm(dim=-1).max()), rel=1e-5)


def test_no_rotation_does_better() -> None:
    found = error_at_infinity(camera(center=(324.5, 236.5)), camera())
    rays = camera().unproject(found.pixels.reshape(-1, 2))[0]
    for axis in torch.eye(3, dtype=torch.float64):
        for sign in (-1e-5, 1e-5):
            turn = rotation_from_vector(sign * axis) @ found.rotation
            seen = camera(center=(324.5, 236.5)).project(rays @ turn.T * 1e9)[0]
            assert float((seen - found.pixels.reshape(-1, 2)).pow(2).sum(-1).mean().sqrt()) > found.rms


def test_what_a_folding_lens_does_not_see_is_nan() -> None:
    found = error_at_infinity(camera(coefficients=[-0.9, 0.1]), camera())
    assert 0.1 < found.valid < 0.95
    assert float(torch.isnan(found.errors).any(-1).double().mean()) == pytest.approx(1 - found.valid)


def test_sizes_must_agree() -> None:
    other = Camera.build(focal=(500, 500), center=(300, 200), size=(600, 400))
    with pytest.raises(InputError, match="same size"):
        error_at_infinity(other, camera())
