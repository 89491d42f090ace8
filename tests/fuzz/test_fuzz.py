"""Fuzzing with fresh seeds, cases that were mended, and that what is planted is found.

`KCAL_FUZZ_SEED` repeats a run (`make test-all` prints it), `KCAL_FUZZ_SECONDS` is the time of each harness.
"""

from __future__ import annotations

import os
import re
import signal
import time
from pathlib import Path

import pytest
import torch

pytest.importorskip("starlette", reason="the extra `mark` is not installed")

from kcal.errors import FileError
from scripts.fuzz import hunt
from scripts.fuzz.harnesses import HARNESSES
from scripts.fuzz.reader import Reader, whole_text

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="cases run in child processes")

SEED = int(os.environ.get("KCAL_FUZZ_SEED") or time.time())
SECONDS = float(os.environ.get("KCAL_FUZZ_SECONDS", "3"))
CORPUS = dict(hunt.corpus(Path(__file__).parent / "corpus"))
NEEDED = {"terrain": "rasterio", "FITS": "astropy"}


@pytest.mark.slow
@pytest.mark.parametrize("name", HARNESSES)
def test_fresh_seeds_find_nothing(name: str, tmp_path: Path) -> None:
    pytest.importorskip(NEEDED.get(name, "kcal"))
    found, count = hunt.hunt(HARNESSES[name], tmp_path, SEED, SECONDS)
    assert not found, "\n".join([f'again: python -m scripts.fuzz --seed {SEED} "{name}"', *map(str, found)])
    assert count


@pytest.mark.parametrize("name", CORPUS)
def test_what_was_mended_stays_so(name: str, tmp_path: Path) -> None:
    pytest.importorskip(NEEDED.get(name, "kcal"))
    assert hunt.replay(HARNESSES[name], tmp_path, CORPUS[name]) == []


def first(path: Path) -> torch.Tensor:
    """The first number of a file, refused by name where there is none."""
    try:
        return torch.tensor(float(path.read_text().split()[0]), dtype=torch.float64)
    except (ValueError, IndexError) as error:
        raise FileError(f"{path}: no number") from error


def crash(path: Path) -> object:
    if "0" in path.read_text(errors="replace"):
        os.kill(os.getpid(), signal.SIGKILL)
    return first(path)


def hang(path: Path) -> object:
    while "5" not in path.read_text(errors="replace"):
        pass
    return first(path)


def hungry(path: Path) -> object:
    return first(path) if "5" in path.read_text(errors="replace") else bytearray(4 * 2**30)


def nameless(path: Path) -> object:
    try:
        return first(path)
    except FileError as error:
        raise FileError("no number") from error


def rounded(found: torch.Tensor, path: Path) -> None:
    path.write_text(f"{min(float(found), 20.0)}")


@pytest.mark.parametrize(
    ("reader", "what"),
    [
        (Reader(lambda path: float(path.read_text()), ".txt", whole_text("15")), "ValueError"),
        (Reader(first, ".txt", whole_text("15")), "AssertionError: (NaN|infinite): "),
        (Reader(first, ".txt", whole_text("15"), rounded, infinite=("",), unknown=("",)), "saved and loaded:  differs"),
        (Reader(nameless, ".txt", whole_text("15"), infinite=("",), unknown=("",)), "names no file"),
        (Reader(crash, ".txt", whole_text("15"), infinite=("",), unknown=("",)), "ended with code -9"),
        (Reader(hang, ".txt", whole_text("15"), infinite=("",), unknown=("",)), "longer than its limit"),
        (Reader(hungry, ".txt", whole_text("15"), infinite=("",), unknown=("",)), "MemoryError"),
    ],
    ids=["traceback", "silent number", "saving", "name", "crash", "hang", "memory"],
)
def test_what_is_planted_is_found(reader: Reader, what: str, tmp_path: Path) -> None:
    def harness(folder: Path) -> hunt.Prepared:
        return reader.prepared(folder)._replace(seconds=0.3)

    found, _ = hunt.hunt(harness, tmp_path, 1, 60.0, most=1)
    assert re.search(what, found[0].what), found
    assert hunt.replay(harness, tmp_path, [found[0].case])
    assert hunt.replay(harness, tmp_path, [b"15"]) == []
