"""`kcal detect`: images to an observations file."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from kcal.cli.console import board_words, ending_with, out, steps, tell, warn
from kcal.cli.inputs import IMAGES, BoardSize, Refine, RefineMethod, SquareSide, typed, typed_with
from kcal.cli.settings import picture_option
from kcal.errors import FileError, InputError
from kcal.files import check_writable, is_stream, source_name

if TYPE_CHECKING:
    from kcal.corners.board import Board


def detect_command(
    images: Annotated[
        list[str],
        typer.Argument(
            metavar="IMAGES",
            help="Images of one camera: files, folders or quoted wildcards; or one video, or a stream (rtsp://..., "
            "camera:0).",
            show_default=False,
        ),
        IMAGES,
    ],
    size: BoardSize,
    output: Annotated[Path, typer.Option("-o", "--output", help="Observations file to write.")],
    square: SquareSide = None,
    refine: RefineMethod = Refine.erf,
    gallery: Annotated[
        Path | None,
        picture_option("images that failed and why, then the views with their corners, worst first.", "--gallery"),
    ] = None,
    coverage: Annotated[Path | None, picture_option("where in the image corners were seen.", "--coverage")] = None,
    time_limit: Annotated[
        float,
        typer.Option(
            metavar="S", help="Seconds of processor time after which the search in one image is given up.", min=0.1
        ),
    ] = 60.0,
    duration: Annotated[
        float, typer.Option(metavar="S", help="Seconds for which a stream is watched.", min=1.0)
    ] = 120.0,
    keep: Annotated[
        Path | None, typer.Option(help="Folder for the frames of a video or stream that became views, as PNG.")
    ] = None,
) -> None:
    """Find the board in the images of one camera.

    Writes the corners of each view, and the reason for each image in which no board was found. EXIF orientation is
    ignored: pixels are used as the sensor wrote them. Nothing is written if no image shows the board.

    **Examples**

    `kcal detect left/ --board 9x6 --square 25mm -o left.obs.json`

    `kcal detect left/ --board charuco:9x6:5x5_100:18mm --square 25mm -o left.obs.json`

    `kcal detect rtsp://10.0.0.7/main --board 9x6 --square 25mm -o left.obs.json --duration 60 --keep frames/`

    `kcal detect "shots/left*.png" --board 9x6 --square 25mm -o left.obs.json --refine opencv`
    """
    from kcal.corners.board import Board

    check_writable(output)
    board = Board.parse(size, square)

    from kcal.corners.detect import Detection, detect
    from kcal.corners.images import VIDEO_SUFFIXES, expand_images, turned_images
    from kcal.corners.video import detect_video

    failed: list[tuple[str, Path, Detection]] = []

    turned: list[Path] = []
    notes: list[str] = []
    streams = [source_name(image) for image in images if is_stream(image)]
    if streams and len(images) > 1:
        raise InputError(f"{streams[0]}: a stream is searched alone, without other images")
    if keep is not None and not os.path.isdir(keep):
        raise FileError(f"{keep}: no such folder")
    if streams or (len(images) == 1 and Path(images[0]).suffix.lower() in VIDEO_SUFFIXES):
        searched = 0

        def count(_: str) -> None:
            nonlocal searched
            searched += 1

        with steps(f"watching {streams[0]} for {duration:g} s" if streams else "searching the video", None):
            observations = detect_video(
                images[0], board, refine.value, progress=count, time_limit=time_limit, duration=duration, keep=keep
            )
        source = f"of {searched} sharp frames (repeats left out)"
    else:
        paths = expand_images(images)
        check_writable(output, *paths)
        with (
            ending_with(lambda error: _right_board(str(error), size, board)),
            steps("detecting", len(paths)) as advance,
        ):
            observations = detect(
                paths,
                board,
                refine.value,
                progress=advance,
                time_limit=time_limit,
                note=notes.append,
                on_failure=lambda name, path, found: failed.append((name, path, found)),
            )
        turned = turned_images([path for path in paths if os.path.isfile(path)])
        source = f"of {len(paths)} images"
    observations.save(output)
    if gallery is not None or coverage is not None:
        from kcal.report.calibration import FailedImage, coverage_figure, gallery_figure
        from kcal.report.figures import save_picture

        if gallery is not None:
            tiles = [FailedImage(name, path, found.reason, found.rejected) for name, path, found in failed]
            save_picture(gallery, gallery_figure(observations, tiles))
        if coverage is not None:
            save_picture(coverage, coverage_figure(observations))

    width, height = observations.image_size
    found, unseen = len(observations.views), sum(view.pixels.count(None) for view in observations.views)
    tell(views=found, failures={failure.name: failure.reason for failure in observations.failures})
    out.print(f"{escape(str(output))}: board found in {found} {source} of {width}x{height} px")
    wide, high = (1e3 * side for side in board.extent)
    out.print(f"board {board}: {wide:g} x {high:g} mm from the first point to the last")
    for text in notes:
        warn(text)
    if turned:
        out.print(f"note: {len(turned)} images have an EXIF rotation, which kcal ignores")
    if unseen:
        out.print(f"corners left out as uncertain: {unseen} of {found * board.corners}")
    for failure in observations.failures:
        out.print(f"  [yellow]failed[/] {escape(failure.name)}: {escape(failure.reason)}")
    if not board.unambiguous:
        out.print(f"note: this board looks the same turned by 180°; for stereo {board.stereo_advice}")


def _right_board(refusal: str, size: str, board: Board) -> str:
    """The command with the board that was found instead, or one that draws the board that was asked for."""
    if (found := re.search(r"a board of (\d+x\d+)", refusal)) and size in typed:
        return f"Perhaps: {typed_with({size: found[1]})}"
    return f"To see what this board looks like: kcal board {board_words(board)} -o board.svg"
