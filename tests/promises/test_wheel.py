"""The wheel: byte-identical from two builds, with its bill of materials, licenses and types inside."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
from packaging.utils import canonicalize_name

from scripts.make_recipe import RECIPE
from scripts.make_recipe import text as recipe_text
from scripts.make_sbom import SBOM, content, requirements

ROOT = Path(__file__).parents[2]


def built(folder: Path) -> Path:
    """A wheel from a copy of the sources, whose files have other times each time."""
    source = folder / "source"
    source.mkdir(parents=True)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copyfile(ROOT / name, source / name)
    shutil.copytree(ROOT / "kcal", source / "kcal", ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    environment = {**os.environ, "SOURCE_DATE_EPOCH": "1700000000"}
    subprocess.run([*command, "--wheel-dir", str(folder), str(source)], check=True, env=environment)
    (wheel,) = folder.glob("*.whl")
    return wheel


@pytest.mark.slow
def test_two_builds_are_the_same(tmp_path: Path) -> None:
    first, second = built(tmp_path / "one"), built(tmp_path / "two")
    assert hashlib.sha256(first.read_bytes()).digest() == hashlib.sha256(second.read_bytes()).digest()
    with zipfile.ZipFile(first) as wheel:
        names = wheel.namelist()
        assert json.loads(wheel.read("kcal/sbom.cdx.json")) == json.loads(SBOM.read_text(encoding="utf-8"))
    assert {"kcal/py.typed", "kcal/stars/bright_stars.bin", "kcal/report/leaflet/leaflet.js"} <= set(names)
    assert {"kcal/web/map/coast.npz", "kcal/web/map/COAST.txt"} <= set(names)
    assert sum(name.endswith("/LICENSE") and ".dist-info/" in name for name in names) == 2
    assert not [name for name in names if name.startswith(("tests", "scripts")) or name.endswith(".pyc")]


def test_the_bill_of_materials_is_valid() -> None:
    assert JsonStrictValidator(SchemaVersion.V1_6).validate_str(SBOM.read_text(encoding="utf-8")) is None


def test_the_bill_of_materials_is_true() -> None:
    """It names what pyproject.toml asks for, with versions that are allowed, those of constraints.txt."""
    stored = json.loads(SBOM.read_text(encoding="utf-8"))
    found = {each["name"]: each for each in stored["components"]}
    pins = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line)
    for each in requirements():
        version = found[canonicalize_name(each.name)]["version"]
        assert each.specifier.contains(version)
        assert pins[each.name] == version
    assert all(each["licenses"] and "not stated" not in str(each["licenses"]) for each in stored["components"])
    # And the packages that these need, by the metadata of what is installed here.
    assert {each["name"] for each in content()["components"]} == found.keys()


def test_the_recipe_is_that_of_pyproject() -> None:
    assert RECIPE.read_text(encoding="utf-8") == recipe_text()


def test_the_release_workflow_builds_as_here_and_publishes_after_the_tests() -> None:
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text(encoding="utf-8"))["jobs"]
    assert "make wheel" in [step.get("run") for step in jobs["build"]["steps"]]
    assert "\nwheel:" in (ROOT / "Makefile").read_text(encoding="utf-8")
    lowest = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["requires-python"]
    assert lowest == f">={min(jobs['test']['strategy']['matrix']['python'])}"
    assert (jobs["publish"]["needs"], jobs["test"]["needs"]) == ("test", "build")
    assert jobs["publish"]["if"] == "github.ref_type == 'tag'"
