"""Cameras behind a flat port: derivatives, rays that start on the port's normal, files, and exact refraction."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from lenses import hybrid_camera
from torch import Tensor
from torch.func import jacfwd

from kcal import Camera, InputError, calibrate_camera
from kcal.calibrate.camera.at_setting import usable_information
from kcal.calibrate.camera.warnings import pupil_findings
from kcal.io.camera_file import camera_to_file, load_camera, save_camera
from kcal.lens import LensModel
from kcal.lens.model import PORT
from kcal.lens.projection import project_components
from scripts.check.ports import WATER, PortedCamera, seen_by
from scripts.shared.captures import error_at_infinity

POINTS = torch.tensor([[0.3, 0.2, 1.2], [-0.4, 0.1, 0.9], [0.0, 0.0, 1.0], [0.06, -0.04, 1.0]], dtype=torch.float64)
AXIS = (0.06, -0.04)


def ported(*values: float) -> Camera:
    """The camera of tests with ζ₁, ζ₂, ζ₃ and the slopes of a port."""
    plain = hybrid_camera("webcam")
    model = LensModel(hybrid=dataclasses.replace(plain.model.hybrid, port=True))
    head, rest = plain.params[:6], plain.params[8:]
    return Camera(torch.cat([head, torch.tensor(values, dtype=torch.float64), rest]), size=plain.size, model=model)


CAMERA = ported(-0.03, -0.05, 0.02, *AXIS)


def test_derivatives() -> None:
    params, model, every = CAMERA.params, CAMERA.model, list(range(len(CAMERA.params)))
    found = project_components(POINTS.T, params, model, every)
    torch.testing.assert_close(found.pixels.T, CAMERA.project(POINTS)[0], rtol=0, atol=1e-10)

    def pixels(points: Tensor, params: Tensor) -> Tensor:
        return project_components(points, params, model).pixels

    by_camera = jacfwd(pixels, 1)(POINTS.T, params).movedim(-1, 0)
    torch.testing.assert_close(found.by_camera, by_camera, rtol=1e-9, atol=1e-8)
    by_point = torch.stack([jacfwd(pixels)(p[:, None], params)[:, 0, :, 0].T for p in POINTS], -1)
    torch.testing.assert_close(found.by_point, by_point, rtol=1e-9, atol=1e-8)
    meter = torch.tensor(0.7, dtype=torch.float64)
    own = project_components(0.7 * POINTS.T, params, model, [0], meter)
    torch.testing.assert_close(own.pixels, found.pixels, rtol=0, atol=1e-10)
    by_meter = jacfwd(lambda m: project_components(0.7 * POINTS.T, params, model, meter=m).pixels)(meter)
    torch.testing.assert_close(own.by_meter, by_meter, rtol=1e-9, atol=1e-8)


def test_rays_start_on_the_normal_and_are_seen_where_they_came_from() -> None:
    pixels = CAMERA.grid(7, 5).flatten(0, 1)
    rays, valid = CAMERA.unproject(pixels)
    origins = CAMERA.ray_origins(rays)
    torch.testing.assert_close(
        origins[:, :2], origins[:, 2:] * torch.tensor(AXIS, dtype=torch.float64), rtol=0, atol=1e-15
    )
    assert float(origins[:, 2].min()) < -0.01
    for distance in (0.5, 3.0, 1e9):
        again, seen = CAMERA.project(origins + distance * rays)
        assert bool((valid & seen).all())
        torch.testing.assert_close(again, pixels, rtol=0, atol=1e-6)
    # Many points, for which other lenses have polynomials, take the same way.
    many = (origins + 0.5 * rays).repeat(300, 1)
    torch.testing.assert_close(CAMERA.project(many)[0][: len(pixels)], pixels, rtol=0, atol=1e-6)


def test_a_port_that_does_nothing_is_none() -> None:
    plain, same = hybrid_camera("webcam"), ported(2e-3, 1e-3, 0.0, 0.0, 0.0)
    torch.testing.assert_close(same.project(POINTS)[0], plain.project(POINTS)[0], rtol=0, atol=1e-9)
    assert plain.names == tuple(name for name in same.names if name not in PORT)


def test_batches() -> None:
    batch = CAMERA.with_parameters(torch.stack([CAMERA.params, ported(0.01, 0.0, 0.0, 0.0, 0.1).params]))
    rays = torch.nn.functional.normalize(POINTS, dim=-1)
    for row, one in enumerate((CAMERA, ported(0.01, 0.0, 0.0, 0.0, 0.1))):
        torch.testing.assert_close(batch.project(POINTS)[0][row], one.project(POINTS)[0])
        torch.testing.assert_close(batch.ray_origins(rays)[row], one.ray_origins(rays))


def test_files(tmp_path: Path) -> None:
    after = load_camera(save_camera(CAMERA, tmp_path / "camera.json"))
    assert (after.model, after.fingerprint) == (CAMERA.model, CAMERA.fingerprint)
    assert camera_to_file(CAMERA).dump()["model"]["hybrid"]["port"] is True
    assert "port" not in camera_to_file(hybrid_camera("webcam")).dump()["model"]["hybrid"]


def test_ports_are_not_interpolated() -> None:
    with pytest.raises(InputError, match="one: it looks through a flat port"):
        usable_information(CAMERA, CAMERA, "one", "one")


def test_what_is_told() -> None:
    """Under water a gap of 50 mm makes rays at 0.4 rad start 50 μ (cos θ / √(1 - μ² sin² θ) - 1) mm farther back."""
    camera = ported(-0.026, -0.029, -0.06, math.tan(math.radians(2.0)), 0.0)
    covariance = torch.zeros(len(camera.params), len(camera.params)).double()
    place = camera.names.index("port_x")
    covariance[place, place] = math.radians(0.5) ** 2
    (found,) = pupil_findings(camera, covariance)
    assert found.name == "port"
    assert "its normal 2.0 ± 0.5° off the camera's axis" in found.text


@pytest.mark.slow
@pytest.mark.parametrize("under_water", [True, False])
def test_refraction_is_found_under_water_alone(under_water: bool) -> None:
    """By Snell's law; in the frame of the calibrated camera the port's normal is the true one, turned like the rays."""
    lens = Camera.build(focal=(1600, 1600), center=(950, 545), size=(1920, 1080), coefficients=[-0.05])
    slopes = torch.tensor([0.06, -0.03, 1.0], dtype=torch.float64)
    truth = PortedCamera(
        lens=lens, normal=slopes / slopes.norm(), gap=0.06, thickness=0.01, outside=WATER if under_water else 1.0
    )
    result = calibrate_camera(seen_by(truth, seed=1, views=16, sigma=0.02))
    form = result.camera.model.hybrid
    assert form is not None
    assert form.port == under_water
    assert ("port" in [found.name for found in result.findings]) == under_water
    if under_water:
        normal = error_at_infinity(result.camera, truth).rotation @ truth.normal
        found = result.camera.coefficients[4:6] - normal[:2] / normal[2]
        sigma = torch.tensor([result.sigma["port_x"], result.sigma["port_y"]], dtype=torch.float64)
        assert bool((found.abs() < 4.0 * sigma).all())
        assert float(sigma.max()) < 0.02
