"""Run one harness in a child process with limits, on damage that Hypothesis draws, for a time or a number of cases.

A harness makes its whole files and servers in a folder, and returns the strategy of its cases (bytes) and the check
that raises if a case breaks an invariant. It can be pickled: a function of a module, or `functools.partial` of one.
Hypothesis makes each finding as small as it can; one that is known already does not stop the search for others. What
ends the child (a crash, a hang inside a library) is a finding as well.
"""

from __future__ import annotations

import base64
import contextlib
import functools
import itertools
import json
import os
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

import hypothesis
from hypothesis.strategies import SearchStrategy

from scripts.shared.children import children

# What one case may take: seconds that its process computes, and bytes beyond what the process has when it begins.
SECONDS, MEMORY = 10, 2 * 2**30
# By the clock so many times as long, for what waits: that a machine is loaded is no finding.
_BY_CLOCK = 10
_STUCK = 900  # seconds after which a child that does not hear its alarm is ended
_EXAMPLES = 200  # of one seed of Hypothesis, which thinks about earlier ones
_RESTARTS = 8


class Prepared(NamedTuple):
    """A harness that is ready: its cases, what raises for one that breaks an invariant, and the limit of one."""

    cases: SearchStrategy[bytes]
    check: Callable[[bytes], object]
    seconds: float = SECONDS


Write = Callable[[str, "Finding"], None]
Harness = Callable[[Path], Prepared]


class Finding(NamedTuple):
    """What a case brought to light, and the smallest case that does."""

    what: str
    case: bytes

    def __str__(self) -> str:
        shown = base64.b64encode(self.case).decode() if len(self.case) <= 6000 else f"{len(self.case)} bytes"
        return f"{self.what}\n  case, base64: {shown}"


class Overtime(BaseException):
    """A case took longer than its limit. No `Exception`: readers catch those."""


@contextlib.contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raise `Overtime` when this process has computed for so many seconds, or waited for many times as many."""
    limits = ((signal.SIGPROF, signal.ITIMER_PROF, seconds), (signal.SIGALRM, signal.ITIMER_REAL, _BY_CLOCK * seconds))
    before = [(signal.signal(alarm, _overtime), signal.setitimer(timer, most)) for alarm, timer, most in limits]
    try:
        yield
    finally:
        for (alarm, timer, _), (handler, outer) in zip(limits, before, strict=True):
            signal.setitimer(timer, 0)
            signal.signal(alarm, handler)
            signal.setitimer(timer, *outer)


def hunt(
    harness: Harness, folder: Path, seed: int, seconds: float, *, cases: int | None = None, most: int | None = None
) -> tuple[list[Finding], int]:
    """Findings of a harness, and how many cases were run.

    The search ends after `seconds`, after so many `cases` if they are stated, or once there are `most` findings.
    """
    found: dict[str, Finding] = {}
    total, until = 0, time.monotonic() + seconds
    for start in range(_RESTARTS):
        left = until - time.monotonic()
        if start and left < 1:
            break
        work = functools.partial(_search, harness, folder, seed + start, left, cases, set(found), most)
        more, count = _child(work, folder, left)
        total += count
        found.update(more)
        if not any(key.startswith("ended") for key in more) or (most and len(found) >= most):
            break
    return list(found.values()), total


def replay(harness: Harness, folder: Path, cases: list[bytes]) -> list[Finding]:
    """Findings of cases that were kept, all in one child."""
    work = functools.partial(_repeat, harness, folder, cases)
    return list(_child(work, folder, SECONDS * (1 + len(cases)))[0].values())


def _repeat(harness: Harness, folder: Path, cases: list[bytes], write: Write) -> int:
    prepared = harness(folder)
    for case in cases:
        (folder / "now").write_bytes(case)
        key, text = _outcome(prepared, case)
        if key:
            write(key, Finding(text, case))
    return len(cases)


def _search(
    harness: Harness,
    folder: Path,
    seed: int,
    seconds: float,
    cases: int | None,
    known: set[str],
    most: int | None,
    write: Write,
) -> int:
    now, prepared = folder / "now", harness(folder)
    # One case at least, however long it took to make the files.
    until, count = time.monotonic() + seconds, 0
    smallest: dict[str, Finding] = {}

    def over() -> bool:
        return count == cases or bool(count and time.monotonic() > until)

    def body(case: bytes) -> None:
        nonlocal count
        if over():
            return
        now.write_bytes(case)
        count += 1
        key, text = _outcome(prepared, case)
        if key and key not in known:
            if key not in smallest or len(case) <= len(smallest[key].case):
                smallest[key] = Finding(text, case)
            raise AssertionError(key)

    quiet = hypothesis.settings(
        max_examples=_EXAMPLES, database=None, deadline=None, verbosity=hypothesis.Verbosity.quiet,
        report_multiple_bugs=False, suppress_health_check=list(hypothesis.HealthCheck),
        phases=[hypothesis.Phase.generate, hypothesis.Phase.shrink],
    )  # fmt: skip
    for batch in itertools.count():
        if over() or (most and len(known) >= most):
            break
        run = hypothesis.seed(seed * 100_003 + batch)(quiet(hypothesis.given(prepared.cases)(body)))
        # Beside the finding: that it came only once, when the time ended while it was made smaller.
        with contextlib.suppress(AssertionError, hypothesis.errors.HypothesisException, BaseExceptionGroup):
            run()
        for key in set(smallest) - known:
            write(key, smallest[key])
            known.add(key)
    return count


def _outcome(prepared: Prepared, case: bytes) -> tuple[str, str]:
    """What a case breaks, as a key that is the same for the same fault, and with all that is known; or nothing."""
    begin, computed = time.monotonic(), time.process_time()
    try:
        with within(prepared.seconds):
            prepared.check(case)
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)
        inside = [frame for frame in frames if f"{os.sep}kcal{os.sep}" in frame.filename] or frames
        text = str(error)[:60] if isinstance(error, AssertionError) else ""
        at = "" if isinstance(error, AssertionError) else f"{Path(inside[-1].filename).name}:{inside[-1].lineno}"
        whole = "".join(traceback.format_exception(error, limit=-4))[-2500:]
        return f"{type(error).__name__} {at} {text}", whole
    taken = max(time.process_time() - computed, (time.monotonic() - begin) / _BY_CLOCK)
    # What caught the alarm, or ran in a library until its end.
    return ("too long", f"took {taken:.0f} s") if taken > prepared.seconds else ("", "")


def _child(work: Callable[[Write], int], folder: Path, seconds: float) -> tuple[dict[str, Finding], int]:
    """Run work in a process of its own with limits; what it wrote down, and the end of it if that was not by itself."""
    out, now = folder / "findings.jsonl", folder / "now"
    out.write_bytes(b"")
    now.write_bytes(b"")
    child = children().Process(target=_be_child, args=(work, folder, out), daemon=True)
    child.start()
    status = _waited(child, now, seconds)
    found, count = {}, 0
    for line in out.read_text().splitlines():
        kept = json.loads(line)
        if isinstance(kept, int):
            count += kept
        else:
            found[kept[0]] = Finding(kept[1], base64.b64decode(kept[2]))
    if status:
        found[f"ended {status}"] = Finding(f"the process ended with {status}", now.read_bytes())
    return found, count


def _be_child(work: Callable[[Write], int], folder: Path, out: Path) -> None:
    code = 1
    try:
        warnings.simplefilter("ignore")
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        limit_memory()
        os.chdir(folder)
        with open(out, "a") as file:

            def write(key: str, finding: Finding) -> None:
                row = [key, finding.what, base64.b64encode(finding.case).decode()]
                print(json.dumps(row), file=file, flush=True)

            print(json.dumps(work(write)), file=file, flush=True)
        code = 0
    except BaseException:
        with open(out, "a") as file:
            print(json.dumps(["harness", traceback.format_exc(), ""]), file=file)
    finally:
        os._exit(code)


def _waited(child: BaseProcess, now: Path, seconds: float) -> str:
    """How the child ended, "" if by itself; one that hangs inside a library is ended."""
    until = time.monotonic() + seconds + _STUCK
    while child.exitcode is None:
        child.join(1.0)
        stuck = time.time() - now.stat().st_mtime > _STUCK and now.stat().st_size
        if child.exitcode is None and (stuck or time.monotonic() > until):
            child.kill()
            child.join()
            return f"a hang of more than {_STUCK} s"
    return f"code {child.exitcode}" if child.exitcode else ""


def limit_memory(most: int = MEMORY) -> None:
    """Limit what this process may have to `most` bytes beyond what it has (Linux)."""
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[0]) if sys.platform == "linux" else 0
    if pages:
        whole = pages * resource.getpagesize() + most
        resource.setrlimit(resource.RLIMIT_AS, (whole, whole))


def _overtime(*_: object) -> None:
    raise Overtime("longer than its limit")


def corpus(folder: Path) -> Iterator[tuple[str, list[bytes]]]:
    """Kept cases by harness: one folder of files each."""
    for place in sorted(path for path in folder.iterdir() if path.is_dir()):
        yield place.name, [path.read_bytes() for path in sorted(place.iterdir())]
