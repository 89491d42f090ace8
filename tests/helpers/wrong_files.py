"""Files of kcal with one wrong field, and what loading says of them."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from kcal.errors import FileError


def assert_refused(
    load: Callable[[Path], object], folder: Path, content: Any, field: Sequence[str | int], value: Any, message: str
) -> None:
    """Loading a file whose `content` has another value in a field fails briefly, with a message that names the file."""
    block = content
    for key in field[:-1]:
        block = block[key]
    block[field[-1]] = value
    path = folder / "wrong.json"
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match=message) as error:
        load(path)
    assert "wrong.json" in str(error.value)
    assert len(str(error.value)) < 400
