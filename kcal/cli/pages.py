"""Commands with a local page: `kcal mark`, and `kcal capture`, which photographs a board with guidance."""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import kcal
from kcal.cli import kinds, rooms
from kcal.cli.board import board_in_images, given_board
from kcal.cli.console import err, out, show_page, warn
from kcal.cli.inputs import IMAGES, pixel_sigma_of
from kcal.cli.options import Kind
from kcal.errors import InputError, KcalError
from kcal.texts import counted_text

_MARK_PORT, _CAPTURE_PORT = 8347, 8348


# `kcal mark`: mark landmarks and targets in both images.

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
    port: kinds.Port = _MARK_PORT,
    browser: bool = True,
) -> None:
    """Mark landmarks and targets on a local web page, and see the σ of each mark at once.

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
    if rig is not None and cameras is not None:
        raise InputError("give --rig or --cameras, not both: a rig file contains its cameras")
    if (reference is None) != (reference_images is None):
        raise InputError("--reference and --reference-images belong together: old marks, and the images they are in")
    page = rooms.marking_app  # what it needs is missed before anything is written
    pictures = rooms.open_pictures(left, right)
    known = None if rig is None else rooms.load_pair(rig)
    own = None if cameras is None else (kcal.load_camera(cameras[0]), kcal.load_camera(cameras[1]))
    old = None if reference is None or reference_images is None else rooms.Reference(reference, *reference_images)
    session = rooms.Session(output, landmarks, pixel_sigma_of(pixel_sigma, known), targets)
    desk = rooms.Desk(pictures, session, own, known, old)
    try:
        desk.check_sizes()
        server = rooms.LocalServer(functools.partial(page, desk), port, fallback=port == _MARK_PORT)
        show_page(server.address, "marking page", browser=browser)
        if session.version:
            err.print(f"continued after {counted_text(session.version, 'action')} in {session.files.log}")
        warn(*session.notes, *filter(None, [session.trouble]))
        server.run()
    finally:
        desk.close()
    for path in (session.files.marks, session.files.points, session.files.landmarks):
        if path.exists():
            out.print(f"wrote {path}")


# `kcal capture`: photograph a board, and be told what to photograph next.


def capture_command(
    source: Annotated[str, Kind(setting=True)],
    *,
    output: kinds.NewFile,
    board: kinds.BoardOrAuto = "auto",
    square: kinds.Square | None = None,
    until: kinds.Pixels = 0.1,
    most: Annotated[int, Kind(metavar="N", least=4)] = 60,
    refine: kinds.RefineMethod = "erf",
    page: bool = True,
    port: Annotated[int, Kind(least=0)] = _CAPTURE_PORT,
    browser: bool = True,
) -> None:
    """Photograph a board, and be told what to photograph next, until the camera is known well enough.

    Frames that show the board at rest and somewhere new are kept. From four views on the camera is calibrated as you
    go; the outline on the page is the view that would tell most. It ends at --until, or with Ctrl+C: everything
    that was kept is on the disk, and the same command continues.

    The page is served to this machine only. It needs the extra `mark`: `pip install 'kcal[mark]'`.

    **Examples**

    `kcal capture camera:0 --board 9x6 --square 25mm -o left.obs.json`

    `kcal capture incoming/ --board 9x6 --square 25mm -o left.obs.json --until 0.05`

    Args:
        source: camera:0, a stream (rtsp://...), a video, a bag, or a folder into which images come.
        output: Observations file to write, or to continue.
        until: Stop when points at infinity are known to this σ, on average over the image.
        most: Stop at this number of views.
        page: Show it on a local page; without, only in this terminal.
        port: Of the local address; 0 for any that is free.
        browser: Open the page in the browser.
    """
    pattern = given_board(board, square)
    if pattern is None and output.exists():
        pattern = kcal.Observations.load(output).board
    pattern = pattern or board_in_images([source], square)
    session = rooms.CaptureSession(output, pattern, rooms.CaptureOptions(until=until, most=most, refine=refine))
    if session.views:
        err.print(f"{output} has {counted_text(session.views, 'view')}; going on")
    stop = threading.Event()
    failed: list[KcalError] = []

    def over() -> bool:
        return stop.is_set() or bool(session.finished)

    def watch() -> None:
        try:
            for shot in rooms.shots(source, over, lambda text: err.print(text)):
                if session.offer(shot.image, shot.name, moving=shot.moving):
                    out.print(f"{session.views}: {shot.name}")
        except KcalError as error:
            failed.append(error)
        stop.set()

    threads = [threading.Thread(target=watch), threading.Thread(target=lambda: rooms.follow(session, until=over))]
    server = None
    if page:
        app = functools.partial(rooms.capture_app, session, stop)
        server = rooms.LocalServer(app, port, fallback=port == _CAPTURE_PORT)
        show_page(server.address, "capture page", browser=browser)
    try:
        for thread in threads:
            thread.start()
        if server is None:
            _tell(session, over)
        else:
            threading.Thread(target=_stop_server, args=(threads, server), daemon=True).start()
            server.run()
    finally:
        stop.set()
        for thread in threads:
            # An interruption may come before all have started.
            if thread.ident is not None:
                thread.join()
    if failed:
        raise failed[0]
    # What came last has not been thought about yet.
    session.think()
    if session.finished:
        out.print(session.finished)
    elif session.views:
        known = f"; points at infinity are known to ± {session.sigma:.3f} px" if session.history else ""
        out.print(f"{counted_text(session.views, 'view')} kept{known}")
    if not session.views:
        raise InputError(f"no frame showed the board: {session.message}")
    out.print(f"wrote {output} and {session.views} frames in {session.frames}")
    camera = f"{output.name.split('.')[0]}.camera.json"
    out.print(f"next: kcal calibrate {output} -o {output.with_name(camera)}", soft_wrap=True)


def _stop_server(threads: list[threading.Thread], server: rooms.LocalServer) -> None:
    """Stop the server when all is captured, a moment later: the page still asks how it ended."""
    for thread in threads:
        thread.join()
    time.sleep(1.5)
    server.stop()


def _tell(session: rooms.CaptureSession, over: Callable[[], bool]) -> None:
    """Print what to photograph next, whenever it changes."""
    said = ""
    while not over():
        words = session.suggestion.words if session.suggestion is not None else session.message
        if words != said:
            known = f" (now ± {session.sigma:.3f} px)" if session.history else ""
            out.print(f"next: the board {words}{known}")
            said = words
        time.sleep(0.2)
