"""Rigs, localizers and `Undistort` with cameras of other makes: baked ones, and a class of a user."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from kcal import Camera, InputError, Localizer, Origin, Rig, save_rig
from kcal.lens import CameraLike, StereoRectification, Undistort, Unproject, bake, undistort_maps
from kcal.lens.camera_like import as_camera
from kcal.nets import InverseNet
from kcal.track import PairBoxes

MODEL = Camera.build(focal=(900, 900), center=(322, 238), size=(640, 480), coefficients=[-0.1, 0.02, 1e-3, -5e-4, 0.0])


class Mine(nn.Module):
    """A pinhole with a weight, whose image is scaled: as small as a camera can be."""

    size = (640, 480)

    def __init__(self) -> None:
        super().__init__()
        self.focal_length = nn.Parameter(torch.tensor(900.0, dtype=torch.float64))

    def project(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        ahead = points_cam[..., 2] > 0
        depth = torch.where(ahead, points_cam[..., 2], 1.0)[..., None]
        return self.focal_length * points_cam[..., :2] / depth + points_cam.new_tensor([320.0, 240.0]), ahead

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        plane = (pixels - pixels.new_tensor([320.0, 240.0])) / self.focal_length
        rays = torch.cat([plane, torch.ones_like(plane[..., :1])], -1)
        return rays / rays.norm(dim=-1, keepdim=True), torch.isfinite(pixels).all(-1)

    def inside(self, pixels: Tensor) -> Tensor:
        return ((pixels >= -0.5) & (pixels <= pixels.new_tensor([639.5, 479.5]))).all(-1)


PLAIN = Camera.build(focal=(900, 900), center=(320, 240), size=(640, 480), model="pinhole")
KINDS = {"baked": (lambda: bake(MODEL, tolerance=1e-5), MODEL), "mine": (Mine, PLAIN)}
every = pytest.mark.parametrize("kind", KINDS)
POINTS = torch.tensor([[3.0, 2.0, 60.0], [15.0, -8.0, 120.0], [5.0, 1.0, 900.0]], dtype=torch.float64)


def rig(*cameras: Any) -> Rig:
    return Rig.pair(*cameras, torch.eye(3), torch.tensor([-8.0, 0.0, 0.0]))


@every
def test_positions_are_those_of_the_camera_that_it_stands_for(kind: str) -> None:
    """One of each make in a rig, too."""
    make, camera = KINDS[kind]
    assert isinstance(make(), CameraLike)
    pixels = rig(camera, camera)(POINTS)[0].unbind(-2)
    origin = Origin(lat=50.0, lon=8.0, height=100.0)
    for pair in ((make(), make()), (make(), camera), (camera, make())):
        localize = [
            Localizer(rig(*cameras).placed(origin=origin, heading_deg=30.0), pixel_sigma=0.1)
            for cameras in (pair, (camera, camera))
        ]
        found, wanted = (one(*pixels) for one in localize)
        assert torch.equal(found.status, wanted.status)
        # The table's error: 1e-5 px at a parallax of 8 px, for the farthest point.
        torch.testing.assert_close(found.enu, wanted.enu, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(found.covariance, wanted.covariance, rtol=1e-3, atol=1e-9)
    many = Rig([make(), camera, make()], ["a", "b", "c"], torch.eye(3).repeat(3, 1, 1), center=4.0 * torch.eye(3))
    seen, visible = many(POINTS)
    assert bool(visible.all())
    torch.testing.assert_close(Localizer(many, pixel_sigma=0.1)(seen).enu, POINTS, rtol=1e-4, atol=1e-4)


def test_gradients_reach_the_weights_of_a_users_camera() -> None:
    mine = Mine()
    pixels = [part.detach() for part in rig(PLAIN, PLAIN)(POINTS)[0].unbind(-2)]
    (gradient,) = torch.autograd.grad(Localizer(rig(mine, mine))(*pixels).enu[..., 2].sum(), mine.focal_length)
    # The depth is the focal length times the baseline over the disparity.
    assert float(gradient) == pytest.approx(float(POINTS[:, 2].sum()) / 900.0, rel=1e-6)


@every
def test_images_are_undistorted(kind: str) -> None:
    make, camera = KINDS[kind]
    image = torch.rand(1, 3, 480, 640)
    pinhole = Camera.build(focal=(880, 880), center=(319.5, 239.5), size=(640, 480), model="pinhole")
    (found, mask), (wanted, also) = (Undistort(one, pinhole)(image) for one in (make(), camera))
    assert float((mask == also).double().mean()) > 0.999
    torch.testing.assert_close(found[..., mask[0] & also[0]], wanted[..., mask[0] & also[0]], rtol=0, atol=1e-4)
    assert undistort_maps(make()).mask.mean() > 0.99


def test_what_needs_parameters_is_refused(tmp_path: Path) -> None:
    baked = rig(bake(MODEL), MODEL)
    for use in (
        lambda: save_rig(baked, tmp_path / "rig.json"),
        lambda: baked.left.free("fx"),
        lambda: baked.left.focal,
    ):
        with pytest.raises(InputError, match=r"a LookupCamera has no \w+: only its projection is known"):
            use()
    with pytest.raises(InputError, match="distorts"):
        assert rig(Mine(), Mine()).fundamental.shape == (3, 3)
    with pytest.raises(InputError, match="size, project, unproject and inside; got Linear"):
        rig(nn.Linear(2, 2), MODEL)
    changed = rig(Mine(), Mine())
    before = changed.fingerprint
    with torch.no_grad():
        changed.left.get_parameter("camera.focal_length").mul_(1.1)
    assert changed.fingerprint != before


def test_a_users_camera_unprojects_as_a_module() -> None:
    pixels = torch.tensor([[300.0, 200.0]])
    torch.testing.assert_close(Unproject(Mine())(pixels)[0], as_camera(Mine()).unproject(pixels)[0])
    with pytest.raises(InputError, match="start: it begins Newton's method"):
        Unproject(Mine(), InverseNet(MODEL))


def test_rigs_of_batches_of_cameras_are_refused_where_single_ones_are_needed() -> None:
    several = Camera(MODEL.params.detach().repeat(3, 1), size=MODEL.size, model=MODEL.model)
    both = rig(several, several)
    for use in (StereoRectification, PairBoxes, lambda own: Localizer(own, weights="all")):
        with pytest.raises(InputError, match=r"single cameras are needed; left is a batch of \(3,\)"):
            use(both)
