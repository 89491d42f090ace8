"""Images of one camera, resampled into a folder: image by image, so that a run that was interrupted continues."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from kcal.cli.console import err
from kcal.errors import FileError, InputError
from kcal.files import check_writable, dump_json, make_folder, read_bytes, write_atomic
from kcal.strict_json import read_json

if TYPE_CHECKING:
    from kcal.lens.images import Undistort

# In every folder of images: how they were made, and which are done.
IMAGE_JOURNAL = "rectify.json"
# Seconds between two writes of the journal.
_OFTEN = 5.0


def targets_of(paths: list[Path], folder: Path, others: list[Path]) -> list[Path]:
    """Choose the file for each image: all different, and none of them an input or one of `others`."""
    inputs = {path.resolve() for path in paths}
    taken: dict[Path, str] = {path: "a file of this command" for path in others}
    targets = []
    for path in paths:
        target = folder / f"{path.stem}.png"
        if target.resolve() in inputs:
            raise InputError(f"{target}: an input image would be overwritten; choose another folder")
        if target in taken:
            raise InputError(f"{target}: both {taken[target]} and {path} would become this file; use two folders")
        taken[target] = str(path)
        targets.append(target)
    return targets


def prepare(folder: Path, files: list[Path]) -> None:
    """Make the folder, and refuse now what could not be written later."""
    make_folder(folder)
    for path in [*files, folder / IMAGE_JOURNAL]:
        check_writable(path)


class ImageJournal:
    """Which images of a folder are done, by which views: nothing is taken for done that another view made.

    Args:
        folder: of the images.
        module: that makes them.
    """

    def __init__(self, folder: Path, module: Undistort) -> None:
        values = [value.tolist() for value in (module.camera.params, module.new_camera.params, module.rotation)]
        kinds = repr((type(module.new_camera).__name__, str(module.camera.model), module.camera.model.hybrid))
        text = repr((values, kinds, module.camera.size, module.new_camera.size, module.at))
        self.path = folder / IMAGE_JOURNAL
        self.view = hashlib.sha256(text.encode()).hexdigest()[:16]
        self.done: dict[str, list[int]] = {}
        self._saved = time.monotonic()
        try:
            content: Any = read_json(read_bytes(self.path), str(self.path)) if self.path.exists() else {}
        except FileError:
            content = {}
        if isinstance(content, dict) and content.get("view") == self.view and isinstance(content.get("done"), dict):
            self.done = content["done"]
        else:
            # Before the first image: a run that is killed must not leave images that an older journal calls done.
            self.save()

    def has(self, path: Path, target: Path) -> bool:
        """Whether this image was made of this file, as it is now."""
        return target.exists() and self.done.get(target.name) == _file_state(path)

    def add(self, path: Path, target: Path) -> None:
        """Note that an image is done."""
        self.done[target.name] = _file_state(path)
        if time.monotonic() - self._saved > _OFTEN:
            self.save()

    def save(self) -> None:
        """Write the journal."""
        write_atomic(self.path, dump_json({"view": self.view, "done": self.done}))
        self._saved = time.monotonic()

    def close(self) -> None:
        """Write the journal; where no image could be made, none is left."""
        if self.done:
            self.save()
        else:
            self.path.unlink(missing_ok=True)


def _file_state(path: Path) -> list[int]:
    state = path.stat()
    return [state.st_size, state.st_mtime_ns]


def convert_images(
    paths: list[Path], targets: list[Path], module: Undistort, advance: Callable[[str], None]
) -> tuple[int, list[str]]:
    """Resample images into files, a bad one not stopping the others.

    Returns:
        how many were done before, and what was wrong with those that failed.
    """
    journal = ImageJournal(targets[0].parent, module)
    failures: list[str] = []
    before = 0
    try:
        for path, target in zip(paths, targets, strict=True):
            if journal.has(path, target):
                before += 1
            else:
                try:
                    _convert(path, target, module)
                    journal.add(path, target)
                except (FileError, InputError) as error:
                    failures.append(str(error))
                    err.print(f"[yellow]failed[/] {escape(str(error))}")
            advance(path.name)
    finally:
        journal.close()
    return before, failures


def _convert(path: Path, target: Path, module: Undistort) -> None:
    import torch

    from kcal.corners.images import decode_image
    from kcal.io.images import write_png

    image = torch.from_numpy(decode_image(read_bytes(path), path))
    (height, width), size = image.shape[:2], module.camera.size
    if (width, height) != size:
        raise InputError(f"{path}: the image is {width}x{height} px, the camera {size[0]}x{size[1]} px")
    new, _ = module(image[None] if image.ndim == 2 else image.permute(2, 0, 1))
    write_png(target, (new[0] if image.ndim == 2 else new.permute(1, 2, 0)).contiguous().numpy())
