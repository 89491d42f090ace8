"""`kcal demo`: the whole chain, on a simulated site or on a folder of real stereo pairs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import kcal
from kcal.cli import kinds
from kcal.cli.options import Kind
from kcal.files import make_folder


def demo_command(
    *,
    output: kinds.Output = Path("kcal-demo"),
    # The draw in which the noise of the targets' marks is nearest to what is said of it, by its RMS.
    seed: Annotated[int, Kind(least=0)] = 1,
    practice: Annotated[Path | None, Kind(metavar="FOLDER")] = None,
    score: Annotated[Path | None, Kind(metavar="FOLDER")] = None,
    images: Path | None = None,
    board: Annotated[str, Kind(metavar="CxR")] = "9x6",
    square: Annotated[str, Kind(metavar="LENGTH")] = "25mm",
    site: kinds.Place | None = None,
    heading: kinds.Degrees = 0.0,
) -> None:
    """Run the main job from images to positions, and compare the result with the truth.

    Without `--images` a site is rendered: two cameras 10 m apart behind ray-traced lenses, a printed board that is bent
    and stretched, twelve surveyed landmarks, and targets from 100 m to 5 km. Its pictures go through `kcal detect`,
    `kcal calibrate`, `kcal rig`, `kcal locate` and `kcal report` as yours would; the truth is used for the comparison
    only. `summary.html` says what was done and what came out.

    With `--practice` the pictures of another site are left to you: two masts' cameras with landmarks to mark, targets
    out to 5 km, boards, and a film with ships. `README.txt` there has the commands. `--score` reads your
    `left.camera.json`, `right.camera.json`, `rig.json`, `positions.geojson` (or `.csv`) and `tracks.csv` (or
    `.geojsonl`) in that folder, and says how far each is from the truth. Files that are there are never written over.

    **Examples**

    `kcal demo`

    `kcal demo --practice practice`

    `kcal demo --score practice`

    `kcal demo --images calibration/ --board 9x6 --square 25mm -o results`

    Args:
        output: Folder for the results; made if it is missing.
        seed: Seed of the simulated site's poses, noise and marks.
        practice: Render a site to practise on into a folder; results are then yours.
        score: Compare your results on a practice site with its truth, in meters.
        images: Folder of real pairs: left01.jpg with right01.jpg, or left/ and right/.
        board: With --images: inner corners, columns by rows.
        square: With --images: side of a square with its unit.
        site: With --images: where the left camera stands; 0,0,0 if not given.
        heading: With --images: azimuth of the left camera's axis.
    """
    if sum(each is not None for each in (practice, score, images)) > 1:
        raise typer.BadParameter("--practice, --score and --images exclude each other")
    if practice is not None or score is not None:
        from kcal.cli.demo_practice import practice_score, practice_site

        if practice is not None:
            practice_site(practice, seed)
        elif score is not None:
            practice_score(score)
        return
    make_folder(output)
    from kcal.cli.demo_run import real_pairs, simulated_site

    if images is None:
        simulated_site(output, seed)
        return

    place = None if site is None else site.origin
    real_pairs(output, images, board, square, kcal.Board.parse(board, square), place, heading)
