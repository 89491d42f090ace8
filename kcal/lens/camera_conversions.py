"""Images made from an image, and cameras made from a camera: resized, letterboxed, of OpenCV and of kornia."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.checks import as_points, as_size, as_tensor
from kcal.errors import InputError, warn_user
from kcal.lens.calibration import CameraCalibration, UntilChanged
from kcal.lens.camera_parameters import CameraParameters
from kcal.lens.model import PRESETS

# `ImageTransform`: how a detector's input was made from the full image, by resizing, cropping and letterboxing.


@dataclass(frozen=True, kw_only=True)
class ImageTransform:
    """Pixels of a full image to pixels of an image that was scaled, cropped or padded from it, and back.

    Convention: pixel (0, 0) is the center of the first pixel, and edges of images coincide when one is resized (as in
    `cv2.resize`, `torch.nn.functional.interpolate(..., align_corners=False)` and Pillow), so that
    u_input = (u_full + 0.5) * scale + offset - 0.5.

    Args:
        full: (width, height) of the full image.
        size: (width, height) of the detector's input.
        scale: input pixels per full pixel, in x and y.
        offset: where the full image's upper left *edge* lies in the input, in input pixels; negative after cropping.

    Raises:
        InputError: a size or scale that is not positive, or a value that is not finite.

    Example:
        >>> letterbox = ImageTransform.letterbox((1920, 1080), (640, 640))
        >>> letterbox.scale[0], letterbox.offset
        (0.3333333333333333, (0, 140))
        >>> letterbox.to_full(torch.tensor([[319.5, 319.5]])).tolist()  # the middle stays the middle
        [[959.5, 539.5]]
    """

    full: tuple[int, int]
    size: tuple[int, int]
    scale: tuple[float, float]
    offset: tuple[float, float]

    def __post_init__(self) -> None:
        numbers = (*self.full, *self.size, *self.scale)
        if not all(0 < number < math.inf for number in numbers) or not all(map(math.isfinite, self.offset)):
            raise InputError(f"image transform: sizes and scales must be positive and all finite, got {self}")

    @classmethod
    def resize(cls, full: tuple[int, int], size: tuple[int, int]) -> ImageTransform:
        """The full image stretched to a size (width, height); its aspect ratio may change."""
        return cls(full=full, size=size, scale=(size[0] / full[0], size[1] / full[1]), offset=(0.0, 0.0))

    @classmethod
    def crop(cls, full: tuple[int, int], left: int, top: int, size: tuple[int, int]) -> ImageTransform:
        """The part of `size` whose first pixel is column `left` and row `top` of the full image.

        Raises:
            InputError: a part that does not lie inside the full image.
        """
        if not (0 <= left <= full[0] - size[0] and 0 <= top <= full[1] - size[1]):
            raise InputError(f"crop of {size} at ({left}, {top}) does not lie inside the image {full}")
        return cls(full=full, size=size, scale=(1.0, 1.0), offset=(-left, -top))

    @classmethod
    def letterbox(
        cls, full: tuple[int, int], size: tuple[int, int], *, centered: bool = True, enlarge: bool = True
    ) -> ImageTransform:
        """The full image scaled to fit into `size`, the rest padded, as `ultralytics.data.augment.LetterBox` does it.

        The scaled image has a whole number of pixels, so that the two scales differ a little from the common ratio:
        boxes that are divided by that ratio are wrong by up to half an input pixel at the far edge.

        Args:
            full: (width, height).
            size: (width, height) of the input.
            centered: pad on both sides; otherwise to the right and below only.
            enlarge: also scale up images that are smaller than `size`.
        """
        full, size = as_size(full), as_size(size)
        ratio = min(size[0] / full[0], size[1] / full[1])
        if not enlarge:
            ratio = min(ratio, 1.0)
        inner = [max(1, round(side * ratio)) for side in full]
        # The odd pixel goes to the right and below: that is what taking 0.1 from a half does.
        pads = [round((whole - part) / 2 - 0.1) if centered else 0 for whole, part in zip(size, inner, strict=True)]
        scale = inner[0] / full[0], inner[1] / full[1]
        return cls(full=full, size=size, scale=scale, offset=(pads[0], pads[1]))

    @classmethod
    def from_matrices(
        cls, matrices: Tensor, full: tuple[int, int], size: tuple[int, int]
    ) -> tuple[ImageTransform, ...]:
        """Those of a batch (B, 3, 3) of matrices between pixels, such as `transform_matrix` of kornia's augmentations.

        Kornia counts pixels from the center of the first one, too, and its matrices are those of its sampling, also
        where `Resize(align_corners=True)` lets centers coincide instead of edges. Only scales and shifts are held.

        Args:
            matrices: u_input = matrix @ u_full, both homogeneous.
            full: (width, height) of the full image.
            size: (width, height) of the input.

        Raises:
            InputError: another shape, or a matrix that turns, mirrors, shears or tilts: no camera sees such an image.

        Example:
            >>> half = torch.tensor([[[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]]])
            >>> (found,) = ImageTransform.from_matrices(half, (640, 480), (320, 240))
            >>> found == ImageTransform.resize((640, 480), (320, 240))
            True
        """
        matrices = as_points("matrices", matrices, 3)
        if matrices.ndim != 3 or matrices.shape[1] != 3:
            raise InputError(f"matrices: shape (B, 3, 3) is needed, got {tuple(matrices.shape)}")
        made = []
        for number, ((a, skew, u), (turn, b, v), last) in enumerate((matrices / matrices[:, 2:, 2:]).tolist()):
            # Kornia computes them in float32.
            if max(abs(skew), abs(turn), 1e3 * abs(last[0]), 1e3 * abs(last[1])) > 1e-5 or not min(a, b) > 0:
                raise InputError(
                    f"matrices: number {number} turns, mirrors, shears or tilts the image; move pixels back by "
                    "kornia.geometry.transform_points(matrix.inverse(), pixels), and keep the full image's camera"
                )
            made.append(cls(full=full, size=size, scale=(a, b), offset=(u + 0.5 - 0.5 * a, v + 0.5 - 0.5 * b)))
        return tuple(made)

    def then(self, other: ImageTransform) -> ImageTransform:
        """This transform followed by another one, as one transform.

        Raises:
            InputError: `other` begins with an image of another size.
        """
        if other.full != self.size:
            raise InputError(f"image transforms: the second begins with {other.full}, the first ends with {self.size}")
        (ax, ay), (bx, by) = self.scale, other.scale
        offset = self.offset[0] * bx + other.offset[0], self.offset[1] * by + other.offset[1]
        return ImageTransform(full=self.full, size=other.size, scale=(ax * bx, ay * by), offset=offset)

    def to_input(self, pixels: Tensor) -> Tensor:
        """Pixels (..., 2) of the full image to pixels of the input, in float64."""
        pixels = as_points("pixels", pixels, 2)
        return (pixels + 0.5) * pixels.new_tensor(self.scale) + pixels.new_tensor(self.offset) - 0.5

    def to_full(self, pixels: Tensor) -> Tensor:
        """Pixels (..., 2) of the input to pixels of the full image, in float64."""
        pixels = as_points("pixels", pixels, 2)
        return (pixels + 0.5 - pixels.new_tensor(self.offset)) / pixels.new_tensor(self.scale) - 0.5

    def intrinsics(self, parameters: Tensor) -> Tensor:
        """Camera parameters (..., 5 + P) of the full image to those of the input; only the intrinsics change."""
        moved = (parameters[..., 2:4] + 0.5) * parameters.new_tensor(self.scale) + parameters.new_tensor(self.offset)
        factors = self.factors(parameters)
        parts = [parameters[..., :2] * factors[:2], moved - 0.5, parameters[..., 4:] * factors[4:]]
        return torch.cat(parts, -1)

    def factors(self, parameters: Tensor) -> Tensor:
        """(5 + P,) by which errors of camera parameters (..., 5 + P) grow; skew is one of columns."""
        sx, sy = self.scale
        return torch.cat([parameters.new_tensor([sx, sy, sx, sy, sx]), parameters.new_ones(parameters.shape[-1] - 5)])

    def calibration(self, known: CameraCalibration | None, parameters: Tensor) -> CameraCalibration | None:
        """The name and error bars of a full-image camera, for the camera of the input.

        What was measured in pixels of the full image (record, information) stays with the full image's camera.
        """
        if known is None:
            return None
        factors = self.factors(parameters)
        sigma = covariance = None
        if known.sigma is not None:
            scaled = zip(known.sigma.items(), factors.tolist(), strict=True)
            sigma = {name: None if value is None else value * factor for (name, value), factor in scaled}
        if known.covariance is not None:
            covariance = factors[:, None] * known.covariance * factors
        return CameraCalibration(name=known.name, sigma=sigma, covariance=covariance, setting=known.setting)


# Cameras made from a camera: of resized, cropped and letterboxed images, of OpenCV and of kornia.

# The lens model that has so many of OpenCV's coefficients.
OPENCV_MODELS = {0: "pinhole"} | {count: f"opencv{count}" for count in (4, 5, 8, 12, 14)}


class ConvertibleCamera(CameraParameters):
    """Conversions of a camera: other image sizes, OpenCV and kornia."""

    calibration = UntilChanged[CameraCalibration](lambda camera, value: value.check(len(camera.names)))

    def transformed(self, transform: ImageTransform) -> Self:
        """The camera of an image that was resized, cropped or padded from this camera's, with its error bars.

        Only the intrinsics change, and exactly: u' = (u + 0.5) * scale + offset - 0.5. Parameters of the calibration's
        record stay with this camera. For the pixels themselves use `transform.to_full`.

        Raises:
            InputError: a transform of an image of another size.

        Example:
            >>> from kcal import Camera
            >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080))
            >>> small = camera.transformed(ImageTransform.letterbox(camera.size, (640, 640)))
            >>> small.size, [round(value, 9) for value in small.center.tolist()]
            ((640, 640), [319.5, 319.5])
        """
        if transform.full != self.size:
            raise InputError(f"the transform is of an image {transform.full}, the camera has {self.size}")
        values = self.params.detach()
        made = type(self)(transform.intrinsics(values), size=transform.size, model=self.model)
        made.calibration = transform.calibration(self.calibration, values)
        return made

    def resized(self, size: tuple[int, int]) -> Self:
        """The camera of images stretched to a size (width, height); see `transformed`."""
        return self.transformed(ImageTransform.resize(self.size, size))

    def cropped(self, left: int, top: int, size: tuple[int, int]) -> Self:
        """The camera of the part of `size` (width, height) that begins at column `left`, row `top`."""
        return self.transformed(ImageTransform.crop(self.size, left, top, size))

    def letterboxed(self, size: tuple[int, int]) -> Self:
        """The camera of images scaled to fit into `size` and padded on both sides; see `ImageTransform.letterbox`."""
        return self.transformed(ImageTransform.letterbox(self.size, size))

    def to_opencv(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """OpenCV's K (3, 3) and D (4 to 14 coefficients); of a fisheye for `cv2.fisheye`, whose alpha is K₀₁ / K₀₀.

        Raises:
            InputError: a lens or a skew that OpenCV's functions do not have, or a batch of cameras.

        Example:
            >>> from kcal import Camera
            >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1])
            >>> camera.to_opencv()[1].tolist()
            [-0.1, 0.0, 0.0, 0.0, 0.0]
        """
        if self.params.ndim != 1:
            raise InputError("to_opencv: a single camera is needed, not a batch; convert the cameras one by one")
        fisheye = self.model.fisheye
        order = PRESETS["fisheye4" if fisheye else "opencv14"].names
        lens = dict(zip(self.model.names, self.coefficients.tolist(), strict=True))
        skew = float(self.values[4])
        if any(value for name, value in lens.items() if name not in order) or (skew and not fisheye):
            raise InputError(
                f"to_opencv: OpenCV's functions have no {self.model} lens{' with skew' if skew else ''}. Fit one that "
                "they have, with its misfit stated: kcal.lens.refit_camera(camera, 'opencv14').camera"
            )
        needed = max((order.index(name) + 1 for name in lens if name in order), default=0)
        count = next(count for count in OPENCV_MODELS if count >= max(needed, 4))
        return self.matrix.detach().cpu().numpy(), np.array([lens.get(name, 0.0) for name in order[:count]])

    @classmethod
    def from_opencv(
        cls, K: npt.ArrayLike, D: npt.ArrayLike | None, size: tuple[int, int], *, fisheye: bool = False
    ) -> Self:
        """The camera of K and D as `cv2.calibrateCamera`, `stereoCalibrate` or `cv2.fisheye.calibrate` return them.

        A `KcalWarning` says where K seems to be of an image of another size, or `size` to be (height, width).

        Args:
            K: (3, 3) camera matrix, pixels.
            D: 4, 5, 8, 12 or 14 coefficients in any shape; None: no distortion.
            size: (width, height) of the image in pixels, as OpenCV's `imageSize`.
            fisheye: whether K and D are of `cv2.fisheye`; D has 4 coefficients then, and K₀₁ is a skew.

        Raises:
            InputError: no camera matrix, another number of coefficients, or a skew, which `cv2.projectPoints` ignores.

        Example:
            >>> from kcal import Camera
            >>> K = [[800, 0, 319.5], [0, 800, 239.5], [0, 0, 1]]
            >>> camera = Camera.from_opencv(K, [[-0.1, 0.01, 0, 0, 0]], (640, 480))
            >>> camera.project(np.array([[0.1, 0.0, 1.0]]))[0].tolist()
            [[399.42008, 239.5]]
        """
        matrix, size = as_tensor("K", K).detach().to("cpu", torch.float64), as_size(size)
        lens = torch.zeros(0) if D is None else as_tensor("D", D).detach().cpu()
        if matrix.shape != (3, 3):
            raise InputError(f"K: a camera matrix (3, 3) is needed, got {tuple(matrix.shape)}")
        (fx, skew, cx), (below, fy, cy), last = matrix.tolist()
        if below or last != [0.0, 0.0, 1.0]:
            turned = matrix[:2, 2].any() or not matrix[2, :2].any()
            raise InputError(f"K: no camera matrix, got {matrix.tolist()}" + ("" if turned else "; give its transpose"))
        counts = (0, 4) if fisheye else tuple(OPENCV_MODELS)
        if lens.numel() not in counts or lens.numel() != max(lens.shape, default=1):
            raise InputError(
                f"D: {' or '.join(map(str, counts[1:]))} coefficients are needed, got shape {tuple(lens.shape)}"
                + ("" if fisheye else "; cameras of more are made with Camera.build(..., model='ext20')")
            )
        if skew and not fisheye:
            raise InputError(
                f"K: a skew of {skew:g} px, which cv2.projectPoints ignores; set it to 0 for the same pixels, or use "
                "it with Camera.build(..., skew=...)"
            )
        values = torch.cat([matrix.new_tensor([fx, fy, cx, cy, skew]), lens.flatten().double()])
        if fisheye:
            values = torch.nn.functional.pad(values, (0, 9 - len(values)))
        camera = cls(values, size=size, model=PRESETS["fisheye4" if fisheye else OPENCV_MODELS[lens.numel()]])
        if doubt := size_doubt(fx, fy, cx, cy, size):
            warn_user(doubt)
        return camera

    def to_kornia(self) -> Any:
        """The same camera in kornia: a `PinholeCamera`, or a `CameraModel` of `kornia.sensors.camera` with its lens.

        Raises:
            InputError: a lens that no camera of kornia holds, or a batch of cameras with lenses.

        Example:
            >>> from kcal import Camera
            >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1])
            >>> type(camera.to_kornia()).__name__
            'CameraModel'
        """
        from kcal.lens.kornia_cameras import kornia_camera  # kornia takes long to load

        return kornia_camera(self)

    @classmethod
    def from_kornia(cls, camera: Any) -> Self:
        """The camera of a `PinholeCamera`, or of a `CameraModel` of `kornia.sensors.camera`, in float64.

        Raises:
            InputError: another class, an orthographic camera, a camera with a pose, or several image sizes.

        Example:
            >>> from kcal import Camera
            >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1])
            >>> str(Camera.from_kornia(camera.to_kornia()).model)
            'opencv8'
        """
        from kcal.lens.kornia_cameras import parameters_from_kornia

        parameters, size, model = parameters_from_kornia(camera)
        return cls(parameters, size=size, model=model)


def size_doubt(fx: float, fy: float, cx: float, cy: float, size: tuple[int, int], most: float = 0.24) -> str:
    """Why a camera matrix does not seem to belong to an image of this size; empty if it may.

    `most` is how far from the middle the principal point may be, in sides of the image.
    """

    def off(width: int, height: int) -> float:
        return max(abs((cx + 0.5) / width - 0.5), abs((cy + 0.5) / height - 0.5))

    (width, height), image = size, f"an image of {size[0]}x{size[1]} px"
    # A rectilinear lens of twenty focal lengths to the side would see 168°.
    if min(fx / width, fy / height) < 0.05:
        return f"K: focal lengths of {fx:g}, {fy:g} px are short for {image}; K must be in pixels of this image"
    # Principal points lie within a few percent of the middle. Of 4:3 with sides exchanged they are off by 0.17.
    if off(width, height) > 0.1 and off(height, width) < 0.05:
        return (
            f"the principal point ({cx:g}, {cy:g}) is in the middle of {height}x{width} px, not of {width}x{height}: "
            "size is (width, height)"
        )
    # Where K is of half the image's size, it is off by a quarter; more is left to crops.
    if off(width, height) > most:
        where = "far from the middle of" if -0.5 <= cx < width and -0.5 <= cy < height else "outside"
        return (
            f"the principal point ({cx:g}, {cy:g}) is {where} {image}: if these are numbers "
            "of another size, give that size and resize the camera"
        )
    return ""
