"""The errors kcal raises. Each message is one line that says what is wrong and what to do."""

from __future__ import annotations


class KcalError(Exception):
    """Base of every error that kcal raises on purpose."""


class InputError(KcalError, ValueError):
    """A value, shape, dtype, unit or option that cannot be used."""


class FileError(KcalError):
    """A file that cannot be read, is not what it should be, or cannot be written."""


class DegenerateError(KcalError):
    """Data that do not determine the answer: too few views, parallel boards, an unstable focal length."""
