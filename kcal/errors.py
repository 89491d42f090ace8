"""The errors kcal raises. Each message is one line that says what is wrong and what to do."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager


class KcalError(Exception):
    """Base of every error that kcal raises on purpose."""


class InputError(KcalError, ValueError):
    """A value, shape, dtype, unit or option that cannot be used."""


class FileError(KcalError):
    """A file that cannot be read, is not what it should be, or cannot be written."""


class ContradictionError(InputError):
    """Measurements of which some contradict all the rest.

    Args:
        text: the message.
        kind: of data that are wrong as a whole, such as "landmarks"; empty for one value, which is measured again.
    """

    def __init__(self, text: str, kind: str = "") -> None:
        super().__init__(text)
        self.kind = kind


class DegenerateError(KcalError):
    """Data that do not determine the answer: too few views, parallel boards, an unstable focal length."""


class KcalWarning(UserWarning):
    """Input that is probably a mistake: meters for millimeters, width for height, right for left."""


def warn_user(message: str) -> None:
    """Warn with a `KcalWarning` where the caller was called, unless by kcal, which means what it does."""

    def module(level: int) -> str:
        return str(sys._getframe(level + 1).f_globals.get("__name__", ""))

    level = 2
    while module(level) in ("kcal.doors", "contextlib"):
        level += 1
    if not module(level).startswith("kcal."):
        warnings.warn(message, KcalWarning, stacklevel=level + 1)


@contextmanager
def with_extra(name: str, what: str) -> Iterator[None]:
    """Import inside what an extra of kcal installs; without it, an `InputError` says how to.

    Example:
        >>> with with_extra("video", "videos need"):
        ...     import no_such_library
        Traceback (most recent call last):
        kcal.errors.InputError: videos need no_such_library; install it with: pip install 'kcal[video]'
    """
    try:
        yield
    except ImportError as error:
        raise InputError(f"{what} {error.name}; install it with: pip install 'kcal[{name}]'") from error
