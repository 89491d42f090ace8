"""Uncertainty of a camera: information, covariance over the image, and differences of two."""

import dataclasses
import math

import pytest
import torch
from lenses import HYBRID, strong

from kcal import Camera, InputError
from kcal.lens import CameraCalibration, camera_difference, rotation_from_vector
from kcal.lens.information import CameraInformation
from kcal.lens.uncertainty import image_sigma, pixel_covariance, projection_sigma
from scripts.shared.captures import error_at_infinity

# Uncertainty of points at infinity: what a change of a parameter does to the image after the best-fit rotation.


SIZE = (640, 480)


def hybrid() -> Camera:
    head = torch.tensor([520.0, 520.0, 325.0, 235.0, 0.0], dtype=torch.float64)
    return Camera(torch.cat([head, 0.2 * strong(HYBRID)]), size=SIZE, model=HYBRID)


CAMERAS = {
    "opencv5": Camera.build(
        focal=(500, 505), center=(325, 235), size=SIZE, coefficients=[-0.2, 0.05, 1e-3, -5e-4, 0.0]
    ),
    "hybrid": hybrid(),
}


@pytest.mark.parametrize(
    ("kind", "name"), [(k, n) for k in CAMERAS for n in ("fx", "cx", "cy")] + [("hybrid", "shape")]
)
def test_a_parameter_moves_the_image_by_as_much(kind: str, name: str) -> None:
    """Independent of the formulas: the changed camera compared with the first one after a turn found by search."""
    camera = CAMERAS[kind]
    place = camera.names.index(name)
    step = 1e-3 * (1.0 if name != "shape" else 1e-3)
    changed = camera.params.detach().clone()
    changed[place] += step
    found = error_at_infinity(camera.with_parameters(changed), camera, columns=25, rows=17)
    unit = torch.zeros(len(camera.names), len(camera.names), dtype=torch.float64)
    unit[place, place] = step**2
    predicted = pixel_covariance(camera, camera.grid(25, 17), unit)
    # To first order in the step.
    assert float(predicted.diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt()) == pytest.approx(found.rms, rel=2e-3)
    # In each place, along its own direction.
    length = found.errors[..., :, None] * found.errors[..., None, :]
    torch.testing.assert_close(length, predicted, rtol=0, atol=2e-2 * float(predicted.max()))


def test_a_turn_is_no_uncertainty() -> None:
    """Far away a pinhole's shift and turn are nearly the same: what is left is small, and smallest in the middle."""
    camera = Camera.build(focal=(5000, 5000), center=(319.5, 239.5), size=SIZE, model="pinhole")
    shift = torch.zeros(5, 5, dtype=torch.float64)
    shift[2, 2] = 1.0
    sigma = image_sigma(dataclass_camera(camera, shift))
    assert float(sigma.max()) < 0.005
    assert sigma.shape == (25, 33)


def dataclass_camera(camera: Camera, covariance: torch.Tensor) -> Camera:
    camera.calibration = dataclasses.replace(CameraCalibration(), covariance=covariance)
    return camera


@pytest.mark.parametrize("at", [0.5, 20.0, math.inf])
def test_projection_sigma_near_and_far(at: float) -> None:
    """Pixels and their rays agree; a change of the pupil moves what is near, by f ζ θ² sin θ cos θ / distance."""
    camera = CAMERAS["hybrid"]
    pupil = camera.names.index("pupil1")
    covariance = torch.zeros(len(camera.names), len(camera.names), dtype=torch.float64)
    covariance[pupil, pupil] = 1e-6
    known = dataclass_camera(camera.with_parameters(camera.params.detach().clone()), covariance)
    pixels = torch.tensor([[100.0, 235.0], [325.0, 235.0], [600.0, 400.0]], dtype=torch.float64)
    rays, valid = known.unproject(pixels)
    assert bool(valid.all())
    found = projection_sigma(known, pixels, at=at)
    torch.testing.assert_close(found, projection_sigma(known, 7.0 * rays, at=at), rtol=1e-6, atol=1e-9)
    if math.isinf(at):
        # To the rounding of rays that are followed for 1e12 m.
        assert float(found.abs().max()) < 1e-9
        return
    moved = known.params.detach().clone()
    moved[pupil] += 1e-3
    there, _ = known.with_parameters(moved).project(known.ray_origins(rays) + at * rays)
    torch.testing.assert_close(found, (there - pixels).norm(dim=-1), rtol=0.02 / at, atol=1e-4)


def test_refusals() -> None:
    camera = Camera.build(focal=(500, 500), center=(319.5, 239.5), size=SIZE, model="pinhole")
    pixels = torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    with pytest.raises(InputError, match="no covariance"):
        pixel_covariance(camera, pixels)
    with pytest.raises(InputError, match=r"\(5, 5\)"):
        pixel_covariance(camera, pixels, torch.eye(3, dtype=torch.float64))
    with pytest.raises(InputError, match="positive distance"):
        pixel_covariance(camera, pixels, torch.eye(5, dtype=torch.float64), at=0.0)
    many = Camera(camera.params.detach().expand(2, -1).clone(), size=SIZE, model="pinhole")
    with pytest.raises(InputError, match="single camera"):
        pixel_covariance(many, pixels)


# Square roots of information: covariances, priors, boards that are integrated out.


def information(board: int = 2, scale: float = 1.0) -> CameraInformation:
    """Five unknowns of a camera of seven parameters, and some of a board."""
    generator = torch.Generator().manual_seed(1)
    count = 5 + board
    sigma = torch.full((count,), math.inf, dtype=torch.float64)
    sigma[3:] = torch.rand(count - 3, generator=generator, dtype=torch.float64) + 0.1
    units = scale ** torch.arange(count, dtype=torch.float64)
    return CameraInformation(
        slots=(0, 0, 1, 2, -1, 3, 4),
        estimate=torch.randn(count, generator=generator, dtype=torch.float64),
        rows=torch.randn(40, count, generator=generator, dtype=torch.float64) * units,
        residuals=torch.randn(40, generator=generator, dtype=torch.float64),
        mean=torch.zeros(count, dtype=torch.float64),
        sigma=sigma,
    )


def test_covariance_of_data_and_prior() -> None:
    """(RᵀR + 1/σ²)⁻¹, tied parameters alike and held ones zero."""
    known = information()
    inverse = torch.linalg.inv(known.rows.T @ known.rows + torch.diag(known.sigma**-2))
    torch.testing.assert_close(known.half().T @ known.half(), inverse, rtol=1e-12, atol=1e-14)
    found = known.covariance()
    assert found.shape == (7, 7)
    assert torch.equal(found[0], found[1])
    assert not found[4].any()
    torch.testing.assert_close(found[5, 2], inverse[3, 1], rtol=1e-11, atol=1e-14)


def test_without_board_is_the_marginal() -> None:
    """Integrating the board out leaves the camera's block of the covariance, and the pull of what is left."""
    known = information()
    alone = known.without_board()
    assert alone.board_size == 0
    torch.testing.assert_close(alone.covariance(), known.covariance(), rtol=1e-11, atol=1e-14)
    # The same best camera: the step to the minimum of everything is that of the camera alone.
    whole, part = known.whole.rows, alone.whole.rows
    step = torch.linalg.lstsq(whole[:, :-1], -whole[:, -1:]).solution[:5]
    torch.testing.assert_close(torch.linalg.lstsq(part[:, :-1], -part[:, -1:]).solution, step, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("prior", [False, True])
def test_a_changed_camera(prior: bool) -> None:
    """The covariance grows by the change. A prior of all cameras alike stays one, for who takes the data away."""
    known, by = information(), torch.zeros(7, 2, dtype=torch.float64)
    by[[0, 1], 0], by[2, 1], by[5] = 0.2, 0.3, 0.0 if prior else 0.1
    found = known.changed(by, prior=prior)
    torch.testing.assert_close(found.covariance(), known.covariance() + by @ by.T, rtol=1e-9, atol=1e-12)
    assert torch.equal(found.sigma[:5], known.sigma[:5] if prior else torch.full_like(known.sigma[:5], math.inf))
    if not prior:  # what is known of the board stays
        ours, theirs = ((one.half().T @ one.half())[known.lens_size :, known.lens_size :] for one in (found, known))
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-12)


def test_rows_are_those_of_its_parts() -> None:
    """Data, priors and what others say, in the order of the unknowns, with residuals at the estimate."""
    known = dataclasses.replace(information(), others=torch.ones(1, 3, dtype=torch.float64))
    assert torch.equal(known.data.rows, torch.cat([known.rows, known.residuals[:, None]], 1))
    pull = (known.estimate - known.mean) / known.sigma
    slots = known.data.slots
    for prior, own in ((known.lens_prior, [3, 4]), (known.board_prior, [5, 6])):
        rows = prior.placed(slots, known.estimate).rows
        assert torch.equal(rows[:, own], torch.diag(1.0 / known.sigma[own]))
        torch.testing.assert_close(rows[:, -1], pull[own])
    assert known.told.placed(slots, known.estimate).rows[-1].tolist() == [0.0] * 5 + [1.0] * 3
    torch.testing.assert_close(known.data.compressed().products[:-1], known.data.products[:-1])
    assert known.whole.rows.shape == (40 + 2 + 2 + 1, 8)


def test_from_covariance_and_back() -> None:
    """Parameters without variance are held; the rest comes back."""
    root = torch.randn(5, 7, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    matrix = root.T @ root + 0.1 * torch.eye(7).double()
    matrix[3], matrix[:, 3] = 0.0, 0.0
    found = CameraInformation.from_covariance(torch.arange(7.0), matrix)
    assert found.slots == (0, 1, 2, -1, 3, 4, 5)
    torch.testing.assert_close(found.covariance(), matrix, rtol=1e-11, atol=1e-13)


def test_refused() -> None:
    """Shapes and values that cannot be."""
    known = information()
    for change in ({"mean": known.mean[:3]}, {"sigma": -known.sigma}, {"residuals": known.residuals * math.nan}):
        fields = {name: getattr(known, name) for name in ("slots", "estimate", "rows", "residuals", "mean", "sigma")}
        with pytest.raises(InputError, match="information"):
            CameraInformation(**fields | change)
    with pytest.raises(InputError, match="finite"):
        CameraInformation.from_covariance(torch.ones(2), torch.full((2, 2), math.nan).double())


# The difference of two cameras: what a turn undoes does not count, and error bars tell whether the rest is chance.


CAMERA = Camera.build(focal=(800, 810), center=(320, 240), size=(640, 480), coefficients=[-0.1, 0.02, 1e-3, 0, 0])

SPREAD = torch.tensor([1.0, 1, 2, 2, 0, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4], dtype=torch.float64)


def drawn(generator: torch.Generator, factor: float = 1.0) -> Camera:
    """A camera whose parameters are off by `factor` times what its covariance says."""
    noise = factor * SPREAD * torch.randn(10, generator=generator, dtype=torch.float64)
    camera = CAMERA.with_parameters(CAMERA.params + noise)
    camera.calibration = CameraCalibration(covariance=torch.diag(SPREAD**2))
    return camera


def test_no_rotation_fits_better() -> None:
    other = Camera.build(focal=(802, 811), center=(323, 238), size=(640, 480), coefficients=[-0.11, 0.03])
    found = camera_difference(CAMERA, other)
    best = float(found.shift.square().sum())
    for axis in range(3):
        for angle in (-1e-5, 1e-5):
            step = torch.zeros(3, dtype=torch.float64)
            step[axis] = angle
            turned = camera_difference(CAMERA, other, rotation=rotation_from_vector(step) @ found.rotation)
            assert float(turned.shift.square().sum()) > best
    assert found.rms < camera_difference(CAMERA, other, rotation=torch.eye(3)).rms / 3


def test_at_a_distance_a_shift_counts_too() -> None:
    """A longer focal length is nearly a camera that stands nearer."""
    other = CAMERA.with_parameters(CAMERA.params * torch.tensor([1.01, 1.01] + [1.0] * 8, dtype=torch.float64))
    far, near = camera_difference(CAMERA, other), camera_difference(CAMERA, other, at=2.0)
    assert near.rms < 0.2 * far.rms
    assert float(near.translation[2]) == pytest.approx(2.0 * 0.01, rel=0.2)
    assert far.translation.tolist() == [0, 0, 0]


@pytest.mark.slow
def test_cameras_that_agree_differ_at_the_stated_rate() -> None:
    generator = torch.Generator().manual_seed(0)
    found = [camera_difference(drawn(generator), drawn(generator), grid=(17, 13)) for _ in range(40)]
    refused = sum(not each.same for each in found)
    # 2 of 40 are expected; more than 7 have a probability of 5e-4.
    assert refused <= 7
    assert 10 <= sum((each.probability or 0) < 0.5 for each in found) <= 30


def test_a_real_change_is_seen() -> None:
    generator = torch.Generator().manual_seed(1)
    found = camera_difference(drawn(generator), drawn(generator, 8.0))
    assert found.same is False
    assert found.ratio is not None
    assert found.ratio > 2


def test_without_error_bars_nothing_is_claimed() -> None:
    found = camera_difference(CAMERA, CAMERA)
    assert (found.same, found.ratio, found.sigma, found.known) == (None, None, None, (False, False))
    one = camera_difference(drawn(torch.Generator().manual_seed(2)), CAMERA)
    assert one.known == (True, False)
    assert one.sigma is not None


def test_the_angle_of_the_turn() -> None:
    turn = rotation_from_vector(torch.tensor([0.0, math.radians(2.0), 0.0], dtype=torch.float64))
    assert camera_difference(CAMERA, CAMERA, rotation=turn).turn_deg == pytest.approx(2.0)


def test_differences_that_are_refused() -> None:
    small = Camera.build(focal=(800, 800), center=(160, 120), size=(320, 240))
    with pytest.raises(InputError, match="640x480 and 320x240"):
        camera_difference(CAMERA, small)
    with pytest.raises(InputError, match="positive distance"):
        camera_difference(CAMERA, CAMERA, at=0.0)
