"""Store the observed corners of one camera's views, in memory and in a file."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import pydantic

from kcal.corners.board import Board
from kcal.errors import InputError
from kcal.image_header import ImageSize
from kcal.native_file import NativeFile, Record

if TYPE_CHECKING:
    from torch import Tensor

# Sides of images have at most 65535 pixels in most formats; far beyond, squares and products overflow.
Coordinate = Annotated[float, pydantic.Field(ge=-1e6, le=1e6)]
Pixel = tuple[Coordinate, Coordinate]
PackedCovariance = tuple[float, float, float]

# Pixels that noise or a bad refinement may move a corner at the image's edge beyond it.
_BEYOND = 2.0


class View(Record):
    """One image in which the board was found.

    Args:
        name: unique name in the file, usually the image's file name; views of two cameras are paired by it.
        pixels: (u, v) of each board corner in the board's order, or None where a corner was not seen. Integer
            coordinates are centers of pixels. Also an array or tensor (N, 2), or (N, 1, 2) as OpenCV has it, with NaN
            where a corner was not seen.
        covariance: (uu, uv, vv) in px² of each board corner, None where not seen; or None if unknown for all.
        image: path from which the image was read, relative or absolute.
        sha256: of the image file's bytes, to notice a changed image.
    """

    name: str = pydantic.Field(min_length=1)
    pixels: tuple[Pixel | None, ...]
    covariance: tuple[PackedCovariance | None, ...] | None = None
    image: str | None = None
    sha256: str | None = None


class Failure(Record):
    """An image that gave no view, and why."""

    name: str
    reason: str


class Observations(NativeFile):
    """All views of one camera (file kind `observations`, version 1).

    Args:
        board: the board that was shown.
        image_size: (width, height) in pixels, the same for all views; all corners lie within.
        refinement: method of `kcal.corners.refine.refine_corners`.
        views: the views in which the board was found.
        failures: the images that gave none.

    Example:
        >>> view = View(name="a.png", pixels=((0.0, 0.0), (9.0, 0.0), (0.0, 9.0), None))
        >>> seen = Observations(board=Board(columns=2, rows=2, square=0.1), image_size=(10, 10), views=(view,))
        >>> tuple(seen.pixels().shape), bool(seen.pixels()[0, 3].isnan().all())
        ((1, 4, 2), True)
    """

    KIND: ClassVar[str] = "observations"
    VERSION: ClassVar[int] = 1

    board: Board
    image_size: ImageSize
    refinement: Literal["erf", "saddle", "opencv", "skimage", "none"] = "erf"
    views: tuple[View, ...]
    failures: tuple[Failure, ...] = ()

    @pydantic.model_validator(mode="after")
    def _consistent(self) -> Observations:
        names = [view.name for view in self.views]
        if len(set(names)) != len(names):
            twice = min(name for name, count in Counter(names).items() if count > 1)
            raise ValueError(f"two views share the name {twice!r}")
        for view in self.views:
            if len(view.pixels) != self.board.corners:
                raise ValueError(f"view {view.name!r} has {len(view.pixels)} corners, the board {self.board.corners}")
            self._refuse_outside(view)
            if view.covariance is None:
                continue
            if len(view.covariance) != len(view.pixels):
                raise ValueError(f"view {view.name!r} has {len(view.covariance)} covariances for its corners")
            for pixel, spread in zip(view.pixels, view.covariance, strict=True):
                if (pixel is None) != (spread is None):
                    raise ValueError(f"view {view.name!r}: seen corners, and only these, must have a covariance")
                if spread is not None and not (spread[0] > 0 and spread[0] * spread[2] > spread[1] ** 2):
                    raise ValueError(f"view {view.name!r}: the covariance {spread} is not positive definite")
        return self

    def _refuse_outside(self, view: View) -> None:
        width, height = self.image_size
        low, right, bottom = -0.5 - _BEYOND, width - 0.5 + _BEYOND, height - 0.5 + _BEYOND
        out = [pixel for pixel in view.pixels if pixel and not (low <= pixel[0] <= right and low <= pixel[1] <= bottom)]
        if out:
            raise ValueError(
                f"view {view.name!r}: {len(out)} corner(s) lie outside the image of {width}x{height} px, one at "
                f"({out[0][0]:.1f}, {out[0][1]:.1f}): the image size or the corners are wrong, or of another scale"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """The views' names, in order."""
        return tuple(view.name for view in self.views)

    def pixels(self) -> Tensor:
        """Corners as (views, corners, 2) float64 pixels; NaN where a corner was not seen.

        Raises:
            InputError: there is no view.
        """
        if not self.views:
            raise InputError("no view with a board; check the board's size and the images")
        import torch

        nowhere = (float("nan"), float("nan"))
        return torch.tensor(
            [[nowhere if pixel is None else pixel for pixel in view.pixels] for view in self.views],
            dtype=torch.float64,
        )

    def covariances(self) -> Tensor | None:
        """Covariances as (views, corners, 2, 2) px²; NaN where not seen, None unless all views have them."""
        if not self.views or any(view.covariance is None for view in self.views):
            return None
        import torch

        nothing = (float("nan"),) * 3
        packed = torch.tensor(
            [[spread or nothing for spread in view.covariance or ()] for view in self.views], dtype=torch.float64
        )
        return packed[..., [0, 1, 1, 2]].unflatten(-1, (2, 2))

    def subset(self, names: list[str]) -> Observations:
        """The same file with only the named views, in the order given."""
        by_name = {view.name: view for view in self.views}
        missing = [name for name in names if name not in by_name]
        if missing:
            raise InputError(f"no view named {missing[0]!r}")
        return self.model_copy(update={"views": tuple(by_name[name] for name in names)})
