"""What commands take of the rooms beside what kcal's doors name, loaded when it is used: the stub says from where.

So no command waits for what another one computes with, nor for what it would need after a refusal. Where a library is
missing that an extra of kcal brings along, the command ends with that extra's name.
"""

import importlib
from typing import Any

from kcal.doors import named_modules
from kcal.errors import InputError

_EXTRAS = {"av": "video", "starlette": "mark", "uvicorn": "mark"}


def __getattr__(name: str) -> Any:
    if name not in (modules := named_modules(__file__)):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = importlib.import_module(modules[name])
    except ImportError as error:
        if (extra := _EXTRAS.get(str(error.name).partition(".")[0])) is None:
            raise
        raise InputError(f"this needs {error.name}; install it with: pip install 'kcal[{extra}]'") from error
    return module if modules[name] == name else getattr(module, name)
