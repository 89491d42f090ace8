"""The observed corners of one camera's views, in memory, in a file, and over images that were resized alike."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
import pydantic
from numpy.typing import NDArray

from kcal.arrow import ArrowRows, arrow_table
from kcal.corners.board import Board
from kcal.doors import shown_in_notebooks
from kcal.errors import InputError
from kcal.file_kind import ImageSize
from kcal.native_file import NativeFile, Record

if TYPE_CHECKING:
    from torch import Tensor


# Store the observed corners of one camera's views, in memory and in a file.

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

    @property
    def places(self) -> NDArray[np.float64]:
        """(N, 2) pixels; NaN where a corner was not seen."""
        return _rows(self.pixels, 2)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(N,) which corners were seen."""
        return np.array([pixel is not None for pixel in self.pixels], dtype=bool)

    def keeping(self, kept: Sequence[bool]) -> View:
        """A copy of the view in which corners that are not kept are None."""

        def of(values: tuple[Any, ...]) -> tuple[Any, ...]:
            return tuple(value if own else None for value, own in zip(values, kept, strict=True))

        spread = self.covariance and of(self.covariance)
        return self.model_copy(update={"pixels": of(self.pixels), "covariance": spread})


def _rows(values: Sequence[tuple[float, ...] | None], size: int) -> NDArray[np.float64]:
    """(N, size) of the rows; NaN where there is none."""
    return np.array([(math.nan,) * size if row is None else row for row in values]).reshape(-1, size)


class Failure(Record):
    """An image that gave no view, and why."""

    name: str
    reason: str


class Observations(ArrowRows, NativeFile):
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

    _repr_html_ = shown_in_notebooks

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
            if [spread is not None for spread in view.covariance] != view.seen.tolist():
                raise ValueError(f"view {view.name!r}: seen corners, and only these, must have a covariance")
            for spread in filter(None, view.covariance):
                if not (spread[0] > 0 and spread[0] * spread[2] > spread[1] ** 2):
                    raise ValueError(f"view {view.name!r}: the covariance {spread} is not positive definite")
        return self

    def _refuse_outside(self, view: View) -> None:
        width, height = self.image_size
        places, far = view.places, np.array(self.image_size) - 0.5 + _BEYOND
        out = places[((places < -0.5 - _BEYOND) | (places > far)).any(1)]
        if len(out):
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

        return torch.from_numpy(np.stack([view.places for view in self.views]))

    def covariances(self) -> Tensor | None:
        """Covariances as (views, corners, 2, 2) px²; NaN where not seen, None unless all views have them."""
        if not self.views or any(view.covariance is None for view in self.views):
            return None
        import torch

        packed = torch.from_numpy(np.stack([_rows(view.covariance or (), 3) for view in self.views]))
        return packed[..., [0, 1, 1, 2]].unflatten(-1, (2, 2))

    def to_arrow(self, **more: Tensor) -> Any:
        """A `pyarrow.Table` of the corners that were seen, one row each; with pyarrow, the extra `tables`.

        Columns: `view`, `corner` (its number on the board), `board_x_m` and its like, `u`, `v` and, where they are
        known, `cov_uu_px2`, `cov_uv_px2`, `cov_vv_px2`.

        Args:
            more: further numbers (V, N) of all corners, by the name of their column.
        """
        pixels, covariances = self.pixels(), self.covariances()
        numbers = {"u": pixels[..., 0], "v": pixels[..., 1]}
        if covariances is not None:
            numbers |= {f"cov_{'uv'[i]}{'uv'[j]}_px2": covariances[..., i, j] for i, j in ((0, 0), (0, 1), (1, 1))}
        view, corner = pixels.isfinite().all(-1).nonzero(as_tuple=True)
        board = {f"board_{axis}_m": self.board.points[corner, i].numpy() for i, axis in enumerate("xyz")}
        texts = {"view": [self.names[i] for i in view.tolist()]}
        rest = {name: value[view, corner].numpy() for name, value in (numbers | more).items()}
        return arrow_table(texts | {"corner": corner.numpy()} | board | rest)

    def subset(self, names: list[str]) -> Observations:
        """The same file with only the named views, in the order given."""
        by_name = {view.name: view for view in self.views}
        missing = [name for name in names if name not in by_name]
        if missing:
            raise InputError(f"no view named {missing[0]!r}")
        return self.model_copy(update={"views": tuple(by_name[name] for name in names)})


# Images of one camera in several sizes: corners of all of them in the pixels of most.
#
# A messenger, a gallery or a video tool makes some images smaller. An image that was only resized shows the same lens:
# its corners are scaled to the size that most images have, edges upon edges. A program that cuts or pads to an even
# size, or to blocks, adds a pixel or two. An image that was cropped or rotated does not tell where in the whole image
# it lies, and one of another camera is not of this lens: both are left out.

Size = tuple[int, int]
# A resized image has both sides rounded to whole pixels.
_ROUNDED = 1.0
# Sizes nearer to each other than this share are cropped by a few pixels more likely than resized.
_NEAR = 0.05
_SAME = 2  # pixels by which images of one camera may differ in width and height
# Names in one message, at most.
_SHOWN = 3


class CommonSize(NamedTuple):
    """The size that most images have.

    Attributes:
        size: (width, height); (0, 0) if no image has one.
        scales: (sx, sy) by which others must be scaled, by their indices.
        left_out: why others cannot be used, by their indices.
        notes: what was done, a sentence each.
    """

    size: Size
    scales: dict[int, tuple[float, float]]
    left_out: dict[int, str]
    notes: tuple[str, ...]


class SizesError(InputError):
    """Images of different sizes, of which none has more than half.

    Args:
        text: the message.
        groups: numbers of the images of each size.
    """

    def __init__(self, text: str, groups: Mapping[Size, Sequence[int]] | None = None) -> None:
        super().__init__(text)
        self.groups = groups or {}


def common_size(names: Sequence[str], sizes: Sequence[Size | None]) -> CommonSize:
    """Find the size of most images, how others must be scaled to have it, and which ones cannot.

    Of sizes that equally many images have, the largest is taken.

    Args:
        names: of the images.
        sizes: (width, height) of each; None for what is no image.

    Raises:
        SizesError: no size to which more than half of the images belong.

    Example:
        >>> found = common_size(["a", "b", "c", "d"], [(1920, 1080), (640, 360), (1920, 1080), (640, 480)])
        >>> found.size, found.scales, list(found.left_out)
        ((1920, 1080), {1: (3.0, 3.0)}, [3])
    """
    groups: dict[Size, list[int]] = {}
    for i, size in enumerate(sizes):
        if size is not None:
            groups.setdefault(size, []).append(i)
    if not groups:
        return CommonSize((0, 0), {}, {}, ())

    def fitting(size: Size) -> int:
        return sum(len(group) for other, group in groups.items() if nearly(other, size) or resized_alike(other, size))

    most = max(groups, key=lambda size: (fitting(size), len(groups[size]), size[0] * size[1]))
    shown = f"{most[0]}x{most[1]} px of most images"
    others = sorted((size for size in groups if size != most), key=lambda size: (-len(groups[size]), size))
    near = [size for size in others if nearly(size, most)]
    alike = [size for size in others if resized_alike(size, most)]
    wrong = [size for size in others if size not in (*near, *alike)]
    turned = {size for size in wrong if (size[1], size[0]) == most or resized_alike((size[1], size[0]), most)}
    if 2 * fitting(most) <= sum(map(len, groups.values())):
        counts = "; ".join(
            f"{len(groups[w, h])} of {w}x{h} px ({_named(names, groups[w, h])})" for w, h in (most, *others)
        )
        cure = "turn back those that were turned by 90 degrees, or " if turned else ""
        raise SizesError(
            f"images of different sizes, of which none has more than half: {counts}; {cure}detect those of each size "
            "apart, as those of a camera of its own",
            groups,
        )
    notes = [
        f"images of {w}x{h} px were taken as they are among the {shown}; which edge has more pixels is not known: "
        f"{_named(names, groups[w, h])}"
        for w, h in near
    ]
    if alike:
        texts = [
            f"{_named(names, groups[w, h])} from {w}x{h} px by {_factor(most[0] / w, most[1] / h)}" for w, h in alike
        ]
        notes.append(f"images of several sizes: corners were scaled to {shown}: {'; '.join(texts)}")
    cures = "cropped or of another camera, take the original or leave it out", "turned by 90 degrees, turn it back"
    left_out = {i: f"{w}x{h} px, not the {shown}: {cures[(w, h) in turned]}" for w, h in wrong for i in groups[w, h]}
    if left_out:
        notes.append(
            f"{len(left_out)} of {len(sizes)} images were left out, because their size is not the {shown}: "
            f"{_named(names, sorted(left_out))}"
        )
    scales = {i: (most[0] / w, most[1] / h) for w, h in alike for i in groups[w, h]}
    return CommonSize(most, scales, left_out, tuple(notes))


def nearly(one: Size, other: Size) -> bool:
    """Whether images differ by a pixel or two, as programs cut or pad them."""
    return max(abs(one[0] - other[0]), abs(one[1] - other[1])) <= _SAME


def resized_alike(one: Size, other: Size) -> bool:
    """Whether one image may be the other one resized: the same shape, up to rounding of the smaller one's sides.

    Example:
        >>> resized_alike((1500, 1000), (640, 427)), resized_alike((640, 480), (640, 360))
        (True, False)
    """
    small, large = sorted((one, other))
    scale = large[0] / small[0]
    return scale >= 1.0 + _NEAR and abs(large[1] / scale - small[1]) <= _ROUNDED


def rescaled(view: View, scale: tuple[float, float]) -> View:
    """A view in an image `scale` times as large: the images' edges, at -0.5, coincide; covariances are scaled alike.

    Example:
        >>> rescaled(View(name="a", pixels=((0.0, 0.0), None)), (3.0, 3.0)).pixels
        ((1.0, 1.0), None)
    """
    x, y = scale
    spread = None if view.covariance is None else _rows(view.covariance, 3) * (x * x, x * y, y * y)
    return View(**dict(view) | {"pixels": (view.places + 0.5) * scale - 0.5, "covariance": spread})


def _named(names: Sequence[str], group: Sequence[int]) -> str:
    shown = ", ".join(names[i] for i in group[:_SHOWN])
    return shown + (f" and {len(group) - _SHOWN} more" if len(group) > _SHOWN else "")


def _factor(x: float, y: float) -> str:
    return f"{x:.4g}" if f"{x:.4g}" == f"{y:.4g}" else f"{x:.4g} and {y:.4g}"
