"""`kcal mark`: mark landmarks and targets in both images on a local web page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kcal.cli.console import err, out, show_page, warn
from kcal.cli.inputs import CALIBRATED, IMAGES, MARKS, RIG, SURVEY, TABLE, PixelSigma, pixel_sigma_of
from kcal.errors import InputError, with_extra

_PORT = 8347


def mark_command(
    left: Annotated[Path, typer.Argument(help="Image of the left camera, a folder of them, or a video."), IMAGES],
    right: Annotated[Path, typer.Argument(help="The same of the right camera."), IMAGES],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="CSV", help="Marks of landmarks; the other files lie beside it.")
    ],
    rig: Annotated[
        Path | None, typer.Option(help="Rig file: cameras, and the relative pose as known so far."), RIG
    ] = None,
    cameras: Annotated[
        tuple[Path, Path] | None,
        typer.Option(metavar="LEFT RIGHT", help="Camera files, if there is no rig yet: landmarks will give one."),
        CALIBRATED,
    ] = None,
    landmarks: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Surveyed places: name,lat,lon,height,sigma or east,north,up."),
        SURVEY,
    ] = None,
    targets: Annotated[
        Path | None, typer.Option(metavar="CSV", help="What will be located: its column name fills the list."), TABLE
    ] = None,
    reference: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Marks in old images, to be found again in these."), MARKS
    ] = None,
    reference_images: Annotated[
        tuple[Path, Path] | None, typer.Option(metavar="LEFT RIGHT", help="With --reference: the old images."), IMAGES
    ] = None,
    pixel_sigma: PixelSigma = None,
    port: Annotated[int, typer.Option(help="Of the local address; 0 for any that is free.", min=0, max=65535)] = _PORT,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
) -> None:
    """Mark landmarks and targets on a local web page, and see at once what each mark is worth.

    A click snaps to the corner, cross, blob or pole end that is there and shows its σ. In the other image the epipolar
    curve appears with a band of two σ of the rig, and on it a proposal with its covariance, or the reason why there is
    none. From four landmarks on the rig is solved as you mark; a wrong landmark is named.

    Every action is on the disk before it is answered: `marks.csv` (for `kcal rig --marks`), `marks.points.csv` (for
    `kcal locate`), `marks.landmarks.csv` (for `kcal rig --landmarks`) and `marks.log` (for undo, and to continue).

    The page is served to this machine only and loads nothing from elsewhere. It needs the extra `mark`:
    `pip install 'kcal[mark]'`. The key `?` on the page lists all keys.

    **Examples**

    `kcal mark left.png right.png --rig rig.json --landmarks survey.csv -o marks.csv`

    `kcal mark new-left.png new-right.png --reference then.csv --reference-images left.png right.png -o now.csv`
    """
    with with_extra("mark", "kcal mark needs"):
        from kcal.mark.server import marking_app
        from kcal.web.serving import LocalServer

    from kcal.io.camera_file import load_camera
    from kcal.io.rig_file import load_pair
    from kcal.mark.guide import Reference, open_pictures
    from kcal.mark.marking_service import Desk
    from kcal.mark.session import Session

    if rig is not None and cameras is not None:
        raise InputError("give --rig or --cameras, not both: a rig file contains its cameras")
    if (reference is None) != (reference_images is None):
        raise InputError("--reference and --reference-images belong together: old marks, and the images they are in")
    pictures = open_pictures(left, right)
    known = None if rig is None else load_pair(rig)
    own = None if cameras is None else (load_camera(cameras[0]), load_camera(cameras[1]))
    old = None if reference is None or reference_images is None else Reference(reference, *reference_images)
    session = Session(output, landmarks, pixel_sigma_of(pixel_sigma, known), targets)
    desk = Desk(pictures, session, own, known, old)
    try:
        desk.check_sizes()
        server = LocalServer(lambda token, hosts: marking_app(desk, token, hosts), port, fallback=port == _PORT)
        show_page(server.address, "marking page", browser=browser)
        if session.version:
            err.print(f"continued after {session.version} actions in {session.files.log}", markup=False)
        for note in (*session.notes, *filter(None, [session.trouble])):
            warn(note)
        server.run()
    finally:
        desk.close()
    for path in (session.files.marks, session.files.points, session.files.landmarks):
        if path.exists():
            out.print(f"wrote {path}", markup=False)
