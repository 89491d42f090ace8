"""`kcal rectify` and `kcal rays`: images as another camera takes them, and rays of their pixels."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import kcal
from kcal.cli import kinds, rooms
from kcal.cli.console import err, out, print_styled, print_table, print_wrote, steps, tell, warn
from kcal.cli.inputs import cameras_and_rig, named_source, single_camera
from kcal.cli.options import Kind
from kcal.errors import FileError, InputError
from kcal.files import check_writable, make_folder, open_atomic, read_bytes

_HEAD = 256  # bytes of a PNG file, in which its note stands

# Images of one camera, resampled into a folder: image by image, so that a run that was interrupted continues.


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


def _view_key(module: kcal.lens.Undistort) -> str:
    values = [value.tolist() for value in (module.camera.params, module.new_camera.params, module.rotation)]
    kinds = repr((type(module.new_camera).__name__, str(module.camera.model), module.camera.model.hybrid))
    return repr((values, kinds, module.camera.size, module.new_camera.size, module.at))


def convert_images(
    paths: list[Path], targets: list[Path], module: kcal.lens.Undistort, advance: Callable[[str], None]
) -> tuple[int, list[str]]:
    """Resample images into files, a bad one not stopping the others.

    Each file has a note of the image and of the view from which it was made: nothing is done again, or kept that was
    made otherwise.

    Returns:
        how many were done before, and what was wrong with those that failed.
    """
    before, failures, view = 0, list[str](), _view_key(module)
    for path, target in zip(paths, targets, strict=True):
        try:
            data = rooms.image_bytes(path)
            note = f"kcal rectify {hashlib.sha256(view.encode() + data).hexdigest()}"
            if target.exists() and note.encode() in read_bytes(target)[:_HEAD]:
                before += 1
            else:
                _convert(data, path, target, module, note)
        except (FileError, InputError) as error:
            failures.append(str(error))
            print_styled(f"failed {error}", "^failed", "yellow", to=err)
        advance(path.name)
    return before, failures


def _convert(data: bytes, path: Path, target: Path, module: kcal.lens.Undistort, note: str) -> None:
    image = rooms.torch.from_numpy(rooms.decode_image(data, path))
    (height, width), size = image.shape[:2], module.camera.size
    if (width, height) != size:
        raise InputError(f"{path}: the image is {width}x{height} px, the camera {size[0]}x{size[1]} px")
    new, _ = module(image[None] if image.ndim == 2 else image.permute(2, 0, 1))
    rooms.write_png(target, (new[0] if image.ndim == 2 else new.permute(1, 2, 0)).contiguous().numpy(), note=note)


# `kcal rectify`: images as another camera takes them: without distortion, turned, in stereo, on a cylinder.

# Meters at which the effect of an entrance pupil is stated.
_NEAR = 1.0
# Pixels below which it does not matter.
_FELT = 0.1
# Of a disparity, as block matchers have it.
_DISPARITY_SIGMA = 0.3


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Which view the new images show, and what is written besides.

    Args:
        fov: Horizontal field of view, in place of --alpha.
        cylinder: On an upright cylinder, up to 360 degrees.
        pan: Look to the right; needs --fov.
        tilt: Look up; needs --fov.
        size: Of the new images; as the source's.
        alpha: 0 keeps only pixels that the source shows, 1 all of the source with a black rim.
        distance: Of what is seen: there the maps are exact; infinitely far if not given.
        maps: Also write the maps as .npy, for cv2.remap and torch's grid_sample.
        mask: Also write a PNG that is white where the images are valid.
    """

    fov: kinds.Degrees | None = None
    cylinder: bool = False
    pan: kinds.Degrees = 0.0
    tilt: kinds.Degrees = 0.0
    size: kinds.Size | None = None
    alpha: kinds.Share = 0.0
    distance: kinds.Distance = math.inf
    maps: bool = False
    mask: bool = False


def rectify_command(
    source: kinds.AnyFile,
    images: list[kinds.Images] | None = None,
    *,
    output: Annotated[kinds.Output, Kind(metavar="FOLDER")] = Path("rectified"),
    view: ViewOptions,
) -> None:
    """Resample images: pinhole without distortion, part of a fisheye as a perspective image, cylinder, stereo pair.

    Writes NAME.png for each image (8 or 16 bits, gray or color as the source) and the pinhole camera of the new images.
    Of a rig, rows of left/ and right/ are epipolar lines (columns, where one camera stands above the other): depth is
    focal length · baseline / disparity, which rectified.rig.json and Q.npy (cv2.reprojectImageTo3D) say, and the table
    shows with its sigma. EXIF orientation is ignored: pixels are used as the sensor wrote them.

    Images that are done are not made again. A bad image does not stop the others: it is reported, and the exit code
    is 1.

    **Examples**

    `kcal rectify left.camera.json left/ -o straight`

    `kcal rectify fisheye.camera.json "shots/*.jpg" -o view --fov 60 --pan 40 --size 1280x720`

    `kcal rectify rig.json left/ right/ -o stereo --maps`

    Args:
        source: Camera or rig file.
        images: Images of the camera: files, folders or quoted wildcards. Of a rig: LEFT RIGHT.
        output: Folder to write to.
    """
    rig = rig_of(source)
    if rig is None:
        _rectify_camera(source, images or [], output, view)
    elif view.cylinder or view.pan or view.tilt:
        raise InputError("--cylinder, --pan and --tilt are for a camera, not for a rig; RIG.json:left is a camera")
    else:
        _rectify_rig(rig, images or [], output, view)


def rig_of(source: str) -> kcal.Rig | None:
    """The rig of a file of kcal or of another program; None for a camera."""
    path, name = named_source(source)
    return cameras_and_rig(path)[1] if name is None else None


@contextmanager
def _resampling(folder: Path, images: dict[Path, list[Path]], extras: list[Path]) -> Iterator[Callable[..., None]]:
    """Call the value with what resamples each camera's images; meanwhile the other files are written. Fail last.

    Args:
        folder: of the extras.
        images: folder of a camera's new images -> the images of this camera.
        extras: other files that will be written.
    """
    targets = {place: targets_of(paths, place, extras) for place, paths in images.items()}
    # What could not be written later is refused now.
    for place, files in [(folder, extras), *targets.items()]:
        make_folder(place)
        for path in files:
            check_writable(path)
    count, failures = sum(map(len, images.values())), list[str]()

    def resample(*modules: kcal.lens.Undistort) -> None:
        before = 0
        with steps("rectifying", count) as advance:
            for (place, paths), module in zip(images.items(), modules, strict=True):
                done, wrong = convert_images(paths, targets[place], module, advance)
                before += done
                failures.extend(wrong)
        if len(failures) == count:
            raise FileError(f"none of {count} images could be resampled: {failures[0]}")
        more = f" ({before} of them before)" if before else ""
        width, height = modules[0].new_camera.size
        out.print(f"{count - len(failures)} of {count} images rectified{more}, {width}x{height} px")

    yield resample if count else lambda *_: None
    print_wrote(folder, *extras)
    if failures:
        raise FileError(f"{len(failures)} of {count} images could not be resampled: {failures[0]}")


def _rectify_camera(source: str, images: list[str], folder: Path, options: ViewOptions) -> None:
    if not images and not options.maps:
        raise InputError("name the images, or write the maps alone with --maps")
    look = options.pan, options.tilt
    if any(look) and options.fov is None:
        raise InputError("--pan and --tilt need --fov: which part of the image is to be shown")
    sides = {folder: rooms.expand_images(images)} if images else {}
    path, part = named_source(source)
    name = part or path.name.removesuffix(".json").removesuffix(".camera")
    camera_path = folder / f"{name}_rectified.json"
    extras = [*([] if options.cylinder else [camera_path]), *_extra_paths(folder, name, options)]

    old, fov, size = single_camera(source), options.fov, options.size
    with _resampling(folder, sides, extras) as resample:
        if options.cylinder:
            view: Any = kcal.lens.cylinder_view(old, fov, size)
        elif fov is None:
            view = rooms.new_pinhole(old, options.alpha, size)
        else:
            view = kcal.lens.pinhole_view(fov, size or old.size)
        module = kcal.lens.Undistort(old, view, kcal.lens.looking(*look) if any(look) else None, at=options.distance)
        resample(module)
        _write_extras(folder, name, module, options)
        if options.cylinder:
            focal, cx, cy = view.params.tolist()
            out.print(f"cylinder: {focal:.2f} px a radian; straight ahead is {cx:.2f}, {cy:.2f}")
        else:
            kcal.save_camera(view, camera_path, name=f"{name} rectified")
            fx, fy, cx, cy = view.params[:4].tolist()
            out.print(f"new camera: fx {fx:.2f}, fy {fy:.2f}, cx {cx:.2f}, cy {cy:.2f}")
        _tell_view(old, module, "")


def _rectify_rig(rig: kcal.Rig, images: list[str], folder: Path, options: ViewOptions) -> None:
    if len(images) not in ((0, 2) if options.maps else (2,)):
        got = f"got {len(images)}" if images else "or --maps for the maps alone"
        raise InputError(f"a rig needs LEFT and RIGHT: two files, folders or quoted wildcards, {got}")
    names = ("left", "right")
    sides = {folder / name: rooms.expand_images([given]) for name, given in zip(names, images, strict=False)}
    rig_path, matrix_path = folder / "rectified.rig.json", folder / "Q.npy"
    extras = [rig_path, matrix_path, *(path for name in names for path in _extra_paths(folder, name, options))]
    with _resampling(folder, sides, extras) as resample:
        both = kcal.lens.StereoRectification(
            rig, alpha=options.alpha, size=options.size, field_of_view=options.fov, at=options.distance
        )
        resample(both.left, both.right)
        kcal.save_rig(kcal.Rig.pair(both.camera, both.camera, rooms.torch.eye(3), -both.right_center), rig_path)
        _save_array(matrix_path, both.depth_matrix)
        focal, _, cx, cy = both.camera.params[:4].tolist()
        out.print(f"both cameras: focal length {focal:.2f} px, cx {cx:.2f}, cy {cy:.2f}, baseline {rig.baseline:.6g} m")
        for name, side in zip(names, (both.left, both.right), strict=True):
            _write_extras(folder, name, side, options)
            _tell_view(side.camera, side, f"{name}: ")
        _tell_side(both)
        _tell_ranges(both)


def _extra_paths(folder: Path, name: str, options: ViewOptions) -> list[Path]:
    found = [folder / f"{name}_map.npy", folder / f"{name}_grid.npy"] if options.maps else []
    return [*found, *([folder / f"{name}_mask.png"] if options.mask else [])]


def _write_extras(folder: Path, name: str, module: kcal.lens.Undistort, options: ViewOptions) -> None:
    """Maps (2, H, W) for cv2.remap, (1, H, W, 2) for grid_sample with align_corners=True, and the mask."""
    if options.maps:
        last = rooms.torch.tensor(module.camera.size, dtype=rooms.torch.float64) - 1.0
        _save_array(folder / f"{name}_map.npy", ((module.grid.double() + 1.0) * 0.5 * last).movedim(-1, 0).float())
        _save_array(folder / f"{name}_grid.npy", module.grid[None].float())
    if options.mask:
        rooms.write_png(folder / f"{name}_mask.png", (module.mask.byte() * 255).numpy())


def _save_array(path: Path, values: Any) -> None:
    import numpy as np

    with open_atomic(path) as file:
        np.save(file, values.contiguous().numpy(), allow_pickle=False)


def _tell_view(camera: kcal.Camera, module: kcal.lens.Undistort, label: str) -> None:
    """Print what the new image shows, what is cut, and what the entrance pupil does."""
    shown = rooms.shown_by(camera, module.new_camera, module.rotation, module.mask)
    across, down = shown.degrees
    out.print(
        f"{label}{across:.1f} x {down:.1f} degrees; {100 * shown.valid:.1f} % of pixels valid; shows "
        f"{100 * shown.source:.1f} % of the source, the rest is cut off"
    )
    shift = rooms.pupil_shift(camera, _NEAR)
    if shift >= _FELT:
        where = "far away" if math.isinf(module.at) else f"at {module.at:g} m"
        out.print(
            f"{label}the entrance pupil moves: maps are exact {where}; points at {_NEAR:g} m and far away are up to "
            f"{shift:.2g} px apart, at {shift / _FELT * _NEAR:.2g} m {_FELT} px (--distance)"
        )
    told = {"valid": shown.valid, "source_shown": shown.source, "degrees": shown.degrees, "pupil_px": shift}
    tell(**{label.removesuffix(": ") or "view": told})


def _tell_side(module: kcal.lens.StereoRectification) -> None:
    """Print what a disparity is; warn where a matcher must be told so."""
    right, down = module.right_center.tolist()[:2]
    line, sign = ("column" if abs(right) > abs(down) else "row"), ("positive" if right + down > 0 else "negative")
    out.print(f"disparity is the {line} in left/ minus the {line} in right/, and {sign}")
    if line == "row":
        where = "below" if down > 0 else "above"
        warn(
            f"the right camera stands {where} the left one, so that the same point is in the same column, and "
            f"disparities are {sign}: transpose both images for a matcher that searches along rows"
        )
    elif sign == "negative":
        warn(
            "the right camera stands to the left of the left one, so that disparities are negative: exchange the "
            "cameras and their images, or let the matcher search from -N to 0 (if it stands to the right in truth, the "
            "rig's pose is left_from_right)"
        )
    if float(module.left.rotation[0, :2] @ module.right.rotation[0, :2]) < 0:
        warn(
            "the right camera is rolled by more than 90° against the left one: both images are upright as the left one"
        )


def _tell_ranges(module: kcal.lens.StereoRectification) -> None:
    """Print what a disparity means in the middle of the image."""
    import torch

    focal, _, cx, cy = module.camera.params[:4].tolist()
    width, height = module.camera.size
    where = torch.tensor([[min(max(cx, 0.0), width - 1.0), 0.5 * (height - 1)]], dtype=torch.float64)
    # Distances from the camera, of which the depth is a part.
    ahead = float(torch.hypot(torch.hypot(where[0, 0] - cx, where[0, 1] - cy), torch.tensor(focal))) / focal
    ranges = rooms.usual_ranges(module.rig)
    apart = float(module.right_center[:2].sum())
    disparity = focal * apart * ahead / torch.tensor(ranges, dtype=torch.float64)
    ranged = kcal.locate.DisparityRanges(module, disparity_sigma=_DISPARITY_SIGMA)
    found = ranged.at(where.expand(len(ranges), 2), disparity)
    rows = [["range, m", "disparity, px", f"sigma, m, of ± {_DISPARITY_SIGMA} px", "95 % from", "to"]]
    for i, at in enumerate(ranges):
        cells = (found.sigma[i], found.low[i], found.high[i])
        rows.append([f"{at:g}", f"{disparity[i]:.4g}", *(f"{float(value):.4g}" for value in cells)])
    print_table(rows)
    if module.rig.covariance is None:
        warn("the rig has no error bars: sigmas are those of the disparities alone")


# `kcal rays`: the ray of every pixel, for renderers such as gsplat.


def rays_command(sources: list[kinds.AnyFile], *, output: Annotated[kinds.NewFile, Kind(metavar="NPZ")]) -> None:
    """Write the ray of every pixel, for Gaussian splatting and other renderers without lens models.

    The file has `rays` (C, H, W, 6) in float32, as gsplat takes them from version 1.6 on: origin, in meters, and
    direction of each pixel's ray. The origin lies on the camera's axis; for a lens with an entrance pupil that moves it
    is not the same for all pixels. Also `mask` (C, H, W), `viewmats` (C, 4, 4) and `Ks` (C, 3, 3). Rays of single
    cameras are in the camera's frame, those of a rig in its first one's. Pixels without a ray have zeros.

    **Examples**

    `kcal rays left.camera.json -o rays.npz`

    `kcal rays rig.json -o rays.npz`

    Args:
        sources: Camera files of one image size, or one rig file.
        output: File to write.
    """
    if output.suffix.lower() != ".npz":
        raise InputError(f"{output}: the name of the file must end with .npz")

    import numpy as np
    import torch

    rig = rig_of(sources[0]) if len(sources) == 1 else None
    cameras = [single_camera(source) for source in sources] if rig is None else rig.each
    viewmats = torch.eye(4, dtype=torch.float64).repeat(len(cameras), 1, 1)
    if rig is not None:
        viewmats[:, :3, :3] = turn = rig.rotation @ rig.rotation[0].T
        viewmats[:, :3, 3] = rig.translation - turn @ rig.translation[0]
    with steps("rays", 2) as advance:
        module = kcal.lens.CameraRays(cameras)
        advance("rounding")
        error = max(rooms.ray_error(camera, own) for camera, own in zip(cameras, module(), strict=True))
        advance("writing")
    # gsplat counts pixels from the corner of the first one.
    Ks = torch.stack([camera.matrix.detach() for camera in cameras])
    Ks[:, :2, 2] += 0.5
    for matrix, camera in zip(Ks, cameras, strict=True):
        matrix[[0, 1], [0, 1]] = rooms.paraxial_focal(camera).value.detach()
    parts = {"rays": module(viewmats), "mask": module.mask, "Ks": Ks, "viewmats": viewmats}
    with open_atomic(output) as file:
        np.savez(file, allow_pickle=False, **{name: values.numpy() for name, values in parts.items()})
    moved = float((module.depths * module.mask).abs().max())
    width, height = cameras[0].size
    share = float(module.mask.double().mean())
    text = f"rays {len(cameras)} x {height} x {width} x 6, float32; {100 * share:.1f} % of the pixels have one"
    out.print(text)
    out.print(f"rounding: at most {error:.1e} px from the pixel, at 1 m and far away")
    if moved:
        out.print(f"the rays start up to {1e3 * moved:.3g} mm from each other on the axis: the entrance pupil moves")
    tell(cameras=len(cameras), valid=share, rounding_px=error, pupil_m=moved)
    print_wrote(output)
