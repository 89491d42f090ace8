"""`Camera`: a lens and its intrinsics as an `nn.Module` that projects points and unprojects pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Self

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from kcal.checks import as_points
from kcal.dispatch import finite_or, in_chunks, is_differentiated, known_true, split_coordinates
from kcal.doors import shown_in_notebooks
from kcal.errors import InputError
from kcal.lens.camera_conversions import ConvertibleCamera
from kcal.lens.camera_parameters import CameraDistortion, ExtendedDistortion
from kcal.lens.hybrid_points import FittedPolynomials, map_points, worth_fitting
from kcal.lens.inverse import InverseStart, PreparedInverse, undistort_components
from kcal.lens.model import LensModel, distort_components, larger_model
from kcal.lens.projection import (
    FAR,
    INTRINSICS,
    from_pixels,
    plane_from_points,
    ray_origins,
    ray_starts,
    rays_from_plane,
    to_pixels,
)
from kcal.lens.region import Region, in_region, surely_in_region


class Camera(ConvertibleCamera):
    """Project points to pixels (`project`) and unproject pixels to rays (`unproject`), both with a validity mask.

    Make one from plain numbers with `Camera.build`, or load one with `kcal.load_camera`.

    Convention: camera frame x right, y down, z forward; pixel (0, 0) is the center of the first pixel; meters. All
    geometry is float64: float32 inputs are promoted, float16 and bfloat16 are refused (near 1000 px they have steps of
    0.5 and 4 px), and `.half()` or `.float()` do not round the camera.

    The parameters do not require gradients until asked (`camera.free("fx", "k1")`), so that training a network around a
    camera does not change its calibration. The region where the lens is valid is computed when the camera is made and
    when a state is loaded. After changing parameters in any other way, call `update_valid_region()`.

    The attribute `calibration` (a `CameraCalibration`) has the name, the error bars and the history of a camera that
    was calibrated or loaded; `kcal.save_camera` stores it, and projection does not use it. It is None until it is set,
    and again once a parameter has changed.

    Args:
        parameters: (..., 5 + P): fx, fy, cx, cy, skew, then the lens coefficients in the order of `model.names`.
            Leading dimensions make a batch of cameras.
        size: (width, height) of the image in pixels.
        model: a `LensModel` or the name of one, for example `"opencv5"`.

    Raises:
        InputError: a wrong shape, a value that is not finite, or a focal length or size that is not positive.

    Example:
        >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080),
        ...                       coefficients=[-0.1, 0.01, 0, 0, 0], model="opencv5")
        >>> pixels, valid = camera.project(torch.tensor([[1.0, 0.0, 10.0], [0.0, 0.0, -1.0]]))
        >>> valid.tolist()
        [True, False]
        >>> rays, valid = camera.unproject(pixels[:1])
        >>> bool(torch.allclose(rays[0] / rays[0, 2] * 10, torch.tensor([1.0, 0, 10], dtype=torch.float64)))
        True
    """

    _repr_html_ = shown_in_notebooks

    results = {  # noqa: RUF012
        "project": (((2,), torch.float64), ((), torch.bool)),
        "unproject": (((3,), torch.float64), ((), torch.bool)),
    }

    def __init__(self, parameters: Tensor, *, size: tuple[int, int], model: LensModel | str = "opencv5") -> None:
        super().__init__(parameters, size, LensModel.named(model))
        self._fitted = FittedPolynomials()
        self._measure_region()

    @classmethod
    def build(
        cls,
        *,
        focal: Sequence[float],
        center: Sequence[float],
        size: tuple[int, int],
        coefficients: Sequence[float] = (),
        model: LensModel | str = "opencv5",
        skew: float = 0.0,
    ) -> Self:
        """Make a single camera from plain numbers; coefficients left out at the end are zero."""
        model = LensModel.named(model)
        lens = [float(value) for value in coefficients]
        if len(lens) > model.size:
            raise InputError(f"{len(lens)} coefficients given, {model} has {model.size}; {larger_model(len(lens))}")
        lens += [0.0] * (model.size - len(lens))
        values = [*map(float, focal), *map(float, center), float(skew), *lens]
        return cls(torch.tensor(values, dtype=torch.float64), size=size, model=model)

    def with_parameters(self, parameters: Tensor) -> Camera:
        """Make a camera of the same kind, size and model with other parameters; no memory is shared, nor gradients.

        Parameters that something else computes get theirs by `torch.func.functional_call`:

        Example:
            >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
            >>> params = (camera.params + 1.0).requires_grad_()
            >>> pixels, _ = torch.func.functional_call(camera, {"params": params}, torch.tensor([[0.5, 0.0, 1.0]]))
            >>> torch.autograd.grad(pixels[0, 0], params)[0].tolist()
            [0.5, 0.0, 1.0, 0.0, 0.0]
        """
        return Camera(parameters, size=self.size, model=self.model)

    @property
    def _long_graph(self) -> bool:
        return self.model.hybrid is not None and self.params.ndim == 1

    @property
    def distortion(self) -> ExtendedDistortion:
        """The distortion alone, as a module that shares this camera's parameters: what one learns, both have.

        Example:
            >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.25])
            >>> camera.distortion(torch.tensor([[0.5, 0.0]], dtype=torch.float64))[0].tolist()
            [[0.46875, 0.0]]
        """
        return CameraDistortion(self)

    def valid_polygon(self) -> Tensor:
        """The part of the image whose pixels have a ray, as a polygon (V, 2) in pixels, clockwise as seen in the image.

        For most cameras this is the whole image: four corners, half a pixel beyond the outermost pixel centers. Where
        the lens folds inside the image, the polygon follows the fold at 256 directions; wedges behind the end of a
        fold (`Region.cuts`) are not left out. It is empty if no pixel has a ray.

        Raises:
            InputError: a batch of cameras.
        """
        if self.params.ndim != 1:
            raise InputError(
                f"valid_polygon: a single camera is needed, not a batch of {tuple(self.valid_radius.shape)}"
            )
        return image_outline(self.params.detach(), self.model, self.valid_region, self.size)

    def _reach(self) -> Tensor:
        width, height = self.size
        values = self.params.detach()
        corners = values.new_tensor([[-0.5, -0.5], [width, -0.5], [-0.5, height], [width, height]])
        return torch.hypot(*from_pixels(corners[:, 0], corners[:, 1], values)).amax(-1)

    def _taken(self, name: str, value: Tensor | ArrayLike, last: int) -> Tensor:
        """Points of a user as float64 (..., N, last) on this camera's device; its batch broadcasts with theirs."""
        other = "pixels are for unproject" if last == 3 else "points and rays are for project"
        points = as_points(name, value, last, like=self.params, otherwise=other)
        pairs = zip(reversed(points.shape[:-2]), reversed(self.params.shape[:-1]), strict=False)
        if not all(a == b or 1 in (a, b) for a, b in pairs):
            raise InputError(
                f"{name}: shape {tuple(points.shape)} does not fit a batch of {tuple(self.params.shape[:-1])} cameras"
            )
        return points

    def project(self, points_cam: Tensor | ArrayLike) -> tuple[Tensor, Tensor]:
        """Map points to pixels.

        The entrance pupil of a hybrid lens moves with the angle, so that the distance of a point counts, too. For
        directions there is `project_rays`.

        Args:
            points_cam: (..., N, 3) in the camera frame, meters; a tensor, array or list.

        Returns:
            pixels (..., N, 2) and valid (..., N). Valid points are finite, in front of the camera (for a fisheye:
            within its monotone angle; for a hybrid lens: on the disc of its field), and not beyond a fold of the lens
            model. They need not lie inside the image; `inside` tells that. Pixels that are not valid are set to the
            principal point.

        Raises:
            InputError: a wrong shape or an integer dtype.
        """
        points = self._taken("points_cam", points_cam, 3)
        if self._long_graph and (found := self.as_operation("project", points)):
            return found[0], found[1]
        if worth_fitting(points, self.params, self.model):
            polynomials = self._fitted.forward(self.params.detach(), self.model, self.valid_region)
            if polynomials is not None:
                return map_points(polynomials, self._project_by_formulas, points, 2)
        return self._project_by_formulas(points)

    def _project_by_formulas(self, points: Tensor) -> tuple[Tensor, Tensor]:
        values = self.values
        coefficients, center = values[..., 5:], values[..., None, 2:4]

        differentiated = is_differentiated(points, values, *self.model.weights)

        def one(points: Tensor) -> tuple[Tensor, Tensor]:
            X, Y, Z = split_coordinates(points)
            x, y, usable = self._plane_from_points(X, Y, Z)
            with torch.no_grad():
                valid, settled = self._possibly_valid(x, y, Z)
                valid = valid if usable is None else valid & usable
                all_valid = known_true(valid)
            if not all_valid:
                # The axis as a stand-in keeps NaN out of values and gradients.
                X, Y, Z = torch.where(valid, X, 0.0), torch.where(valid, Y, 0.0), torch.where(valid, Z, 1.0)
                x, y, _ = self._plane_from_points(X, Y, Z)
            lens = distort_components(x, y, coefficients, self.model, slopes=not (settled or differentiated))
            if not settled:
                with torch.no_grad():
                    known = None if differentiated else lens
                    valid = valid & in_region(x, y, coefficients, self.model, self.valid_region, known)
            pixels = torch.stack(to_pixels(lens.x, lens.y, values), -1)
            # Of lenses without coefficients one region serves all cameras.
            valid = valid.expand(pixels.shape[:-1])
            return pixels if all_valid and settled else torch.where(valid[..., None], pixels, center), valid

        return self._in_chunks(one, points)

    def project_rays(self, rays: Tensor | ArrayLike) -> tuple[Tensor, Tensor]:
        """Map directions (..., N, 3), that is points at infinity, to pixels (..., N, 2), and valid (..., N).

        This is the inverse of `unproject`. It differs from `project` for a hybrid lens only.

        Raises:
            InputError: a wrong shape or an integer dtype.
        """
        return self.project(self._taken("rays", rays, 3) * FAR)

    def ray_origins(self, rays: Tensor | ArrayLike) -> Tensor:
        """Find where rays start: (0, 0, ζ₁ θ² + ζ₂ θ⁴) for a hybrid lens, the origin for others.

        Behind a flat port they start on the port's normal through the lens, not on the optical axis.

        With a ray of `unproject`, every point `ray_origin + t * ray` with t > 0 is projected to the pixel of the ray,
        except for t of the order of the pupil's movement, where rays intersect each other.

        Args:
            rays: (..., N, 3) directions in the camera frame, of any length.

        Returns:
            (..., N, 3) in the camera frame, meters.

        Raises:
            InputError: a wrong shape or an integer dtype.

        Example:
            >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
            >>> camera.ray_origins(torch.tensor([[0.0, 0.6, 0.8]])).tolist()
            [[0.0, 0.0, 0.0]]
        """
        rays = self._taken("rays", rays, 3)
        if not self.model.hybrid:
            return torch.zeros_like(rays)
        return ray_origins(rays, self.coefficients, self.model.hybrid.port)

    def _plane_from_points(self, X: Tensor, Y: Tensor, Z: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Map points (..., N) to the plane of the lens, with a mask of where that was found; None: everywhere."""
        if not self.model.hybrid:
            return *plane_from_points(X, Y, Z, self.model), None
        pupil = ray_starts(X, Y, Z, self.coefficients, port=self.model.hybrid.port)
        return *plane_from_points(*pupil.moved(X, Y, Z), self.model), pupil.found

    def _possibly_valid(self, x: Tensor, y: Tensor, Z: Tensor) -> tuple[Tensor, bool]:
        """Points that are usable and within the outline of the valid region; whether that settles their validity."""
        # A point infinitely far ahead would be projected to the axis.
        usable = Z.abs() < torch.inf
        if not self.model.wide:
            usable = usable & (Z > 0)
        if self.model.radial:
            return usable & self.valid_region.covers(x, y), True
        sure = usable & surely_in_region(x, y, self.valid_region)
        if known_true(sure):
            return sure, True
        return usable & self.valid_region.encloses(x, y), False

    def _in_chunks(self, function: Callable[[Tensor], tuple[Tensor, Tensor]], points: Tensor) -> tuple[Tensor, Tensor]:
        differentiated = is_differentiated(points, self)
        return in_chunks(function, points, self.valid_radius.numel(), differentiated=differentiated)

    def _to_plane(self, pixels: Tensor, start: InverseStart | None) -> tuple[Tensor, Tensor, Tensor]:
        """Map pixels (..., N, 2) to x, y on the plane of the lens, and valid; each is (..., N)."""
        ready = PreparedInverse(self.valid_region, self.inverse_start, start)
        return pixels_to_plane(pixels, self.values, self.model, ready)

    def normalize(self, pixels: Tensor | ArrayLike, *, start: InverseStart | None = None) -> tuple[Tensor, Tensor]:
        """Map pixels (..., N, 2) to undistorted coordinates (..., N, 2) on the plane z = 1, and valid (..., N).

        Pixels of a fisheye that look 89° or more off axis have no such coordinates and are not valid. `start` is that
        of `unproject`.

        Raises:
            InputError: a wrong shape or an integer dtype.
        """
        pixels = self._taken("pixels", pixels, 2)
        if self.model.wide:
            rays, valid = self.unproject(pixels, start=start)
            valid = valid & (math.cos(math.radians(89.0)) < rays[..., 2])
            depth = torch.where(valid, rays[..., 2], 1.0)
            return torch.where(valid[..., None], rays[..., :2], 0.0) / depth[..., None], valid

        def one(pixels: Tensor) -> tuple[Tensor, Tensor]:
            x, y, valid = self._to_plane(pixels, start)
            return torch.stack([x, y], -1), valid

        return self._in_chunks(one, pixels)

    def unproject(self, pixels: Tensor | ArrayLike, *, start: InverseStart | None = None) -> tuple[Tensor, Tensor]:
        """Map pixels to rays.

        Args:
            pixels: (..., N, 2); any real position, also outside the image.
            start: initial guess of Newton's method in place of the closed form, for example `InverseNet.guess`. It
                affects run time only, not the result.

        Returns:
            rays (..., N, 3) of length one, and valid (..., N). They are directions; `ray_origins` tells where they
            start. A pixel that is not finite or that the lens model cannot produce is not valid, and its ray is the
            optical axis. Gradients by pixels and parameters follow the implicit function theorem.

        Raises:
            InputError: a wrong shape or an integer dtype.
        """
        pixels = self._taken("pixels", pixels, 2)
        if start is None and self._long_graph and (found := self.as_operation("unproject", pixels)):
            return found[0], found[1]
        if start is None and worth_fitting(pixels, self.params, self.model):
            ready = PreparedInverse(self.valid_region, self.inverse_start)
            polynomials = self._fitted.backward(self.params.detach(), self.model, ready)
            if polynomials is not None:
                return map_points(polynomials, self._unproject_by_formulas, pixels, 3)
        return self._unproject_by_formulas(pixels, start)

    def _unproject_by_formulas(self, pixels: Tensor, start: InverseStart | None = None) -> tuple[Tensor, Tensor]:
        def one(pixels: Tensor) -> tuple[Tensor, Tensor]:
            x, y, valid = self._to_plane(pixels, start)
            return torch.stack(rays_from_plane(x, y, self.model), -1), valid

        return self._in_chunks(one, pixels)

    def inside(self, pixels: Tensor | ArrayLike) -> Tensor:
        """Whether pixels (..., N, 2) lie in the image, whose edges are half a pixel beyond the outer pixel centers."""
        pixels = self._taken("pixels", pixels, 2)
        width, height = self.size
        u, v = pixels.unbind(-1)
        return (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)

    def grid(self, columns: int, rows: int) -> Tensor:
        """Pixels (rows, columns, 2) spread evenly over the image, including its outermost pixels."""
        if not (columns >= 1 and rows >= 1 and columns == int(columns) and rows == int(rows)):
            raise InputError(f"grid: whole numbers of columns and rows are needed, got {columns} and {rows}")
        width, height = self.size
        kind, place = torch.float64, self.params.device
        u = torch.linspace(0, width - 1, columns, dtype=kind, device=place)
        v = torch.linspace(0, height - 1, rows, dtype=kind, device=place)
        return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)

    def covers_image(self) -> Tensor:
        """Whether every pixel of the image has a ray, (...); checked along the border of the image."""
        grid = self.grid(17, 13)
        return self.unproject(torch.cat([grid[0], grid[-1], grid[:, 0], grid[:, -1]]))[1].all(-1)

    def forward(self, points_cam: Tensor | ArrayLike) -> tuple[Tensor, Tensor]:
        """The same as `project`."""
        return self.project(points_cam)

    def extra_repr(self) -> str:
        """Model, size and focal length for `repr`."""
        values = ", ".join(f"{value:.6g}" for value in self.focal.flatten().tolist()[:6])
        text = f"model={self.model}, size={self.size}, focal=({values})"
        if self.params.ndim > 1:
            return text
        share = polygon_area(self.valid_polygon()) / (self.size[0] * self.size[1])
        return f"{text}, valid={'whole image' if share > 1 - 1e-9 else f'{share:.1%} of the image'}"


def pixels_to_plane(
    pixels: Tensor, values: Tensor, model: LensModel, ready: PreparedInverse
) -> tuple[Tensor, Tensor, Tensor]:
    """Map pixels (..., N, 2) to x, y on the plane of a lens with `values` (..., 5 + P), and valid; each is (..., N)."""
    cx, cy = values[..., 2, None], values[..., 3, None]
    u, v = split_coordinates(pixels)
    u, v, finite = finite_or(u, v, cx, cy)
    x, y = from_pixels(u, v, values)
    return undistort_components(x, y, finite, values[..., 5:], model, ready)


# The valid region of a lens as a polygon in the image.


def image_outline(parameters: Tensor, model: LensModel, region: Region, size: tuple[int, int]) -> Tensor:
    """Map the valid region to the image (width, height): a polygon (V, 2) in pixels.

    Args:
        parameters: (5 + P,) of a single camera.
        model: its lens model.
        region: its valid region.
        size: (width, height) of the image.
    """
    # A little inside the edge: at a pole the edge itself is mapped to infinity.
    x, y = (region.outline(256) * (1.0 - 1e-6)).unbind(-1)
    lens = distort_components(x, y, parameters[len(INTRINSICS) :], model, slopes=False)
    polygon = torch.stack(to_pixels(lens.x, lens.y, parameters), -1)
    return clip_to_image(polygon, size) if bool(region.radius > 0) else polygon[:0]


def clip_to_image(polygon: Tensor, size: tuple[int, int]) -> Tensor:
    """Clip a polygon (V, 2) to the image, whose edges lie half a pixel beyond the outer pixel centers.

    Source: Sutherland and Hodgman (1974), one edge of the image after the other.

    Example:
        >>> triangle = torch.tensor([[-0.5, -0.5], [9.5, -0.5], [-0.5, 9.5]], dtype=torch.float64)
        >>> clip_to_image(triangle, (5, 10)).tolist()
        [[-0.5, -0.5], [4.5, -0.5], [4.5, 4.5], [-0.5, 9.5]]
    """
    width, height = size
    for axis, edge, sign in ((0, -0.5, 1.0), (0, width - 0.5, -1.0), (1, -0.5, 1.0), (1, height - 0.5, -1.0)):
        height_over = sign * (polygon[:, axis] - edge)
        following, height_after = polygon.roll(-1, 0), height_over.roll(-1, 0)
        weight = (height_over / (height_over - height_after))[:, None]
        crossing = polygon + weight * (following - polygon)
        crossing[:, axis] = edge
        keep = torch.stack([height_over >= 0, (height_over > 0) != (height_after > 0)], -1)
        # A corner on the edge is kept as such; its crossing would repeat it.
        keep[:, 1] &= (height_over != 0) & (height_after != 0)
        polygon = torch.stack([polygon, crossing], 1)[keep]
    return polygon


def polygon_area(polygon: Tensor) -> float:
    """Area of a polygon (V, 2) whose corners run clockwise as seen in the image (x right, y down)."""
    (x, y), (next_x, next_y) = polygon.T, polygon.roll(-1, 0).T
    return float(0.5 * (x * next_y - y * next_x).sum())
