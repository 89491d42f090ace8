"""All harnesses by name."""

from __future__ import annotations

from scripts.fuzz.commands import commands
from scripts.fuzz.hunt import Harness
from scripts.fuzz.readers import READERS
from scripts.fuzz.servers import SERVERS

HARNESSES: dict[str, Harness] = (
    {name: reader.prepared for name, reader in READERS.items()} | SERVERS | {"commands": commands}
)
