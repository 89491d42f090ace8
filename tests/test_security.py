"""What SECURITY.md says: its limits are those of the code, and the container's user."""

import re
from pathlib import Path

from kcal import file_kind, strict_json
from kcal.io import lookup_file
from kcal.web import serving
from scripts.check import container
from scripts.fuzz.harnesses import HARNESSES
from scripts.fuzz.readers import READERS

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "SECURITY.md").read_text(encoding="utf-8")


def test_its_limits_are_those_of_the_code() -> None:
    rows = dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", TEXT, re.MULTILINE))
    assert rows["JSON files of kcal"].startswith(f"{strict_json.MOST_BYTES >> 20} MiB, {strict_json.MOST_DEPTH} levels")
    assert rows["images"].startswith(f"{file_kind.MOST_PIXELS // 10**6} megapixels")
    assert rows["lookup tables (.npz)"].startswith(f"{lookup_file._MOST_BYTES >> 20} MiB")
    assert rows["requests to a local page"].startswith(f"{serving._LARGEST_BODY >> 20} MiB, {serving._DEEPEST} levels")


def test_every_reader_and_server_is_fuzzed() -> None:
    assert set(HARNESSES) >= {*READERS, "marking", "capture", "live map", "commands"}


def test_the_container_has_a_user_without_rights_and_a_health_check() -> None:
    steps = container.steps()
    words = [step.word for step in steps]
    (user,) = (step.rest for step in steps if step.word == "USER")
    assert int(user.split(":")[0]) > 0
    assert words.count("HEALTHCHECK") == 1
    assert "RUN" not in words[words.index("USER") :]
    copied = [name for step in steps if step.word == "COPY" for name in step.rest.split()[:-1]]
    kept = (ROOT / ".containerignore").read_text().split()
    assert all((ROOT / name).exists() and f"!{name}" in kept for name in copied)
