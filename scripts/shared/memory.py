"""The peak memory of processes, for the benchmarks."""

from pathlib import Path


def peak_megabytes(process: int | str = "self") -> float:
    """Peak of what this process, or the one of a number, had in memory, libraries included (Linux).

    Not `resource.getrusage`: its peak is inherited from the process that started this one.
    """
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) / 1024.0
