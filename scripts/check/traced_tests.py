"""Run tests in processes of their own, and see which lines of kcal each test executes."""

from __future__ import annotations

import contextlib
import json
import math
import os
import resource
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import coverage
import pytest

from scripts.shared.children import children

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


class Lines:
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
    lines = Lines()
    lines.coverage.start()
    run_tests([file], lines)
    lines.coverage.stop()
    return {"seconds": lines.seconds, "failed": sorted(lines.failed), "unseen": lines.unseen, "lines": lines.executed()}
