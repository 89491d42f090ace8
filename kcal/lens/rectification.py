"""Stereo rectification: both images of a rig as two pinholes side by side see them, so that rows are epipolar lines.

The new x axis lies along the baseline, the new z axis between both cameras' axes (A. Fusiello, E. Trucco and A. Verri,
"A compact algorithm for rectification of stereo pairs", 2000). Both pinholes have one focal length and one principal
point, so that far things have no disparity and depth is f b / disparity.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.checks import Float64Module, as_points
from kcal.dispatch import still
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.images import Undistort
from kcal.lens.pinhole import TurnedCamera, inner_rectangle, outer_rectangle
from kcal.lens.rig import StereoRig
from kcal.lens.views import pinhole_view

# Between the baseline and a camera's axis, degrees: nearer, the rectified images are stretched beyond use.
_LEAST_ANGLE = 20.0


class StereoRectification(Float64Module):
    """Resample both images of a rig so that the same thing is in the same row of both.

    Convention: the rectified frame has its origin in the left camera; points_left = rotation @ points_rectified, and
    the right pinhole stands at (baseline, 0, 0). Disparity is the column in the left minus that in the right image.
    The frame and the new camera are chosen once, from the rig as it stands: they have no gradients by it. Images have
    gradients by images and by the cameras' parameters.

    Args:
        rig: two cameras.
        alpha: 0 keeps only pixels that both cameras show far away, 1 all that either shows.
        size: (width, height) of the new images; that of the left camera if not given.
        field_of_view: horizontal, degrees, in place of what `alpha` chooses.
        at: range of what is seen, meters; it matters for lenses with an entrance pupil that moves.

    Raises:
        InputError: alpha, field of view or size that cannot be.
        DegenerateError: the cameras look along their baseline, or in directions that have nothing in common.

    Example:
        >>> camera = Camera.build(focal=(500, 500), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.2])
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-2.0, 0.0, 0.0]))
        >>> rectify = StereoRectification(rig)
        >>> left, right, mask_left, mask_right = rectify(torch.rand(1, 3, 480, 640), torch.rand(1, 3, 480, 640))
        >>> tuple(left.shape), bool(mask_left.all())
        ((1, 3, 480, 640), True)
        >>> depth = rectify.depth(torch.tensor([10.0]))  # two cameras 2 m apart
        >>> bool(torch.isclose(depth, rectify.camera.focal[0] * 2 / 10))
        True
    """

    rotation: Tensor

    def __init__(
        self,
        rig: StereoRig,
        *,
        alpha: float = 0.0,
        size: tuple[int, int] | None = None,
        field_of_view: float | None = None,
        at: float = math.inf,
    ) -> None:
        super().__init__()
        self.rig, rig = rig, still(rig)
        turn = _rectified_frame(rig)
        left, right = turn, rig.right_from_left_rotation @ turn
        size = rig.left.size if size is None else size
        if field_of_view is not None:
            self.camera = pinhole_view(field_of_view, size).to(turn.device)
        else:
            self.camera = _common_pinhole((TurnedCamera(rig.left, left), TurnedCamera(rig.right, right)), alpha, size)
        self.left = Undistort(self.rig.left, self.camera, left, at=at)
        self.right = Undistort(self.rig.right, self.camera, right, at=at)
        self.register_buffer("rotation", turn)

    def forward(self, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Rectify images (..., C, H, W), each of its camera's size: left, right, and their masks (..., H', W')."""
        (new_left, mask_left), (new_right, mask_right) = self.left(left), self.right(right)
        return new_left, new_right, mask_left, mask_right

    @property
    def _baseline(self) -> Tensor:
        return self.rig.baseline.detach()

    @property
    def depth_matrix(self) -> Tensor:
        """(4, 4) Q of OpenCV: (X, Y, Z, W) = Q (u, v, disparity, 1), the point being (X, Y, Z) / W, in meters."""
        focal, _, cx, cy, _ = self.camera.params.detach().unbind()
        Q = torch.zeros(4, 4, dtype=torch.float64, device=focal.device)
        Q[0, 0], Q[1, 1], Q[0, 3], Q[1, 3], Q[2, 3], Q[3, 2] = 1.0, 1.0, -cx, -cy, focal, 1.0 / self._baseline
        return Q

    def depth(self, disparity: Tensor) -> Tensor:
        """Depth Z along the rectified axis, meters, of disparities in pixels; infinite where these are not positive."""
        disparity = torch.as_tensor(disparity, dtype=torch.float64)
        ahead = disparity > 0
        reach = self.camera.params.detach()[0] * self._baseline
        return torch.where(ahead, reach / torch.where(ahead, disparity, 1.0), torch.inf)

    def points(self, pixels: Tensor, disparity: Tensor) -> Tensor:
        """Points (..., N, 3) in the rig's frame, meters, of left rectified pixels (..., N, 2) and disparities (..., N).

        Entrance pupils are taken to stand still; `kcal.locate.DisparityRanges` takes the lenses as they are.
        """
        pixels = as_points("pixels", pixels, 2)
        focal, center = self.camera.params.detach()[0], self.camera.params.detach()[2:4]
        plane = (pixels - center) / focal
        ahead = torch.cat([plane, torch.ones_like(plane[..., :1])], -1)
        return self.depth(disparity)[..., None] * ahead @ self.rotation.mT

    def source_pixels(self, pixels: Tensor, disparity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where rectified pixels lie in the images as taken.

        Args:
            pixels: (..., N, 2) of the left rectified image.
            disparity: (..., N).

        Returns:
            left and right (..., N, 2), and valid (..., N).
        """
        pixels = as_points("pixels", pixels, 2)
        moved = pixels - torch.stack([disparity, torch.zeros_like(disparity)], -1)
        found = []
        for module, where in ((self.left, pixels), (self.right, moved)):
            rays, _ = self.camera.unproject(where)
            found.append(TurnedCamera(module.camera, module.rotation, module.at).project_rays(rays))
        return found[0][0], found[1][0], found[0][1] & found[1][1]


def _rectified_frame(rig: StereoRig) -> Tensor:
    """(3, 3) left_from_rectified: x along the baseline, z as nearly as possible between both cameras' axes."""
    rotation = rig.right_from_left_rotation
    center = -rotation.T @ rig.right_from_left_translation
    length = float(center.norm())
    if not length > 0:
        raise DegenerateError("rectification: the cameras stand in one place, so that there is no disparity")
    across = center / length
    # In the left camera's frame, both cameras look along the third rows.
    for name, axis in (("left", torch.eye(3).to(rotation)[2]), ("right", rotation[2])):
        angle = math.degrees(math.acos(min(1.0, abs(float(axis @ across)))))
        if angle < _LEAST_ANGLE:
            raise DegenerateError(
                f"rectification: the {name} camera looks {angle:.0f} degrees from the baseline, at the other camera or "
                f"away from it; at least {_LEAST_ANGLE:g} are needed"
            )
    ahead = torch.eye(3).to(rotation)[2] + rotation[2]
    ahead = ahead - (ahead @ across) * across
    if float(ahead.norm()) < 0.1:
        raise DegenerateError("rectification: the cameras look in opposite directions")
    ahead = ahead / ahead.norm()
    return torch.stack([across, torch.linalg.cross(ahead, across), ahead], -1)


def _common_pinhole(cameras: tuple[TurnedCamera, TurnedCamera], alpha: float, size: tuple[int, int]) -> Camera:
    """One pinhole with square pixels for both cameras."""
    if not 0.0 <= alpha <= 1.0:
        raise InputError(f"alpha {alpha}: a number from 0 (only what both show) to 1 (all that either shows) is needed")
    if min(size) < 2:
        raise InputError(f"rectified images of {size[0]}x{size[1]} px: at least 2 pixels each way are needed")
    last = torch.tensor(size, dtype=torch.float64, device=cameras[0].params.device) - 1
    focal, middle = torch.zeros_like(last[0]), torch.zeros_like(last)
    for share, inner in ((1.0 - alpha, True), (alpha, False)):
        if not share:
            continue
        each = [inner_rectangle(camera, size) if inner else outer_rectangle(camera) for camera in cameras]
        lows, highs = (torch.stack([one[k] for one in each]) for k in (0, 1))
        low, high = (lows.amax(0), highs.amin(0)) if inner else (lows.amin(0), highs.amax(0))
        if not bool((high > low).all()):
            raise DegenerateError("rectification: the cameras have no directions in common; give a field of view")
        scale = last / (high - low)
        focal = focal + share * (scale.max() if inner else scale.min())
        middle = middle + share * 0.5 * (low + high)
    center = 0.5 * last - focal * middle
    values = torch.cat([focal[None], focal[None], center, torch.zeros_like(focal[None])])
    return Camera(values, size=size, model="pinhole")
