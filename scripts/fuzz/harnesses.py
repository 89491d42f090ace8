"""All harnesses by name."""

from __future__ import annotations

from pathlib import Path

from scripts.fuzz.commands import commands
from scripts.fuzz.hunt import Harness, Prepared
from scripts.fuzz.readers import READERS
from scripts.fuzz.servers import SERVERS

HARNESSES: dict[str, Harness] = (
    {name: reader.prepared for name, reader in READERS.items()} | SERVERS | {"commands": commands}
)


def prepared(name: str, folder: Path) -> Prepared:
    """The harness of a name, made ready."""
    return HARNESSES[name](folder)
