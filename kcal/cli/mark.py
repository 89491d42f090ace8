"""`kcal mark`: mark landmarks and targets in both images on a local web page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import kcal
from kcal.cli import kinds
from kcal.cli.console import err, out, show_page, warn
from kcal.cli.inputs import IMAGES, pixel_sigma_of
from kcal.cli.options import Kind
from kcal.errors import InputError, with_extra

_PORT = 8347
_Pictures = Annotated[Path, Kind(metavar="IMAGES"), IMAGES]
_Both = Kind(metavar="LEFT RIGHT")


def mark_command(
    left: _Pictures,
    right: _Pictures,
    *,
    output: Annotated[kinds.Output, Kind(metavar="CSV")],
    rig: kinds.RigFile | None = None,
    cameras: Annotated[tuple[kinds.CalibratedCamera, kinds.CalibratedCamera] | None, _Both] = None,
    landmarks: kinds.Survey | None = None,
    targets: kinds.Table | None = None,
    reference: kinds.Marks | None = None,
    reference_images: Annotated[tuple[_Pictures, _Pictures] | None, _Both] = None,
    pixel_sigma: kinds.PixelSigma | None = None,
    port: kinds.Port = _PORT,
    browser: bool = True,
) -> None:
    """Mark landmarks and targets on a local web page, and see at once what each mark is worth.

    A click snaps to the corner, cross, blob or pole end that is there and shows its σ, at least one pixel of the screen
    where the image is shown small. In the other image the epipolar curve appears with a band of two σ of the rig, and
    on it a proposal with its covariance, or the reason why there is none. From four landmarks on the rig is solved as
    you mark; a wrong landmark is named.

    Every action is on the disk before it is answered: `marks.csv` (for `kcal rig --marks`), `marks.points.csv` (for
    `kcal locate`), `marks.landmarks.csv` (for `kcal rig --landmarks`) and `marks.log` (for undo, and to continue).

    The page is served to this machine only and loads nothing from elsewhere. It needs the extra `mark`:
    `pip install 'kcal[mark]'`. The key `?` on the page lists all keys.

    **Examples**

    `kcal mark left.png right.png --rig rig.json --landmarks survey.csv --targets targets.csv -o marks.csv`

    `kcal mark new-left.png new-right.png --reference then.csv --reference-images left.png right.png -o now.csv`

    Args:
        left: Image of the left camera, a folder of them, or a video.
        right: The same of the right camera.
        output: Marks of landmarks; the other files are written beside it.
        rig: Rig file: cameras, and the relative pose as known so far.
        cameras: Camera files, if there is no rig yet: landmarks will give one.
        landmarks: Surveyed places: name,lat,lon,height,sigma or east,north,up.
        targets: What will be located: the names in its column `name` fill the list.
        reference: Marks in old images, to be found again in these.
        reference_images: With --reference: the old images.
        browser: Open the page in the browser.
    """
    with with_extra("mark", "kcal mark needs"):
        from kcal.mark.server import marking_app
        from kcal.web.serving import LocalServer

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
    own = None if cameras is None else (kcal.load_camera(cameras[0]), kcal.load_camera(cameras[1]))
    old = None if reference is None or reference_images is None else Reference(reference, *reference_images)
    session = Session(output, landmarks, pixel_sigma_of(pixel_sigma, known), targets)
    desk = Desk(pictures, session, own, known, old)
    try:
        desk.check_sizes()
        server = LocalServer(lambda token, hosts: marking_app(desk, token, hosts), port, fallback=port == _PORT)
        show_page(server.address, "marking page", browser=browser)
        if session.version:
            err.print(f"continued after {session.version} actions in {session.files.log}")
        warn(*session.notes, *filter(None, [session.trouble]))
        server.run()
    finally:
        desk.close()
    for path in (session.files.marks, session.files.points, session.files.landmarks):
        if path.exists():
            out.print(f"wrote {path}")
