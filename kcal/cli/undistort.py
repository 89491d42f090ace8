"""`kcal undistort`: images without lens distortion, and their pinhole camera."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from kcal.cli.console import err, out, print_wrote, steps
from kcal.cli.inputs import CAMERA, IMAGES
from kcal.errors import FileError, InputError
from kcal.files import check_writable, make_folder, read_bytes

if TYPE_CHECKING:
    from kcal.lens.images import Undistort


def undistort_command(
    images: Annotated[
        list[str],
        typer.Argument(
            metavar="IMAGES", help="Images of one camera: files, folders or quoted wildcards.", show_default=False
        ),
        IMAGES,
    ],
    camera: Annotated[Path, typer.Argument(help="Camera file from `kcal calibrate`.", show_default=False), CAMERA],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FOLDER", help="Folder to write to.")],
    alpha: Annotated[
        float,
        typer.Option(
            "--alpha",
            min=0,
            max=1,
            help="0 keeps only pixels that the source shows, 1 all of the source with a black rim.",
        ),
    ] = 0.0,
    mask: Annotated[
        bool, typer.Option("--mask", help="Also write a PNG that is white where the images are valid.")
    ] = False,
) -> None:
    """Remove the lens's distortion from images.

    Writes NAME.png for each image (8 or 16 bits, gray or color as the source) and CAMERA_undistorted.json, the
    pinhole camera of the new images. Straight lines become straight; pixels that the source does not show are black.
    EXIF orientation is ignored: pixels are used as the sensor wrote them.

    A bad image does not stop the others: it is reported, and the exit code is 1.

    **Examples**

    `kcal undistort left/ left.camera.json -o left-straight`

    `kcal undistort "shots/*.jpg" left.camera.json -o straight --alpha 1 --mask`
    """
    from kcal.corners.images import expand_images

    paths = expand_images(images)
    name = camera.name.removesuffix(".json").removesuffix(".camera")
    camera_path, mask_path = output / f"{name}_undistorted.json", output / f"{name}_mask.png"
    outputs = _outputs(paths, output, [camera_path, *([mask_path] if mask else [])])

    from kcal.cli.camera_sources import calibrated_camera
    from kcal.io.camera_file import save_camera
    from kcal.io.images import write_png
    from kcal.lens.images import Undistort
    from kcal.lens.pinhole import new_pinhole

    old = calibrated_camera(camera)
    _prepare(output, [*outputs, camera_path, mask_path])
    failures: list[str] = []
    with steps("undistorting", 1 + len(paths)) as advance:
        module = Undistort(old, new_pinhole(old, alpha))
        advance("lens")
        for path, target in zip(paths, outputs, strict=True):
            try:
                _convert(path, target, module)
            except (FileError, InputError) as error:
                failures.append(str(error))
                err.print(f"[yellow]failed[/] {escape(str(error))}")
            advance(path.name)
    if len(failures) == len(paths):
        raise FileError(f"none of {len(paths)} images could be undistorted: {failures[0]}")
    save_camera(module.new_camera, camera_path, name=f"{name} undistorted")
    if mask:
        write_png(mask_path, (module.mask.byte() * 255).numpy())

    width, height = module.new_camera.size
    fx, fy, cx, cy = module.new_camera.params[:4].tolist()
    share = float(module.mask.double().mean())
    out.print(f"{len(paths) - len(failures)} of {len(paths)} images undistorted, {width}x{height} px")
    out.print(f"new camera: fx {fx:.2f}, fy {fy:.2f}, cx {cx:.2f}, cy {cy:.2f}; {100 * share:.1f} % of pixels valid")
    print_wrote(output, camera_path, mask_path if mask else None)
    if failures:
        raise FileError(f"{len(failures)} of {len(paths)} images could not be undistorted: {failures[0]}")


def _outputs(paths: list[Path], folder: Path, others: list[Path]) -> list[Path]:
    """Choose the file for each image: all different, and none of them an input."""
    inputs = {path.resolve() for path in paths}
    taken: dict[Path, str] = {path: "a file of this command" for path in others}
    outputs = []
    for path in paths:
        target = folder / f"{path.stem}.png"
        if target.resolve() in inputs:
            raise InputError(f"{target}: an input image would be overwritten; choose another folder")
        if target in taken:
            raise InputError(f"{target}: both {taken[target]} and {path} would become this file; use two folders")
        taken[target] = str(path)
        outputs.append(target)
    return outputs


def _prepare(folder: Path, files: list[Path]) -> None:
    """Make the folder, and refuse now what could not be written later."""
    make_folder(folder)
    for path in files:
        check_writable(path)


def _convert(path: Path, target: Path, module: Undistort) -> None:
    import torch

    from kcal.corners.images import decode_gray
    from kcal.io.images import decode_image, write_png

    data = read_bytes(path)
    # This refuses damaged files, which `decode_image` alone would fill with gray.
    decode_gray(data, path)
    image = torch.from_numpy(decode_image(data, path))
    (height, width), size = image.shape[:2], module.camera.size
    if (width, height) != size:
        raise InputError(f"{path}: the image is {width}x{height} px, the camera {size[0]}x{size[1]} px")
    new, _ = module(image[None] if image.ndim == 2 else image.permute(2, 0, 1))
    write_png(target, (new[0] if image.ndim == 2 else new.permute(1, 2, 0)).contiguous().numpy())
