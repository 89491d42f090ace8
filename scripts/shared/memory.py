"""The peak memory of this process, for the benchmarks."""

from pathlib import Path


def peak_megabytes() -> float:
    """Peak of what this process had in memory, libraries included (Linux).

    Not `resource.getrusage`: its peak is inherited from the process that started this one.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) / 1024.0
