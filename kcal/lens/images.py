"""Undistort and rectify images: where each new pixel comes from, of one camera and of both of a rig."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from kcal.checks import Float64Module, StatedModule, as_points, as_tensor
from kcal.dispatch import is_differentiated, is_traced, may_branch, still
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.camera_like import CameraLike, as_camera, check_single
from kcal.lens.rig import Rig
from kcal.lens.views import (
    Cylinder,
    TurnedCamera,
    inner_rectangle,
    new_pinhole,
    outer_rectangle,
    pinhole_view,
    source_pixels,
)
from kcal.texts import brief, briefly

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


# Undistort and rectify images: compute the source position of each new pixel, and resample.
#
# Each pixel of the new image is a ray, and the source camera projects it. Positions are computed in float64. Sampling
# runs in the image's own precision, to which positions are rounded once: in float32 that moves a sample by less than W
# * 1.2e-7 px (0.0003 px at 1920 columns). float16 and bfloat16 images are sampled in float32, because 8 to 11 bits are
# too few for a position.

# Position of pixels without a source: far outside, so that the sampler returns its border value (black) and never a
# plausible pixel.
NOWHERE = -1e4
# Pixels computed at a time, so that temporary values stay small for any image.
_BAND = 1 << 18
_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_INTEGERS = (torch.uint8, torch.uint16)


@briefly
class UndistortMaps(NamedTuple):
    """Source positions for `cv2.remap` (float32), and a mask of the pixels that have one; each (H, W)."""

    map_x: NDArray[np.float32]
    map_y: NDArray[np.float32]
    mask: NDArray[np.bool_]


def undistort_maps(
    camera: Camera | CameraLike,
    new_camera: Camera | Cylinder | None = None,
    rotation: Tensor | None = None,
    *,
    at: float = math.inf,
) -> UndistortMaps:
    """Compute maps for `cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR)`.

    Convention: new pixel (column x, row y) takes the source's value at (map_x[y, x], map_y[y, x]); whole numbers are
    pixel centers. Where the source shows nothing, the mask is False and both maps are -10000, so that OpenCV's default
    border makes the pixel black. That is outside the centers of the source's outer pixels, and beyond a fold of its
    lens.

    Args:
        camera: the single camera that took the image.
        new_camera: the camera of the new image, by default `new_pinhole(camera)`, or a `Cylinder`. If it has a lens,
            the new image is distorted by that lens.
        rotation: (3, 3) camera_from_new: where the new camera looks; by default where the camera does.
        at: range of what is seen, meters. It matters for lenses with an entrance pupil that moves (`pupil_shift`).

    Returns:
        map_x, map_y (float32) and mask (bool) as NumPy arrays (H, W) of the new image's size. Rounding to float32
        moves positions by up to 1e-4 px at 1920 columns.

    Raises:
        InputError: a batch of cameras, or an image less than two pixels wide or high.
        DegenerateError: see `new_pinhole`.

    Example:
        >>> camera = Camera.build(focal=(500, 500), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.2])
        >>> maps = undistort_maps(camera)
        >>> maps.map_x.shape, bool(maps.mask.all()), [round(float(maps.map_x[240, i]), 3) for i in (0, 639)]
        ((480, 640), True, [0.0, 639.0])
    """
    source: Camera = as_camera(camera)
    with torch.no_grad():
        pixels, mask = _source_positions(source, new_camera or new_pinhole(source), rotation, at)
    if mask.ndim != 2:
        raise InputError(f"undistort_maps: a single camera is needed, not a batch of {tuple(mask.shape[:-2])}")
    map_x, map_y = pixels.to("cpu", torch.float32).unbind(-1)
    return UndistortMaps(map_x.contiguous().numpy(), map_y.contiguous().numpy(), mask.cpu().numpy())


class Undistort(StatedModule):
    """Resample images as another camera, usually a pinhole, would have taken them.

    Sampling is bilinear, as kornia's `remap` with `align_corners=True`: integer coordinates are pixel centers. Where
    the source shows nothing, the image is 0 and the mask False (see `undistort_maps`).

    The maps are computed once and kept, for one precision at a time. They are updated when the parameters of a camera
    change. While a camera requires gradients, they are computed at each call, and gradients also reach its parameters.
    The new camera does not change with the old one.

    Args:
        camera: the camera that took the images, a batch of cameras, or a `CameraLike`.
        new_camera: the camera of the new images, single or a batch, or a `Cylinder`. By default `new_pinhole(camera)`,
            for which every new pixel is valid.
        rotation: (..., 3, 3) camera_from_new: where the new cameras look; by default where the cameras do.
        at: range of what is seen, meters. It matters for lenses with an entrance pupil that moves (`pupil_shift`).

    Raises:
        InputError: an image less than two pixels wide or high, or batches of cameras that do not broadcast.
        DegenerateError: see `new_pinhole`.

    Example:
        >>> camera = Camera.build(focal=(500, 500), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.2])
        >>> undistort = Undistort(camera)
        >>> image, mask = undistort(torch.rand(2, 3, 480, 640))
        >>> image.shape, mask.shape, bool(mask.all())
        (torch.Size([2, 3, 480, 640]), torch.Size([2, 480, 640]), True)
    """

    grid: Tensor
    mask: Tensor
    rotation: Tensor
    _made_from: Tensor

    def __init__(
        self,
        camera: Camera | CameraLike,
        new_camera: Camera | Cylinder | None = None,
        rotation: Tensor | None = None,
        *,
        at: float = math.inf,
    ) -> None:
        super().__init__()
        self.camera: Camera = as_camera(camera)
        self.new_camera = new_pinhole(self.camera) if new_camera is None else new_camera
        self.at = at
        turn = torch.eye(3) if rotation is None else rotation
        turn = turn if is_differentiated(turn) else turn.detach()
        self.register_buffer("rotation", turn.to(self.camera.params), persistent=rotation is not None)
        for name, value in zip(("grid", "mask"), self._grid(torch.float32), strict=True):
            self.register_buffer(name, value.detach(), persistent=False)
        self.register_buffer("_made_from", self._camera_values(), persistent=False)
        self._for_opencv: tuple[Tensor | None, Tensor] = None, self.mask

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Undistort images.

        Args:
            image: (..., C, H, W) of the camera's size: floating point of any precision, or uint8 or uint16, which are
                sampled in float32 and rounded to the nearest level. Leading dimensions broadcast against those of a
                batch of cameras.

        Returns:
            image (..., C, H', W') of the same dtype, and mask (..., H', W').

        Raises:
            InputError: not a tensor, a wrong dtype, size or device, or leading dimensions that do not fit the cameras.
        """
        self._check(image)
        precision = image.dtype if image.dtype in (torch.float32, torch.float64) else torch.float32
        grid, mask = self._maps(precision)
        try:
            lead = torch.broadcast_shapes(image.shape[:-3], mask.shape[:-2])
        except RuntimeError as error:
            raise InputError(
                f"image: leading shape {tuple(image.shape[:-3])} does not fit {tuple(mask.shape[:-2])} cameras"
            ) from error
        count, channels = math.prod(lead), image.shape[-3]
        mask = mask.expand(*lead, *mask.shape[-2:])
        if count * channels == 0:
            return image.new_zeros((*lead, channels, *mask.shape[-2:])), mask
        if image.dtype in _INTEGERS and grid is self.grid and _opencv_samples(image, mask):
            return _sampled_by_opencv(image, self._pixel_maps(), lead), mask
        source = image.to(precision).expand(*lead, *image.shape[-3:]).reshape(count, *image.shape[-3:])
        grid = grid.expand(*mask.shape, 2).reshape(count, *mask.shape[-2:], 2)
        sampled = torch.nn.functional.grid_sample(source, grid, mode="bilinear", align_corners=True)
        if image.dtype in _INTEGERS:
            sampled = sampled.round()
        return sampled.to(image.dtype).reshape(*lead, *sampled.shape[1:]), mask

    @property
    def constants(self) -> object:
        """Range of what is seen."""
        return self.at

    def _check(self, image: Tensor) -> None:
        if not isinstance(image, Tensor):
            raise InputError(f"image: a torch tensor is needed, got {type(image).__name__}")
        if image.dtype not in (*_FLOATS, *_INTEGERS):
            raise InputError(f"image: floating point, uint8 or uint16 is needed, got {image.dtype}")
        width, height = self.camera.size
        if image.ndim < 3 or tuple(image.shape[-2:]) != (height, width):
            raise InputError(f"image: shape (..., C, {height}, {width}) is needed, got {tuple(image.shape)}")
        if image.device != self.mask.device:
            raise InputError(f"image is on {image.device}, the module on {self.mask.device}; move one with .to()")

    def _camera_values(self) -> Tensor:
        """All values that the maps depend on, to notice when they change."""
        parts = [self.rotation]
        for camera in (self.camera, self.new_camera):
            parts += [*camera.parameters(), *camera.buffers()]
        return torch.cat([part.detach().flatten().to(torch.float64) for part in parts])

    def _maps(self, precision: torch.dtype) -> tuple[Tensor, Tensor]:
        live = is_differentiated(self) or not (torch.compiler.is_compiling() or may_branch(self.camera.params))
        compiling = torch.compiler.is_compiling()
        if live or (compiling and self.grid.dtype != precision):
            return self._grid(precision)
        # Compiled and exported graphs keep their maps, because comparing values would break the graph. In an eager call
        # the comparison takes some microseconds, and a stale map would give a wrong image.
        grid, mask = self.grid, self.mask  # which another thread may change
        if not compiling and (grid.dtype != precision or not torch.equal(self._made_from, self._camera_values())):
            # Maps that are kept serve differentiated calls, too.
            with torch.inference_mode(False), torch.no_grad():
                self.grid, self.mask = grid, mask = self._grid(precision)
                self._made_from = self._camera_values()
        return grid, mask

    def _pixel_maps(self) -> Tensor:
        """(..., 2, H', W') the kept grid as columns and rows of the source, as OpenCV takes them."""
        if self._for_opencv[0] is not self.grid:
            size = self.grid.new_tensor(self.camera.size)
            self._for_opencv = self.grid, ((self.grid + 1) * (0.5 * (size - 1))).movedim(-1, -3).contiguous()
        return self._for_opencv[1]

    def _grid(self, precision: torch.dtype) -> tuple[Tensor, Tensor]:
        """Positions (..., H', W', 2) for `grid_sample`, -1 and 1 at the centers of the outer pixels, rounded once."""
        pixels, mask = _source_positions(self.camera, self.new_camera, self.rotation, self.at)
        # One axis at a time: fewer copies of the whole image's positions in float64.
        axes = zip(pixels.unbind(-1), self.camera.size, strict=True)
        return torch.stack([(2 * part / (size - 1) - 1).to(precision) for part, size in axes], -1), mask

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:
        def moved(tensor: Tensor) -> Tensor:
            """Buffers keep their precision: `.half()` would move samples by half a pixel."""
            result = fn(tensor)
            return tensor.to(result.device) if result.dtype != tensor.dtype else result

        return super()._apply(moved, recurse)


def _opencv_samples(image: Tensor, mask: Tensor) -> bool:
    """Whether OpenCV may sample whole numbers: on the CPU, where nothing is traced or mapped; it has 16-bit sizes."""
    small = max(*image.shape[-2:], *mask.shape[-2:]) < 1 << 15
    if not small or image.device.type != "cpu" or is_traced() or not may_branch(image[..., 0, 0]):
        return False
    from kcal.opencv import cv2

    # OpenCV 4 rounds positions to 1/32 px.
    return int(cv2.__version__.split(".")[0]) >= 5


def _sampled_by_opencv(image: Tensor, maps: Tensor, lead: tuple[int, ...]) -> Tensor:
    """(*lead, C, H', W') of images (..., C, H, W) by bilinear sampling at maps (..., 2, H', W'), as exact as torch's.

    Half of torch's time. Channels stay as they lie in memory: apart, or side by side as in OpenCV's own images. OpenCV
    rounds positions in images of two channels, and in those of more than four.
    """
    from kcal.opencv import cv2

    images = image.expand(*lead, *image.shape[-3:])[None].flatten(0, -4)
    places = maps.expand(*lead, *maps.shape[-3:])[None].flatten(0, -4).numpy()
    count, channels, shape = len(images), image.shape[-3], maps.shape[-2:]
    together = channels in (3, 4)
    if together and images.movedim(1, -1).is_contiguous():
        out = images.new_empty((count, *shape, channels)).movedim(-1, 1)
        for one, new, (columns, rows) in zip(images, out, places, strict=True):
            pixels = one.movedim(0, -1).numpy(), new.movedim(0, -1).numpy()
            cv2.remap(pixels[0], columns, rows, cv2.INTER_LINEAR, pixels[1])
        return out.view(*lead, *out.shape[1:])
    out = images.new_empty((count, channels, *shape))
    for one, new, (columns, rows) in zip(images.numpy(), out.numpy(), places, strict=True):
        if together:
            cv2.split(cv2.remap(cv2.merge(list(one)), columns, rows, cv2.INTER_LINEAR), list(new))
        else:
            for plane, given in zip(one, new, strict=True):
                cv2.remap(plane, columns, rows, cv2.INTER_LINEAR, given)
    return out.view(*lead, *out.shape[1:])


class UndistortImage(nn.Module):
    """`Undistort` that returns the image alone, for chains of image operations such as kornia's `ImageSequential`.

    Pixels that the source does not show are 0; with the default new camera there are none.

    Args:
        camera: see `Undistort`.
        new_camera: see `Undistort`.
        rotation: see `Undistort`.

    Example:
        >>> from kornia.augmentation import ImageSequential, RandomHorizontalFlip
        >>> camera = Camera.build(focal=(500, 500), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.2])
        >>> ImageSequential(UndistortImage(camera), RandomHorizontalFlip())(torch.rand(2, 3, 480, 640)).shape
        torch.Size([2, 3, 480, 640])
    """

    __repr__ = brief

    def __init__(
        self, camera: Camera | CameraLike, new_camera: Camera | Cylinder | None = None, rotation: Tensor | None = None
    ) -> None:
        super().__init__()
        self.undistort = Undistort(camera, new_camera, rotation)

    def forward(self, image: Tensor) -> Tensor:
        """Undistort images (..., C, H, W); see `Undistort.forward`."""
        return self.undistort(image)[0]


def _source_positions(
    camera: Camera, new_camera: Camera | Cylinder, rotation: Tensor | None, at: float
) -> tuple[Tensor, Tensor]:
    """Source pixel (..., H, W, 2) of each pixel of the new image, and mask (..., H, W)."""
    width, height = new_camera.size
    if min(width, height, *camera.size) < 2:
        raise InputError(f"images of {camera.size} and {new_camera.size}: at least 2 pixels each way are needed")
    if not at > 0:
        raise InputError(f"at: a positive range in meters is needed, got {at}")
    if rotation is not None and rotation.shape[-2:] != (3, 3):
        raise InputError(f"rotation: shape (..., 3, 3) is needed, got {tuple(rotation.shape)}")
    plain = rotation is None and math.isinf(at)
    turn = torch.eye(3) if rotation is None else rotation
    source_camera = camera if plain else TurnedCamera(camera, turn.to(camera.params), at)
    shapes = [tuple(c.params.shape[:-1]) for c in (camera, new_camera)]
    try:
        torch.broadcast_shapes(*shapes)
    except RuntimeError as error:
        raise InputError(f"batches of {shapes[0]} cameras and {shapes[1]} new cameras do not fit") from error
    bands, grid = [], new_camera.grid(width, height).flatten(0, 1)
    for pixels in grid.split(_BAND):
        rays, valid = new_camera.unproject(pixels)
        source, seen = source_pixels(source_camera, rays)
        mask = seen & valid
        bands.append((torch.where(mask[..., None], source, NOWHERE), mask))
    # 1.6 GB of an image of 100 megapixels, as are the bands together.
    del grid, pixels
    source, mask = torch.cat([band[0] for band in bands], -2), torch.cat([band[1] for band in bands], -1)
    return source.unflatten(-2, (height, width)), mask.unflatten(-1, (height, width))


# Stereo rectification: both images of a rig as two pinholes side by side see them, so that rows are epipolar lines.
#
# The new x axis lies along the baseline, the new z axis between both cameras' axes (A. Fusiello, E. Trucco and A.
# Verri, "A compact algorithm for rectification of stereo pairs", 2000). Both pinholes have one focal length and one
# principal point, so that far points have no disparity and depth is f b / disparity. Images stay upright, as those of
# cv2.stereoRectify: x or y lies along the baseline, in either direction, whichever turns the cameras least.

# Degrees between the baseline and a camera's axis below which the rectified images are stretched beyond use, and
# between the rectified axis and a camera's above which a pinhole does not show the middle of its image.
_LEAST_ANGLE, _MOST_TURNED = 20.0, 80.0


class StereoRectification(Float64Module):
    """Resample both images of a rig so that the same point is in the same row of both.

    Convention: the rectified frame has its origin in the left camera; points_left = rotation @ points_rectified, and
    the right pinhole stands at `right_center`, commonly (baseline, 0, 0). Disparity is the column in the left minus
    that in the right image. Images stay upright, as with cv2.stereoRectify. So disparities are negative where the right
    camera stands to the left of the left one. Where one camera stands above the other, the same point is in the same
    column, and disparity is the row in the left minus that in the right image. Where one camera is rolled against the
    other by more than 90 degrees, both images are upright as the left one is.

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
        DegenerateError: the cameras look along their baseline, or in directions that have nothing in common, or see
            nothing of the field of view.

    Example:
        >>> camera = Camera.build(focal=(500, 500), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.2])
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-2.0, 0.0, 0.0]))
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
        rig: Rig,
        *,
        alpha: float = 0.0,
        size: tuple[int, int] | None = None,
        field_of_view: float | None = None,
        at: float = math.inf,
    ) -> None:
        super().__init__()
        check_single(rig.names, rig.each, "StereoRectification")
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
        for name, side in (("left", self.left), ("right", self.right)):
            if not bool(side.mask.any()):
                raise DegenerateError(f"rectification: the {name} camera shows nothing of this field of view; widen it")
        self.register_buffer("rotation", turn)

    def forward(self, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Rectify images (..., C, H, W), each of its camera's size: left, right, and their masks (..., H', W')."""
        (new_left, mask_left), (new_right, mask_right) = self.left(left), self.right(right)
        return new_left, new_right, mask_left, mask_right

    @property
    def right_center(self) -> Tensor:
        """(3,) meters in the rectified frame: where the right pinhole stands, along x, or along y if that is nearer."""
        rig = still(self.rig)
        return -(rig.right_from_left_rotation @ self.rotation).mT @ rig.right_from_left_translation

    @property
    def _apart(self) -> tuple[Tensor, Tensor]:
        """Axis (2,) along which the cameras stand apart, 1 there, and how far, signed as `right_center`."""
        place = self.right_center[:2]
        return (place / torch.linalg.vector_norm(place)).round().abs(), place.sum()

    @property
    def depth_matrix(self) -> Tensor:
        """(4, 4) Q of OpenCV: (X, Y, Z, W) = Q (u, v, disparity, 1), the point being (X, Y, Z) / W, in meters."""
        focal, _, cx, cy, _ = self.camera.params.detach().unbind()
        Q = torch.zeros(4, 4, dtype=torch.float64, device=focal.device)
        Q[0, 0], Q[1, 1], Q[0, 3], Q[1, 3], Q[2, 3], Q[3, 2] = 1.0, 1.0, -cx, -cy, focal, 1.0 / self._apart[1]
        return Q

    def depth(self, disparity: Tensor | ArrayLike) -> Tensor:
        """Depth Z along the rectified axis, meters, of disparities in pixels; infinite for 0 and the wrong sign."""
        disparity = as_disparity(disparity, self.rotation)
        reach = self.camera.params.detach()[0] * self._apart[1]
        ahead = disparity * reach > 0
        return torch.where(ahead, reach / torch.where(ahead, disparity, 1.0), torch.inf)

    def points(self, pixels: Tensor | ArrayLike, disparity: Tensor | ArrayLike) -> Tensor:
        """Points (..., N, 3) in the rig's frame, meters, of left rectified pixels (..., N, 2) and disparities (..., N).

        Entrance pupils are taken to stand still; `kcal.locate.DisparityRanges` takes the lenses as they are.
        """
        pixels = as_points("pixels", pixels, 2, self.rotation)
        focal, center = self.camera.params.detach()[0], self.camera.params.detach()[2:4]
        plane = (pixels - center) / focal
        ahead = torch.cat([plane, torch.ones_like(plane[..., :1])], -1)
        return self.depth(disparity)[..., None] * ahead @ self.rotation.mT

    def source_pixels(self, pixels: Tensor | ArrayLike, disparity: Tensor | ArrayLike) -> tuple[Tensor, Tensor, Tensor]:
        """Where rectified pixels lie in the images as taken.

        Args:
            pixels: (..., N, 2) of the left rectified image.
            disparity: (..., N).

        Returns:
            left and right (..., N, 2), and valid (..., N).
        """
        pixels = as_points("pixels", pixels, 2, self.rotation)
        moved = pixels - as_disparity(disparity, self.rotation)[..., None] * self._apart[0]
        found = []
        for module, where in ((self.left, pixels), (self.right, moved)):
            rays, _ = self.camera.unproject(where)
            found.append(TurnedCamera(module.camera, module.rotation, module.at).project_rays(rays))
        return found[0][0], found[1][0], found[0][1] & found[1][1]


def as_disparity(disparity: Tensor | ArrayLike, like: Tensor) -> Tensor:
    """Disparities (...) as float64 on the device of `like`.

    Raises:
        InputError: not floating point, or less than float32.
    """
    given = as_tensor("disparity", disparity)
    if not given.is_floating_point():
        raise InputError(
            "disparity: floating point is needed, got whole numbers; those of cv2.StereoSGBM are sixteenths of a "
            "pixel: divide them by 16.0"
        )
    if given is not disparity:
        given = given.to(like.device)
    return as_points("disparity", given[..., None], 1, like)[..., 0]


def _rectified_frame(rig: Rig) -> Tensor:
    """(3, 3) left_from_rectified: x or y along the baseline, z as nearly as possible between both cameras' axes."""
    rotation = rig.right_from_left_rotation
    center = -rotation.T @ rig.right_from_left_translation
    length = float(center.norm())
    if not length > 0:
        raise DegenerateError("rectification: the cameras stand in one place, so that there is no disparity")
    across = center / length
    # In the left camera's frame, the cameras' axes are the rows.
    axes = {"left": torch.eye(3).to(rotation), "right": rotation}
    for name, (_, _, axis) in axes.items():
        angle = math.degrees(math.acos(min(1.0, abs(float(axis @ across)))))
        if angle < _LEAST_ANGLE:
            raise DegenerateError(
                f"rectification: the {name} camera looks {angle:.0f} degrees from the baseline, at the other camera or "
                f"away from it; at least {_LEAST_ANGLE:g} are needed"
            )
    ahead = axes["left"][2] + rotation[2]
    ahead = torch.nn.functional.normalize(ahead - (ahead @ across) * across, dim=0)
    for name, (_, _, axis) in axes.items():
        angle = math.degrees(math.acos(max(-1.0, min(1.0, float(axis @ ahead)))))
        if not angle <= _MOST_TURNED:
            raise DegenerateError(
                f"rectification: the {name} camera looks {angle:.0f} degrees away from what lies between both cameras' "
                f"axes; at most {_MOST_TURNED:g} are possible: the cameras look in different directions"
            )
    down = torch.linalg.cross(ahead, across)
    level = axes["left"][0] + (rotation[0] if float(axes["left"][0] @ rotation[0]) > 0 else 0.0)
    quarter = round(math.atan2(float(level @ down), float(level @ across)) / (0.5 * math.pi)) % 4
    right = (across, down, -across, -down)[quarter]
    return torch.stack([right, torch.linalg.cross(ahead, right), ahead], -1)


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
            raise DegenerateError(
                "rectification: far away the cameras have no directions in common; for near points give a field of "
                "view (--fov)"
            )
        scale = last / (high - low)
        focal = focal + share * (scale.max() if inner else scale.min())
        middle = middle + share * 0.5 * (low + high)
    center = 0.5 * last - focal * middle
    values = torch.cat([focal[None], focal[None], center, torch.zeros_like(focal[None])])
    return Camera(values, size=size, model="pinhole")
