"""The `kcal` command; also `python -m kcal`, for environments whose commands are not on the PATH."""

import gc
import os
import sys

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
    try:
        from kcal.cli.main import main as run

        run()
    except KeyboardInterrupt:
        print("interrupted; nothing was written", file=sys.stderr)
        sys.exit(130)
    finally:
        gc.freeze()


if __name__ == "__main__":
    main()
