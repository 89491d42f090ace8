"""The `kcal` command; also `python -m kcal`, for environments whose commands are not on the PATH."""

from __future__ import annotations

import gc
import io
import os
import signal
import sys
import threading

from kcal.interrupts import listen, only_interruptions

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


def main() -> None:
    """Run the command line, and end with one line and exit code 130 if it is interrupted, also while it loads.

    It has one thread, and so do the processes that it starts: what commands solve is small, and threads would wait for
    each other (`kcal.threads`).
    """
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    # The garbage collector would search the imported libraries again and again while they load and once more at the
    # end: .55 of 2.1 CPU s of `kcal diff`. Cyclic garbage of ordinary work stays below 50,000 objects.
    gc.set_threshold(50_000, 20, 20)
    # A pipe on Windows has no σ, nor has the locale C: files and other programs get UTF-8, a screen what it can show.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(encoding=None if stream.isatty() else "utf-8", errors="replace")
    listen()
    # What loads now takes .3 s; the line that shows the progress then takes this place.
    if (
        sys.stderr
        and sys.stderr.isatty()
        and sys.argv[1:]
        and not {"--help", "--help-all", "--version"} & set(sys.argv)
    ):
        print("kcal ...", end="\r", file=sys.stderr, flush=True)
    code: int | str | None = None
    try:
        with only_interruptions():
            from kcal.cli.main import main as run

            run()
    except KeyboardInterrupt:
        print("interrupted; nothing was written", file=sys.stderr)
        code = 130
    except SystemExit as ended:
        code = ended.code
    finally:
        gc.freeze()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it ends already
    exec("")  # otherwise Python ends as if killed where an interruption came inside such a call
    if any(thread.name == "unstoppable" for thread in threading.enumerate()):  # kcal.threads
        sys.stdout.flush()
        os._exit(code if isinstance(code, int) else bool(code))
    sys.exit(code)


if __name__ == "__main__":
    main()
