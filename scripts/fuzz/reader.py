"""A reader of files as a harness: what is read, how it is damaged, and what must hold of what is accepted."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from hypothesis import strategies
from pydantic import BaseModel
from torch import Tensor, nn

from kcal import Camera, InputError, KcalError, Localizer, PositionStatus, Rig
from scripts.fuzz.damage import damaged
from scripts.fuzz.hunt import Prepared
from scripts.shared.page import DOCS


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


# Files of every version of kcal.
_SMALL = 20_000  # bytes
PROMISED = DOCS.parents[1] / "tests" / "promises" / "files"


class Reader(NamedTuple):
    """What reads files of a suffix, how to make a valid one, and what must hold for what is read.

    Attributes:
        read: a file.
        suffix: of its name; it also says how it is damaged.
        write: makes a whole file.
        save: writes again what was read; None where kcal has no writer for it.
        relative: of saved and loaded numbers.
        infinite: ends of places of numbers that may be infinite by their documentation.
        unknown: and of those that may be NaN.
        more: wildcard of further whole files, below `tests/promises/files`.
        named: whether an error must name the file.
        kept: what of it is compared after saving; everything by itself.
    """

    read: Callable[[Path], Any]
    suffix: str
    write: Callable[[Path], object]
    save: Callable[[Any, Path], object] | None = None
    relative: float = 0.0
    infinite: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    more: str = ""
    named: bool = True
    kept: Callable[[Any], Any] = lambda found: found

    def wholes(self, folder: Path) -> list[bytes]:
        """Whole files of the kind."""
        good = folder / f"good{self.suffix}"
        self.write(good)
        return [good.read_bytes(), *(path.read_bytes() for path in sorted(PROMISED.glob(self.more or "no such")))]

    def check(self, path: Path) -> None:
        """Read a file, and raise unless it is refused by its name or everything holds of what was read."""
        try:
            found = self.read(path)
        except KcalError as error:
            if self.named and path.stem not in str(error):
                raise AssertionError(f"the message names no file: {error!s:.200}") from error
            return
        require_finite(found, self.infinite, self.unknown)
        require_status(found)
        if self.save is None:
            return
        again = path.with_name(f"again{self.suffix}")
        try:
            self.save(found, again)
        except InputError:  # for example a lens that the format does not have
            return
        require_same(self.kept(found), self.kept(self.read(again)), self.relative)

    def prepared(self, folder: Path) -> Prepared:
        """The harness of this reader."""
        wholes, path = self.wholes(folder), folder / f"bad{self.suffix}"

        # Large ones seldom: a case of them takes as long as a hundred others. The first, which is made here, is quick.
        small = [whole for whole in wholes if len(whole) < _SMALL] or wholes

        @strategies.composite
        def cases(draw: Any) -> bytes:
            rng = draw(strategies.randoms(use_true_random=False))
            draw_of = rng.random()
            few = wholes if draw_of < 0.1 else small if draw_of < 0.4 else wholes[:1]
            return damaged(rng.choice(few), self.suffix, rng)

        def check(case: bytes) -> None:
            path.write_bytes(case)
            self.check(path)

        # That files of earlier versions are accepted is tested with them.
        check(wholes[0])
        self.read(path)
        return Prepared(cases(), check)


def whole_text(content: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(content, encoding="utf-8")
