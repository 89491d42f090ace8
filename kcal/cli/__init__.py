"""The command line: parses, calls, prints (floor 6)."""
