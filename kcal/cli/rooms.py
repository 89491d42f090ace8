"""What commands take of the rooms beside what kcal's doors name, loaded when it is used: the stub says from where.

So no command waits for what another one computes with, nor for what it would need after a refusal.
"""

import importlib
from typing import Any

from kcal.doors import named_modules


def __getattr__(name: str) -> Any:
    if name not in named_modules(__file__):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(named_modules(__file__)[name]), name)
