"""Calibration, rig and position as one chain of gradients; and the layer on another device."""

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, pixels_of
from elsewhere import DEVICE, Elsewhere
from torch import Tensor

from kcal import CalibrationOptions, Camera, Localizer, Origin, Rig
from kcal.calibrate.camera.layer import CalibratedViews, CalibrationLayer
from kcal.lens import rotation_from_vector

TURN = rotation_from_vector(torch.tensor([0.01, -0.03, 0.02], dtype=torch.float64))
SHIFT = torch.tensor([-0.06, 0.01, 0.02], dtype=torch.float64)


def corners_of_both() -> tuple[Tensor, Tensor]:
    """Of the same boards in two cameras of a rig."""
    left = motions(camera(), 6, 3)
    rotation, translation = left
    right = TURN @ rotation, translation @ TURN.T + SHIFT
    return tuple(pixels_of(camera("opencv4"), poses, noise=0.1) for poses in (left, right))  # type: ignore[return-value]


def located(layer: CalibrationLayer, corners: tuple[Tensor, Tensor], start: list[CalibratedViews | None]) -> Tensor:
    """Inverse range and position of a pair of pixels, from the corners of calibration images alone."""
    found = [layer(one, BOARD.points, start=first) for one, first in zip(corners, start, strict=True)]
    start[:] = found
    left, right = found
    turn = right.cam_from_board_rotation[0] @ left.cam_from_board_rotation[0].mT
    shift = right.cam_from_board_translation[0] - turn @ left.cam_from_board_translation[0]
    rig = Rig.pair(left.camera(differentiable=True), right.camera(differentiable=True), turn, shift)
    localize = Localizer(rig.placed(origin=Origin(lat=45.0, lon=6.0, height=0.0), heading_deg=0.0))
    pixels = [torch.tensor([[330.0, 250.0]], dtype=torch.float64), torch.tensor([[300.0, 238.0]], dtype=torch.float64)]
    where = localize(*pixels)
    return torch.cat([where.enu[0], where.inverse_range])


@pytest.mark.slow
def test_a_position_is_differentiable_by_the_corners_of_calibration_images() -> None:
    layer, corners = CalibrationLayer(SIZE, CalibrationOptions()), corners_of_both()
    start: list[CalibratedViews | None] = [None, None]
    located(layer, corners, start)
    amount = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    g = torch.Generator().manual_seed(1)
    along = [torch.randn(one.shape, generator=g).double() for one in corners]

    def solve(amount: Tensor) -> Tensor:
        # From the same start each time: with the default lens, it also holds the amplitudes.
        moved = tuple(one + share * way for one, share, way in zip(corners, amount, along, strict=True))
        return located(layer, moved, list(start))

    assert torch.autograd.gradcheck(solve, (amount,), eps=1e-3, atol=1e-5, rtol=1e-3, fast_mode=True)


def test_a_differentiable_camera_is_a_camera() -> None:
    found = CalibrationLayer(SIZE, CalibrationOptions(model="opencv4"))(
        corners_of_both()[0].requires_grad_(True), BOARD.points
    )
    plain, attached = found.camera(), found.camera(differentiable=True)
    assert not list(attached.parameters())
    assert plain.fingerprint == attached.fingerprint
    points = torch.tensor([[0.3, 0.2, 1.0], [-0.4, 0.1, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(plain.project(points)[0], found.project(points)[0].detach(), rtol=0, atol=1e-9)
    again = Camera(plain.params + 1.0, size=plain.size, model=plain.model)
    again.load_state_dict(attached.state_dict())
    assert torch.equal(again.params, plain.params)
    pixels = torch.tensor([[100.0, 200.0]], dtype=torch.float64)
    rays = attached.unproject(pixels)[0]
    assert rays.requires_grad
    torch.testing.assert_close(rays, plain.unproject(pixels)[0], rtol=0, atol=3e-16, check_layout=False)
    assert torch.equal(attached.resized((320, 240)).params, plain.resized((320, 240)).params)


@pytest.mark.slow
def test_what_comes_of_another_device_returns_to_it() -> None:
    layer, corners = CalibrationLayer(SIZE, CalibrationOptions()), corners_of_both()[0].requires_grad_(True)
    points = torch.tensor([[0.1, 0.05, 1.0]], dtype=torch.float64)
    here = layer(corners, BOARD.points)
    layer(corners, BOARD.points, start=here).project(points)[0].sum().backward()
    with Elsewhere():
        moved = corners.detach().to(DEVICE).requires_grad_(True)
        mask = torch.ones(moved.shape[:2], dtype=torch.bool, device=DEVICE)
        found = layer(moved, BOARD.points.to(DEVICE), mask, start=here)
        pixels = found.project(points.to(DEVICE))[0]
        assert pixels.device == found.residuals.device == found.camera(differentiable=True).params.device == DEVICE
        pixels.sum().backward()
        assert moved.grad is not None
        assert corners.grad is not None
        torch.testing.assert_close(moved.grad.cpu(), corners.grad, rtol=1e-6, atol=1e-9)
