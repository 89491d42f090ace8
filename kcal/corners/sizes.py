"""Images of one camera that were resized alike: corners of all of them in the pixels of most.

A messenger, a gallery or a video tool makes some images smaller. An image that was only resized shows the same lens:
its corners are scaled to the size that most images have, edges upon edges. An image that was cropped or rotated does
not tell where in the whole image it lies, and is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from kcal.corners.observations import View
from kcal.errors import InputError

Size = tuple[int, int]
# A resized image has both sides rounded to whole pixels.
_ROUNDED = 1.0
# Sizes nearer to each other than this share are cropped by a few pixels more likely than resized.
_NEAR = 0.05
# Names in one message, at most.
_SHOWN = 3


class CommonSize(NamedTuple):
    """The size that most images have.

    Attributes:
        size: (width, height).
        scales: (sx, sy) by which the others must be scaled, by their indices.
        note: which images these are, in one sentence; empty if there are none.
    """

    size: Size
    scales: dict[int, tuple[float, float]]
    note: str


def common_size(names: Sequence[str], sizes: Sequence[Size | None]) -> CommonSize:
    """Find the size of most images, and how the others must be scaled to have it.

    Of sizes that equally many images have, the largest is taken.

    Args:
        names: of the images.
        sizes: (width, height) of each; None for what is no image.

    Raises:
        InputError: images that were cropped or rotated, or no image.

    Example:
        >>> found = common_size(["a", "b", "c"], [(1920, 1080), (640, 360), (1920, 1080)])
        >>> found.size, found.scales
        ((1920, 1080), {1: (3.0, 3.0)})
    """
    groups: dict[Size, list[int]] = {}
    for i, size in enumerate(sizes):
        if size is not None:
            groups.setdefault(size, []).append(i)
    if not groups:
        raise InputError("no image that can be read")
    most = max(groups, key=lambda size: (len(groups[size]), size[0] * size[1]))
    others = sorted((size for size in groups if size != most), key=lambda size: (-len(groups[size]), size))
    wrong = [size for size in others if not resized_alike(size, most)]
    if wrong:
        shown = "; ".join(f"{w}x{h} ({_named(names, groups[w, h])})" for w, h in (most, *others))
        turned = any(resized_alike((h, w), most) or (h, w) == most for w, h in wrong)
        which = "turned by 90 degrees: turn them back" if turned else "cropped: take the originals"
        raise InputError(
            f"images of different sizes: {shown}; some were {which}, or run kcal detect on those of each size apart, "
            "as on a camera of its own"
        )
    texts = [f"{_named(names, groups[w, h])} from {w}x{h} px by {_factor(most[0] / w, most[1] / h)}" for w, h in others]
    note = f"images of several sizes: corners were scaled to {most[0]}x{most[1]} px of most images: {'; '.join(texts)}"
    scales = {i: (most[0] / w, most[1] / h) for w, h in others for i in groups[w, h]}
    return CommonSize(most, scales, note if others else "")


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
    pixels = tuple(at and ((at[0] + 0.5) * x - 0.5, (at[1] + 0.5) * y - 0.5) for at in view.pixels)
    spread = view.covariance
    if spread is not None:
        spread = tuple(own and (own[0] * x * x, own[1] * x * y, own[2] * y * y) for own in spread)
    return view.model_copy(update={"pixels": pixels, "covariance": spread})


def _named(names: Sequence[str], group: Sequence[int]) -> str:
    shown = ", ".join(names[i] for i in group[:_SHOWN])
    return shown + (f" and {len(group) - _SHOWN} more" if len(group) > _SHOWN else "")


def _factor(x: float, y: float) -> str:
    return f"{x:.4g}" if f"{x:.4g}" == f"{y:.4g}" else f"{x:.4g} and {y:.4g}"
