"""The page on which a demonstration says what was done and what came out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kcal.corners.observations import Observations
from kcal.io.rig_file import RigFile
from kcal.report.judge_rig import rig_verdict
from kcal.report.tables import Part, save_summary
from kcal.report.verdict import Requirement
from kcal.texts import length_text

# What the rig of the simulated site must do.
REQUIREMENT = "5km:10%"

if TYPE_CHECKING:
    from kcal.sim.scene import DemoScene


def save_site_summary(
    output: Path, scene: DemoScene, table: Sequence[Sequence[str]], chance: str, command: str
) -> None:
    """Write `summary.html` for the simulated site.

    Args:
        output: folder with the results.
        scene: the truth.
        table: true and estimated positions.
        chance: how many intervals contain the truth, and how many misses are usual.
        command: locates the targets again.
    """
    seen = [Observations.load(output / f"{side}.obs.json") for side in ("left", "right")]
    found = sum(len(file.views) for file in seen)
    file = RigFile.load(output / "rig.json")
    rig = file.rig()
    (answer,) = rig_verdict(rig, Requirement.parse(REQUIREMENT), mark_sigma=scene.mark_sigma).answers
    calibration = math.hypot(answer.parts["lenses"], answer.parts["relative pose"])
    true = float(scene.rig.baseline)
    parts = [
        Part(
            heading="What came out",
            text=(
                f"May this rig be used? {'Yes' if answer.ok else 'No'}: {answer.text}. Noise in the marks makes "
                f"±{length_text(answer.parts['marks'], digits=2)} of it, lenses and relative pose "
                f"±{length_text(calibration, digits=2)}.",
                f'{chance} "Across" is the error across the line of sight. The last column is the error that is left '
                "when the marks have no noise: the share of the calibration.",
            ),
            table=tuple(map(tuple, table)),
        ),
        _map_part(output, "True positions, estimates, and the error of each range"),
        Part(
            heading="1. Each camera was calibrated",
            text=(
                f"A printed board was photographed {scene.near_views} times by each camera, and found in {found} of "
                f"{2 * scene.near_views} pictures. The board is bent by 1 mm and stretched by 0.15 %; kcal measures "
                f"that on the way. {_residuals_text(file)} The truth is a lens traced ray by ray through seven "
                "pieces of glass that are not quite centered.",
            ),
            pictures=(
                (output / "images" / "left-near" / "near-02.png", "One of the pictures"),
                (output / "left.png", "Left camera: where corners were, and their residuals"),
            ),
        ),
        Part(
            heading="2. The rig was solved",
            text=(
                f"{len(scene.landmarks.names)} landmarks, surveyed to {100 * scene.survey_sigma:g} cm and marked in "
                f"both images, tell where the cameras stand and look. Baseline: "
                f"{length_text(float(rig.baseline), digits=5)} (true {length_text(true, digits=5)}).",
            ),
            pictures=((output / "rig.png", "Residuals by source"),),
        ),
        _yourself_part(command),
    ]
    lead = (
        "kcal rendered a site whose truth is known, calibrated two cameras from their own pictures of a printed board, "
        "solved the rig, and located seven targets. Nothing but the pictures and a surveyor's list was used; the truth "
        "comes in only here, for the comparison."
    )
    save_summary(output / "summary.html", "Two cameras, seven targets, 100 m to 5 km", lead, parts)


def save_pairs_summary(output: Path, table: Sequence[Sequence[str]], command: str) -> None:
    """Write `summary.html` for a folder of pairs.

    Args:
        output: folder with the results.
        table: the board's diagonal in each pair, known and located.
        command: locates the corners again.
    """
    file = RigFile.load(output / "rig.json")
    pairs = 0 if file.calibration is None else file.calibration.pairs
    parts = [
        Part(
            heading="What came out",
            text=(
                "Two opposite corners of the board were located in each pair. Their distance is known, so the table "
                "shows how accurate the rig is at the distance of the board.",
            ),
            table=tuple(map(tuple, table)),
        ),
        _map_part(output, "The located corners, and the interval of each range"),
        Part(
            heading="1. Each camera was calibrated",
            text=(_residuals_text(file),),
            pictures=tuple(
                (output / f"{side}.png", f"{side.capitalize()} camera: where corners were, and their residuals")
                for side in ("left", "right")
            ),
        ),
        Part(
            heading="2. The rig was solved",
            text=(f"From {pairs} pairs: baseline {length_text(float(file.rig().baseline), digits=5)}.",),
        ),
        _yourself_part(command),
    ]
    lead = "kcal found the board in your pictures, calibrated both cameras, solved the rig, and located its corners."
    save_summary(output / "summary.html", f"Two cameras, {pairs} pairs of pictures", lead, parts)


def _residuals_text(file: RigFile) -> str:
    cameras = zip(("left", "right"), (file.left.calibration, file.right.calibration), strict=True)
    rms = ", ".join(f"{side} {record.rms:.3f} px" for side, record in cameras if record is not None)
    return f"RMS of the residuals: {rms}."


def _map_part(output: Path, caption: str) -> Part:
    return Part(
        heading="The map",
        text=(
            "Seen from above, north up; ranges are on a logarithmic scale. map.html beside this page can be moved "
            "and zoomed.",
        ),
        pictures=((output / "map.png", caption),),
    )


def _yourself_part(command: str) -> Part:
    return Part(
        heading="3. Do it yourself",
        text=(
            "Print a board (kcal board), photograph it (kcal capture helps), and go on as the tutorial shows. This "
            "locates the points again, from the files in this folder:",
        ),
        code=command,
    )
