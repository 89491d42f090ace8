"""How many small planted mistakes the tests of each room notice; those that no test noticed, line by line.

Mistakes (`scripts/check/mutations.py`) are drawn at random and planted one at a time in memory; no file is changed. For
each, those tests of the room's own folder run that execute its lines (`coverage` knows), the quickest first, until one
fails, without the slow ones. What nobody noticed so far also meets the tests that came too late in a long file to be
observed. A line that no test executes is not noticed. Each mistake costs a process that begins with kcal loaded.

    python -m scripts.measure mutants --rooms lens io --sample 8 --seed 49 [--write]

First, every test file runs once, to see which lines each test executes and what time it takes; `--times` prints the
rooms and tests that take long. `--seconds`: after which nothing is begun; `--budget`: seconds of tests for one mistake.
All results are kept in .mutants/, and another run goes on where the last one stopped.
Another seed draws afresh: what was drawn with one seed is not drawn with the next. `--again` repeats mistakes that went
unnoticed, with the tests as they are now, and changes no share. Rooms without results in .mutants/ keep their rows of
the page.

Neither mutmut (8 hours for one run of each mistake; it rewrites every function, which `torch.compile` refuses) nor
cosmic-ray (a new process and the whole suite for each mistake) draws samples or chooses tests by what they execute.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import importlib.machinery
import inspect
import json
import math
import os
import pkgutil
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, NamedTuple

import coverage
import pytest

from scripts.check.mutations import Site, sites
from scripts.shared.children import children
from scripts.shared.page import Line, Lines, laid_out, read_section, section, show

HARMLESS = {
    "cc931d9fd18dd576": "`repr` or `compare` of a field that follows from the others",
    "b0297d28c7fdb75f": "how finely a start of Newton's method is tabulated",
    "1861c5cc51a9507f": "a cell is cut in unequal parts that still cover it: the proof takes longer",
    "c1c0d87e7ed882a1": "a number that stands where it is not read",
    "b65b2b83af420b66": "cells without spaces are stripped: only time",
    "b32215be7946701c": "zero times a number, added or subtracted",
    "4beb85845d5b49a6": "a number that is set again before it is read",
    "ffa3e8654c336e29": "a row of nodes more, beyond the image",
    "7900d21ef92672db": "a number that stands where it is not read",
    "2166b957298e0a07": "how coordinates lie in memory: only time",
    "76620474b9ce23e3": "by what a covariance is divided where a variance is zero: how much rounding is let through",
    "4ba3346cb1ac1a53": "rounds more than are needed where pixels are not square",
    "901479ab88fb1d4e": "where a search of amplitudes begins",
    "24324b097f27a6bd": "the rows without one more, of which the pupil's are none",
    "622e793a3790f775": "fy for fx of a camera with square pixels",
    "eb5d59136d2feaa9": "where a thing stands on a site that is made up",
    "3fd88ae2dcad7243": "compares no elements at all",
    "5ffe52c4f8d4ca51": "random numbers that nothing reads: other draws of the same kind",
    "3bfb151f959b9181": "where a thing stands on a site that is made up",
    "cdd6206bf027eb13": "how finely the truth is tabulated",
    "de053044b2589680": "when stopped elements are dropped from a batch: only time",
    "e0ea7adc7be67053": "how many steps a search may take that ends long before",
    "919fd48b3143c8b7": "a number, from the same factors in another order",
    "0596630b21cb4ec2": "a number, from the same factors in another order",
    "ab8b1729821ccfe0": "a first focal length, from which a fit begins",
    "02a20fa8d7b5185d": "where a thing stands on a site that is made up",
    "96a90b97a1771eed": "a variance that is zero to the last bit",
    "921b63f435eb9d99": "whether two texts are equal, whichever comes first",
    "3b10bbfa613c0d36": "lines of a log below the level that is shown",
    "ed7dec0d6447abef": "when stopped elements are dropped from a batch: only time",
    "e7fec4571310adb3": "what happens when no port is free, and there always is one",
    "9d350f625c8848c9": "a negative number, which means none whatever its size",
    "00831ec1d5c8d5b9": "a factor of three in limits of rounding",
    "687fb8c6ef964857": "when stopped elements are dropped from a batch: only time",
    "70f90a90996024bd": "zero, or the cube of zero",
    "4c0100bb1d58a305": "which focal lengths below a millionth of a pixel are refused",
    "3082889367ad8c91": "which way the two axes across the baseline point",
    "6c6214b58c56f43b": "pixels of which one coordinate is NaN: no lens has a ray for them either",
    "5de44679f2cc6387": "rays that have length one",
    "868ad6314f05f253": "the angle between two rays, whichever comes first",
    "4f7ded21d6d6f9ec": "a first principal point, from which a fit begins",
    "43745dfb24530793": "a share that equals a limit to the last bit",
    "41ec4fe6054bc787": "how many matches are worked on at a time: only memory",
    "47e93b395d9a2442": "the size of letters",
    "d3166586025778b5": "the size of letters",
    "991f7ae90849076e": "a circle, drawn from another of its points on",
    "de07024734379c68": "by how many points a name stands beside its mark",
    "2d9fdadb75d7d0e3": "the size of letters",
    "1e51aa8f523d671c": "whether nothing is searched for what is missing of one camera alone, of which nothing is kept",
    "5e0d5c9b92387eca": "the third best of all, which nothing reads",
    "9c9b58ae1e5c2c2a": "numbers of cells, of which no two are alike in either way",
    "f4b30131556f65a1": "the determinant of a product, in either order",
    "fd451fa74fc52ba2": "whether all of two axes are finite, whichever comes first",
    "839c16b3f3d8599d": "what is taken where no angle is wide enough, and the widest one always is",
    "a163b7a5790def1c": "where a search of amplitudes begins",
    "de5f75858fc5244d": "how far away things are put that are as good as infinitely far",
}


ROOT = Path(__file__).parents[2]
# Seconds of the clock for each of processor time: on a busy machine.
CLOCK = 100.0
MEMORY = 6 << 30
# Seconds of processor time after which the rest of a file of tests does not count.
FILE = 8.0


def apart(work: Callable[..., object], *arguments: object, seconds: float, loaded: Sequence[str]) -> Any:
    """What `work` returns in a process of its own, or "too slow" or "crash"; seconds of processor time.

    The process begins with the modules of `loaded`.
    """
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder, "answer.json")
        child = children(*loaded).Process(target=_write_answer, args=(answer, seconds, work, *arguments))
        child.start()
        child.join(CLOCK * seconds)
        late, code = child.exitcode is None, child.exitcode
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid or 0, signal.SIGKILL)
        child.join()
        if answer.exists():
            return json.loads(answer.read_text())
        return "too slow" if late or code == -signal.SIGXCPU else "crash"


def _write_answer(answer: Path, seconds: float, work: Callable[..., object], *arguments: object) -> None:
    os.setpgid(0, 0)
    used = math.ceil(time.process_time() + seconds)
    resource.setrlimit(resource.RLIMIT_CPU, (used, used + 5))
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    silence = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(silence, stream)
    with contextlib.suppress(BaseException):
        answer.write_text(json.dumps(work(*arguments)))
    os._exit(0)


class Executed:
    """Plugin of pytest: which tests execute a line of kcal, and their processor time.

    What fixtures of more than one test execute counts for all tests of the file.
    """

    def __init__(self) -> None:
        self.coverage = coverage.Coverage(data_file=None, include=[f"{ROOT}/kcal/*"], config_file=False)
        self.seconds: dict[str, float] = {}
        self.failed: set[str] = set()
        self.unseen: list[str] = []
        self.end = time.process_time() + FILE

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Name the test that executes what follows, and time it."""
        self.coverage.switch_context(item.nodeid)
        begin = time.process_time()
        yield
        self.seconds[item.nodeid] = round(time.process_time() - begin, 2)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Leave out the rest of a file that takes too long, and what needs a browser, whose time is not counted."""
        browser = any("Chromium" in mark.kwargs.get("reason", "") for mark in item.iter_markers("skipif"))
        if browser:
            pytest.skip("browser")
        if time.process_time() > self.end:
            self.unseen.append(item.nodeid)
            pytest.skip("too long")

    @pytest.hookimpl(hookwrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> Iterator[None]:
        """Let no test own what a shared fixture executes."""
        if fixturedef.scope != "function":
            self.coverage.switch_context("*")
        yield
        if fixturedef.scope != "function" and "::" in (name := os.environ["PYTEST_CURRENT_TEST"]):
            self.coverage.switch_context(name.rsplit(" ", 1)[0])

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note which tests pass."""
        if report.outcome != "passed":
            self.failed.add(report.nodeid)

    def executed(self) -> dict[str, dict[int, list[str]]]:
        """Tests by path and line; "*" for all."""
        data = self.coverage.get_data()
        return {
            str(Path(path).relative_to(ROOT)): {
                # What a file of tests executes when it is imported counts for all of its tests.
                line: [name or "*" for name in names]
                for line, names in data.contexts_by_lineno(path).items()
            }
            for path in data.measured_files()
        }


class First:
    """Plugin of pytest: the test that noticed."""

    name = ""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note a test that fails."""
        if report.failed and not self.name:
            self.name = report.nodeid

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Note a file that cannot be imported."""
        if report.failed and not self.name:
            self.name = f"import of {report.nodeid}"


def run_tests(arguments: list[str], plugin: object) -> int:
    os.chdir(ROOT)
    options = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--no-header", "--tb=no", "--assert=plain"]
    return int(pytest.main([*options, "-m", "not slow", *arguments], plugins=[plugin]))


def observed(file: str) -> dict:
    """The tests of one file."""
    lines = Executed()
    lines.coverage.start()
    run_tests([file], lines)
    lines.coverage.stop()
    return {"seconds": lines.seconds, "failed": sorted(lines.failed), "unseen": lines.unseen, "lines": lines.executed()}


STATE = ROOT / ".mutants"
# The modules at the top, beside the rooms.
TOP = "top"
ROOMS = (
    "lens", "solve", "corners", "io", "calibrate/problem", "calibrate/hybrid", "calibrate/camera", "calibrate/rig",
    "calibrate/batch", "nets", "locate", "stars", "scene", "skyline", "watch", "report", "mark", "capture", "web",
    "pipeline", "cli", "sim",
    TOP,
)  # fmt: skip
# Loaded once, in the server of the processes.
LIBRARIES = ("torch", "kornia", "scipy.stats", "scipy.spatial", "skimage", "cv2", "hypothesis", "matplotlib.pyplot")
# A mistake that makes tests so much slower is noticed, or after so many seconds of processor time.
SLOWER, AT_LEAST = 3.0, 10.0


def plant_in_function(path: str, site: Site, tree: ast.Module) -> bool:
    """Give a function that is loaded the code of the changed module; False where none is found."""
    module = sys.modules.get(path.removesuffix(".py").replace("/", "."))
    name = site.function.split(".<locals>")[0]
    found: Any = module
    code: Any = compile(tree, str(ROOT / path), "exec", dont_inherit=True)
    for part in name.split("."):
        found = inspect.getattr_static(found, part, None)
        code = next((c for c in code.co_consts if isinstance(c, CodeType) and c.co_name == part), None)
        if found is None or code is None:
            return False
    found = inspect.unwrap(getattr(found, "__func__", getattr(found, "fget", getattr(found, "func", found))))
    if not isinstance(found, FunctionType) or found.__code__.co_freevars != code.co_freevars:
        return False
    found.__code__ = code
    return True


def plant_by_import(path: str, tree: ast.Module) -> None:
    """Load kcal anew, with the changed module in it."""
    target, load = str(ROOT / path), importlib.machinery.SourceFileLoader.get_code

    def get_code(self: importlib.machinery.SourceFileLoader, name: str) -> CodeType | None:
        return compile(tree, target, "exec", dont_inherit=True) if self.path == target else load(self, name)

    setattr(importlib.machinery.SourceFileLoader, "get_code", get_code)  # noqa: B010
    for name in [name for name in sys.modules if name.split(".")[0] == "kcal"]:
        del sys.modules[name]


def with_mistake(path: str, number: int, tests: list[str]) -> str:
    """Run tests with one mistake in kcal; the first that fails, or nothing."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    site = sites(tree, path)[number]
    site.plant()
    ast.fix_missing_locations(tree)
    if not (site.function and plant_in_function(path, site, tree)):
        plant_by_import(path, tree)
    first = First()
    code = run_tests(["-x", *tests], first)
    # A test that is no longer there has noticed nothing.
    missing = code in (pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED) and not first.name
    return first.name or f"pytest ended with {code}" if code and not missing else ""


def loaded() -> list[str]:
    """Modules with which a process begins."""
    return [*LIBRARIES, *(module.name for module in pkgutil.walk_packages([str(ROOT / "kcal")], "kcal."))]


def modules(room: str) -> list[Path]:
    folder = ROOT / "kcal" / ("" if room == TOP else room)
    return [path for path in sorted(folder.glob("*.py")) if path.name != "__init__.py"]


def test_files(room: str) -> list[Path]:
    return sorted((ROOT / "tests" / ("" if room == TOP else room)).glob("test_*.py"))


def observe(room: str, stop: float) -> list[dict]:
    """The tests of a room by file; from .mutants/ where the file and the room are the same, none where time is up."""
    found, code = [], b"".join(path.read_bytes() for path in modules(room))
    for file in test_files(room):
        name = str(file.relative_to(ROOT))
        kept, digest = STATE / f"{name.replace('/', '-')}.json", hashlib.sha256(file.read_bytes() + code).hexdigest()
        known = json.loads(kept.read_text()) if kept.exists() else {}
        if known.get("digest") != digest:
            known = {}
        if not known and time.monotonic() < stop:
            answer = apart(observed, name, seconds=3 * FILE, loaded=loaded())
            known = {
                "digest": digest,
                **(answer if isinstance(answer, dict) else {"seconds": {}, "lines": {}, "unseen": []}),
            }
            kept.write_text(json.dumps(known))
            note = "" if isinstance(answer, dict) and not answer["failed"] else f" ({answer})"[:300]
            print(f"{name}: {len(known['seconds'])} tests, {sum(known['seconds'].values()):.0f} s{note}", flush=True)
        if known.get("seconds"):
            found.append(known | {"cached": "functools.cache" in file.read_text(encoding="utf-8")})
    return found


def chosen(files: list[dict], path: str, site: Site, budget: float) -> tuple[list[str], int, float, list[str]]:
    """Tests that execute a mistake, the quickest first; how many the budget leaves out; seconds of processor time.

    And those that may execute it, in files whose observed tests execute its module.

    Outside of functions, all tests that execute any line of the module: they may read a constant.
    """
    found: list[tuple[bool, float, str]] = []
    unseen: list[str] = []
    for file in files:
        unseen += file["unseen"] if path in file["lines"] else []
        lines: dict[str, list[str]] = file["lines"].get(path, {})
        names = {
            name
            for line, tests in lines.items()
            if not site.function or site.first <= int(line) <= site.last
            for name in tests
        }
        if "*" in names:
            names = set(file["seconds"])
        # What the first test leaves in a cache, others of the file look at.
        more = set(file["seconds"]) - names if names and file["cached"] else set()
        found += [(name in more, file["seconds"][name], name) for name in names | more if name not in file["failed"]]
    found.sort()
    total = 0.0
    tests: list[str] = []
    for _, seconds, name in found:
        if total + seconds <= budget or not tests:
            total += seconds
            tests.append(name)
    return tests, len(found) - len(tests), total, unseen


def draws(room: str, seed: int) -> list[tuple[str, int, Site]]:
    """All mistakes of a room in a random order: path, number in its module, mistake."""
    found = []
    for path in modules(room):
        name = str(path.relative_to(ROOT))
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found += [(name, number, site) for number, site in enumerate(sites(tree, name))]
    # In an order of their own each, so that a change of one function leaves the others where they are.
    return sorted(found, key=lambda draw: hashlib.sha256(f"{seed} {draw[2].key}".encode()).digest())


def results(*, first: bool = False) -> dict[str, dict]:
    """What became of each mistake, the last time; or `first`."""
    kept = STATE / "results.jsonl"
    lines = kept.read_text().splitlines() if kept.exists() else []
    return {entry["key"]: entry for entry in map(json.loads, lines[::-1] if first else lines)}


def rows_of_page() -> dict[str, tuple[str, ...]]:
    """The rows of the table as it is, by room."""
    rows = [line.strip("| ").split(" | ") for line in read_section("mutants.md", "mutants").splitlines()]
    return {row[0].strip("`"): tuple(row) for row in rows if row[0].strip("`") in ROOMS}


def judge(files: list[dict], path: str, number: int, site: Site, budget: float, seed: int) -> None:
    """Plant one mistake and run tests."""
    tests, left, seconds, unseen = chosen(files, path, site, budget)
    limit = AT_LEAST + SLOWER * seconds
    by = apart(with_mistake, path, number, tests, seconds=limit, loaded=loaded()) if tests else ""
    if unseen and not by:
        # What they take is not known: to take long is no notice.
        late = apart(with_mistake, path, number, unseen, seconds=AT_LEAST + budget, loaded=loaded())
        by, left = ("", left + len(unseen)) if late == "too slow" else (late, left)
    entry = {
        "key": site.key,
        "path": path,
        "seed": seed,
        "noticed": bool(by),
        "by": by,
        "tests": len(tests),
        "left": left,
    }
    with (STATE / "results.jsonl").open("a") as file:
        file.write(json.dumps(entry) + "\n")
    verdict = f"noticed by {by}" if by else f"NOT NOTICED by {len(tests)} tests ({left} too slow)"
    print(f"{path}:{site.line} {site.kind}: {site.before} -> {site.after}: {verdict} [{site.key}]", flush=True)


def interval(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share (E. B. Wilson, 1927)."""
    z2 = 1.96**2
    middle, half = hits + z2 / 2, 1.96 * math.sqrt(hits * (count - hits) / count + z2 / 4)
    return (middle - half) / (count + z2), (middle + half) / (count + z2)


class Draw(NamedTuple):
    """What became of the mistakes of a room that one seed drew: number, harmless ones, noticed ones."""

    drawn: int
    harmless: int
    noticed: int

    @property
    def share(self) -> str:
        """Noticed ones among those that change a result."""
        return f"{self.noticed} of {self.drawn - self.harmless}"


def first_draw(by_seed: dict[int, Draw], row: tuple[str, ...] | None) -> str:
    """What the first draw of a room noticed: the row of the page tells it where .mutants/ began later."""
    if row is not None and (row[1] or int(row[2]) not in by_seed):
        return row[1] or row[-1]
    return by_seed[min(by_seed)].share if len(by_seed) > 1 else ""


def report() -> tuple[list[Line], list[Line]]:
    """A table of the rooms, the first and the last draw of each; and what was not noticed, or is harmless, by line."""
    kept, at_first, known = results(), results(first=True), rows_of_page()
    rows: list[tuple[object, ...]] = []
    missed: list[tuple[object, ...]] = []
    idle: list[tuple[object, ...]] = []
    total = noticed = 0
    for room in ROOMS:
        folder = Path("kcal", "" if room == TOP else room)
        # Those in code that was changed since count, too.
        every = [entry for entry in kept.values() if Path(entry["path"]).parent == folder]
        by_seed: dict[int, Draw] = {}
        for seed in sorted({entry["seed"] for entry in every}):
            # As drawn, before anything was mended.
            own = [(entry["key"], at_first[entry["key"]]["noticed"]) for entry in every if entry["seed"] == seed]
            matter = [found for key, found in own if key not in HARMLESS]
            by_seed[seed] = Draw(len(own), len(own) - len(matter), sum(matter))
        if not by_seed:
            # Drawn elsewhere: the page knows.
            if room in known:
                rows.append(known[room])
                hits, count = map(int, known[room][-1].split(" of "))
                total, noticed = total + count, noticed + hits
            continue
        last = max(by_seed)
        judged = [(path, site, kept[site.key]) for path, _, site in draws(room, 0) if site.key in kept]
        for path, site, entry in sorted(judged, key=lambda row: (row[0], row[1].line)):
            texts = (f"`{' '.join(text.split())[:70]}`".replace("|", "\\|") for text in (site.before, site.after))
            where = f"{path}:{site.line}", entry["seed"], site.kind, *texts
            if site.key in HARMLESS:
                idle.append((*where, HARMLESS[site.key]))
            elif not entry["noticed"]:
                missed.append((*where, entry["tests"], site.key))
        end = by_seed[last]
        total, noticed = total + end.drawn - end.harmless, noticed + end.noticed
        before = first_draw(by_seed, known.get(room))
        rows.append((f"`{room}`", before, last, end.drawn, end.harmless, end.share))
    if not total:
        return ["Nothing was drawn yet."], []
    low, high = interval(noticed, total)
    summary = (
        f"In the last draw of each room, {noticed} of {total} mistakes that change a result were noticed: "
        f"{100 * noticed / total:.0f} % (95 % interval {100 * low:.0f} to {100 * high:.0f} %)."
    )
    heads = ("room", "first draw", "last draw: seed", "drawn", "harmless", "noticed")
    lines = [
        f"Not noticed ({len(missed)})", ("line", "seed", "kind", "before", "after", "tests", "key"), *missed,
        f"Harmless ({len(idle)})", ("line", "seed", "kind", "before", "after", "why"), *idle,
    ]  # fmt: skip
    return [heads, *rows, summary], lines


def time_table(rooms: Sequence[str]) -> Lines:
    """Processor time of each room's tests, and the tests that take longest."""
    yield ["room", "tests", "CPU s", "those of 2 s and more"]
    for room in rooms:
        tests = sorted(((s, name) for file in observe(room, -math.inf) for name, s in file["seconds"].items()))[::-1]
        longest = ", ".join(f"{name.split('/')[-1]} {seconds:.0f}" for seconds, name in tests[:6] if seconds >= 2)
        yield (f"`{room}`", len(tests), f"{sum(seconds for seconds, _ in tests):.0f}", longest)


@section("mutants.md", "mutants", seconds=0.0, rooms=("web",))
def mutants(
    rooms: tuple[str, ...] = ROOMS, sample: int = 8, seed: int = 1, seconds: float = math.inf, budget: float = 30.0,
    again: bool = False, times: bool = False,
) -> list[Line]:  # fmt: skip
    if times:
        show(list(laid_out(time_table(rooms))))
        return []
    STATE.mkdir(exist_ok=True)
    stop = time.monotonic() + seconds
    for room in rooms:
        files, kept = observe(room, stop), results()
        before = {key for key, entry in kept.items() if entry["seed"] != seed}
        drawn = [draw for draw in draws(room, seed) if draw[2].key not in before]
        for path, number, site in drawn[:sample]:
            if time.monotonic() > stop:
                break
            repeat = again and not kept.get(site.key, {"noticed": True})["noticed"]
            if site.key not in HARMLESS and (site.key not in kept or repeat):
                judge(files, path, number, site, budget, seed)
    found, lines = report()
    show(list(laid_out(lines)))
    return found
