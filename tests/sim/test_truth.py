"""The true lens: its table is the tracing, its inverse its inverse, and misplaced glass acts where it is."""

from __future__ import annotations

import pytest
import torch

from kcal.errors import InputError
from kcal.sim.captures import drawn_lens
from kcal.sim.raytrace import SURVEILLANCE, Misalignment
from kcal.sim.truth import TruthLens
from scripts.shared.captures import PAPER_BOARD, capture_corners
from scripts.shared.prescriptions import MACHINE_VISION, PRESCRIPTIONS, WEBCAM

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
    near = torch.tensor([[-0.49, -0.49], [width - 0.51, height - 0.51]]).double()
    assert bool(lens.inside(near).all())
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
