"""Rigs from boards that are held by hand before rolling shutters: does their covariance contain the truth?

    python -m scripts.check.handheld_rigs --out FILE --seeds 0-99
    python -m scripts.check.handheld_rigs --out FILE --write     # the table in docs/measured

Truth: two exact cameras of 1280 x 960 pixels, 25 cm apart, which see twelve boards (9 x 6 corners, 5 cm); noise of 0.1
px; hands as in `scripts.shared.moving_captures`, for each camera its own. Measure: the error of the relative pose (six
numbers) in units of its covariance, squared and divided by six, which is one on the average; and the errors themselves.
"""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
from pathlib import Path

import torch
from torch import Tensor

from kcal import Board, Camera, KcalError, Observations, RigOptions, calibrate_rig
from kcal.lens import rotation_from_vector, vector_from_rotation
from kcal.lens.pose import Pose
from kcal.sim.captures import BoardSize, sample_board_poses
from scripts.shared.moving_captures import Hands, MovingCapture, moving_capture
from scripts.shared.page import table, tell
from scripts.shared.records import Record, finish, read, seeds
from scripts.shared.simulated import view_of

PAGE = "ordinary.md"
BOARD, SIZE = Board(columns=9, rows=6, square=0.05), BoardSize(9, 6, 0.05)
CAMERA = Camera.build(focal=(1100, 1100), center=(639.5, 479.5), size=(1280, 960), coefficients=[-0.1])
TURN = rotation_from_vector(torch.tensor([0.0, -0.15, 0.0], dtype=torch.float64))
SHIFT = torch.tensor([-0.25, 0.0, 0.0], dtype=torch.float64)
BOARDS, SIGMA, FEWEST = 12, 0.1, 12
# Squared distance that a normal vector of six components exceeds once in twenty times.
CHI2 = 12.592


def captured(held_by: str, seed: int, fit: str) -> Record:
    """One rig."""
    generator = torch.Generator().manual_seed(seed)
    poses = sample_board_poses(CAMERA, SIZE, BOARDS, generator, fill=(0.25, 0.5))
    right = [Pose(TURN @ pose.rotation, TURN @ pose.translation + SHIFT) for pose in poses]
    hands = Hands() if held_by == "hand" else None
    sides = [
        moving_capture(CAMERA, own, sigma=SIGMA, seed=2 * seed + k, hands=hands, board=SIZE)
        for k, own in enumerate((poses, right))
    ]
    seen = [CAMERA.inside(side.pixels) & side.pixels.isfinite().all(-1) for side in sides]
    kept = (torch.stack(seen).sum(-1) >= FEWEST).all(0).nonzero()[:, 0].tolist()
    left_seen, right_seen = (observed(side, inside, kept) for side, inside in zip(sides, seen, strict=True))
    pairs = [(str(i), str(i)) for i in kept]
    try:
        options = RigOptions(motion=fit != "still")
        result = calibrate_rig(CAMERA, CAMERA, left_seen, right_seen, pairs, options)
    except KcalError as refusal:
        return {"refused": str(refusal)}
    found = result.stereo()
    turn = vector_from_rotation(found.right_from_left_rotation @ TURN.T)
    shift = found.right_from_left_translation - SHIFT
    error = torch.cat([turn, shift])
    square = float(error @ torch.linalg.solve(result.relative_covariance(), error))
    return {"chi2": square, "mrad": 1e3 * float(turn.norm()), "mm": 1e3 * float(shift.norm())}


def observed(side: MovingCapture, inside: Tensor, kept: list[int]) -> Observations:
    """What one camera saw of the boards that both saw, with the corners' covariances."""
    pixels = torch.where(inside[..., None], side.pixels, torch.nan)
    views = tuple(view_of(str(i), pixels[i], side.covariance[i]) for i in kept)
    return Observations(board=BOARD, image_size=CAMERA.size, views=views)


def line(record: Record) -> str:
    """One line to print."""
    if "refused" in record:
        return f"refused: {record['refused'][:90]}"
    return f"χ²/6 {record['chi2'] / 6:.2f}, {record['mrad']:.3f} mrad, {record['mm']:.3f} mm"


def lines(records: list[Record]) -> list[str]:
    """One row for boards by hand and on a stand, with and without motion."""
    rows = []
    for held_by, fit in itertools.product(("hand", "stand"), ("default", "still")):
        own = [record for record in records if (record["key"][0], record["key"][2]) == (held_by, fit)]
        known = [record for record in own if "refused" not in record]
        if known:
            inside = 100.0 * statistics.fmean(record["chi2"] < CHI2 for record in known)
            mean = statistics.fmean(record["chi2"] / 6 for record in known)
            errors = [math.sqrt(statistics.fmean(record[key] ** 2 for record in known)) for key in ("mrad", "mm")]
            refused = len(own) - len(known)
            rows.append(
                [held_by, fit, len(own), refused, f"{mean:.2f}", f"{inside:.0f} %", *(f"{e:.3f}" for e in errors)]
            )
    head = ["held by", "fit", "rigs", "refused", "χ²/6", "in 95 %", "RMS error of rotation, mrad", "of position, mm"]
    return table(head, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", nargs="+", type=Path, required=True, help="JSON lines; the first is written to")
    parser.add_argument("--seeds", type=seeds, help="for example 0-99")
    parser.add_argument("--write", action="store_true", help="write the table into the page")
    arguments = parser.parse_args()
    if arguments.seeds is not None:
        keys = list(itertools.product(("hand", "stand"), arguments.seeds, ("default", "still")))
        finish(arguments.out[0], keys, captured, line)
    tell(PAGE, "rigs", lines(read(arguments.out)), write=arguments.write)


if __name__ == "__main__":
    main()
