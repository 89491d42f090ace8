"""Write scripts/release/recipe.yaml, with which conda-forge would build kcal (version 1 of its format of recipes).

    python -m scripts.make_recipe

Versions and dependencies are those of pyproject.toml (`tests/promises/test_wheel.py`). kcal is on no registry yet: the
source is the archive that the release workflow builds.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
RECIPE = ROOT / "scripts" / "release" / "recipe.yaml"
# Packages that have another name at conda-forge. Its OpenCV is built with the contributed modules and without a screen.
_NAMES = {"torch": "pytorch", "opencv-contrib-python-headless": "py-opencv", "matplotlib": "matplotlib-base"}


def recipe() -> dict[str, Any]:
    """The recipe, from pyproject.toml."""
    text = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    project, build = text["project"], text["build-system"]
    python = project["requires-python"].removeprefix(">=")

    def named(requirement: str) -> str:
        one = Requirement(requirement)
        return f"{_NAMES.get(one.name, one.name)} {','.join(sorted(map(str, one.specifier), reverse=True))}"

    return {
        "schema_version": 1,
        "context": {"version": project["version"], "python_min": python},
        "package": {"name": project["name"], "version": "${{ version }}"},
        "source": {"path": "../../dist/kcal-${{ version }}.tar.gz"},
        "build": {
            "number": 0,
            "noarch": "python",
            "script": "python -m pip install . --no-deps --no-build-isolation",
            "python": {"entry_points": [f"{name} = {what}" for name, what in project["scripts"].items()]},
        },
        "requirements": {
            "host": ["python ${{ python_min }}.*", "pip", *map(named, build["requires"])],
            "run": ["python >=${{ python_min }}", *map(named, project["dependencies"])],
        },
        # No `pip check`: conda-forge's OpenCV does not go by the name that kcal's requirement has.
        "tests": [
            {"python": {"imports": ["kcal", "kcal.corners", "kcal.lens", "kcal.locate"], "pip_check": False}},
            {"script": ["kcal --version", "kcal --help"]},
        ],
        "about": {
            "summary": project["description"],
            "license": project["license"],
            "license_file": project["license-files"],
        },
    }


def text() -> str:
    """What the file has."""
    head = "# Made by scripts/make_recipe.py from pyproject.toml.\n"
    return head + yaml.safe_dump(recipe(), sort_keys=False, width=120)


if __name__ == "__main__":
    RECIPE.parent.mkdir(exist_ok=True)
    RECIPE.write_text(text(), encoding="utf-8")
