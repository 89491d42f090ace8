"""Write cameras and rigs in formats of other programs; what a format cannot hold is refitted, with its misfit."""

from __future__ import annotations

import dataclasses
import io
import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.problem.parameters import CoefficientPrior
from kcal.errors import DegenerateError, InputError
from kcal.files import write_atomic
from kcal.io.foreign import camera_name, paths_for, plain, rig_poses
from kcal.io.foreign_lenses import ForeignCamera, fit_foreign
from kcal.io.format_mrcal import fit_spline, project_spline, write_model, write_mrcal
from kcal.io.format_prior import prior_of, write_priors
from kcal.io.formats import FORMATS, CameraFormat, format_named, held_exactly
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.difference import PixelShift
from kcal.lens.images import undistort_maps
from kcal.lens.model import LensModel
from kcal.lens.pose import Pose
from kcal.lens.projection import INTRINSICS, parameter_names, project_components
from kcal.lens.rig import Rig
from kcal.lens.uncertainty import carried_covariance
from kcal.lens.views import new_pinhole
from kcal.solve.lm import DenseProblem, LMOptions, minimize
from kcal.texts import brief

# Fit a parametric lens model to a calibrated camera, for programs that know only that model.

# Beyond this angle from the axis perspective models have hardly any image.
_STEEPEST = math.radians(80.0)
# Pixels of misfit in proportion to which the weak prior on coefficients counts; 0.3 as in `CalibrationOptions`.
_NOISE, _WIDTH = 0.01, 0.3


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RefittedCamera:
    """A camera of another model, and how well it approximates the original one.

    Args:
        camera: of the model that was asked for, in the same frame.
        rms: sqrt(mean ‖e‖²) over the image, pixels.
        largest: largest ‖e‖.
        covered: share of the image that was fitted: without what the original camera has no ray for, and without what
            the model cannot show.
        width: (5 + P,) standard deviations of the weak prior on the coefficients; infinite for what has none. None: no
            prior.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.1, 0.01])
        >>> refit_camera(camera, "pinhole").largest > 1  # a pinhole is no lens
        True
    """

    __repr__ = brief

    camera: Camera
    rms: float
    largest: float
    covered: float
    width: Tensor | None = None


def refit_camera(
    camera: Camera, model: LensModel | str = "opencv14", *, grid: tuple[int, int] = (33, 25)
) -> RefittedCamera:
    """Fit a parametric model to a camera over its whole image, at infinity.

    The sum of squared distances in pixels is minimized on a grid of directions, with a weak prior on the coefficients.
    The frame stays as it is, so a rig's pose is kept. Movements of the entrance pupil are lost: points within a few
    meters are seen elsewhere than by the original camera.

    Args:
        camera: a single camera, for example a hybrid one.
        model: a parametric lens model, by name or as a `LensModel`.
        grid: columns and rows of the directions.

    Raises:
        InputError: a batch of cameras, a hybrid model, or a camera with hardly any ray.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.1, 0.01])
        >>> found = refit_camera(camera, "opencv14")
        >>> found.rms < 0.001, found.covered
        (True, 1.0)
    """
    model = LensModel.named(model)
    values = camera.params.detach()
    if values.ndim != 1:
        raise InputError("refit_camera: a single camera is needed, not a batch")
    if model.hybrid:
        raise InputError("refit_camera: name a parametric model, for example opencv14")
    pixels = camera.grid(*grid).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    angle = torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2])
    good = valid & ((angle < _STEEPEST) if not model.wide else valid)
    if int(good.sum()) < model.size + len(INTRINSICS):
        raise InputError(f"refit_camera: only {int(good.sum())} of {len(good)} directions can be shown by {model}")
    points, wanted = rays[good].T, pixels[good].T
    names = parameter_names(model)
    free = torch.tensor([i for i, name in enumerate(names) if name != "skew"])
    reach = float(torch.tan(angle[good].max())) if not model.wide else float(angle[good].max())
    prior = CoefficientPrior(_WIDTH, reach).term(model, _NOISE)

    def parameters(x: Tensor) -> Tensor:
        return torch.zeros(len(names), dtype=x.dtype).index_put((free,), x)

    def residual(x: Tensor) -> Tensor:
        here = parameters(x)
        seen = project_components(points, here, model)
        return torch.cat([(seen.pixels - wanted).flatten(), prior.weight * here[prior.index]])

    # Near the axis every lens is a pinhole.
    near = angle[good] <= angle[good].sort().values[max(8, int(good.sum()) // 16)]
    plane = points[:2, near] / points[2, near]
    slope = ((wanted[:, near] - values[2:4, None]) * plane).sum() / plane.square().sum()
    start = torch.zeros(len(free), dtype=torch.float64)
    start[:4] = torch.stack([slope, slope, values[2], values[3]])
    result = minimize(DenseProblem(residual, ()), (start,), LMOptions(max_iterations=500, tolerance=1e-10))
    found = Camera(parameters(result.state[0]), size=camera.size, model=model)
    seen, shown = found.project(rays[good])
    error = (seen - pixels[good])[shown].norm(dim=-1)
    if not len(error):
        raise InputError(f"refit_camera: {model} cannot stand for this camera: its fit has no image of any direction")
    return RefittedCamera(
        camera=found,
        rms=float(error.square().mean().sqrt()),
        largest=float(error.max()),
        covered=float(shown.sum()) / len(pixels),
        width=torch.full_like(found.params, math.inf).index_put((prior.index,), _NOISE / prior.weight),
    )


# Write cameras and rigs in formats of other programs; what a format cannot hold is refitted, with the misfit stated.
#
# A lens is never truncated. If the format has a model that contains it, it is written exactly. If not, the model of the
# format that comes nearest is fitted over the whole image, and its error is measured on a denser grid. mrcal's files
# hold any lens as a spline, and maps for `cv2.remap` (.npz) any image.

_SPLINE_SAMPLES = (193, 145)
REMAP = "remap"
# Pixels (RMS) up to which kcal's models stand for a lens in formats that have wide ones.
_NEAR = 0.2


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ExportedCameras:
    """What `export_cameras` has written.

    Args:
        format: name of the format.
        paths: of the files.
        models: lens model of each camera in them, by its name there or in kcal.
        misfits: for each camera None if it was written exactly.
        lost: what the cameras have and the files do not.
        notes: what a reader of the files should know.
    """

    __repr__ = brief

    format: str
    paths: tuple[Path, ...]
    models: tuple[str, ...]
    misfits: tuple[Misfit | None, ...]
    lost: tuple[str, ...]
    notes: tuple[str, ...] = ()


def format_for(path: str | Path, format: str | None = None) -> str:
    """The format of a file to be written: as named, or by its suffix.

    Raises:
        InputError: an unknown name or suffix.
    """
    path = Path(path)
    if format is not None:
        if format != REMAP and format_named(format).write is None:
            raise InputError(
                f"kcal reads {format} files and does not write them; choose one of {', '.join(_written())}"
            )
        return "bag" if format == "ros" and path.suffix.lower() in FORMATS["bag"].suffixes else format
    by_suffix = {suffix: name for name, known in FORMATS.items() for suffix in known.suffixes} | {".npz": REMAP}
    if path.name == "camera_models.json":
        return "opensfm"
    if path.suffix.lower() not in by_suffix:
        raise InputError(f"{path}: no format for this suffix; name one (--format {', '.join(_written())})")
    return by_suffix[path.suffix.lower()]


def _written() -> list[str]:
    return [*(name for name, known in FORMATS.items() if known.write is not None), REMAP]


def export_cameras(
    cameras: Camera | Rig | Sequence[Camera], path: str | Path, *, format: str | None = None, model: str | None = None
) -> ExportedCameras:
    """Write one camera, several, or a rig for another program.

    The format follows from the suffix: `.yml`, `.yaml`, `.xml` OpenCV; `.cameramodel` mrcal; `.txt`, `.bin` COLMAP;
    `.json` nerfstudio; `.mat` MATLAB; `.toml` aniposelib; `.npz` maps for `cv2.remap`. Others are named: ros, kalibr,
    basalt, opensfm, multical, gtsam, ceres, numpy. Formats with one camera per file get NAME_left and NAME_right for a
    rig.

    Cameras of one file get one lens model, the one that is nearest to all of them, with a note on those that would be
    nearer without the others. Kalibr's chains and Basalt's files hold lenses that are far off their pinhole and fisheye
    models as the nearest of omni-radtan, ds, eucm and fov.

    What is known of the cameras is written beside the file, as NAME.prior.json, or in it (gtsam, ceres, numpy): the
    parameters in the program's order and their square-root information, the misfit of a lens that was fitted included.

    Args:
        cameras: a single camera, a rig, or single cameras without poses.
        path: of the file.
        format: name of the format; None: by the suffix.
        model: lens model to fit, of kcal or of the program, one that the format holds; None: the one that contains the
            lens, else the one that comes nearest.

    Raises:
        InputError: batches, an unknown format, a model that the format does not hold, or a lens that no model of the
            format shows in the whole image.
        FileError: a file cannot be written.

    Example:
        >>> import tempfile
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.1, 0.01])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     done = export_cameras(camera, Path(folder, "cameras.txt"))
        >>> done.format, done.models, done.misfits, done.lost
        ('colmap', ('opencv4',), (None,), ())
    """
    path = Path(path)
    poses: tuple[Pose, ...] = ()
    rig = None
    if isinstance(cameras, Rig):
        rig, several, poses = cameras, cameras.each, rig_poses(cameras)
    else:
        several = [cameras] if isinstance(cameras, Camera) else list(cameras)
    if not several or any(camera.params.ndim != 1 for camera in several):
        raise InputError("export_cameras: single cameras are needed, not batches")
    name = format_for(path, format)
    if name == REMAP:
        return _write_maps(several, path)
    known = FORMATS[name]
    if len(several) > known.poses:
        poses = ()
    model = model and str(model)
    if model is not None and model not in (*known.lenses, *known.models):
        raise InputError(f"{name} files do not hold {model}; choose one of {', '.join((*known.models, *known.lenses))}")
    kinds = known.models if model is None else [model] if model in known.models else []
    exact = [held_exactly(camera, kinds, known.skew) for camera in several]
    if name == "mrcal" and model is None and None in exact:
        return _write_splines(several, exact, poses, path, _lost(several, rig, known))
    found, notes = _in_one_model(several, exact, name, model) if kinds else ([], ())
    far = model is None and known.wide and _squares(found) > len(several) * _NEAR**2
    if far or not kinds:
        other = _nearest_foreign(several, [model] if model else known.lenses)
        if other is None and model:
            raise InputError(f"the lens {model} does not show the whole image of this camera; choose another model")
        if other is not None and (model or _squares(other[1]) < 0.25 * _squares(found)):
            assert known.write is not None
            return ExportedCameras(
                format=name,
                paths=tuple(known.write(other[0], poses, path)),
                models=tuple(lens.kind for lens in other[0]),
                misfits=other[1],
                lost=_lost(several, rig, known),
                notes=() if model else (_foreign_instead(other[0], found, other[1]),),
            )
    written = [_with_covariance(camera, *one) for camera, one in zip(several, found, strict=True)]
    priors = [
        prior_of(name, camera, None if one.misfit is None else (one.misfit.rms, one.misfit.largest))
        for camera, one in zip(written, found, strict=True)
    ]
    carried = any(prior["sqrt_information"] is not None for prior in priors)
    if known.prior:
        paths = [write_priors(name, priors, path)]
    else:
        assert known.write is not None
        paths = known.write(written, poses, path)
        paths += [write_priors(name, priors, path.with_name(f"{path.stem}.prior.json"))] if carried else []
    return ExportedCameras(
        format=name,
        paths=tuple(paths),
        models=tuple(str(camera.model) for camera in written),
        misfits=tuple(one.misfit for one in found),
        lost=_lost(several, rig, known, carried),
        notes=notes + _mixed(written),
    )


def _with_covariance(camera: Camera, substitute: Camera, misfit: Misfit | None, width: Tensor | None) -> Camera:
    """The substitute with the camera's name and what is known of it, misfit included."""
    covariance = carried_covariance(camera, substitute, misfit=misfit.rms if misfit else 0.0, width=width)
    substitute.calibration = CameraCalibration(name=camera_name(camera, ""), covariance=covariance)
    return substitute


def _mixed(cameras: Sequence[Camera]) -> tuple[str, ...]:
    """A note where fisheye and other lenses are together."""
    if len({camera.model.fisheye for camera in cameras}) < 2:
        return ()
    models = " and ".join(dict.fromkeys(str(camera.model) for camera in cameras))
    return (
        f"the cameras have lens models of different kinds, {models}: programs that expect one kind cannot use them",
    )


class _Fitted(NamedTuple):
    """A camera in a model of a format, how far it is from the original (None: not at all), and the fit's weak prior."""

    camera: Camera
    misfit: Misfit | None = None
    width: Tensor | None = None

    @property
    def rms(self) -> float:
        """Of the misfit, pixels."""
        return self.misfit.rms if self.misfit is not None else 0.0


def _in_one_model(
    cameras: Sequence[Camera], exact: Sequence[Camera | None], name: str, model: str | None
) -> tuple[list[_Fitted], tuple[str, ...]]:
    """Each camera in a model of the format, in one model for all unless every camera is held exactly.

    With notes on cameras that would be nearer to what they are without the others.
    """
    held = [_Fitted(camera) for camera in exact if camera is not None]
    if len(held) == len(cameras):
        return held, ()
    fits = [_fit_each(camera, name, model) for camera in cameras]
    alone = [
        _Fitted(one) if one is not None else min(found.values(), key=lambda one: one.rms)
        for one, found in zip(exact, fits, strict=True)
    ]
    shared = [[found[kind] for found in fits] for kind in fits[0] if all(kind in found for found in fits)]
    chosen = min(shared, key=_squares, default=alone)
    return chosen, tuple(
        f"{camera_name(camera, f'camera {number}')}: written as {one.camera.model} (RMS {one.rms:.2g} px) so "
        f"that all cameras have one lens model; in a file of its own it is {own.camera.model} "
        f"({f'RMS {own.rms:.2g} px' if own.misfit else 'exact'})"
        for number, (camera, one, own) in enumerate(zip(cameras, chosen, alone, strict=True), 1)
        if one.rms > own.rms
    )


def _fit_each(camera: Camera, name: str, model: str | None) -> dict[LensModel, _Fitted]:
    """The camera in each model of a format that shows its whole image."""
    found, refused = {}, []
    kinds = [LensModel.named(one) for one in ([model] if model else FORMATS[name].models)]
    # The models that no other one of them contains.
    for kind in (kind for kind in kinds if not any(other != kind and other.contains(kind) for other in kinds)):
        try:
            found[kind] = _in_model(camera, kind, name)
        except (InputError, DegenerateError) as error:
            refused.append(str(error))
    if not found:
        raise InputError(
            f"no lens model of {name} files can stand for this camera ({'; '.join(refused)}). mrcal files hold it as a "
            "spline (.cameramodel), and maps for cv2.remap its undistorted image (.npz)"
        )
    return found


def _in_model(camera: Camera, kind: LensModel, name: str) -> _Fitted:
    """A camera in a lens model, exactly where it contains the lens."""
    held = held_exactly(camera, [str(kind)], FORMATS[name].skew)
    if held is not None:
        return _Fitted(held)
    fitted = refit_camera(camera, kind)
    return _Fitted(fitted.camera, measured_misfit(camera, str(kind), fitted.camera.project_rays), fitted.width)


def _squares(found: Sequence[_Fitted | Misfit]) -> float:
    return sum(one.rms**2 for one in found)


def _nearest_foreign(
    cameras: Sequence[Camera], kinds: Sequence[str]
) -> tuple[list[ForeignCamera], tuple[Misfit, ...]] | None:
    """The cameras in the lens of other programs that comes nearest to all; None if none shows all of an image."""
    best = None
    for kind in kinds:
        lenses = [fit_foreign(kind, camera) for camera in cameras]
        try:
            misfits = tuple(
                measured_misfit(camera, kind, lens.project) for camera, lens in zip(cameras, lenses, strict=True)
            )
        except DegenerateError:
            continue
        folds = [not bool(lens.unproject(camera.grid(33, 25).reshape(-1, 2))[1].all())
                 for camera, lens in zip(cameras, lenses, strict=True)]  # fmt: skip
        if not any(folds) and (best is None or _squares(misfits) < _squares(best[1])):
            best = lenses, misfits
    return best


def _foreign_instead(lenses: Sequence[ForeignCamera], found: Sequence[_Fitted], misfits: Sequence[Misfit]) -> str:
    """A note that another lens of the program stands for all cameras."""
    names = ", ".join(
        f"{lens.name or f'camera {number}'} RMS {misfit.rms:.2g} px"
        for number, (lens, misfit) in enumerate(zip(lenses, misfits, strict=True), 1)
    )
    most = max(one.rms for one in found)
    return f"written as {lenses[0].kind} ({names}): in one model of kcal's that the format holds, up to {most:.2g} px"


def _lost(cameras: Sequence[Camera], rig: Rig | None, known: CameraFormat, carried: bool = False) -> tuple[str, ...]:
    """What the cameras have that the format does not, in words."""
    records = [camera.calibration for camera in cameras if camera.calibration is not None]
    found = {
        "error bars": not carried
        and any(record.covariance is not None or record.sigma is not None for record in records),
        "calibration record": any(record.record is not None for record in records),
        "entrance pupil": any(bool((camera.coefficients[1:3] != 0).any()) for camera in cameras if camera.model.hybrid),
        "relative pose": rig is not None and len(cameras) > known.poses,
        "covariance of the rig": rig is not None and rig.known,
        "mounting": rig is not None and (rig.mounting is not None or rig.origin is not None),
    }
    return tuple(what for what, there in found.items() if there)


def _write_splines(
    cameras: Sequence[Camera], exact: Sequence[Camera | None], poses: Sequence[Pose], path: Path, lost: tuple[str, ...]
) -> ExportedCameras:
    """Write mrcal files, those cameras as splines that its parametric models do not contain."""
    paths = paths_for(path, len(cameras))
    models: list[str] = []
    misfits: list[Misfit | None] = []
    for camera, held, pose, target in itertools.zip_longest(cameras, exact, poses, paths):
        if held is not None:
            write_mrcal([held], [pose] if pose else [], target)
            models.append(str(held.model))
            misfits.append(None)
            continue
        pixels = _edge_to_edge(camera, _SPLINE_SAMPLES).reshape(-1, 2)
        rays, valid = camera.unproject(pixels)
        grid, values = fit_spline(rays[valid].numpy(), pixels[valid].numpy(), camera.size)

        def project(rays: Tensor, grid=grid, values=values) -> tuple[Tensor, Tensor]:  # type: ignore[no-untyped-def]
            seen = torch.from_numpy(project_spline(grid, values, rays.numpy()))
            return seen, torch.ones(len(seen), dtype=torch.bool)

        misfits.append(measured_misfit(camera, grid.name, project))
        write_model(target, camera, grid.name, values.tolist(), pose)
        models.append(grid.name)
    return ExportedCameras(
        format="mrcal", paths=tuple(paths), models=tuple(models), misfits=tuple(misfits), lost=lost
    )  # fmt: skip


def _write_maps(cameras: Sequence[Camera], path: Path) -> ExportedCameras:
    """Write maps that undistort an image by `cv2.remap`, and the pinhole camera that they lead to."""
    paths = paths_for(path, len(cameras))
    for camera, target in zip(cameras, paths, strict=True):
        new = new_pinhole(camera)
        data = io.BytesIO()
        np.savez(
            data,
            **undistort_maps(camera, new)._asdict(),
            camera_matrix=np.array(plain(new.matrix)),
            image_size=np.array(camera.size),
            name=np.array(camera_name(camera, target.stem)),
        )
        write_atomic(target, data.getvalue())
    lost = ("everything but the undistorted image",)
    return ExportedCameras(
        format=REMAP, paths=tuple(paths), models=("maps",) * len(cameras), misfits=(None,) * len(cameras), lost=lost
    )


# How far a lens that is written in place of another one is from it, over the image.

# Columns and rows on which a misfit is measured: four times as dense as the fit's, reaching to the image's edge.
_DENSE = (129, 97)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Misfit(PixelShift):
    """The lens written in place of another one, and its error over the image and at infinity.

    Args:
        model: of the format.
        pixels: (rows, columns, 2) that the camera sees rays at.
        shift: (rows, columns, 2) pixels at which what was written sees them, minus `pixels`; NaN where the camera
            itself has no ray.
    """

    model: str

    @property
    def largest(self) -> float:
        """Bound of the length: its maximum on the grid, and what it can be more between the grid's points."""
        bends = [torch.diff(self.shift, n=2, dim=axis).abs() for axis in (0, 1)]
        most = [float(torch.nan_to_num(bend).max()) for bend in bends]
        return super().largest + sum(most) / 4.0


def _edge_to_edge(camera: Camera, count: tuple[int, int]) -> Tensor:
    """(rows, columns, 2) places from edge to edge: half a pixel beyond the centers of the outer pixels."""
    u, v = (
        torch.linspace(-0.5, side - 0.5, n, dtype=torch.float64) for side, n in zip(camera.size, count, strict=True)
    )
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)


def measured_misfit(camera: Camera, model: str, project: Callable[[Tensor], tuple[Tensor, Tensor]]) -> Misfit:
    """Compare what a camera sees with pixels and a mask that `project` returns for rays (N, 3).

    Raises:
        DegenerateError: rays of the camera without a pixel, because the other lens folds or ends.
    """
    pixels = _edge_to_edge(camera, _DENSE)
    rays, valid = camera.unproject(pixels.reshape(-1, 2))
    if not bool(valid.any()):
        raise DegenerateError("this camera has no ray for any pixel")
    seen, shown = project(rays)
    if not bool(shown[valid].all()):
        share = float(shown[valid].double().mean())
        raise DegenerateError(f"{model} shows only {share:.1%} of what the camera sees: it folds or ends before")
    shift = torch.where(valid[:, None], seen - pixels.reshape(-1, 2), torch.nan)
    return Misfit(model=model, pixels=pixels, shift=shift.reshape(pixels.shape))
