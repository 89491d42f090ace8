"""`kcal board` and `kcal detect`: a board to print, a printed board measured, and a board found in images."""

from __future__ import annotations

import dataclasses
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import kcal
from kcal.cli import console, kinds, rooms
from kcal.cli.console import board_words, ending_with, err, out, print_left_out, print_wrote, steps, tell, warn
from kcal.cli.inputs import typed, typed_with
from kcal.cli.options import Kind
from kcal.errors import InputError, KcalError
from kcal.files import check_writable, is_stream, make_folder, source_name, write_atomic
from kcal.texts import counted_text


def board_print_command(
    *,
    board: kinds.Board,
    output: kinds.NewFile,
    square: kinds.Square | None = None,
    paper: Annotated[str, Kind(metavar="PAPER")] = "auto",
) -> None:
    """Draw a board to print at true scale: checkerboard, ChArUco board, circles or AprilGrid.

    Print it at 100 % ("actual size"), check the printed ruler, and glue the board to something flat and stiff. Choose
    one odd and one even number (9x6, 7x6): such a board looks different when it is turned by 180°.

    `kcal board measure` finds later how the printed board differs from this drawing.

    **Examples**

    `kcal board --board 9x6 --square 25mm --paper A4 -o board.pdf`

    `kcal board --board charuco:9x6 --square 25mm --paper A4 -o charuco.pdf`

    `kcal board --board 7x6 --square 50mm --paper A2 -o board.svg`

    `kcal board --board aprilgrid:6x6 --square 25mm --paper A4 -o april.pdf`

    `kcal board --board asymmetric:4x11 --square 20mm --paper A4 -o circles.pdf`

    Args:
        output: File to write, .svg or .pdf.
        paper: Size of the paper: A5, A4, A3, A2, A1, A0, letter, legal, tabloid, or auto for as large as needed.
    """
    suffix = output.suffix.lower()
    if suffix not in (".svg", ".pdf"):
        raise InputError(f"{output}: give a file name that ends in .svg or .pdf")
    pattern = kcal.Board.parse(board, square)
    sheet = rooms.board_sheet(pattern, paper)
    write_atomic(output, rooms.to_svg(sheet.drawing) if suffix == ".svg" else rooms.to_pdf(sheet.drawing))
    out.print(f"{output}: {pattern}, page {sheet.drawing.width:g}x{sheet.drawing.height:g} mm")
    if sheet.quiet < 1:
        squares = pattern.pattern == "checkerboard"
        white = f"{sheet.quiet:.1f} squares" if squares else f"{sheet.quiet * sheet.margin:.0f} mm"
        out.print(f"note: only {white} of white around the board; keep the background light")
    if not pattern.unambiguous:
        out.print(f"note: this board looks the same turned by 180°; for stereo {pattern.stereo_advice}")


def board_measure_command(
    observations: list[kinds.Observed], *, output: kinds.NewFile, picture: kinds.Picture | None = None
) -> None:
    """Measure a printed board: how it bends, and how its print errs, each with its σ.

    Fits each camera and its board, as `kcal calibrate` does. Cameras that saw the same board share it, and measure it
    together; the evidence tells whether they did. Tilt and roll the board in many directions: without rolls, stretch
    and keystone of the board cannot be told from the camera's.

    **Examples**

    `kcal board measure left.obs.json right.obs.json -o plate.board.json --picture plate.png`

    Args:
        observations: Observations files of one or several cameras.
        output: Board file to write.
        picture: Heights as colors, print errors as arrows.
    """
    sets = [kcal.Observations.load(path) for path in observations]
    names = [path.name.split(".")[0] for path in observations]
    if len(set(names)) < len(names):
        names = [str(path) for path in observations]
    with steps("measuring", 2 * len(sets) if len(sets) > 1 else 1) as advance:
        found = rooms.fit_cameras(sets, names=names, advance=advance)
    board = dataclasses.replace(found.boards[0], name=output.name.split(".")[0])
    kcal.calibrate.save_measured_board(board, output)
    console.draw_picture(picture, lambda: rooms.board_figure(board))
    out.print(f"{board.board}, {len(board.observations)} of {len(sets)} observations: {', '.join(board.observations)}")
    out.print("\n".join(f"  {line}" for line in rooms.board_text(board)))
    out.print(f"evidence against the board as ordered: {board.log_evidence:.0f} nats")
    for name, camera in zip(names, found.cameras, strict=True):
        if turned := int((camera.turns > 0).sum()):
            out.print(f"{name}: {turned} of {len(camera.turns)} views were read from another end of the board")
    if len(board.observations) > 1:
        least = min(camera.nats for camera in found.cameras if camera.board == 0)
        out.print(f"evidence that they saw one board: {least:.0f} nats")
    if len(found.boards) > 1:
        others = ", ".join(name for name, camera in zip(names, found.cameras, strict=True) if camera.board != 0)
        warn(
            f"these observations show {len(found.boards)} boards, not one: {output} is the board of "
            f"{', '.join(board.observations)}. Two prints of one pattern are two boards; measure {others} apart"
        )
    print_wrote(output, picture)


# `kcal detect`: images to an observations file.


def detect_command(
    images: list[kinds.Images],
    *,
    output: kinds.NewFile,
    board: kinds.BoardOrAuto = "auto",
    square: kinds.Square | None = None,
    refine: kinds.RefineMethod = "erf",
    gallery: kinds.Picture | None = None,
    coverage: kinds.Picture | None = None,
    time_limit: Annotated[float, Kind(metavar="S", least=0.1)] = 60.0,
    duration: Annotated[float, Kind(metavar="S", least=1.0)] = 120.0,
    keep: Path | None = None,
    topic: Annotated[list[str], Kind(metavar="TOPIC")] | None = None,
) -> None:
    """Find the board in the images of one camera.

    The images tell which board it is; --square tells its size. Writes the corners of each view, and the reason for each
    image in which no board was found. EXIF orientation is ignored: pixels are used as the sensor wrote them. Nothing is
    written if no image shows the board, or if more images show another one.

    **Examples**

    `kcal detect left/ --square 25mm -o left.obs.json`

    `kcal detect left/ --board 9x6 --square 25mm -o left.obs.json`

    `kcal detect left/ --board charuco:9x6:5x5_100:18mm --square 25mm -o left.obs.json`

    `kcal detect rtsp://10.0.0.7/main --board 9x6 --square 25mm -o left.obs.json --duration 60 --keep frames/`

    `kcal detect run.mcap --topic /left/image_raw --topic /right/image_raw --square 25mm -o rig.obs.json`

    `kcal detect "shots/left*.png" --board 9x6 --square 25mm -o left.obs.json --refine opencv`

    Args:
        images: Images of one camera: files, folders or quoted wildcards; or one video, a bag of ROS (.bag,
            .mcap, folder), or a stream (rtsp://..., camera:0).
        output: Observations file to write.
        gallery: Images that failed and why, then the views with their corners, worst first.
        coverage: Where in the image corners were seen.
        time_limit: Seconds of CPU time after which the search in one image is given up.
        duration: Seconds for which a stream is watched.
        keep: Folder for the frames of a video or stream that became views, as PNG.
        topic: Of a bag that has images of several. Two, of the cameras of a rig, give two files, NAME_left and
            NAME_right, with views of the same moments.
    """
    given = given_board(board, square)
    failed: list[tuple[str, Path, rooms.Detection]] = []
    turned: list[Path] = []
    streams = [source_name(image) for image in images if is_stream(image)]
    if streams and len(images) > 1:
        raise InputError(f"{streams[0]}: a stream is searched alone, without other images")
    if keep is not None:
        make_folder(keep)
    bag = rooms.bag_and_topic(images[0]) if len(images) == 1 else None
    if topic and bag is None:
        raise InputError("--topic is of one bag: kcal detect run.mcap --topic /left/image_raw ...")
    if bag is not None and topic:
        images = [f"{bag[0]}:{one}" for one in topic]
    if len(topic or ()) > 1 and (gallery or coverage):
        raise InputError("--gallery and --coverage are of one camera: give one --topic")
    outputs = _of_each_camera(output, len(images)) if len(topic or ()) > 1 else [output]
    if bag is not None or (len(images) == 1 and rooms.is_video(images[0])):
        searched: list[str] = []
        pattern = given or board_in_images(images, square, time_limit)
        with steps(f"watching {streams[0]} for {duration:g} s" if streams else "searching the video", None):
            observed = rooms.detect_videos(
                images, pattern, refine, progress=searched.append, time_limit=time_limit, duration=duration,
                keep=keep,
            )  # fmt: skip
        source = f"of {len(searched)} sharp {'moments' if len(images) > 1 else 'frames'} (repeats left out)"
    else:
        paths = rooms.expand_images(images)
        check_writable(output, *paths)
        pattern = given or board_in_images(paths, square, time_limit)
        with (
            ending_with(lambda error: _next_command(error, board, pattern, images, paths, output)),
            steps("detecting", len(paths)) as advance,
        ):
            seen = kcal.detect(
                paths,
                pattern,
                refine,
                progress=advance,
                time_limit=time_limit,
                note=warn,
                on_failure=lambda *one: failed.append(one),
            )
        observed = [seen]
        turned = rooms.turned_images([path for path in paths if os.path.isfile(path)])
        source = f"of {len(paths)} images"
    for path, one in zip(outputs, observed, strict=True):
        one.save(path)
    tiles = (rooms.FailedImage(name, path, found.reason, found.rejected) for name, path, found in failed)
    console.draw_picture(gallery, lambda: rooms.gallery_figure(observed[0], list(tiles)))
    console.draw_picture(coverage, lambda: rooms.coverage_figure(observed[0]))

    views = [view for one in observed for view in one.views]
    failures = [failure for one in observed for failure in one.failures]
    found, unseen = len(views), sum(int((~view.seen).sum()) for view in views)
    tell(views=found, failures={failure.name: failure.reason for failure in failures})
    for path, one in zip(outputs, observed, strict=True):
        width, height = one.image_size
        out.print(f"{path}: board found in {len(one.views)} {source} of {width}x{height} px")
    wide, high = (1e3 * side for side in pattern.extent)
    out.print(f"board {pattern}: {wide:g} x {high:g} mm from the first point to the last")
    if turned:
        out.print(
            f"note: {len(turned)} images have an EXIF rotation, of {len(paths)}, which kcal ignores: corners are in "
            "pixels of the sensor"
        )
    if unseen:
        out.print(f"corners left out as uncertain: {unseen} of {found * pattern.corners}")
    lines = [f"failed {failure.name}: {failure.reason}" for failure in failures]
    print_left_out(lines, output, f"{counted_text(len(lines), 'image')} failed")
    if not pattern.unambiguous:
        out.print(f"note: this board looks the same turned by 180°; for stereo {pattern.stereo_advice}")


def _of_each_camera(output: Path, count: int) -> list[Path]:
    name, _, kind = output.name.partition(".")
    sides = ("left", "right") if count == 2 else map(str, range(1, count + 1))
    return [check_writable(output.with_name(f"{name}_{side}.{kind}")) for side in sides]


def given_board(size: str, square: str | None) -> kcal.Board | None:
    """The board that `--board` and `--square` say; None where the images have to tell it."""
    return None if size == "auto" else kcal.Board.parse(size, square)


def board_in_images(images: Sequence[str | Path], square: str | None, time_limit: float | None = None) -> kcal.Board:
    """The board that images, a video or a stream show; it is said."""

    def say(found: rooms.Recognized) -> None:
        if found.seen is not None:
            tell(board=found.seen.text)
            err.print(f"board {found.seen.text}, seen in {found.votes} of {found.looked} images that were looked at")

    first = images[0]
    with steps("looking for a board", None):
        shown = rooms.spread_frames(first) if rooms.is_video(first) else images
        return kcal.corners.recognize_board(shown, square, time_limit=time_limit, note=say)


_CURED = 6  # images that are looked at to name the board of a refusal


def _next_command(
    refusal: KcalError, given: str, board: kcal.Board, images: Sequence[str], paths: Sequence[Path], output: Path
) -> str:
    """The command for images of each size, that with the board that was found, or one that draws the board."""
    if isinstance(refusal, rooms.SizesError):
        return f"To split them: {' && '.join(_of_each_size(refusal.groups, images, paths, output))}"
    if isinstance(refusal, rooms.OtherBoardError) and given in typed:
        seen = rooms.recognize_images(refusal.images, _CURED).seen
        if seen is not None and seen.other_than(board):
            return f"Perhaps: {typed_with({given: seen.text})}"
    return f"To see what this board looks like: kcal board {board_words(board)} -o board.svg"


def _of_each_size(
    groups: Mapping[tuple[int, int], Sequence[int]], images: Sequence[str], paths: Sequence[Path], output: Path
) -> Iterator[str]:
    """A command for the images of each size, those of most first; sizes that may be of one camera stay together."""
    together: dict[tuple[int, int], list[int]] = {}
    for size, numbers in groups.items():
        alike = (other for other in together if rooms.nearly(size, other) or rooms.resized_alike(size, other))
        together.setdefault(next(alike, size), []).extend(numbers)
    for (width, height), numbers in sorted(together.items(), key=lambda group: -len(group[1])):
        own = output.with_name(f"{output.name.split('.')[0]}-{width}x{height}.obs.json")
        words = [str(own) if word == str(output) else word for word in typed if word not in images]
        yield shlex.join(["kcal", words[0], *(str(paths[number]) for number in sorted(numbers)), *words[1:]])
