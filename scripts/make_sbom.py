"""Write kcal/sbom.cdx.json: what a wheel of kcal holds and needs, with versions and licenses (CycloneDX 1.6).

    python -m scripts.make_sbom        # in an environment with the versions of constraints.txt

Versions are those that the tests ran with; pyproject.toml states the ranges. There is no time and no serial number in
it, so that two builds of a wheel are the same. `tests/promises/test_wheel.py` checks it against both files.
"""

from __future__ import annotations

import importlib.metadata
import json
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
SBOM = ROOT / "kcal" / "sbom.cdx.json"
# Inside the package, not by kcal's authors.
EMBEDDED = (
    {
        "type": "library",
        "name": "leaflet",
        "version": "1.9.4",
        "description": "the map of kcal's pages, in kcal/report/leaflet",
        "licenses": [{"license": {"id": "BSD-2-Clause"}}],
        "purl": "pkg:npm/leaflet@1.9.4",
    },
    {
        "type": "data",
        "name": "Bright Star Catalogue",
        "version": "5",
        "description": "Hoffleit and Warren 1991, packed in kcal/stars/bright_stars.bin",
        "licenses": [{"license": {"name": "not stated by its authors: positions and brightness of stars"}}],
    },
    {
        "type": "data",
        "name": "Natural Earth 1:50m land",
        "version": "4.1.0",
        "description": "coastlines of maps, packed in kcal/web/map/coast.npz; kcal/web/map/COAST.txt names the source",
        "licenses": [{"license": {"name": "public domain"}}],
    },
)


def requirements() -> list[Requirement]:
    """What an installation without extras needs."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [Requirement(text) for text in project["dependencies"]]


def needed(wanted: Iterable[Requirement], extra: str = "") -> dict[str, list[str]]:
    """Each package that is installed for some requirements, and the packages that it needs itself."""
    out: dict[str, list[str]] = {}
    waiting = [(each, extra) for each in wanted]
    while waiting:
        requirement, given = waiting.pop()
        name = canonicalize_name(requirement.name)
        if name in out or (requirement.marker and not requirement.marker.evaluate({"extra": given})):
            continue
        found = [
            (each, one)
            for each in map(Requirement, importlib.metadata.requires(name) or ())
            for one in requirement.extras or {""}
            if each.marker is None or each.marker.evaluate({"extra": one})
        ]
        out[name] = sorted({canonicalize_name(each.name) for each, _ in found})
        waiting += found
    return dict(sorted(out.items()))


def licenses(name: str) -> list[dict[str, Any]]:
    """As the package states them: an SPDX expression, its classifiers, or its own words."""
    about = importlib.metadata.metadata(name)
    if "License-Expression" in about:
        return [{"expression": about["License-Expression"]}]
    heads = [
        text.rpartition("::")[2].strip() for text in about.get_all("Classifier") or [] if text.startswith("License")
    ]
    words = heads or [(about.get_all("License") or ["not stated"])[0].strip().splitlines()[0][:100]]
    return [{"license": {"name": word}} for word in words]


def version_of(name: str) -> str:
    """Without the local part: +cpu is another build of the same release."""
    return importlib.metadata.version(name).partition("+")[0]


def content() -> dict[str, Any]:
    """The document."""
    packages = needed(requirements())
    refs = {name: f"pkg:pypi/{name}@{version_of(name)}" for name in packages}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    own = f"pkg:pypi/kcal@{project['version']}"
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {
            "component": {
                "type": "library",
                "bom-ref": own,
                "name": "kcal",
                "version": project["version"],
                "licenses": [{"expression": project["license"]}],
                "purl": own,
                "components": list(EMBEDDED),
            }
        },
        "components": [
            {
                "type": "library",
                "bom-ref": refs[name],
                "name": name,
                "version": version_of(name),
                "licenses": licenses(name),
                "purl": refs[name],
            }
            for name in packages
        ],
        "dependencies": [
            {"ref": own, "dependsOn": sorted(refs[canonicalize_name(each.name)] for each in requirements())},
            *({"ref": refs[name], "dependsOn": [refs[each] for each in others]} for name, others in packages.items()),
        ],
    }


def main() -> None:
    SBOM.write_text(json.dumps(content(), indent=1) + "\n", encoding="utf-8")
    print(f"{SBOM.relative_to(ROOT)}: {len(content()['components'])} packages, {len(EMBEDDED)} embedded works")


if __name__ == "__main__":
    main()
