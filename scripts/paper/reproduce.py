"""The paper's experiment on simulated rigs: its tables and figures, each beside the paper's own numbers.

    python -m scripts.paper.reproduce --work FOLDER [--seeds 5] [--views 30] [--write]

Three kinds of cameras stand for the paper's: wide glass lenses that are poorly centered, plastic aspheres, and machine
vision lenses; all are ray-traced (`kcal.sim.truth`), so that no lens model of kcal or OpenCV is the truth. Every seed
is another pair of lenses, another set of board views, survey and marks. Images are rendered, spoiled and searched;
corners and results of each seed stay in FOLDER, and a run that was interrupted goes on from there: a changed kcal needs
another folder. Processes for other `--kinds` may work in the same one. With `--write` the tables of
docs/measured/paper.md and its pictures are made. One process, one thread.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import torch

from scripts.paper.figures import write_figures
from scripts.paper.page import sections
from scripts.paper.site import KINDS
from scripts.paper.solve import run_seed
from scripts.shared.page import write_section
from scripts.shared.timing import show


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for corners and results; kept")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--views", type=int, default=30, help="board views of each camera")
    parser.add_argument("--kinds", default=",".join(KINDS), help="kinds of cameras")
    parser.add_argument(
        "--write", action="store_true", help="write the tables of docs/measured/paper.md and its pictures"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)

    results: dict[str, list[dict]] = {}
    # Seed by seed, so that a run that is stopped has something of every kind.
    for seed in range(arguments.seeds):
        for name in arguments.kinds.split(","):
            start = time.perf_counter()
            result = run_seed(arguments.work / f"{name}-{seed}-{arguments.views}", name, seed, arguments.views)
            results.setdefault(name, []).append(result)
            print(f"{name}, seed {seed}: {time.perf_counter() - start:.0f} s", flush=True)
    for name, lines in sections(results).items():
        show(["", *lines])
        write_section("paper.md", name, lines, write=arguments.write)
    if arguments.write:
        write_figures(results)


if __name__ == "__main__":
    main()
