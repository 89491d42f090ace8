"""Cameras made from a camera: of resized, cropped and letterboxed images, and of kornia."""

from __future__ import annotations

from typing import Any, Self

from kcal.errors import InputError
from kcal.lens.calibration import CameraCalibration, UntilChanged
from kcal.lens.camera_parameters import CameraParameters
from kcal.lens.image_transform import ImageTransform


class ConvertibleCamera(CameraParameters):
    """What every camera can be made into; the parameters are those of `CameraParameters`."""

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
