"""Compare the pinned dependencies with a stored list of advisories, without a network.

    python -m scripts.check.advisories insecure_full.json [--pins constraints.txt]

The list is one in the format of the package `safety-db` (`safety_db/insecure_full.json` in its wheel): advisories by
name, each with the versions that it concerns. Its date is printed, since a list knows nothing of what came later.
"""

from __future__ import annotations

import argparse
import datetime
import json
import sys
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.specifiers import InvalidSpecifier, SpecifierSet
from packaging.utils import canonicalize_name

PINS = Path(__file__).parents[2] / "constraints.txt"


def pinned(path: Path) -> dict[str, str]:
    """Versions by name."""
    lines = (line.partition("#")[0].strip() for line in path.read_text(encoding="utf-8").splitlines())
    needed = [Requirement(line) for line in lines if line]
    return {canonicalize_name(one.name): next(iter(one.specifier)).version for one in needed}


def concerned(pins: dict[str, str], known: dict[str, Any]) -> list[str]:
    """A line for each advisory that names a pinned version; one whose versions cannot be read counts as naming it."""
    found = []
    for name, advisories in known.items():
        version = pins.get(canonicalize_name(name))
        for advisory in advisories if version is not None and not name.startswith("$") else ():
            if any(_contains(spec, version) for spec in advisory["specs"]):
                found.append(f"{name}=={version}: {advisory['id']} {advisory.get('cve') or ''}: {advisory['advisory']}")
    return found


def _contains(spec: str, version: str | None) -> bool:
    try:
        return version is not None and SpecifierSet(spec).contains(version, prereleases=True)
    except InvalidSpecifier:
        return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("list", type=Path, metavar="JSON", help="advisories in the format of safety-db")
    parser.add_argument("--pins", type=Path, default=PINS)
    given = parser.parse_args()
    known, pins = json.loads(given.list.read_bytes()), pinned(given.pins)
    found = concerned(pins, known)
    day = datetime.datetime.fromtimestamp(known["$meta"]["timestamp"], datetime.UTC).date()
    named = sum(canonicalize_name(name) in pins for name in known)
    print(f"advisories known on {day}: {named} of {len(pins)} pinned packages have some, {len(found)} concern a pin")
    print("\n".join(found))
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
