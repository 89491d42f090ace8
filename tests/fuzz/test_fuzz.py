"""Fuzzing with one seed, cases that were mended, and that what is planted is found.

Seed and number of cases are fixed, so that a run is the same on every machine. `make fuzz` draws fresh seeds.
"""

import contextlib
import functools
import io
import itertools
import os
import re
import signal
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("starlette", reason="the extra `mark` is not installed")

from kcal.errors import FileError
from scripts.fuzz import hunt
from scripts.fuzz.__main__ import main
from scripts.fuzz.harnesses import HARNESSES
from scripts.fuzz.reader import Reader, whole_text
from scripts.fuzz.readers import missing

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="cases run in child processes")

# Of each harness: a second of computing.
CASES, FEWER = 100, {"commands": 12, "mrcal .cameramodel": 40, "omni": 30}
CORPUS = Path(__file__).parent / "corpus"


def counts(names: list[str], *options: str) -> dict[str, int]:
    """Cases that were run of each harness that can run here, as the command runs them; a finding fails."""
    there, out = [name for name in names if not missing(name)], io.StringIO()
    with contextlib.redirect_stdout(out), pytest.raises(SystemExit) as ended:
        main([*options, *names])
    assert ended.value.code == 0, f"{options} {names}\n{out.getvalue()}"
    told = re.findall(r"^(.+): (\d+) cases, 0 findings$", out.getvalue(), re.MULTILINE)
    assert [name for name, _ in told] == there
    return {name: int(count) for name, count in told}


@pytest.mark.slow
@pytest.mark.parametrize("name", HARNESSES)
def test_damage_finds_nothing(name: str) -> None:
    if package := missing(name):
        pytest.skip(f"{package} is not installed")
    cases = FEWER.get(name, CASES)
    assert counts([name], "--seed", "1", "--cases", str(cases)) == {name: cases}


def test_what_was_mended_stays_so() -> None:
    corpus = dict(hunt.corpus(CORPUS))
    assert corpus.keys() <= HARNESSES.keys()
    found = counts(list(corpus), "--replay", str(CORPUS))
    assert found == {name: len(corpus[name]) for name in found}


def test_a_limit_is_of_what_is_computed() -> None:
    """The clock has many times as long; limits outside go on."""

    def left() -> list[float]:
        return [signal.getitimer(timer)[0] for timer in (signal.ITIMER_PROF, signal.ITIMER_REAL)]

    with hunt.within(60.0):
        with hunt.within(20.0):
            assert 0 < left()[0] < 21 < left()[1] < 201
        assert 21 < left()[0] < 61 < left()[1] < 601
    assert left() == [0.0, 0.0]
    with pytest.raises(hunt.Overtime), hunt.within(0.1):
        next(number for number in itertools.count() if number < 0)


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


PLANTED = {
    "traceback": (Reader(lambda path: float(path.read_text()), ".txt", whole_text("15")), "ValueError"),
    "silent number": (Reader(first, ".txt", whole_text("15")), "AssertionError: (NaN|infinite): "),
    "saving": (
        Reader(first, ".txt", whole_text("15"), rounded, infinite=("",), unknown=("",)),
        "saved and loaded:  differs",
    ),
    "name": (Reader(nameless, ".txt", whole_text("15"), infinite=("",), unknown=("",)), "names no file"),
    "crash": (Reader(crash, ".txt", whole_text("15"), infinite=("",), unknown=("",)), "ended with code -9"),
    "hang": (Reader(hang, ".txt", whole_text("15"), infinite=("",), unknown=("",)), "longer than its limit"),
    "memory": (Reader(hungry, ".txt", whole_text("15"), infinite=("",), unknown=("",)), "MemoryError"),
}


def planted(name: str, folder: Path) -> hunt.Prepared:
    return PLANTED[name][0].prepared(folder)._replace(seconds=0.2 if name == "hang" else 60.0)


@pytest.mark.parametrize("name", PLANTED)
def test_what_is_planted_is_found(name: str, tmp_path: Path) -> None:
    harness = functools.partial(planted, name)
    found, _ = hunt.hunt(harness, tmp_path, 1, 600.0, most=1)
    assert re.search(PLANTED[name][1], found[0].what), found
    assert hunt.replay(harness, tmp_path, [found[0].case])
    assert hunt.replay(harness, tmp_path, [b"15"]) == []
