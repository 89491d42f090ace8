"""How many small planted mistakes the tests notice, folder by folder; those that no test noticed, line by line.

Mistakes (`scripts/check/mutations.py`) are drawn at random and planted one at a time in memory; no file is changed. For
each, tests run that call the function that was changed: those of the same folder of tests/ and its examples in
docstrings, the quickest first, then those of other folders. Each mistake costs a forked process that has the libraries
loaded already.

    python -m scripts.check.mutants [FOLDER ...] [--sample 40] [--seed 0] [--seconds 3600] [--budget 60]

First, every test file runs once, to see which functions each test calls and what time it takes. All results are kept in
.mutants/, and another run goes on where the last one stopped; what was changed since is drawn anew. `--again` repeats
mistakes that went unnoticed, with the tests as they are now.

Neither mutmut (8 hours for one run of each mistake; it rewrites every function, which `torch.compile` refuses) nor
cosmic-ray (a new process and the whole suite for each mistake) draws samples or chooses tests by what they call.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import hashlib
import importlib
import importlib.machinery
import json
import math
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest

from scripts.check.harmless import HARMLESS
from scripts.check.mutations import Site, sites
from scripts.shared.page import table

ROOT = Path(__file__).parents[2]
STATE = ROOT / ".mutants"
FOLDERS = ("lens", "solve", "calibrate", "locate", "corners", "io")
# Folders of tests that count too, if those of the folders above notice nothing.
ELSEWHERE = ("report", "capture", "sim")
# Loaded once, before anything is forked.
LIBRARIES = ("torch", "kornia", "scipy.stats", "scipy.spatial", "skimage", "cv2", "pydantic", "hypothesis", "typer")
# A mistake that makes tests so much slower is noticed. Seconds of processor time, and of the clock for each of them.
SLOWER, AT_LEAST, CLOCK = 3.0, 20.0, 10.0
MEMORY = 6 << 30


def forked(work: Callable[[], object], seconds: float) -> Any:
    """What `work` returns in a process of its own, or "too slow" or "crash"; seconds of processor time."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder, "answer.json")
        pid = os.fork()
        if pid == 0:
            os.setpgid(0, 0)
            resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(seconds), math.ceil(seconds) + 5))
            resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
            silence = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(silence, stream)
            with contextlib.suppress(BaseException):
                answer.write_text(json.dumps(work()))
            os._exit(0)
        end, status = time.monotonic() + CLOCK * seconds, None
        while status is None and time.monotonic() < end:
            done, code = os.waitpid(pid, os.WNOHANG)
            status = code if done else None
            time.sleep(0.02)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)
        if status is None:
            os.waitpid(pid, 0)
        if answer.exists():
            return json.loads(answer.read_text())
        slow = status is None or (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU)
        return "too slow" if slow else "crash"


class Calls:
    """Plugin of pytest: which functions of kcal each test calls, and its processor time."""

    def __init__(self) -> None:
        self.tests: dict[str, dict] = {}
        # What fixtures call counts for all tests of the file, because one test sets them up for the others.
        self.fixtures: set[tuple[str, str]] = set()
        self.setup = 0.0
        self._called: set[tuple[str, str]] = set()

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Trace the calls of one test."""
        called = self._called = set()
        known: set[CodeType] = set()
        base = f"{ROOT}/kcal/"

        def trace(frame: FrameType, event: str, arg: object) -> None:
            if (code := frame.f_code) not in known:
                known.add(code)
                if code.co_filename.startswith(base):
                    called.add((code.co_filename[len(str(ROOT)) + 1 :], code.co_qualname))

        begin = time.process_time()
        self.tests[item.nodeid] = {"passed": True}
        sys.settrace(trace)
        yield
        sys.settrace(None)
        self.tests[item.nodeid] |= {"seconds": round(time.process_time() - begin, 2), "calls": sorted(called)}

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_setup(self) -> Iterator[None]:
        """Time the fixtures of one test."""
        begin = time.process_time()
        yield
        self.setup = max(self.setup, time.process_time() - begin)
        self.fixtures |= self._called

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note which tests pass."""
        if report.outcome != "passed":
            self.tests[report.nodeid]["passed"] = False


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
    return int(pytest.main([*options, *arguments], plugins=[plugin]))


def observed(file: str) -> dict:
    """The tests of one file."""
    calls = Calls()
    run_tests([file], calls)
    return {"tests": calls.tests, "fixtures": sorted(calls.fixtures), "setup": round(calls.setup, 2)}


def with_mistake(path: str, number: int, tests: list[str]) -> list[str]:
    """Import kcal with one mistake in it and run tests; the first that fails, or nothing."""
    target, load = str(ROOT / path), importlib.machinery.SourceFileLoader.get_code

    def get_code(self: importlib.machinery.SourceFileLoader, name: str) -> CodeType | None:
        if self.path != target:
            return load(self, name)
        tree = ast.parse(Path(target).read_text(encoding="utf-8"))
        sites(tree, path)[number].plant()
        return compile(ast.fix_missing_locations(tree), target, "exec", dont_inherit=True)

    setattr(importlib.machinery.SourceFileLoader, "get_code", get_code)  # noqa: B010
    first = First()
    code = run_tests(["-x", *tests], first)
    # A test that is no longer there has noticed nothing.
    missing = code == pytest.ExitCode.USAGE_ERROR and not first.name
    return [first.name or f"pytest ended with {code}"] if code and not missing else []


def modules(folder: str) -> list[Path]:
    return [path for path in sorted((ROOT / "kcal" / folder).rglob("*.py")) if path.name != "__init__.py"]


def observe(folder: str, stop: float) -> dict[str, dict]:
    """The tests of a folder by file; from .mutants/ where the file is the same, none where time is up."""
    examples = [path for path in modules(folder) if ">>>" in path.read_text(encoding="utf-8")]
    found = {}
    for file in [*sorted((ROOT / "tests" / folder).rglob("test_*.py")), *examples]:
        name = str(file.relative_to(ROOT))
        kept, digest = STATE / f"{name.replace('/', '-')}.json", hashlib.sha256(file.read_bytes()).hexdigest()
        known = json.loads(kept.read_text()) if kept.exists() else {}
        if known.get("digest") != digest:
            known = {}
        if not known and time.monotonic() < stop:
            answer = forked(lambda name=name: observed(name), 1800.0)  # type: ignore[misc]
            known = {"digest": digest, **(answer if isinstance(answer, dict) else {"tests": {}})}
            kept.write_text(json.dumps(known))
            print(f"{name}: {len(known['tests'])} tests", flush=True)
        if known.get("tests"):
            found[name] = known
    return found


def chosen(known: dict[str, dict], path: str, function: str, budget: float) -> tuple[list[str], int, float]:
    """Tests that call a function, the quickest first; how many the budget leaves out; seconds of processor time.

    Outside of functions, all tests of a file that calls any of the module: they may read a constant alone.
    """

    def calls(places: list[list[str]]) -> bool:
        return any(place[0] == path and function in ("", place[1]) for place in places)

    found = []
    for file in known.values():
        shared = calls(file["fixtures"])
        if not function:
            shared = shared or any(calls(test["calls"]) for test in file["tests"].values())
        for name, test in file["tests"].items():
            if test["passed"] and (shared or calls(test["calls"])):
                found.append((test["seconds"], name, file["setup"]))
    found.sort()
    total = 0.0
    tests: list[str] = []
    setups: dict[str, float] = {}
    for seconds, name, setup in found:
        if total + seconds <= budget or not tests:
            total += seconds
            tests.append(name)
            setups[name.split("::")[0]] = setup
    return tests, len(found) - len(tests), total + sum(setups.values())


def draws(folder: str, seed: int) -> list[tuple[str, int, Site]]:
    """All mistakes of a folder in a random order: path, number in its module, mistake."""
    found = []
    for path in modules(folder):
        name = str(path.relative_to(ROOT))
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found += [(name, number, site) for number, site in enumerate(sites(tree, name))]
    # In an order of their own each, so that a change of one function leaves the others where they are.
    return sorted(found, key=lambda draw: hashlib.sha256(f"{seed} {draw[2].key}".encode()).digest())


def results() -> dict[str, dict]:
    kept = STATE / "results.jsonl"
    lines = kept.read_text().splitlines() if kept.exists() else []
    return {entry["key"]: entry for entry in map(json.loads, lines)}


def judge(groups: Sequence[dict[str, dict]], path: str, number: int, site: Site, budget: float) -> None:
    """Plant one mistake and run tests, one group after the other until it is noticed."""
    by, count, left = "", 0, 0
    for known in groups:
        tests, more, seconds = chosen(known, path, site.function, budget)
        count, left = count + len(tests), left + more
        if tests and not by:
            answer = forked(lambda tests=tests: with_mistake(path, number, tests), AT_LEAST + SLOWER * seconds)  # type: ignore[misc]
            by = answer if isinstance(answer, str) else "".join(answer)
    entry = {"key": site.key, "noticed": bool(by), "by": by, "tests": count, "left": left}
    with (STATE / "results.jsonl").open("a") as file:
        file.write(json.dumps(entry) + "\n")
    verdict = f"noticed by {by}" if by else f"NOT NOTICED by {count} tests ({left} too slow)"
    print(f"{path}:{site.line} {site.kind}: {site.before} -> {site.after}: {verdict}", flush=True)


def interval(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share (E. B. Wilson, 1927)."""
    z2 = 1.96**2
    middle, half = hits + z2 / 2, 1.96 * math.sqrt(hits * (count - hits) / count + z2 / 4)
    return (middle - half) / (count + z2), (middle + half) / (count + z2)


def report(seed: int) -> str:
    """A table of the folders, and what was not noticed, line by line."""
    kept, rows, missed, counts = results(), [], [], {}
    idle: list[tuple[object, ...]] = []
    for folder in FOLDERS:
        every = draws(folder, seed)
        judged = [(path, site, kept[site.key]) for path, _, site in every if site.key in kept]
        if not judged:
            continue
        before = len(idle)
        for path, site, entry in sorted(judged, key=lambda row: (row[0], row[1].line)):
            texts = (f"`{' '.join(text.split())[:70]}`".replace("|", "\\|") for text in (site.before, site.after))
            where = f"{path}:{site.line}", site.kind, *texts
            if site.key in HARMLESS:
                idle.append((*where, HARMLESS[site.key]))
            elif not entry["noticed"]:
                missed.append((*where, entry["tests"]))
        harmless = len(idle) - before
        hits = sum(entry["noticed"] and site.key not in HARMLESS for _, site, entry in judged)
        counts[folder] = hits, len(judged) - harmless
        low, high = interval(*counts[folder])
        share = f"{100 * hits / counts[folder][1]:.0f} %", f"{100 * low:.0f} to {100 * high:.0f} %"
        rows.append((f"`{folder}`", len(every), len(judged), harmless, hits, *share))
    hits, total = (sum(values) for values in zip(*counts.values(), strict=True))
    worst = min(counts, key=lambda folder: counts[folder][0] / counts[folder][1])
    shares = (
        f"{100 * hits / total:.0f} % over all folders, {100 * counts[worst][0] / counts[worst][1]:.0f} % in `{worst}`"
    )
    return "\n".join([
        f"The tests notice {hits} of {total} small mistakes planted at random that change a result: "
        f"{shares}, the lowest.", "",
        *table(("folder", "possible mistakes", "planted", "harmless", "noticed", "share", "95 % interval"), rows), "",
        f"## Not noticed ({len(missed)})", "", "With the number of tests that call the function.", "",
        *table(("line", "kind", "before", "after", "tests"), missed), "",
        f"## Harmless ({len(idle)})", "", "They change no result and are in no share (`scripts/check/harmless.py`).",
        "",
        *table(("line", "kind", "before", "after", "why"), idle), "",
    ])  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", default=FOLDERS, help="of kcal/")
    parser.add_argument("--sample", type=int, default=40, help="mistakes in each folder")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=math.inf, help="after which nothing is begun")
    parser.add_argument("--budget", type=float, default=60.0, help="seconds of tests for one mistake")
    parser.add_argument("--again", action="store_true", help="only what went unnoticed, with the tests as they are now")
    arguments = parser.parse_args()
    STATE.mkdir(exist_ok=True)
    for library in LIBRARIES:
        importlib.import_module(library)
    stop = time.monotonic() + arguments.seconds
    others: dict[str, dict] = {}
    for folder in FOLDERS:
        others |= observe(folder, -math.inf)
    for folder in ELSEWHERE:
        others |= observe(folder, stop)
    for folder in arguments.folders:
        own, kept = observe(folder, stop), results()
        groups = own, {file: known for file, known in others.items() if file not in own}
        for path, number, site in draws(folder, arguments.seed)[: arguments.sample]:
            if time.monotonic() > stop:
                break
            if site.key not in kept or (arguments.again and not kept[site.key]["noticed"]):
                judge(groups, path, number, site, arguments.budget)
    text = report(arguments.seed)
    print(text)


if __name__ == "__main__":
    main()
