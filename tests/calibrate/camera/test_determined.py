"""Whether views determine where a camera sees what they show: its directions, not its parameters."""

from __future__ import annotations

import math

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, observe, pixels_of
from lenses import hybrid_camera

from kcal.calibrate.camera.advice import check_directions, direction_share
from kcal.calibrate.camera.calibrate import calibrate_camera
from kcal.corners.board import Board
from kcal.corners.observations import Observations, View
from kcal.errors import DegenerateError
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.pose import rotation_from_vector
from kcal.lens.projection import FAR, project_components
from kcal.lens.uncertainty import paraxial_focal


def rays_of(lens: Camera) -> torch.Tensor:
    rays, valid = lens.unproject(lens.grid(15, 11).reshape(-1, 2))
    return rays[valid]


def spread_of(lens: Camera, **sigma: float) -> torch.Tensor:
    """Covariance with one common change of the parameters, of these sizes."""
    change = torch.tensor([sigma.get(name, 0.0) for name in lens.names], dtype=torch.float64)
    return change[:, None] * change


def test_for_a_pinhole_it_is_the_share_of_the_focal_length() -> None:
    lens = Camera.build(focal=(5000, 5000), center=(319.5, 239.5), size=SIZE, model="pinhole")
    share = direction_share(lens.params, lens.model, rays_of(lens), spread_of(lens, fx=100.0, fy=100.0))
    assert share == pytest.approx(0.02, rel=1e-3)


def test_a_shift_of_the_principal_point_is_a_turn() -> None:
    lens = Camera.build(focal=(5000, 5000), center=(319.5, 239.5), size=SIZE, model="pinhole")
    assert direction_share(lens.params, lens.model, rays_of(lens), spread_of(lens, cx=100.0)) < 0.001


def test_what_other_parameters_make_up_for_does_not_count() -> None:
    """A focal length known to 29 % together with weights that take it back where boards were."""
    lens = hybrid_camera("webcam")
    rays, change = rays_of(lens), torch.zeros(len(lens.names), dtype=torch.float64)
    # Boards were in the middle, where weights can bend the image as they like.
    rays = rays[rays[:, 2] > 0.5 * (1.0 + float(rays[:, 2].min()))]
    change[:2] = 0.29 * lens.focal.detach()
    plain = direction_share(lens.params.detach(), lens.model, rays, change[:, None] * change)
    assert plain > 0.2
    free = list(range(8, len(lens.names)))
    slopes = project_components(FAR * rays.T, lens.params.detach(), lens.model, [0, 1, *free]).by_camera.flatten(1)
    moved = change[0] * slopes[0] + change[1] * slopes[1]
    change[free] = -torch.linalg.lstsq(slopes[2:].T, moved).solution
    made_up = direction_share(lens.params.detach(), lens.model, rays, change[:, None] * change)
    assert made_up < 0.1 * plain


@pytest.mark.parametrize("unknown", [math.nan, math.inf])
def test_no_covariance_is_no_knowledge(unknown: float) -> None:
    lens = camera("pinhole")
    spread = torch.diag(torch.tensor([1.0, unknown, 1.0, 1.0, 0.0], dtype=torch.float64))
    assert direction_share(lens.params.detach(), lens.model, rays_of(lens), spread) == math.inf


def test_all_held_is_all_known() -> None:
    lens = camera("pinhole")
    assert direction_share(lens.params.detach(), lens.model, rays_of(lens), torch.zeros(5, 5).double()) == 0.0


def test_the_message_names_the_view_that_is_tilted_most() -> None:
    lens = camera("pinhole")
    rotation, translation = motions(lens, 5, 3, tilt=12.0)
    points = BOARD.points @ rotation.mT + translation[:, None]
    seen = torch.ones(points.shape[:2], dtype=torch.bool)
    tilts = torch.rad2deg(torch.acos(rotation[:, 2, 2]))
    most = int(tilts.argmax())
    message = rf"only to ±6\.\d %.* in 0 of 5 views \(by {float(tilts[most]):.0f}° at most, in n{most}\).*45 degrees"
    spread = spread_of(lens, fx=30.5, fy=30.5)
    with pytest.raises(DegenerateError, match=message):
        check_directions(lens.params.detach(), lens.model, points, seen, spread, rotation, [f"n{i}" for i in range(5)])
    check_directions(lens.params.detach(), LensModel(), points, seen, spread / 4.0, rotation)


@pytest.mark.slow
def test_a_fisheye_whose_parameter_is_open_calibrates(kcal_data) -> None:
    """Its focal length on the axis is known to a quarter pixel, its fx far less."""
    found = calibrate_camera(Observations.load(kcal_data / "captures" / "fish_l.obs.json"))
    focal, sigma = paraxial_focal(found.camera).mean
    assert (found.sigma["fx"] or 0.0) > 15 * sigma
    assert sigma < 0.25
    assert 226.0 < focal < 230.0


@pytest.mark.slow
def test_the_focal_length_of_a_simulated_capture() -> None:
    """With its σ, over several captures of one camera; the parameter's σ is larger than that of the lens."""
    truth, pulls = camera("opencv4"), []
    wanted = float(truth.focal.mean())
    truth = Camera.build(
        focal=(wanted, wanted), center=truth.center.tolist(), size=SIZE, coefficients=[-0.21, 0.06], model="opencv4"
    )
    for seed in range(6):
        found = calibrate_camera(observe(pixels_of(truth, motions(truth, 10, seed), noise=0.1, seed=seed)))
        focal, sigma = paraxial_focal(found.camera).mean
        assert sigma < (found.sigma["fx"] or 0.0)
        pulls.append((focal - wanted) / sigma)
    # χ² of six: below 22.5 but once in a thousand.
    assert 0.3 < sum(pull * pull for pull in pulls) < 22.5


@pytest.mark.parametrize(("spread", "refused"), [(2.0, True), (5.5, False), (20.0, False)])
def test_the_spread_of_tilts_counts_not_the_tilt(spread: float, refused: bool) -> None:
    """All boards by 25 degrees, and by little or much more or less."""
    draw = torch.Generator().manual_seed(1)
    truth = Camera.build(focal=(800, 800), center=(322, 238), size=(640, 480), model="pinhole")
    board, count = Board(columns=9, rows=6, square=0.03), 14
    tilt = torch.tensor([25.0, 0.0, 0.0]) + spread * (2.0 * torch.rand(count, 3, generator=draw) - 1.0)
    points = (board.points - board.points.mean(0)) @ rotation_from_vector(torch.deg2rad(tilt.double())).mT
    place = (2.0 * torch.rand(count, 3, generator=draw).double() - 1.0) * torch.tensor([0.05, 0.04, 0.04])
    pixels = truth.project(points + (place + torch.tensor([0.0, 0.0, 0.65]))[:, None])[0]
    pixels = pixels + 0.02 * torch.randn(pixels.shape, generator=draw, dtype=torch.float64)
    views = tuple(View(name=str(i), pixels=tuple(map(tuple, one))) for i, one in enumerate(pixels.tolist()))
    seen = Observations(board=board, image_size=(640, 480), views=views)
    if refused:
        with pytest.raises(DegenerateError, match="tilted alike"):
            calibrate_camera(seen)
    else:
        assert float(calibrate_camera(seen).camera.focal[0]) == pytest.approx(800.0, rel=0.02)
