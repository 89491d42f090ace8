"""The `kcal` command; also `python -m kcal`, for environments whose commands are not on the PATH."""

import sys


def main() -> None:
    """Run the command line, and end with one line and exit code 130 if it is interrupted, also while it loads."""
    try:
        from kcal.cli.main import main as run

        run()
    except KeyboardInterrupt:
        print("interrupted; nothing was written", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
