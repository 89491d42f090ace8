"""What must hold for whatever a reader accepts: finite numbers, points with a status, and the same after saving."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import BaseModel
from torch import Tensor, nn

from kcal import Camera, Localizer, PositionStatus, Rig


def leaves(value: Any, place: str = "", depth: int = 12) -> Iterator[tuple[str, Any]]:
    """Numbers, arrays and texts inside a value, with where they are."""
    parts: Any = ()
    if isinstance(value, Tensor):
        yield place, value.detach().cpu().numpy()
    elif value is None or isinstance(value, np.ndarray | np.generic | int | float | complex | str | bytes | Path):
        yield place, value
    elif isinstance(value, nn.Module):
        parts = [*value.named_parameters(), *value.named_buffers(), *_others(value)]
    elif isinstance(value, Mapping):
        parts = value.items()
    elif isinstance(value, BaseModel):
        parts = [(name, getattr(value, name)) for name in type(value).model_fields]
    elif dataclasses.is_dataclass(value):
        parts = [(field.name, getattr(value, field.name)) for field in dataclasses.fields(value)]
    elif isinstance(value, tuple) and hasattr(value, "_fields"):
        parts = zip(value._fields, value, strict=True)
    elif isinstance(value, list | tuple | set | frozenset):
        parts = enumerate(value)
    for name, part in parts if depth else ():
        yield from leaves(part, f"{place}.{name}", depth - 1)


def _others(module: nn.Module) -> list[tuple[str, Any]]:
    known = {"training", "_parameters", "_buffers", "_modules"}
    return [(name, part) for name, part in vars(module).items() if name not in known and not name.startswith("_")]


def require_finite(value: Any, infinite: tuple[str, ...] = (), unknown: tuple[str, ...] = ()) -> None:
    """Raise `AssertionError` at a number that is not finite, unless its place ends as one of these says.

    Args:
        value: anything.
        infinite: ends of places that may be infinite by their documentation.
        unknown: and of those that may be NaN.
    """
    for place, part in leaves(value):
        if not isinstance(part, np.ndarray | float) or (isinstance(part, np.ndarray) and part.dtype.kind not in "fc"):
            continue
        assert place.endswith(infinite) or not np.isinf(part).any(), f"infinite: {place}"
        assert place.endswith(unknown) or not np.isnan(part).any(), f"NaN: {place}"


def require_same(first: Any, second: Any, relative: float) -> None:
    """Raise `AssertionError` where two values differ, arrays by more than `relative` of their largest element."""
    for one, two in zip(leaves(first), leaves(second), strict=True):
        assert one[0] == two[0], f"saved and loaded: {one[0]} became {two[0]}"
        if isinstance(one[1], np.ndarray | float) and isinstance(two[1], np.ndarray | float):
            array = np.asarray(one[1])
            off = relative * float(np.abs(array[np.isfinite(array)]).max(initial=0.0)) if relative else 0.0
            same = np.shape(array) == np.shape(two[1]) and np.allclose(array, two[1], 0.0, off, equal_nan=True)
        else:
            same = one[1] == two[1]
        assert same, f"saved and loaded: {one[0]} differs ({str(one[1])[:200]} | {str(two[1])[:200]})"


def require_status(value: Any) -> None:
    """Raise `AssertionError` if a camera or a rig gives numbers that are not finite and calls them valid."""
    if isinstance(value, Camera):
        width, height = value.size
        pixels = torch.tensor([[0.0, 0.0], [width / 2, height / 2], [width - 1.0, height - 1.0]], dtype=torch.float64)
        rays, seen = value.unproject(pixels)
        assert bool(rays[seen].isfinite().all()), "valid rays are not finite"
        points = torch.tensor([[0.1, 0.1, 1.0], [-0.5, 0.2, 1.0], [0.0, 0.0, 1e6]], dtype=torch.float64)
        found, valid = value.project(points)
        assert bool(found[valid].isfinite().all()), "valid pixels are not finite"
    if isinstance(value, Rig):
        seen = value(torch.tensor([[1.0, 1.0, 60.0]], dtype=torch.float64))[0]
        if bool(seen.isfinite().all()):
            place = Localizer(value, pixel_sigma=0.3)(seen)
            good = place.status == PositionStatus.OK
            assert bool(place.enu[good].isfinite().all()), "a good position is not finite"
            assert bool(place.range_low[good].isfinite().all()), "the interval of a good position is not finite"
