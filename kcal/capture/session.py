"""Frames for a capture: keep the useful ones of a board, calibrate as they come, and say what to photograph next."""

from __future__ import annotations

import dataclasses
import math
import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from torch import Tensor

from kcal.bag import bag_and_topic
from kcal.calibrate.camera.advice import NextView, board_rolls, far_sigma, next_view, possible_views
from kcal.calibrate.camera.calibrate import CameraCalibrationResult, calibrate_camera
from kcal.corners.board import Board
from kcal.corners.detect import detect_board, view_of
from kcal.corners.images import IMAGE_SUFFIXES, Gray, decode_gray
from kcal.corners.observations import Observations
from kcal.corners.refine import Refinement
from kcal.corners.video import NEW, is_new_view, read_frames, sharpest
from kcal.errors import FileError, InputError, KcalError
from kcal.files import is_stream, make_folder, read_bytes, write_atomic
from kcal.io.images import encode_png
from kcal.lens.camera import Camera
from kcal.threads import Handover
from kcal.web.serving import local_app, page_files

# Frames for a capture: a camera or stream, a video, or a folder into which images come.

# Seconds between two looks into a folder.
_LOOK = 0.5


class Shot(NamedTuple):
    """A frame with a name; `moving` tells frames of a moving board from single images."""

    name: str
    image: Gray
    moving: bool


def shots(source: str, stopped: Callable[[], bool], tell: Callable[[str], None]) -> Iterator[Shot]:
    """Frames of a source, until it ends or `stopped` says so.

    Of a video or stream the sharpest of every few frames; of a folder the images that are there and those that come.

    Args:
        source: `camera:0`, `rtsp://...`, a video file, a bag, or a folder.
        stopped: looked at before each frame.
        tell: called with the reason for each image of a folder that cannot be read.

    Raises:
        FileError: no such file or folder, no video, or a stream that does not answer.
    """
    if not is_stream(source) and os.path.isdir(source) and bag_and_topic(source) is None:
        yield from _of_folder(Path(source), stopped, tell)
        return
    # A live source ends when it is told to.
    frames = sharpest(read_frames(source, float("inf")))
    # Of a stream, frames that come while one is looked at are left out.
    newest = Handover(frames, 1, waits=False) if is_stream(source) else None
    try:
        for frame in newest or frames:
            if stopped():
                return
            yield Shot(frame.name(source), frame.image, True)
    finally:
        if newest is not None:
            newest.close(wait=5.0)


def _of_folder(folder: Path, stopped: Callable[[], bool], tell: Callable[[str], None]) -> Iterator[Shot]:
    sizes: dict[str, int] = {}
    done: set[str] = set()
    while not stopped():
        try:
            entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
            images = [entry for entry in entries if Path(entry.name).suffix.lower() in IMAGE_SUFFIXES]
            found = {entry.name: entry.stat().st_size for entry in images if entry.is_file() and entry.name not in done}
        except OSError as error:
            raise FileError(f"{folder}: cannot be read: {error.strerror}") from error
        # An image that still grows is looked at again when it has come to rest.
        ready = [name for name, size in found.items() if size and sizes.get(name) == size]
        for name in ready:
            if stopped():
                return
            done.add(name)
            try:
                yield Shot(name, decode_gray(read_bytes(folder / name), name), False)
            except FileError as error:
                tell(str(error))
        sizes = found
        if not ready:
            time.sleep(_LOOK)


# Keep the useful frames of a board, calibrate as they come, and say what to photograph next.

# Views before the first calibration: four tilts determine a focal length.
FIRST_VIEWS = 4
# A board that moves by more than this share of the image's width between two frames is blurred.
_STILL = 0.003
# Until a camera is calibrated its focal length is taken for this share of the image's width, 58° across.
_USUAL_FOCAL = 0.9


@dataclasses.dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """When to stop, and how frames are searched.

    Args:
        until: px, standard deviation of points at infinity along an axis, RMS over the image, at which to stop.
        most: number of views at which to stop.
        refine: see `kcal.corners.refine.refine_corners`.
    """

    until: float = 0.1
    most: int = 60
    refine: Refinement = "erf"

    def __post_init__(self) -> None:
        if not 0 < self.until < math.inf:
            raise InputError(f"CaptureOptions: until must be positive pixels, got {self.until}")
        if self.most < FIRST_VIEWS:
            raise InputError(f"CaptureOptions: most must be at least {FIRST_VIEWS} views, got {self.most}")


class CaptureSession:
    """Views of one camera, from the first frame to a camera that is known well enough.

    Observations and frames are on the disk before the next frame is looked at; a session with an existing observations
    file continues it. `offer` and `think` may be called from two threads.

    Args:
        output: observations file; frames that became views go into a folder beside it, NAME.frames.
        board: that is photographed.
        options: see `CaptureOptions`.

    Raises:
        FileError: the file or the folder cannot be written, or an existing file cannot be read.
        InputError: the existing file is of another board.
    """

    def __init__(self, output: Path, board: Board, options: CaptureOptions | None = None) -> None:
        self.output, self.board, self.options = output, board, options or CaptureOptions()
        self.frames = make_folder(output.parent / (output.name.split(".")[0] + ".frames"))
        self.seen: Observations | None = None
        self.result: CameraCalibrationResult | None = None
        self.suggestion: NextView | None = None
        self.history: list[tuple[int, float]] = []
        self.message = "show the board"
        self.corners: Tensor | None = None
        self._image: Gray | None = None
        self._before: Tensor | None = None
        self._calibrated = 0
        self._lock = threading.Lock()
        if output.exists():
            self.seen = Observations.load(output)
            if self.seen.board != board:
                raise InputError(
                    f"{output}: holds views of another board ({self.seen.board}); give --output another name"
                )

    @property
    def views(self) -> int:
        """How many frames were kept."""
        return 0 if self.seen is None else len(self.seen.views)

    @property
    def sigma(self) -> float:
        """px, of points at infinity (`far_sigma`); NaN before the first calibration."""
        return self.history[-1][1] if self.history else math.nan

    @property
    def finished(self) -> str:
        """Why no more views are needed; empty while they are."""
        if self.sigma <= self.options.until:
            return f"points at infinity are known to ± {self.sigma:.3f} px: enough"
        return f"{self.views} views were kept: the most that were asked for" if self.views >= self.options.most else ""

    def offer(self, image: Gray, name: str, *, moving: bool) -> bool:
        """Look at a frame and keep it if it shows the board, sharp and somewhere new.

        Args:
            image: (H, W) gray.
            name: of the frame.
            moving: the frame is one of many of a moving board: it must have come to rest since the frame before.

        Raises:
            InputError: an image of another size than the first one.
            FileError: the frame cannot be written.
        """
        size = (image.shape[1], image.shape[0])
        if self.seen is not None and self.seen.image_size != size:
            raise InputError(f"{name}: {size[0]}x{size[1]} px, earlier views have another size; one camera at a time")
        found = detect_board(image, self.board, self.options.refine)
        with self._lock:
            self._image, self.corners = image, found.pixels
            before, self._before = self._before, found.pixels
            if found.pixels is None:
                self.message = found.reason
                return False
            if moving and (before is None or is_new_view(found.pixels, [before], _STILL * size[0])):
                self.message = "hold still"
                return False
            kept = [] if self.seen is None else list(self.seen.pixels())
            if not is_new_view(found.pixels, kept, NEW * size[0]):
                self.message = "kept one like this already; move the board"
                return False
            path = self.frames / (re.sub(r"[^\w.-]+", "_", name.removesuffix(".png")) + ".png")
            write_atomic(path, encode_png(cast(Any, image)))
            views = () if self.seen is None else self.seen.views
            view = view_of(found, name, image=str(path))
            self.seen = Observations(
                board=self.board, image_size=size, refinement=self.options.refine, views=(*views, view)
            )
            self.seen.save(self.output)
            self.message = f"kept {name}"
        self._advise()
        return True

    def _advise(self) -> None:
        """Say what to photograph next by what is known now: a fit takes long, and what was asked for is there."""
        with self._lock:
            seen, result, fitted = self.seen, self.result, self.history[-1][0] if self.history else 0
        if seen is None:
            return
        if result is None or result.hybrid is None:
            found: NextView | None = _first_view(seen.image_size, self.board, len(seen.views))
        else:
            found = next_view(result.camera, self.board, result.hybrid.sigma, seen.pixels()[fitted:])
        with self._lock:
            # What came meanwhile has its own.
            if self.seen is seen and self.result is result:
                self.suggestion = found

    def think(self) -> bool:
        """Calibrate with the views of this moment and find the next one; False if there is nothing new."""
        with self._lock:
            seen, image = self.seen, self._image
        count = 0 if seen is None else len(seen.views)
        if seen is None or count < FIRST_VIEWS:
            size = seen.image_size if seen is not None else None if image is None else image.shape[::-1]
            if size is None or (self.suggestion is not None and count == self._calibrated):
                return False
            self._calibrated, self.suggestion = count, _first_view((size[0], size[1]), self.board, count)
            return True
        if count == self._calibrated:
            return False
        self._calibrated = count
        try:
            result = calibrate_camera(seen)
            sigma = far_sigma(result.camera)
        except KcalError as error:
            self.message = f"cannot be calibrated yet: {error}"
            return True
        with self._lock:
            self.result = result
            self.history.append((count, sigma))
        self._advise()
        return True

    def picture(self) -> bytes | None:
        """The last frame as PNG, at most 1280 px wide; None before the first."""
        image = self._image
        if image is None:
            return None
        step = -(-image.shape[1] // 1280)
        return encode_png(cast(Any, np.ascontiguousarray(image[::step, ::step])))

    def state(self) -> dict[str, Any]:
        """All that the page shows."""
        with self._lock:
            seen, image, result, next_one = self.seen, self._image, self.result, self.suggestion
            corners, history, message = self.corners, list(self.history), self.message
        size = seen.image_size if seen is not None else image.shape[::-1] if image is not None else (0, 0)
        return {
            "views": 0 if seen is None else len(seen.views),
            "most": self.options.most,
            "until": self.options.until,
            "history": [[count, sigma] for count, sigma in history if math.isfinite(sigma)],
            "message": message,
            "finished": self.finished,
            "size": list(size),
            "corners": _seen_pixels(corners),
            "outlines": [] if seen is None else [self._outline(view) for view in seen.pixels()],
            "holds": [] if result is None else _holds(result.cam_from_board_rotation),
            "warnings": [] if result is None else list(result.warnings),
            "next": None
            if next_one is None
            else {
                "words": next_one.words,
                "outline": self._outline(next_one.pixels),
                "first": _seen_pixels(next_one.pixels[:1]),
                "sigma": next_one.sigma if math.isfinite(next_one.sigma) else None,
            },
        }

    def _outline(self, pixels: Tensor) -> list[list[float]]:
        """The board's outer corners, around it; those that were not seen are left out."""
        last = self.board.columns - 1
        return _seen_pixels(pixels[[0, last, self.board.corners - 1, self.board.corners - 1 - last]])


def follow(session: CaptureSession, *, until: Callable[[], bool]) -> None:
    """Think while frames come, until the session is finished or `until` says so; for a thread of its own."""
    pause = threading.Event()
    while not until() and not session.finished:
        if not session.think():
            pause.wait(0.1)


def _first_view(size: tuple[int, int], board: Board, number: int) -> NextView:
    """One of four tilts in the middle of the image, for a camera of which nothing is known."""
    width, height = size
    camera = Camera.build(
        focal=(_USUAL_FOCAL * width,) * 2, center=(0.5 * width, 0.5 * height), size=size, model="pinhole"
    )
    views = possible_views(camera, board)
    steep = [i for i, text in enumerate(views.words) if "near, in the middle" in text and "away" in text]
    i = steep[(number * 3) % len(steep)]
    return NextView(views.rotation[i], views.translation[i], views.pixels[i], views.words[i], math.nan)


def _seen_pixels(pixels: Tensor | None) -> list[list[float]]:
    return [] if pixels is None else pixels[pixels.isfinite().all(-1)].tolist()


def _holds(rotation: Tensor) -> list[list[float]]:
    """Of each view: where the board's normal leans (x, y), as the sine of its tilt, and its roll in degrees."""
    rotation = rotation[rotation.isfinite().all(-1).all(-1)]
    return torch.cat([rotation[:, :2, 2], board_rolls(rotation)[:, None]], 1).tolist()


# The capture page's routes.


def capture_app(session: CaptureSession, stop: threading.Event, token: str, hosts: tuple[str, ...]) -> Starlette:
    """The application.

    Args:
        session: that is shown.
        stop: set when the page asks to end.
        token: that requests for data must carry.
        hosts: that are answered.
    """

    async def state(_: Request) -> Response:
        return JSONResponse({**await run_in_threadpool(session.state), "stopped": stop.is_set()})

    async def picture(_: Request) -> Response:
        found = await run_in_threadpool(session.picture)
        return Response(status_code=204) if found is None else Response(found, media_type="image/png")

    async def end(_: Request) -> Response:
        stop.set()
        return JSONResponse({})

    routes = [
        Route("/api/state", state, methods=["GET"]),
        Route("/api/picture", picture, methods=["GET"]),
        Route("/api/stop", end, methods=["POST"]),
    ]
    return local_app(routes, page_files(("kcal.capture", "page")), token, hosts)
