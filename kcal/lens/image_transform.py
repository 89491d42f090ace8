"""`ImageTransform`: how a detector's input was made from the full image, by resizing, cropping and letterboxing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from kcal.checks import as_points, as_size
from kcal.errors import InputError
from kcal.lens.calibration import CameraCalibration


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
        """This and after it another one, as one.

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
        return torch.cat(
            [parameters[..., :2] * factors[:2], moved - 0.5, parameters[..., 4:] * factors[4:]], -1
        )  # fmt: skip

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
