"""Fuzzing: damaged files and messages for every reader and server; see `python -m scripts.fuzz --help`."""
