"""`kcal rectify`: images as another camera takes them: without distortion, turned, in stereo, on a cylinder."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcal.cli.camera_sources import cameras_and_rig, named_source, parse_size, single_camera
from kcal.cli.console import out, print_table, print_wrote, steps, tell, warn
from kcal.cli.converted import convert_images, prepare, targets_of
from kcal.cli.inputs import CAMERA, CAMERA_OR_RIG, IMAGES
from kcal.errors import FileError, InputError
from kcal.files import write_atomic

if TYPE_CHECKING:
    from kcal.lens.camera import Camera
    from kcal.lens.images import Undistort
    from kcal.lens.rectification import StereoRectification
    from kcal.lens.rig import StereoRig

# Meters at which the effect of an entrance pupil is stated.
_NEAR = 1.0
# Pixels below which it does not matter.
_FELT = 0.1
# Of a disparity, as block matchers have it.
_DISPARITY_SIGMA = 0.3

_OUTPUT = Annotated[Path, typer.Option("-o", "--output", metavar="FOLDER", help="Folder to write to.")]
_ALPHA = Annotated[
    float,
    typer.Option(
        "--alpha", min=0, max=1, help="0 keeps only pixels that the source shows, 1 all of the source with a black rim."
    ),
]
_MASK = Annotated[bool, typer.Option("--mask", help="Also write a PNG that is white where the images are valid.")]


def rectify_command(
    source: Annotated[
        str, typer.Argument(metavar="CAMERA|RIG", help="Camera or rig file.", show_default=False), CAMERA_OR_RIG
    ],
    images: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="IMAGES",
            help="Images of the camera: files, folders or quoted wildcards. Of a rig: LEFT RIGHT.",
            show_default=False,
        ),
        IMAGES,
    ] = None,
    output: _OUTPUT = Path("rectified"),
    fov: Annotated[
        float | None, typer.Option("--fov", metavar="DEG", help="Horizontal field of view, in place of --alpha.")
    ] = None,
    cylinder: Annotated[bool, typer.Option("--cylinder", help="On an upright cylinder, up to 360 degrees.")] = False,
    pan: Annotated[float, typer.Option("--pan", metavar="DEG", help="Look to the right; needs --fov.")] = 0.0,
    tilt: Annotated[float, typer.Option("--tilt", metavar="DEG", help="Look up; needs --fov.")] = 0.0,
    size: Annotated[
        str | None, typer.Option("--size", metavar="WxH", help="Of the new images; as the source's.")
    ] = None,
    alpha: _ALPHA = 0.0,
    at: Annotated[
        float, typer.Option("--at", metavar="M", min=1e-3, help="Range at which the maps are exact; infinity.")
    ] = math.inf,
    maps: Annotated[
        bool, typer.Option("--maps", help="Also write the maps as .npy, for cv2.remap and torch's grid_sample.")
    ] = False,
    mask: _MASK = False,
) -> None:
    """Resample images: pinhole without distortion, part of a fisheye as a perspective image, cylinder, stereo pair.

    Writes NAME.png for each image (8 or 16 bits, gray or color as the source) and the pinhole camera of the new images.
    Of a rig, rows of left/ and right/ are epipolar lines: depth is focal length · baseline / disparity, which
    rectified.rig.json and Q.npy (cv2.reprojectImageTo3D) say, and the table shows with its sigma. EXIF orientation is
    ignored: pixels are used as the sensor wrote them.

    Images that are done are not made again. A bad image does not stop the others: it is reported, and the exit code
    is 1.

    **Examples**

    `kcal rectify left.camera.json left/ -o straight`

    `kcal rectify fisheye.camera.json "shots/*.jpg" -o view --fov 60 --pan 40 --size 1280x720`

    `kcal rectify rig.json left/ right/ -o stereo --maps`
    """
    rig = rig_of(source)
    shape = parse_size(size)
    if rig is None:
        _rectify_camera(
            source, images or [], output, fov, cylinder, (pan, tilt), maps, mask, "rectified", alpha=alpha, size=shape,
            at=at,
        )  # fmt: skip
    elif cylinder or pan or tilt:
        raise InputError("--cylinder, --pan and --tilt are for a camera, not for a rig; RIG.json:left is a camera")
    else:
        _rectify_rig(rig, images or [], output, fov, maps, mask, alpha=alpha, size=shape, at=at)


def undistort_command(
    images: Annotated[list[str], typer.Argument(metavar="IMAGES", help="Images of one camera."), IMAGES],
    camera: Annotated[Path, typer.Argument(help="Camera file from `kcal calibrate`."), CAMERA],
    output: _OUTPUT,
    alpha: _ALPHA = 0.0,
    mask: _MASK = False,
) -> None:
    """`kcal rectify CAMERA IMAGES` under its old name and with the old order of arguments."""
    warn("kcal undistort is called kcal rectify CAMERA IMAGES now; the old name goes in version 2.0")
    _rectify_camera(
        str(camera), images, output, None, False, (0.0, 0.0), False, mask, "undistorted", alpha=alpha, size=None,
        at=math.inf,
    )  # fmt: skip


def rig_of(source: str) -> StereoRig | None:
    """The rig of a file of kcal or of another program; None for a camera."""
    path, name = named_source(source)
    return cameras_and_rig(path)[1] if name is None else None


def _rectify_camera(
    source: str,
    images: list[str],
    folder: Path,
    fov: float | None,
    cylinder: bool,
    look: tuple[float, float],
    maps: bool,
    mask: bool,
    suffix: str,
    *,
    alpha: float,
    size: tuple[int, int] | None,
    at: float,
) -> None:
    from kcal.corners.images import expand_images

    if not images and not maps:
        raise InputError("name the images, or write the maps alone with --maps")
    if any(look) and fov is None:
        raise InputError("--pan and --tilt need --fov: which part of the image is to be shown")
    paths = expand_images(images) if images else []
    path, part = named_source(source)
    name = part or path.name.removesuffix(".json").removesuffix(".camera")
    camera_path = folder / f"{name}_{suffix}.json"
    extras = [*([] if cylinder else [camera_path]), *_extra_paths(folder, name, maps, mask)]
    targets = targets_of(paths, folder, extras)

    from kcal.io.camera_file import save_camera
    from kcal.lens.images import Undistort
    from kcal.lens.pinhole import new_pinhole
    from kcal.lens.views import cylinder_view, looking, pinhole_view

    old = single_camera(source)
    prepare(folder, [*targets, *extras])
    with steps("rectifying", 1 + len(paths)) as advance:
        if cylinder:
            view: Any = cylinder_view(old, fov, size)
        else:
            view = new_pinhole(old, alpha, size) if fov is None else pinhole_view(fov, size or old.size)
        module = Undistort(old, view, looking(*look) if any(look) else None, at=at)
        advance("maps")
        before, failures = convert_images(paths, targets, module, advance) if paths else (0, [])
    _refuse_none(paths, failures)
    if not cylinder:
        save_camera(view, camera_path, name=f"{name} {suffix}")
    _write_extras(folder, name, module, maps, mask)
    _tell_images(len(paths), before, failures, view.size, suffix)
    if cylinder:
        focal, cx, cy = view.params.tolist()
        out.print(f"cylinder: {focal:.2f} px a radian; straight ahead is {cx:.2f}, {cy:.2f}")
    else:
        fx, fy, cx, cy = view.params[:4].tolist()
        out.print(f"new camera: fx {fx:.2f}, fy {fy:.2f}, cx {cx:.2f}, cy {cy:.2f}")
    _tell_view(old, module, "")
    print_wrote(folder, *extras)
    _fail_at_end(paths, failures)


def _rectify_rig(
    rig: StereoRig,
    images: list[str],
    folder: Path,
    fov: float | None,
    maps: bool,
    mask: bool,
    *,
    alpha: float,
    size: tuple[int, int] | None,
    at: float,
) -> None:
    from kcal.corners.images import expand_images

    if len(images) not in ((0, 2) if maps else (2,)):
        raise InputError(f"a rig needs LEFT and RIGHT: two files, folders or quoted wildcards, got {len(images)}")
    names = ("left", "right")
    sides = {name: expand_images([given]) for name, given in zip(names, images, strict=False)}
    rig_path, matrix_path = folder / "rectified.rig.json", folder / "Q.npy"
    extras = [rig_path, matrix_path, *(path for name in names for path in _extra_paths(folder, name, maps, mask))]
    targets = {name: targets_of(paths, folder / name, []) for name, paths in sides.items()}

    import torch

    from kcal.io.rig_file import save_rig
    from kcal.lens.rectification import StereoRectification
    from kcal.lens.rig import StereoRig

    prepare(folder, extras)
    for name, files in targets.items():
        prepare(folder / name, files)
    before, failures = 0, list[str]()
    with steps("rectifying", 1 + sum(map(len, sides.values()))) as advance:
        module = StereoRectification(rig, alpha=alpha, size=size, field_of_view=fov, at=at)
        advance("maps")
        for name, side in zip(names, (module.left, module.right), strict=True):
            if name in sides:
                done, wrong = convert_images(sides[name], targets[name], side, advance)
                before, failures = before + done, failures + wrong
    paths = [path for some in sides.values() for path in some]
    _refuse_none(paths, failures)
    apart = torch.tensor([-float(rig.baseline), 0.0, 0.0], dtype=torch.float64)
    save_rig(StereoRig(module.camera, module.camera, torch.eye(3), apart), rig_path)
    _save_array(matrix_path, module.depth_matrix)
    for name, side in zip(names, (module.left, module.right), strict=True):
        _write_extras(folder, name, side, maps, mask)
    _tell_images(len(paths), before, failures, module.camera.size, "rectified")
    focal, _, cx, cy = module.camera.params[:4].tolist()
    out.print(f"both cameras: focal length {focal:.2f} px, cx {cx:.2f}, cy {cy:.2f}, baseline {rig.baseline:.6g} m")
    for name, side in zip(names, (module.left, module.right), strict=True):
        _tell_view(side.camera, side, f"{name}: ")
    _tell_ranges(module)
    print_wrote(folder, *extras)
    _fail_at_end(paths, failures)


def _extra_paths(folder: Path, name: str, maps: bool, mask: bool) -> list[Path]:
    found = [folder / f"{name}_map.npy", folder / f"{name}_grid.npy"] if maps else []
    return [*found, *([folder / f"{name}_mask.png"] if mask else [])]


def _write_extras(folder: Path, name: str, module: Undistort, maps: bool, mask: bool) -> None:
    """Maps (2, H, W) for cv2.remap, (1, H, W, 2) for grid_sample with align_corners=True, and the mask."""
    import torch

    from kcal.io.images import write_png

    if maps:
        last = torch.tensor(module.camera.size, dtype=torch.float64)[:, None, None] - 1.0
        grid = torch.stack([module.grid_x, module.grid_y])
        _save_array(folder / f"{name}_map.npy", ((grid.double() + 1.0) * 0.5 * last).float())
        _save_array(folder / f"{name}_grid.npy", grid.movedim(0, -1)[None].float())
    if mask:
        write_png(folder / f"{name}_mask.png", (module.mask.byte() * 255).numpy())


def _save_array(path: Path, values: Any) -> None:
    import numpy as np

    data = io.BytesIO()
    np.save(data, values.contiguous().numpy(), allow_pickle=False)
    write_atomic(path, data.getvalue())


def _tell_images(count: int, before: int, failures: list[str], size: tuple[int, int], word: str) -> None:
    if count:
        more = f" ({before} of them before)" if before else ""
        out.print(f"{count - len(failures)} of {count} images {word}{more}, {size[0]}x{size[1]} px")


def _tell_view(camera: Camera, module: Undistort, label: str) -> None:
    """Print what the new image shows, what is cut, and what the entrance pupil does."""
    from kcal.lens.views import pupil_shift, shown_by

    shown = shown_by(camera, module.new_camera, module.rotation, module.mask)
    across, down = shown.degrees
    out.print(
        f"{label}{across:.1f} x {down:.1f} degrees; {100 * shown.valid:.1f} % of pixels valid; shows "
        f"{100 * shown.source:.1f} % of the source, the rest is cut off",
        markup=False,
    )
    shift = pupil_shift(camera, _NEAR)
    if shift >= _FELT:
        where = "far away" if math.isinf(module.at) else f"at {module.at:g} m"
        out.print(
            f"{label}the entrance pupil moves: maps are exact {where}; things at {_NEAR:g} m and far away are up to "
            f"{shift:.2g} px apart, at {shift / _FELT * _NEAR:.2g} m {_FELT} px (--at)",
            markup=False,
        )
    told = {"valid": shown.valid, "source_shown": shown.source, "degrees": shown.degrees, "pupil_px": shift}
    tell(**{label.removesuffix(": ") or "view": told})


def _tell_ranges(module: StereoRectification) -> None:
    """Print what a disparity means in the middle of the image."""
    import torch

    from kcal.locate.disparity import DisparityRanges
    from kcal.locate.range_sigmas import usual_ranges

    focal, _, cx, cy = module.camera.params[:4].tolist()
    width, height = module.camera.size
    where = torch.tensor([[min(max(cx, 0.0), width - 1.0), 0.5 * (height - 1)]], dtype=torch.float64)
    # Distances from the camera, of which the depth is a part.
    ahead = float(torch.hypot(torch.hypot(where[0, 0] - cx, where[0, 1] - cy), torch.tensor(focal))) / focal
    ranges = usual_ranges(module.rig)
    disparity = focal * float(module.rig.baseline) * ahead / torch.tensor(ranges, dtype=torch.float64)
    found = DisparityRanges(module, disparity_sigma=_DISPARITY_SIGMA).at(where.expand(len(ranges), 2), disparity)
    rows = [["range, m", "disparity, px", f"sigma, m, of ± {_DISPARITY_SIGMA} px", "95 % from", "to"]]
    for i, at in enumerate(ranges):
        cells = (found.sigma[i], found.low[i], found.high[i])
        rows.append([f"{at:g}", f"{disparity[i]:.4g}", *(f"{float(value):.4g}" for value in cells)])
    print_table(rows)
    if module.rig.covariance is None:
        warn("the rig has no error bars: sigmas are those of the disparities alone")


def _refuse_none(paths: list[Path], failures: list[str]) -> None:
    if paths and len(failures) == len(paths):
        raise FileError(f"none of {len(paths)} images could be resampled: {failures[0]}")


def _fail_at_end(paths: list[Path], failures: list[str]) -> None:
    if failures:
        raise FileError(f"{len(failures)} of {len(paths)} images could not be resampled: {failures[0]}")
