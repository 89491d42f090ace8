"""`kcal demo`: the whole chain, on a simulated site or on a folder of real stereo pairs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kcal.files import make_folder


def demo_command(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the results; made if it is missing.")
    ] = Path("kcal-demo"),
    # The draw in which the noise of the targets' marks is nearest to what is said of it, by its RMS.
    seed: Annotated[int, typer.Option(help="Seed of the simulated site's poses, noise and marks.", min=0)] = 1,
    practice: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Render a site to practise on into a folder; results are then yours."),
    ] = None,
    score: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Compare your results on a practice site with its truth, in meters."),
    ] = None,
    images: Annotated[
        Path | None, typer.Option(help="Folder of real pairs: left01.jpg with right01.jpg, or left/ and right/.")
    ] = None,
    size: Annotated[
        str, typer.Option("--board", metavar="CxR", help="With --images: inner corners, columns by rows.")
    ] = "9x6",
    square: Annotated[
        str, typer.Option("--square", metavar="LENGTH", help="With --images: side of a square with its unit.")
    ] = "25mm",
    origin: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON,HEIGHT",
            help="With --images: position of the left camera in degrees and meters; 0,0,0 if not given.",
        ),
    ] = None,
    heading: Annotated[
        float, typer.Option(metavar="DEG", help="With --images: azimuth of the left camera's axis.")
    ] = 0.0,
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
    from kcal.corners.board import Board
    from kcal.locate.geodesy import Origin

    place = None if origin is None else Origin.parse(origin)
    real_pairs(output, images, size, square, Board.parse(size, square), place, heading)
