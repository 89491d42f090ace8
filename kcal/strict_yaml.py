"""Read YAML of unknown origin: short, flat, and without anchors that repeat themselves."""

from __future__ import annotations

import re
from typing import Any

import yaml

from kcal.errors import FileError
from kcal.strict_json import MOST_DEPTH, nesting

# The parser is slow: this much takes it some ten seconds. Values that a document may have once anchors are followed.
MOST_BYTES, MOST_VALUES = 2**20, 200_000


def read_yaml(text: str, source: str) -> dict[str, Any]:
    """The mapping in a YAML text; nothing in it is executed.

    Raises:
        FileError: no YAML, no mapping, nested deeper than 32 levels, or anchors that say more than 200,000 values;
            `source` names the file.

    Example:
        >>> read_yaml("tagCols: 6", "memory")
        {'tagCols': 6}
    """
    if nesting(text.encode("utf-8", "replace")) > MOST_DEPTH:
        raise FileError(f"{source}: nested deeper than {MOST_DEPTH} levels; no file of a camera or a board is")
    try:
        # OpenCV's first line is no directive of YAML, and `ros2 topic echo` ends with the start of another document.
        content = yaml.safe_load(re.sub(r"\A\s*%YAML:.*|^---\s*\Z", "", text, flags=re.MULTILINE))
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        raise FileError(f"{source}: no YAML file: {' '.join(str(error).split())[:300]}") from error
    if not isinstance(content, dict):
        raise FileError(f"{source}: a mapping of names to values is needed")
    if _values(content, {}) > MOST_VALUES:
        raise FileError(f"{source}: its anchors repeat more than {MOST_VALUES:,} values, or themselves")
    return content


def _values(value: Any, counted: dict[int, float]) -> float:
    """How many values there are, each as often as it is named; infinitely many in what contains itself."""
    if not isinstance(value, dict | list | set | tuple):
        return 1
    if id(value) not in counted:
        counted[id(value)] = float("inf")
        inside = [*value, *value.values()] if isinstance(value, dict) else value
        counted[id(value)] = 1 + sum(_values(part, counted) for part in inside)
    return counted[id(value)]
