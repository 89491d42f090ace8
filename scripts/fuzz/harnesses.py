"""All harnesses by name."""

from __future__ import annotations

import importlib.util

from scripts.fuzz.commands import commands
from scripts.fuzz.hunt import Harness
from scripts.fuzz.readers import READERS
from scripts.fuzz.servers import SERVERS

HARNESSES: dict[str, Harness] = (
    {name: reader.prepared for name, reader in READERS.items()} | SERVERS | {"commands": commands}
)
_NEEDED = {"terrain": "rasterio", "map picture": "rasterio", "FITS": "astropy"}


def missing(name: str) -> str:
    """The package that a harness needs and that is not installed, or ""."""
    package = _NEEDED.get(name, "kcal")
    return "" if importlib.util.find_spec(package) else package
