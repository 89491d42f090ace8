"""Cameras to calibrate, and the two pieces of work: find the board in one image, and calibrate one camera.

The name of a piece is a hash of everything that it depends on: the image's bytes, the options, and kcal's version. A
finished piece is found by that name after an interruption, and is done again if its input has changed.
"""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import kcal
from kcal.calibrate.camera.calibrate import CalibrationOptions, CameraCalibrationResult, calibrate_camera
from kcal.calibrate.camera.result import HYBRID
from kcal.corners.board import Board
from kcal.corners.detect import detect_board, recognize_board, refuse_other_board, view_of
from kcal.corners.images import decode_gray, expand_images, image_bytes, unique_names
from kcal.corners.observations import Failure, Observations, PackedCovariance, Pixel, View, common_size, rescaled
from kcal.corners.refine import Refinement
from kcal.errors import FileError, InputError, KcalError
from kcal.file_kind import ImageSize
from kcal.files import read_bytes
from kcal.io.camera_file import CameraFile
from kcal.native_file import NativeFile
from kcal.threads import work_limit

# Finished pieces of work, in the folder of the results.
WORK = ".work"
_COLUMNS = ("camera", "images", "board", "square", "model")


@dataclasses.dataclass(frozen=True, kw_only=True)
class BatchOptions:
    """Options for all cameras of a batch.

    Args:
        refine: how corners are refined, see `kcal.corners.refine.refine_corners`.
        board_warp: also estimate how each board bends.
        one_type: the cameras are of one type: each learns from the others what its lens is like.
        time_limit: seconds of CPU time for one image or one calibration, after which it is given up.
    """

    refine: Refinement = "erf"
    board_warp: bool = False
    one_type: bool = False
    time_limit: float = 300.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraJob:
    """One camera of a batch; `error` says why its images cannot be read."""

    name: str
    images: tuple[Path, ...] = ()
    board: Board | None = None
    model: str = "hybrid"
    error: str = ""


class Detected(NativeFile):
    """The corners of one image, or the reason why there are none (file kind `detected`)."""

    KIND: ClassVar[str] = "detected"
    VERSION: ClassVar[int] = 1

    size: ImageSize | None = None
    pixels: tuple[Pixel | None, ...] | None = None
    covariance: tuple[PackedCovariance | None, ...] | None = None
    reason: str = ""


class Calibrated(NativeFile):
    """One camera's calibration, or the reason why there is none (file kind `calibrated`)."""

    KIND: ClassVar[str] = "calibrated"
    VERSION: ClassVar[int] = 1

    camera: CameraFile | None = None
    warnings: tuple[str, ...] = ()
    error: str = ""


def read_jobs(source: Path, board: Board | None, model: str, square: str | None = None) -> list[CameraJob]:
    """Read which cameras a folder of folders or a CSV table names.

    In a folder, every folder with images is a camera. A table has the columns `camera` and `images` (a file, folder or
    wildcard, relative to the table) and may have `board`, `square` and `model`, which override the arguments. Without a
    board, the images of each camera tell which one it is, with squares of a side such as `25mm`.

    Raises:
        FileError: no such file or folder, no camera in it, or a table that cannot be read.
        InputError: a camera without a board.
    """
    if os.path.isdir(source):
        rows = [
            {"camera": folder.name, "images": str(folder)}
            for folder in sorted(source.iterdir())
            # Results of a batch are no camera.
            if folder.is_dir() and not folder.name.startswith(".") and not (folder / WORK).is_dir()
        ]
        if not rows:
            raise FileError(f"{source}: no folders in it; make one folder of images for each camera, or give a CSV")
    else:
        rows = _read_table(source)
    for name, times in Counter(row["camera"] for row in rows).items():
        if times > 1:
            raise InputError(f"{source}: two cameras are named {name!r}")
        if not name or Path(name).name != name or name.startswith("."):
            raise InputError(f"{source}: {name!r} cannot name a camera: it becomes a file name")
    return [_job(source, row, board, model, square) for row in rows]


def pieces(jobs: Sequence[CameraJob]) -> int:
    """Count the pieces of work: one for each image, for each camera, and for each that shares its kind of board."""
    return sum(len(job.images) + (not job.error) for job in jobs) + sum(map(len, sharing_jobs(jobs)))


def sharing_jobs(jobs: Sequence[CameraJob]) -> list[list[int]]:
    """Which cameras may have seen one board: those with the hybrid lens and boards of one kind."""
    hybrid = [i for i, job in enumerate(jobs) if not job.error and job.model == HYBRID]
    kinds: dict[Board | None, list[int]] = {}
    for i in hybrid:
        kinds.setdefault(jobs[i].board, []).append(i)
    return [numbers for numbers in kinds.values() if len(numbers) > 1]


def _job(source: Path, row: dict[str, str], board: Board | None, model: str, square: str | None) -> CameraJob:
    name = row["camera"]
    try:
        if row.get("board") or row.get("square"):
            kind = row.get("board", "")
            if source.is_file() and Path(kind).suffix.lower() in (".yaml", ".yml"):
                kind = str(source.parent / kind)
            board = Board.parse(kind, row.get("square", ""))
        images = expand_images([source.parent / row["images"] if source.is_file() else row["images"]])
        if board is None and square is not None:
            board = recognize_board(images, square)
    except KcalError as error:
        return CameraJob(name=name, error=str(error))
    if board is None:
        raise InputError(
            f"camera {name!r}: no board; give --square, and --board if images do not tell it, or columns of these names"
        )
    return CameraJob(name=name, images=tuple(images), board=board, model=row.get("model") or model)


def _read_table(path: Path) -> list[dict[str, str]]:
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileError(f"{path}: not UTF-8 text; save it as CSV in UTF-8") from error
    reader = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True)
    rows = []
    try:
        header = reader.fieldnames or []
        if not {"camera", "images"} <= set(header) <= set(_COLUMNS):
            raise FileError(
                f"{path}: the first line must name the columns camera,images and may name board,square,model"
            )
        for row in reader:
            if None in row or None in row.values():
                raise FileError(f"{path}: line {reader.line_num}: {len(header)} fields are needed")
            rows.append({key: value.strip() for key, value in row.items()})
    except csv.Error as error:
        raise FileError(f"{path}: line {reader.line_num}: {error}") from error
    if not rows:
        raise FileError(f"{path}: no camera under the header")
    return rows


def hash_of(*parts: object) -> str:
    """Name a piece of work by everything that it depends on."""
    return hashlib.sha256(repr((kcal.__version__, *parts)).encode()).hexdigest()[:32]


def detect_image(path: str, board: Board, options: BatchOptions) -> Detected:
    """Find the board in one image."""
    with work_limit(options.time_limit):
        try:
            image = decode_gray(image_bytes(path), path)
        except FileError as error:
            return Detected(reason=str(error).removeprefix(f"{path}: "))
        found = detect_board(image, board, options.refine)
        size = image.shape[1], image.shape[0]
        if found.pixels is None:
            return Detected(size=size, reason=found.reason)
        view = view_of(found, Path(path).name)
        return Detected(size=size, pixels=view.pixels, covariance=view.covariance)


def observations_of(
    job: CameraJob, pieces: list[Detected], digests: list[str], refine: Refinement
) -> tuple[Observations, str]:
    """Put the pieces of one camera's images together; also what was done about images of several sizes.

    Raises:
        InputError: no size that more than half of the images have, or no board in any.
    """
    assert job.board is not None
    names = unique_names(list(job.images))
    views, failures = [], []
    common = common_size(names, [piece.size for piece in pieces])
    for i, (name, path, piece, digest) in enumerate(zip(names, job.images, pieces, digests, strict=True)):
        if piece.pixels is None or i in common.left_out:
            failures.append(Failure(name=name, reason=common.left_out.get(i, piece.reason)))
            continue
        view = View(name=name, pixels=piece.pixels, covariance=piece.covariance, image=str(path), sha256=digest)
        views.append(rescaled(view, common.scales[i]) if i in common.scales else view)
    paths = dict(zip(names, job.images, strict=True))
    refuse_other_board(
        len(views), [(paths[one.name], f"{one.name}: {one.reason}") for one in failures], len(pieces), job.board
    )
    seen = Observations(
        board=job.board, image_size=common.size, refinement=refine, views=tuple(views), failures=tuple(failures)
    )
    return seen, "; ".join(common.notes)


def calibration_options(model: str, options: BatchOptions) -> CalibrationOptions:
    """How cameras of this model are calibrated."""
    return CalibrationOptions(model=model, board_warp=options.board_warp)


def calibrate_again(seen: Observations, options: BatchOptions, model: str = HYBRID) -> CameraCalibrationResult:
    """One camera, with all that its calibration tells."""
    with work_limit(options.time_limit):
        return calibrate_camera(seen, calibration_options(model, options))


def calibrated(result: CameraCalibrationResult, name: str) -> Calibrated:
    """What is kept of a calibration."""
    return Calibrated(camera=result.file(name=name, source=f"{name}.obs.json"), warnings=result.warnings)


def calibrate_observations(seen: Observations, name: str, model: str, options: BatchOptions) -> Calibrated:
    """Calibrate one camera."""
    try:
        return calibrated(calibrate_again(seen, options, model), name)
    except KcalError as error:
        return Calibrated(error=str(error))
