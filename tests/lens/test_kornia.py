"""kcal's cameras, rigs and images together with the real kornia."""

import json

import cv2
import kornia.geometry.epipolar as epi
import numpy as np
import pytest
import torch
from kornia.augmentation import (
    ImageSequential,
    RandomCrop,
    RandomHorizontalFlip,
    RandomResizedCrop,
    Resize,
    VideoSequential,
)
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.vector import Vector2, Vector3
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType
from lenses import HYBRID, strong

from kcal import Camera, InputError, Rig
from kcal.lens import ImageTransform, Undistort, UndistortImage, rotation_from_vector
from scripts.make_kornia_vectors import PATH, vectors

POINTS = torch.tensor([[0.1, -0.2, 1.1], [-0.3, 0.2, 1.3], [0.4, 0.3, 2.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
LENSES = {
    "opencv4": [-0.2, 0.05, 1e-3, -5e-4],
    "opencv5": [-0.2, 0.05, 1e-3, -5e-4, 0.01],
    "opencv8": [-0.2, 0.05, 1e-3, -5e-4, 0.01, 0.02, 0.01, 0.003],
    "fisheye4": [0.02, -0.01, 0.003, -0.0005],
}


def camera_with(model: str, lens: list[float], skew: float = 0.0) -> Camera:
    return Camera.build(
        focal=(800, 810), center=(321, 238), size=(640, 480), coefficients=lens, model=model, skew=skew
    )  # fmt: skip


@pytest.mark.parametrize("model", LENSES)
def test_lenses_go_to_kornia_and_come_back(model: str) -> None:
    camera = camera_with(model, LENSES[model])
    there = camera.to_kornia()
    pixels, _ = camera.project(POINTS)
    assert torch.allclose(there.project(Vector3(POINTS)).data, pixels, rtol=0, atol=1e-10)
    again = Camera.from_kornia(there)
    assert again.size == camera.size
    assert torch.allclose(again.project(POINTS)[0], pixels, rtol=0, atol=1e-12)


def test_a_lens_whose_other_coefficients_are_zero_is_held() -> None:
    camera = camera_with("opencv14", [-0.2, 0.05])
    pixels, _ = camera.project(POINTS)
    assert torch.allclose(camera.to_kornia().project(Vector3(POINTS)).data, pixels, rtol=0, atol=1e-10)


@pytest.mark.parametrize("count", [1, 3])
def test_pinholes_in_batches_and_with_skew(count: int) -> None:
    values = torch.tensor([800.0, 810, 321, 238, 2.5], dtype=torch.float64) * torch.linspace(1, 1.2, count)[:, None]
    camera = Camera(values, size=(640, 480), model="pinhole")
    there = camera.to_kornia()
    assert isinstance(there, PinholeCamera)
    points = POINTS.expand(count, -1, 3)
    pixels, _ = camera.project(points)
    assert torch.allclose(there.project(points), pixels, rtol=0, atol=1e-9)
    assert torch.allclose(there.unproject(pixels, points[..., 2:]), points, rtol=0, atol=1e-12)
    assert torch.equal(Camera.from_kornia(there).params, values if count > 1 else values[0])


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (camera_with("opencv12", [-0.2, 0.05, 0, 0, 0, 0, 0, 0, 1e-3]), r"no camera of kornia holds .*refit_camera"),
        (Camera(torch.cat([torch.tensor([800.0, 800, 320, 240, 0]), strong(HYBRID)]), size=(640, 480), model=HYBRID),
         "holds this hybrid lens"),
        (camera_with("opencv5", [-0.2], skew=1.0), "lens with skew"),
        (Camera(torch.tensor([[8e2, 8e2, 320, 240, 0, -0.1, 0, 0, 0]]).repeat(2, 1), size=(640, 480), model="opencv4"),
         "one by one"),
    ],
)  # fmt: skip
def test_what_kornia_does_not_hold_is_refused(camera: Camera, message: str) -> None:
    with pytest.raises(InputError, match=message):
        camera.to_kornia()


def test_what_kcal_does_not_take_is_refused() -> None:
    pinhole = camera_with("pinhole", []).to_kornia()
    pinhole.extrinsics[:, 0, 3] = 1.0
    with pytest.raises(InputError, match="has a pose"):
        Camera.from_kornia(pinhole)
    orthographic = CameraModel(ImageSize(480, 640), CameraModelType.ORTHOGRAPHIC, torch.tensor([1.0, 1, 320, 240]))
    for wrong in (orthographic, torch.eye(3)):
        with pytest.raises(InputError, match="a perspective or Kannala-Brandt camera"):
            Camera.from_kornia(wrong)


def test_unprojection_agrees() -> None:
    camera = camera_with("opencv5", LENSES["opencv5"])
    pixels, _ = camera.project(POINTS)
    theirs = camera.to_kornia().unproject(Vector2(pixels), POINTS[:, 2]).data
    rays, _ = camera.unproject(pixels)
    assert torch.allclose(rays * (POINTS[:, 2:] / rays[:, 2:]), POINTS, rtol=0, atol=1e-12)
    assert torch.allclose(theirs, POINTS, rtol=0, atol=1e-3)  # five steps of a fixed iteration


def rig_with(lens: list[float]) -> Rig:
    turn = rotation_from_vector(torch.tensor([0.01, -0.03, 0.02], dtype=torch.float64))
    right = Camera.build(focal=(700, 705), center=(330, 236), size=(640, 480), coefficients=lens)
    return Rig.pair(camera_with("opencv5", lens), right, turn, torch.tensor([-1.0, 0.05, 0.02]))


def test_a_pinhole_rig_in_the_epipolar_functions() -> None:
    rig = rig_with([])
    points = POINTS * 5
    left, right = rig(points)[0].unbind(-2)
    assert float(epi.sampson_epipolar_distance(left[None], right[None], rig.fundamental[None]).max()) < 1e-18
    wrong = epi.sampson_epipolar_distance(left[None], right[None] + torch.tensor([0.0, 1.0]), rig.fundamental[None])
    assert float(wrong.min()) > 0.1
    found = epi.find_fundamental(left[None].repeat(1, 2, 1), right[None].repeat(1, 2, 1), torch.ones(1, 8).double())
    assert found.shape == (1, 3, 3)
    pose = rig.right_from_left_rotation[None], rig.right_from_left_translation[None, :, None]
    still = torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, 1, dtype=torch.float64)
    both = (rig.left, still), (rig.right, pose)
    matrices = [epi.projection_from_KRt(camera.matrix[None], *at) for camera, at in both]
    back = epi.triangulate_points(*matrices, left[None], right[None], solver="svd")
    assert torch.allclose(back[0], points, rtol=0, atol=1e-8)


def test_a_rig_with_lenses_by_rays() -> None:
    rig = rig_with([-0.25, 0.05])
    left, right = rig(POINTS * 5)[0].unbind(-2)
    planes = [camera.normalize(pixels)[0][None] for camera, pixels in ((rig.left, left), (rig.right, right))]
    assert float(epi.sampson_epipolar_distance(*planes, rig.essential[None]).max()) < 1e-24
    shift = rig.right_from_left_translation
    pose = epi.motion_from_essential_choose_solution(
        rig.essential[None], torch.eye(3).double()[None], torch.eye(3).double()[None], *planes
    )
    assert torch.allclose(pose[0][0], rig.right_from_left_rotation, atol=1e-9)
    assert torch.allclose(pose[1][0, :, 0], shift / shift.norm(), atol=1e-9)
    with pytest.raises(InputError, match="left lens distorts"):
        _ = rig.fundamental


def test_a_posed_rig_goes_to_kornia_and_comes_back() -> None:
    rig = rig_with([])
    left, right = rig.to_kornia()
    points = POINTS * 5
    for camera, pixels in zip((left, right), rig(points)[0].unbind(-2), strict=True):
        assert torch.allclose(camera.project(points[None])[0], pixels, rtol=0, atol=1e-9)
    # The frame may stand anywhere.
    moved = torch.eye(4).double()
    moved[:3, :3], moved[:3, 3] = rotation_from_vector(torch.tensor([0.3, -0.5, 1.0]).double()), torch.tensor([5, 6, 7])
    placed = [PinholeCamera(c.intrinsics, c.extrinsics @ moved, c.height, c.width) for c in (left, right)]
    again = Rig.from_kornia(*placed)
    assert torch.allclose(again.right_from_left_rotation, rig.right_from_left_rotation, atol=1e-14)
    assert torch.allclose(again.right_from_left_translation, rig.right_from_left_translation, atol=1e-13)
    assert torch.equal(again.left.params, Camera.from_kornia(camera_with("pinhole", []).to_kornia()).params)
    with pytest.raises(InputError, match="left camera has a lens"):
        rig_with([-0.2]).to_kornia()
    with pytest.raises(InputError, match=r"extrinsics \(1, 4, 4\) is needed, got Tensor"):
        Rig.from_kornia(torch.eye(3), right)


@pytest.mark.parametrize(
    "augment",
    [Resize((120, 200), align_corners=True), Resize((120, 200), align_corners=False), RandomCrop((90, 110)),
     RandomResizedCrop((96, 128), scale=(0.4, 0.6), cropping_mode="resample")],
    ids=["resize, centers", "resize, edges", "crop", "crop and resize"],
)  # fmt: skip
def test_transforms_of_augmentations_are_those_of_their_pixels(augment: torch.nn.Module) -> None:
    """A ramp of columns and one of rows: the value at an input pixel is where it lies in the full image."""
    torch.manual_seed(3)
    x, y = torch.meshgrid(torch.arange(160.0), torch.arange(120.0), indexing="xy")
    seen = augment(torch.stack([x, y])[None].repeat(2, 1, 1, 1))
    size = seen.shape[3], seen.shape[2]
    transforms = ImageTransform.from_matrices(augment.transform_matrix, (160, 120), size)  # type: ignore[arg-type]
    pixels = torch.tensor([[40.0, 30.0], [61.0, 52.0], [70.0, 44.0]])
    for image, transform in zip(seen, transforms, strict=True):
        wanted = image[:, pixels[:, 1].long(), pixels[:, 0].long()].T.double()
        assert torch.allclose(transform.to_full(pixels), wanted, rtol=0, atol=2e-3)


def test_what_no_camera_sees_is_refused() -> None:
    turned = RandomHorizontalFlip(p=1.0)
    turned(torch.rand(1, 1, 48, 64))
    with pytest.raises(InputError, match="number 0 turns, mirrors"):
        ImageTransform.from_matrices(turned.transform_matrix, (64, 48), (64, 48))
    with pytest.raises(InputError, match=r"\(B, 3, 3\)"):
        ImageTransform.from_matrices(torch.eye(3), (64, 48), (64, 48))


def test_undistort_in_sequences() -> None:
    camera = camera_with("opencv5", [-0.2, 0.05])
    image = torch.rand(2, 3, 480, 640)
    wanted = Undistort(camera)(image)[0]
    assert torch.equal(ImageSequential(UndistortImage(camera), RandomHorizontalFlip(p=1.0))(image), wanted.flip(-1))
    video = torch.rand(1, 3, 2, 480, 640)  # B C T H W
    frames = torch.stack([Undistort(camera)(video[:, :, i])[0] for i in range(2)], 2)
    flow = VideoSequential(UndistortImage(camera), RandomHorizontalFlip(p=1.0), data_format="BCTHW")
    assert torch.equal(flow(video), frames.flip(-1))


def test_the_vectors_for_kornia_are_what_is_computed() -> None:
    """tests/kornia_conformance/vectors.json; OpenCV agrees with its pixels."""
    stored, made = json.loads(PATH.read_text()), vectors()
    for old, new in zip(stored["cameras"], made["cameras"], strict=True):
        assert old["type"] == new["type"]
        for key in ("params", "points", "pixels", "pixels_by_point", "pixels_by_params"):
            wanted = torch.tensor(new[key], dtype=torch.float64)
            torch.testing.assert_close(torch.tensor(old[key], dtype=torch.float64), wanted, rtol=1e-11, atol=1e-11)
        fx, fy, cx, cy, *lens = new["params"]
        matrix, zero = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.zeros(3)
        points = np.array(new["points"])
        if new["type"] == "KANNALA_BRANDT_K3":
            seen = cv2.fisheye.projectPoints(points[:, None], zero, zero, matrix, np.array(lens))[0][:, 0]
        else:
            seen = cv2.projectPoints(points, zero, zero, matrix, np.array(lens or [0.0] * 4))[0][:, 0]
        assert np.abs(seen - np.array(new["pixels"])).max() < 1e-9
