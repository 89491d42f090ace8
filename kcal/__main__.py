"""`python -m kcal`, for environments whose commands are not on the PATH."""

from kcal.cli.main import main

if __name__ == "__main__":
    main()
