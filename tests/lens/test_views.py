"""Cylinders, turned views, stereo rectification and rays, against OpenCV and against the cameras themselves."""

import math
import warnings

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from kcal import Camera, DegenerateError, InputError, Rig
from kcal.lens import StereoRectification, Undistort, rotation_from_vector, undistort_maps
from kcal.lens.camera_like import CameraRays, ray_error
from kcal.lens.views import Cylinder, cylinder_view, looking, pinhole_view, pupil_shift, shown_by
from kcal.locate import DisparityRanges
from kcal.rig import RigCovariance
from tests.helpers.lenses import HYBRID

F64 = torch.float64
LEFT = Camera.build(focal=(500, 500), center=(322, 238), size=(640, 480), coefficients=[-0.2, 0.03])
RIGHT = Camera.build(focal=(510, 508), center=(312, 242), size=(640, 480), coefficients=[-0.18, 0.02, 1e-3, 5e-4])
TURN = rotation_from_vector(torch.tensor([0.02, -0.1, 0.03], dtype=F64))
RIG = Rig.pair(LEFT, RIGHT, TURN, -TURN @ torch.tensor([2.0, 0.1, 0.05], dtype=F64))


def with_pupil(first: float = 0.004) -> Camera:
    """A hybrid camera whose entrance pupil moves by `first` meters at one radian."""
    values = torch.zeros(5 + HYBRID.size, dtype=F64)
    values[:4] = torch.tensor([100.0, 100.0, 79.5, 59.5])
    values[6] = first
    return Camera(values, size=(160, 120), model=HYBRID)


def points(count: int = 200) -> Tensor:
    spread = torch.rand(count, 3, dtype=F64, generator=torch.Generator().manual_seed(1))
    return spread * torch.tensor([20.0, 15.0, 80.0]) + torch.tensor([-10.0, -7.0, 20.0])


class TestViews:
    def test_turned_pinhole_as_opencv(self) -> None:
        """OpenCV's rectification map with a rotation has the same source positions."""
        view, turn = pinhole_view(40.0, (400, 300)), looking(10.0, -6.0)
        maps = undistort_maps(LEFT, view, turn)
        lens = np.array([-0.2, 0.03, 0, 0, 0])
        x, y = cv2.initUndistortRectifyMap(
            LEFT.matrix.numpy(), lens, turn.T.numpy(), view.matrix.numpy(), (400, 300), cv2.CV_32FC1
        )
        assert maps.mask.all()
        assert max(np.abs(maps.map_x - x).max(), np.abs(maps.map_y - y).max()) < 1e-3

    @pytest.mark.parametrize(("pan", "tilt", "sign"), [(20.0, 0.0, (1, 0)), (0.0, 20.0, (0, -1))])
    def test_directions_of_looking(self, pan: float, tilt: float, sign: tuple[int, int]) -> None:
        """Right is +x, up is -y: the new middle lies there in the source."""
        maps = undistort_maps(LEFT, pinhole_view(10.0, (101, 101)), looking(pan, tilt))
        offset = np.array([maps.map_x[50, 50] - 322, maps.map_y[50, 50] - 238])
        assert np.array_equal(np.sign(np.round(offset)), sign)

    def test_cylinder(self) -> None:
        """Points of a vertical line are in one column; the picture is as wide as the image sees."""
        view = cylinder_view(LEFT)
        line = torch.stack([torch.full((9,), 1.0), torch.linspace(-1, 1, 9), torch.full((9,), 4.0)], -1).double()
        seen, _ = view.project(line)
        assert float(seen[:, 0].std()) < 1e-9
        back, valid = view.unproject(seen)
        assert bool(valid.all())
        assert torch.allclose(back, line / line.norm(dim=-1, keepdim=True))
        left, _ = LEFT.unproject(LEFT.grid(3, 3)[1, :1])
        assert torch.allclose(view.project(left)[0][0, 0], torch.zeros((), dtype=F64), atol=1e-9)
        shown = shown_by(LEFT, view, torch.eye(3, dtype=F64), Undistort(LEFT, view).mask)
        assert shown.valid > 0.9
        assert shown.source > 0.9

    def test_shown(self) -> None:
        """A view of half the tangents shows a quarter of a pinhole's image."""
        camera = pinhole_view(90.0, (641, 641))
        view = pinhole_view(math.degrees(2 * math.atan(0.5)), (641, 641))
        found = shown_by(camera, view, torch.eye(3, dtype=F64), torch.ones(641, 641))
        assert abs(found.source - 0.25) < 0.02
        assert abs(found.degrees[0] - 53.13) < 0.01

    def test_range_and_pupil(self) -> None:
        """Maps for a range are the camera's own projection; the shift is what they differ by from those far away."""
        camera, view = with_pupil(), pinhole_view(60.0, (81, 61))
        near, far = undistort_maps(camera, view, at=1.0), undistort_maps(camera, view)
        rays, _ = view.unproject(torch.tensor([[70.0, 50.0]]))
        pixel, _ = camera.project(rays)
        assert abs(near.map_x[50, 70] - float(pixel[0, 0])) < 1e-4
        apart = np.hypot(near.map_x - far.map_x, near.map_y - far.map_y)
        shift = pupil_shift(camera, 1.0)
        assert 0.05 < apart.max() < shift
        assert abs(pupil_shift(camera, 2.0) / shift - 0.5) < 0.01
        assert pupil_shift(LEFT, 1.0) == 0.0

    @pytest.mark.parametrize(
        "make",
        [
            lambda: pinhole_view(175.0, (64, 48)),
            lambda: Cylinder(focal=10.0, center=(0.0, 0.0), size=(100, 10)),
            lambda: cylinder_view(LEFT, 400.0),
            lambda: Undistort(LEFT, at=0.0),
            lambda: Undistort(LEFT, rotation=torch.eye(2)),
        ],
    )
    def test_refused(self, make: object) -> None:
        with pytest.raises(InputError):
            make()  # type: ignore[operator]


class TestStereo:
    @pytest.mark.parametrize("options", [{}, {"alpha": 1.0}, {"field_of_view": 50.0}], ids=str)
    @pytest.mark.parametrize("rolled", [0.0, 180.0])
    @pytest.mark.parametrize(
        ("place", "axis", "sign"),
        [
            ((2.0, 0.1, 0.05), 0, 1), ((-2.0, 0.1, 0.05), 0, -1), ((0.1, 2.0, 0.05), 1, 1), ((0.1, -2.0, 0.05), 1, -1),
            ((2.0, -1.6, 0.0), 0, 1),
        ],
        ids=["right", "left", "below", "above", "diagonal"],
    )  # fmt: skip
    def test_rows_and_disparity(
        self, place: tuple[float, float, float], axis: int, sign: int, rolled: float, options: dict[str, float]
    ) -> None:
        """A point is in one row, or column, of both upright images, as OpenCV's; its disparity gives it back."""
        turn = rotation_from_vector(torch.tensor([0.0, 0.0, math.radians(rolled)], dtype=F64)) @ TURN
        shift = -turn @ torch.tensor(place, dtype=F64)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rig = Rig.pair(LEFT, RIGHT, turn, shift)
        rectify, there = StereoRectification(rig, **options), points()
        if not rolled:
            lens, more = np.array([-0.2, 0.03, 0, 0, 0]), np.array([-0.18, 0.02, 1e-3, 5e-4, 0])
            first, _, _, second, Q, *_ = cv2.stereoRectify(
                LEFT.matrix.numpy(), lens, RIGHT.matrix.numpy(), more, (640, 480), turn.numpy(), shift[:, None].numpy()
            )
            assert np.abs(second[axis, 3]) > np.abs(second[1 - axis, 3])
            assert abs(float(rectify.depth_matrix[3, 2]) - Q[3, 2]) < 1e-9
            assert np.abs(first.T - rectify.rotation.numpy()).max() < 0.02
        # Upright: x of the left image lies in its half; all of what both show has a source.
        assert float(rectify.rotation[0, 0]) > 0.7
        if not options:
            assert bool(rectify.left.mask.all() and rectify.right.mask.all())
            assert rectify.camera.focal[0] < (2000 if place[1] == -1.6 else 900)
        pixels, valid = rig(there)
        (seen_left, seen_right), valid = pixels.unbind(-2), valid.all(-1)
        turned = there @ rectify.rotation
        left, _ = rectify.camera.project(turned)
        right, _ = rectify.camera.project(turned - rectify.right_center)
        assert float((left - right)[:, 1 - axis].abs().max()) < 1e-9
        disparity = (left - right)[:, axis]
        assert float((sign * disparity).min()) > 0
        assert not bool(rectify.depth(-disparity).isfinite().any())
        source_left, source_right, _ = rectify.source_pixels(left, disparity)
        assert float((source_left - seen_left)[valid].abs().max()) < 1e-9
        assert float((source_right - seen_right)[valid].abs().max()) < 1e-5
        assert float((rectify.points(left, disparity) - there).abs().max()) < 1e-4
        # As OpenCV reads the matrix.
        homogeneous = torch.cat([left, disparity[:, None], torch.ones_like(disparity)[:, None]], -1)
        found = homogeneous @ rectify.depth_matrix.T
        assert float((found[:, :3] / found[:, 3:] - turned).abs().max()) < 1e-6
        at = DisparityRanges(rectify).at(left[valid], disparity[valid])
        assert float((at.range - there[valid].norm(dim=-1)).abs().max()) < 1e-4

    @pytest.mark.parametrize("alpha", [0.0, 1.0])
    def test_alpha(self, alpha: float) -> None:
        """0: every pixel has a source in both; 1: all of either source is shown."""
        rectify = StereoRectification(RIG, alpha=alpha)
        for side in (rectify.left, rectify.right):
            shown = shown_by(side.camera, rectify.camera, side.rotation, side.mask)
            assert shown.valid == 1.0 if alpha == 0 else shown.source == 1.0

    def test_images(self) -> None:
        """Both modules resample, batches included."""
        images = torch.rand(2, 1, 480, 640)
        left, right, mask_left, mask_right = StereoRectification(RIG, size=(64, 48))(images, images)
        assert left.shape == right.shape == (2, 1, 48, 64)
        assert bool(mask_left.all() and mask_right.all())

    def test_ranges(self) -> None:
        """Ranges are those of the points; sigma is r² / (f b) of the disparity's, and grows with the rig's."""
        rectify, there = StereoRectification(RIG), points(50)
        turned = there @ rectify.rotation
        left, _ = rectify.camera.project(turned)
        disparity = rectify.camera.focal[0].detach() * RIG.baseline / turned[:, 2]
        found = DisparityRanges(rectify, disparity_sigma=0.3).at(left, disparity)
        ranges, ok = there.norm(dim=-1), found.valid
        assert int(ok.sum()) > 30
        assert float((found.range - ranges)[ok].abs().max()) < 1e-4
        assert float((found.sigma / (0.3 * ranges / disparity) - 1)[ok].abs().max()) < 0.05
        known = Rig.pair(LEFT, RIGHT, TURN, RIG.right_from_left_translation)
        yaw = torch.zeros(6, dtype=F64)
        yaw[1] = 1e-3**2
        known.covariance = RigCovariance.of(known, pose=torch.diag(yaw))
        wider = DisparityRanges(StereoRectification(known), disparity_sigma=0.3).at(left, disparity)
        # A milliradian of yaw is half a pixel of disparity.
        ratio = wider.sigma[ok] / found.sigma[ok]
        assert 1.8 < float(ratio.median()) < 2.1
        nothing = DisparityRanges(rectify).at(left[:2], torch.tensor([0.0, math.nan], dtype=F64))
        assert not bool(nothing.valid.any())
        assert bool(nothing.sigma.isinf().all())

    def test_refused(self) -> None:
        ahead = Rig.pair(LEFT, RIGHT, torch.eye(3), torch.tensor([0.0, 0.0, -1.0]))
        with pytest.raises(DegenerateError, match="the left camera looks 0 degrees from the baseline"):
            StereoRectification(ahead)
        with pytest.raises(InputError, match="alpha"):
            StereoRectification(RIG, alpha=2.0)
        for degrees, options, text in (
            (175.0, {}, "the left camera looks 88 degrees away"),
            (120.0, {}, "no directions in common"),
            (120.0, {"field_of_view": 30.0}, "the left camera shows nothing of this field of view"),
        ):
            turn = rotation_from_vector(torch.tensor([math.radians(degrees), 0.0, 0.0], dtype=F64))
            with pytest.raises(DegenerateError, match=text):
                StereoRectification(Rig.pair(LEFT, RIGHT, turn, -turn[:, 0]), **options)


class TestRays:
    def test_as_opencv(self) -> None:
        """Directions are those of cv2.undistortPoints at pixel centers; rounding is below a thousandth of a pixel."""
        rays = CameraRays(LEFT)()
        assert rays.shape == (1, 480, 640, 6)
        assert rays.dtype == torch.float32
        grid = LEFT.grid(640, 480).numpy()[::40, ::40].reshape(-1, 1, 2)
        lens = np.array([-0.2, 0.03, 0, 0, 0])
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        plane = cv2.undistortPoints(grid, LEFT.matrix.numpy(), lens, criteria=criteria)[:, 0]
        ours = rays[0, ::40, ::40, 3:].reshape(-1, 3).double()
        assert np.abs((ours[:, :2] / ours[:, 2:]).numpy() - plane).max() < 2e-7
        assert bool((rays[..., :3] == 0).all())
        assert ray_error(LEFT, rays[0]) < 1e-3

    def test_pupil_in_the_world(self) -> None:
        """Points along the rays of a turned camera are seen in their pixels at any range; origins are not one point."""
        camera = with_pupil()
        viewmat = torch.eye(4, dtype=F64)
        viewmat[:3, :3], viewmat[:3, 3] = TURN, torch.tensor([3.0, -1.0, 2.0])
        rays = CameraRays(camera)(viewmat[None, None], dtype=F64)[0, 0]
        assert float(rays[..., :3].reshape(-1, 3).std(0).max()) > 1e-4
        for at in (0.5, 50.0):
            there = rays[..., :3] + at * rays[..., 3:]
            seen, valid = camera.project(there.reshape(-1, 3) @ TURN.T + viewmat[:3, 3])
            assert bool(valid.all())
            assert float((seen - camera.grid(160, 120).reshape(-1, 2)).abs().max()) < 1e-6

    def test_pixels_without_rays(self) -> None:
        folding = Camera.build(focal=(60, 60), center=(79.5, 59.5), size=(160, 120), coefficients=[-0.4])
        module = CameraRays([folding, folding])
        assert not bool(module.mask.all())
        assert bool((module()[~module.mask] == 0).all())
        assert ray_error(folding, module()[0]) < 1e-3

    def test_refused(self) -> None:
        with pytest.raises(InputError, match="images of one size"):
            CameraRays([LEFT, with_pupil()])
        with pytest.raises(InputError, match="no rotation"):
            CameraRays(LEFT)(2.0 * torch.eye(4)[None])


@pytest.mark.parametrize("place", [(-0.12, 0, 0), (0.12, 0, 0), (0, -0.12, 0), (0, 0.12, 0), (-0.12, -0.1, 0)])
def test_rectified_pairs_stay_upright_wherever_the_second_camera_is(place: tuple[float, float, float]) -> None:
    """A dot near the top of the image stays there, but where the baseline is vertical, and nothing is refused."""
    camera = Camera.build(focal=(450, 450), center=(319.5, 179.5), size=(640, 360), model="pinhole")
    rig = Rig.pair(camera, camera, torch.eye(3, dtype=F64), torch.tensor(place, dtype=F64))
    image = torch.zeros(1, 1, 360, 640, dtype=F64)
    image[..., 50, 320] = 1
    seen = StereoRectification(rig, field_of_view=60.0)(image, image)[0][0, 0]
    row, column = divmod(int(seen.argmax()), seen.shape[1])
    assert seen.max() > 0
    assert row < seen.shape[0] / 2
    # What is straight ahead of an upright pair stays above the middle column.
    assert abs(column - seen.shape[1] / 2) < 0.2 * seen.shape[1]
