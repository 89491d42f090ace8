"""What commands take of the rooms: each name stands in the stub, which has no others, and is found where it says."""

import ast
import sys
from pathlib import Path

import pytest

from kcal.cli import rooms
from kcal.doors import named_modules
from kcal.errors import InputError
from kcal.locate.marks import is_long


def test_the_stub_has_what_commands_use_and_nothing_else() -> None:
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in Path(rooms.__file__).parent.glob("*.py")]
    parts = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    used = {part.attr for part in parts if isinstance(part.value, ast.Name) and part.value.id == "rooms"}
    assert used == set(named_modules(rooms.__file__))


def test_a_name_is_what_its_module_defines() -> None:
    assert rooms.is_long is is_long
    with pytest.raises(AttributeError, match="no attribute 'is_short'"):
        _ = rooms.is_short  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("name", "library", "extra"),
    [("Videos", "av", "video"), ("sender_to", "starlette", "mark"), ("LocalServer", "uvicorn", "mark")],
)
def test_a_library_that_is_missing_is_named_with_its_extra(
    name: str, library: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for loaded in [one for one in sys.modules if one.partition(".")[0] == library]:
        monkeypatch.setitem(sys.modules, loaded, None)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, named_modules(rooms.__file__)[name], raising=False)
    with pytest.raises(InputError, match=rf"this needs {library}\S*; install it with: pip install 'kcal\[{extra}\]'"):
        getattr(rooms, name)
