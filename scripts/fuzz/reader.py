"""A reader of files as a harness: what is read, how it is damaged, and what must hold of what is accepted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from hypothesis import strategies

from kcal.errors import InputError, KcalError
from scripts.fuzz.damage import damaged
from scripts.fuzz.hunt import Prepared
from scripts.fuzz.invariants import require_finite, require_same, require_status
from scripts.shared.page import DOCS

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
