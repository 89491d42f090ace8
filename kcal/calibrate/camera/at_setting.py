"""A camera at a setting of zoom or focus between those at which its lens was calibrated."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Hashable, Mapping, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.camera.calibrate import calibrate_camera
from kcal.calibrate.camera.result import HYBRID, NETWORK, CalibrationOptions, Progress
from kcal.calibrate.camera.trust import POSES, held_out_squares
from kcal.calibrate.problem.views import Views, poses_under, whitening
from kcal.corners.observations import Observations
from kcal.errors import InputError, KcalError
from kcal.gaussian import triangular
from kcal.io.foreign import camera_name
from kcal.lens.calibration import CameraCalibration, LensSetting
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.model import LensModel, radius_over_angle
from kcal.lens.projection import FAR, project_components
from kcal.lens.uncertainty import FIT_PX, fitted_errors, inverse_half, pixel_covariance
from kcal.texts import brief, setting_text
from kcal.threads import in_one_thread

# How values between settings follow from values at settings: the smoothest curve through them, with its error.
#
# The prior is a straight line (in several settings a plane) of any slope, plus a Gaussian process of the generalized
# covariance |h|³ / 12. In one setting that is a Wiener process as second derivative, and the curve is the natural cubic
# spline (Wahba, Spline Models for Observational Data, 1990, section 1.4; Cressie, Statistics for Spatial Data, 1993,
# section 5.4, for generalized covariances). The curve does not depend on the size of the process, but its error does.

# Quantile up to which a normal distribution of the stated standard deviation is as wide as Student's: that of the
# 95 % intervals.
_QUANTILE = 0.975
# In widths of the settings: rounding.
_SAME = 1e-9


class SettingSpline:
    """Weights of settings (n, D) at any place between them; each axis is scaled to its range.

    Attributes:
        degrees: of freedom that tell the size of the process: settings beyond those that a plane goes through.

    Example:
        >>> spline = SettingSpline(torch.tensor([[0.0], [1.0], [2.0], [4.0]]).double())
        >>> [round(value, 3) for value in spline.weights(torch.tensor([1.5]).double()).tolist()]
        [-0.082, 0.614, 0.492, -0.024]
        >>> spline.inside(torch.tensor([4.1]).double()), spline.degrees
        (False, 2)
    """

    def __init__(self, settings: Tensor) -> None:
        self._low, self._width = settings.amin(0), settings.amax(0) - settings.amin(0)
        self._places = (settings - self._low) / self._width
        count, self._plane = len(settings), torch.cat([torch.ones_like(settings[:, :1]), self._places], 1)
        self.degrees = count - self._plane.shape[1]
        process, plane = _process(self._places, self._places), self._plane
        corner = plane.new_zeros(plane.shape[1], plane.shape[1])
        self._system = torch.cat([torch.cat([process, plane], 1), torch.cat([plane.T, corner], 1)])
        open_ways = torch.linalg.qr(plane, mode="complete")[0][:, plane.shape[1] :]
        root = torch.linalg.cholesky(open_ways.T @ process @ open_ways)
        # (m, n): unit normal under the prior, whatever the plane is.
        self._contrasts = torch.linalg.solve_triangular(root, open_ways.T, upper=False)

    @staticmethod
    def flat(settings: Tensor) -> bool:
        """Whether all settings (n, D) lie in a space of fewer dimensions, or are fewer than D + 2."""
        count, axes = settings.shape
        scaled = (settings - settings.mean(0)) / (settings.amax(0) - settings.amin(0))
        return count < axes + 2 or int(torch.linalg.matrix_rank(scaled, atol=_SAME)) < axes

    def inside(self, at: Tensor) -> bool:
        """Whether a setting (D,) lies between the others: in their convex hull."""
        from scipy.optimize import nnls  # half a second, which no other calibration needs

        place = torch.cat([at.new_ones(1), (at - self._low) / self._width])
        return bool(nnls(self._plane.T.numpy(), place.numpy())[1] < _SAME)

    def _solved(self, at: Tensor) -> tuple[Tensor, Tensor]:
        place = (at - self._low) / self._width
        right = torch.cat([_process(self._places, place[None])[:, 0], at.new_ones(1), place])
        return torch.linalg.solve(self._system, right), right

    def weights(self, at: Tensor) -> Tensor:
        """(n,) of the values at the settings, whose sum is the value there."""
        return self._solved(at)[0][: len(self._places)]

    def slopes(self, at: Tensor) -> Tensor:
        """(n, D) derivatives of the weights by the setting."""
        apart = (at - self._low) / self._width - self._places
        rates = apart.norm(dim=1, keepdim=True) * apart / 4.0
        plane = torch.cat([torch.zeros_like(apart[:1]), torch.eye(len(at), dtype=at.dtype)])
        return torch.linalg.solve(self._system, torch.cat([rates, plane]))[: len(apart)] / self._width

    def errors(self, at: Tensor) -> Tensor:
        """(m, n) of the values at the settings: independent errors of the value there, one sigma each.

        The size of the process is what the m contrasts of the values show, for each value by itself. As it is only
        estimated, errors have Student's distribution of m degrees of freedom; they are stated as normal ones that
        are as wide at 95 %.
        """
        from scipy.special import ndtri, stdtrit  # which takes long to load

        solution, right = self._solved(at)
        widen = float(stdtrit(self.degrees, _QUANTILE) / ndtri(_QUANTILE))
        variance = (-(solution @ right)).clamp_min(0.0) / self.degrees
        return widen * variance.sqrt() * self._contrasts


def _process(one: Tensor, other: Tensor) -> Tensor:
    distance = (one[:, None] - other).square().sum(-1).clamp_min(1e-300).sqrt()
    return distance**3 / 12.0


# Which cameras at which settings can be interpolated; what cannot is refused with its cause and cure.


def usable_information(camera: Camera, first: Camera, name: str, first_name: str) -> CameraInformation:
    """What is known of a camera that can be used."""
    if camera.params.ndim != 1:
        raise InputError(f"{name}: a batch of cameras; a single one is needed")
    if camera.size != first.size:
        sizes = [f"{width}x{height} px" for width, height in (camera.size, first.size)]
        raise InputError(f"{name}: its image is {sizes[0]}, that of {first_name} {sizes[1]}: not one camera")
    if camera.model.hybrid and camera.model.hybrid.port:
        raise InputError(f"{name}: it looks through a flat port, which is not interpolated: calibrate at that setting")
    known = camera.calibration
    if known is None or known.setting is None:
        raise InputError(
            f"{name}: it does not say at which setting it was calibrated: kcal calibrate OBS --setting ..."
        )
    if known.setting.interpolated_from:
        raise InputError(f"{name}: it is interpolated itself; use the cameras that it came from")
    information = known.known(camera.params.detach())
    if information is None:
        raise InputError(
            f"{name}: it has no error bars: calibrate it with kcal calibrate OBS --setting {known.setting}"
        )
    return information


def varied_settings(
    cameras: Sequence[Camera], setting: Mapping[str, float], names: Sequence[str]
) -> tuple[list[str], Tensor]:
    """Which kinds of settings vary, and the settings of the cameras (n, D)."""
    LensSetting(values=dict(setting))
    stated = [
        camera.calibration.setting.values for camera in cameras if camera.calibration and camera.calibration.setting
    ]
    for name, values in zip(names, stated, strict=True):
        if values.keys() != setting.keys():
            raise InputError(f"{name}: it states {', '.join(values)}, but {', '.join(setting)} is asked for")
    axes = [axis for axis in setting if len({values[axis] for values in stated} | {setting[axis]}) > 1]
    return axes, torch.tensor([[values[axis] for axis in axes] for values in stated], dtype=torch.float64)


def setting_sigmas(axes: list[str], setting: Mapping[str, float], sigma: Mapping[str, float]) -> Tensor:
    """(D,) standard deviations with which the lens comes back to the settings that vary."""
    for name, value in sigma.items():
        if name not in setting or not 0 <= value < math.inf:
            raise InputError(f"setting sigma {name}={value:g}: a number, not negative, of one of {', '.join(setting)}")
        if value and name not in axes:
            raise InputError(f"setting sigma {name}={value:g}: all cameras have one {name}, so its effect is unknown")
    return torch.tensor([sigma.get(axis, 0.0) for axis in axes], dtype=torch.float64)


def spline_between(axes: list[str], places: Tensor, at: Tensor, names: Sequence[str]) -> SettingSpline:
    """Refuse what cannot be interpolated."""
    if len(places) < len(axes) + 2:
        raise InputError(
            f"{len(places)} cameras do not tell how the lens changes between settings of {' and '.join(axes)}: "
            f"{len(axes) + 2} are needed, 5 are better"
        )
    for i, place in enumerate(places):
        if len(again := (places[:i] == place).all(1).nonzero()):
            raise InputError(f"{names[i]} and {names[int(again[0])]} are at one setting: leave one of them out")
    lowest, highest = places.amin(0).tolist(), places.amax(0).tolist()
    for axis, low, high, value in zip(axes, lowest, highest, at.tolist(), strict=True):
        if not low <= value <= high:
            raise InputError(
                f"{axis}={value:g} is outside the calibrated {axis} of {low:g} to {high:g}: a lens is not "
                f"extrapolated; calibrate it at {axis}={value:g} or beyond"
            )
    if SettingSpline.flat(places):
        raise InputError(f"{' and '.join(axes)} change together in these cameras: calibrate other combinations as well")
    spline = SettingSpline(places)
    if not spline.inside(at):
        text = setting_text(dict(zip(axes, at.tolist(), strict=True)))
        raise InputError(f"{text} does not lie between these calibrations (in their convex hull): calibrate near it")
    return spline


# The lens that shows given lines of sight at given pixels, and how errors of the lines become its own.

# Steps of the fit at most (three are usual), and the one in pixels below which it has converged.
_STEPS, _SMALL = 20, 1e-7
_PUPIL = ("pupil1", "pupil2")


class LinesSeen(NamedTuple):
    """What a camera sees at N pixels.

    Attributes:
        lines: (N, 3) the ray in the stereographic chart (x, y) / (1 + z), and where on the axis it starts, meters.
        by_camera: (N, 3, C) their derivatives by the camera's parameters.
        valid: (N,) which pixels have a ray.
    """

    lines: Tensor
    by_camera: Tensor
    valid: Tensor

    @classmethod
    def by(cls, camera: Camera, pixels: Tensor, wanted: list[int]) -> LinesSeen:
        """Of a camera, with the derivatives by the `wanted` numbers of its parameters."""
        rays, valid = camera.unproject(pixels)
        chart = rays[:, :2] / (1.0 + rays[:, 2:])
        _, by_chart, by_camera = _image(chart, camera.params.detach(), camera.model, wanted)
        angle = 2.0 * torch.atan(chart.norm(dim=-1))
        powers = {name: angle ** (2 * i) for i, name in enumerate(_PUPIL, 1)}
        zero = torch.zeros_like(angle)
        starts = torch.stack([powers.get(camera.names[i], zero) for i in wanted], -1)
        return cls(
            torch.cat([chart, camera.ray_origins(rays)[:, 2:]], 1),
            torch.cat([-torch.linalg.solve(by_chart, by_camera), starts[:, None]], 1),
            valid,
        )

    def changes(self, half: Tensor) -> Tensor:
        """(K, N, 3) of the lines with changes (K, C) of the parameters."""
        return torch.einsum("kp,ncp->knc", half, self.by_camera)


def _image(chart: Tensor, params: Tensor, model: LensModel, wanted: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (N, 2) of rays in the chart, and their derivatives by it (N, 2, 2) and by parameters (N, 2, C)."""
    size = 1.0 + chart.square().sum(-1, keepdim=True)
    rays = torch.cat([2.0 * chart / size, 2.0 / size - 1.0], 1)
    seen = project_components(FAR * rays.T, params, model, wanted)
    outer = chart[:, :, None] * chart[:, None] / size[..., None]
    across = 2.0 * (torch.eye(2, dtype=chart.dtype) - 2.0 * outer) / size[..., None]
    ray_by_chart = torch.cat([across, -4.0 * (chart / size.square())[:, None]], 1)
    by_chart = FAR * seen.by_point.permute(2, 1, 0) @ ray_by_chart
    return seen.pixels.T, by_chart, seen.by_camera.permute(2, 1, 0)


@dataclasses.dataclass(frozen=True)
class FittedLines:
    """The lens that shows given lines at given pixels, and how its parameters follow theirs."""

    camera: Camera
    misfit: float
    by_chart: Tensor
    slopes: Tensor
    selection: Tensor
    limits: Tensor
    starts: Tensor

    @classmethod
    def of(cls, first: Camera, known: CameraInformation, pixels: Tensor, lines: Tensor) -> FittedLines:
        """Of the kind of a similar camera, from which what the image does not show is taken over."""
        chart, start = lines.split((2, 1), 1)
        if len(pixels) < len(first.names):
            raise InputError(f"the cameras have rays in common at only {len(pixels)} places of the image")
        params, names = first.params.detach().clone(), first.names
        # The focal length of the base that shows the image as large.
        rays, _ = first.unproject(pixels)
        own = rays[:, :2] / (1.0 + rays[:, 2:])
        params[:2] *= (own.square().sum() / chart.square().sum()).sqrt()
        form = first.model.hybrid
        if form is not None:
            # The disc of the nearest calibration, or as much more as the image needs.
            angle = 2.0 * torch.atan(chart.norm(dim=-1))
            needed = float((angle * radius_over_angle(form.shape * angle.square())).max())
            scaled = form.radius * float(first.params[0] / params[0])
            form = dataclasses.replace(form, radius=max(scaled, needed))
        model = dataclasses.replace(first.model, hybrid=form)
        pupil = [i for i, name in enumerate(names) if name in _PUPIL]
        chosen = [slot for slot in range(known.lens_size) if not any(known.slots[i] == slot for i in pupil)]
        selection = known.selection()[:, chosen]
        free = selection.any(1).nonzero()[:, 0].tolist()
        limits, begin = 1.0 / known.sigma[chosen], params.clone()
        for _ in range(_STEPS):
            image, by_chart, by_camera = _image(chart, params, model, free)
            slopes, off = (by_camera @ selection[free]).flatten(0, 1), (pixels - image).flatten()
            half, _ = inverse_half(slopes, FIT_PX * limits)
            moved = torch.linalg.lstsq(selection, (begin - params)[:, None]).solution[:, 0]
            step = half.T @ (half @ (slopes.T @ off + (FIT_PX * limits).square() * moved))
            params = params + selection @ step
            if float((slopes @ step).abs().max()) < _SMALL:
                break
        powers = (2.0 * torch.atan(chart.norm(dim=-1)))[:, None] ** chart.new_tensor([2.0, 4.0][: len(pupil)])
        starts = first.params.new_zeros(len(names), len(pixels))
        if pupil and all(known.slots[i] >= 0 for i in pupil):
            starts[pupil] = torch.linalg.pinv(powers)
            params = torch.where(starts.any(1), starts @ start[:, 0], params)
        camera = Camera(params, size=first.size, model=model)
        image, by_chart, _ = _image(chart, params, model, [])
        misfit = float((pixels - image).square().sum(-1).mean().sqrt())
        return cls(camera, misfit, by_chart, slopes, selection, limits, starts)

    def errors(self, changes: Tensor) -> Tensor:
        """(K', 5 + P) of the parameters, of changes (K, N, 3) of the lines; the last rows are of the misfit."""
        by_image = -torch.einsum("nab,knb->kna", self.by_chart, changes[..., :2]).flatten(1)
        half = fitted_errors(by_image, self.slopes, self.limits, self.misfit, len(self.by_chart)) @ self.selection.T
        half[: len(changes)] += changes[..., 2] @ self.starts.T
        return half


# A camera at a setting of zoom or focus between those at which its lens was calibrated.
#
# What is interpolated is the image itself: for each pixel of a grid, the ray that it sees and where on the axis that
# ray starts, whatever lens models the calibrations have. A lens is fitted to the rays, and errors go the same way:
# those of the calibrations, that of the curve between them, and that of the
# motor.

_GRID = (41, 25)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class InterpolatedCamera:
    """A camera between settings, and where its error bars come from.

    Args:
        camera: with its covariance; `camera.calibration.setting` names its sources.
        weights: of the cameras that were given; their sum is 1.
        calibration_px: median over the image of the standard deviation of a point at infinity that comes from the
            calibrations (as `kcal.lens.uncertainty.projection_sigma`).
        interpolation_px: likewise of the curve between the settings.
        setting_px: likewise of the settings themselves.
        misfit_px: root mean square of what the lens model cannot follow of the interpolated rays; part of the
            covariance.
    """

    camera: Camera
    weights: tuple[float, ...]
    calibration_px: float
    interpolation_px: float
    setting_px: float
    misfit_px: float


def camera_at_setting(
    cameras: Sequence[Camera],
    setting: Mapping[str, float],
    *,
    setting_sigma: Mapping[str, float] | None = None,
    names: Sequence[str] | None = None,
) -> InterpolatedCamera:
    """Interpolate a camera between calibrations of one lens at several settings of its zoom or focus.

    Rays are interpolated by a cubic spline, each pixel by itself. The error of the spline is stated from how the
    calibrations curve (Student's distribution, so few settings give wide error bars), and added to that of the
    calibrations. Where these saw a board of the same kind, its errors count as the same board's. A setting that was
    calibrated gives the calibration itself.

    Args:
        cameras: of the same image size, with their covariance and setting (`CameraCalibration.setting`); one more
            than a line through them needs, so three for one kind of setting, four for two. Five are better.
        setting: name -> number, within the range of the calibrations (for two kinds their convex hull).
        setting_sigma: standard deviation with which the motor comes back to a setting, by name: the lens's position
            now, and also those in which it was calibrated, are that uncertain.
        names: of the cameras, for messages and the record; their own names if not given.

    Raises:
        InputError: a setting outside those that were calibrated, too few of them, two cameras at one setting, or
            cameras that do not fit together.

    Example:
        >>> from kcal.lens import CameraCalibration, LensSetting
        >>> cameras, known = [], torch.diag(torch.tensor([1.0, 1, 1, 1, 0])).double()
        >>> for focus in (0.0, 1.0, 2.0, 3.0, 4.0, 5.0):
        ...     camera = Camera.build(focal=(800 + focus**2,) * 2, center=(320, 240), size=(640, 480), model="pinhole")
        ...     stood = LensSetting(values={"focus": focus})
        ...     camera.calibration = CameraCalibration(covariance=known, setting=stood)
        ...     cameras.append(camera)
        >>> found = camera_at_setting(cameras, {"focus": 2.5})
        >>> [round(float(value), 2) for value in found.camera.focal]
        [806.26, 806.26]
    """
    if not cameras:
        raise InputError("camera_at_setting: no camera")
    names = (
        [camera_name(camera, f"camera {i + 1}") for i, camera in enumerate(cameras)] if names is None else list(names)
    )
    known = [
        usable_information(camera, cameras[0], name, names[0]) for camera, name in zip(cameras, names, strict=True)
    ]
    axes, places = varied_settings(cameras, setting, names)
    at = torch.tensor([float(setting[axis]) for axis in axes], dtype=torch.float64)
    spread = setting_sigmas(axes, setting, setting_sigma or {})
    same = (places == at).all(1).nonzero()[:, 0]
    if len(same) == 1 and not bool(spread.any()):
        return _calibrated(cameras, int(same[0]), known[int(same[0])])
    spline = spline_between(axes, places, at, names)
    weights = spline.weights(at)
    pixels = cameras[0].grid(*_GRID).reshape(-1, 2)
    free = [[i for i, slot in enumerate(one.slots) if slot >= 0] for one in known]
    seen = [LinesSeen.by(camera, pixels, own) for camera, own in zip(cameras, free, strict=True)]
    lines = torch.stack([one.lines for one in seen])
    good = torch.stack([one.valid for one in seen]).all(0)
    nearest = int(weights.argmax())
    between = torch.einsum("i,inc->nc", weights, lines)
    fit = FittedLines.of(cameras[nearest], known[nearest], pixels[good], between[good])

    def by_settings(factors: Tensor) -> Tensor:
        """Changes (K, N, 3) of the lines, from factors (K, n) of those at the settings."""
        return torch.einsum("ki,inc->knc", factors, lines)

    calibrations = []
    alone, boards = zip(*map(_errors, known), strict=True)
    records = [camera.calibration.record if camera.calibration else None for camera in cameras]
    kinds = {None if record is None else record.board for record in records}
    # Whether all cameras may have seen the same board.
    one_board = len(kinds) == 1 and len(set(map(len, boards))) == 1
    for halves, together in ((alone, False), (boards, one_board)):
        parts = [
            weight * one.changes(half[:, own])
            for weight, one, half, own in zip(weights, seen, halves, free, strict=True)
        ]
        calibrations.append(torch.stack(parts).sum(0) if together else torch.cat(parts))
    # The motor is wrong now, and was at each calibration.
    here = [spline.slopes(at), *(weight * spline.slopes(place) for weight, place in zip(weights, places, strict=True))]
    motor = by_settings((torch.cat(here, 1) * spread.repeat(len(here))).T)
    groups = [torch.cat(calibrations), by_settings(spline.errors(at)), motor]
    half = fit.errors(torch.cat(groups)[:, good])
    calibration, curve, setting_error, _ = half.split([*map(len, groups), len(half) - sum(map(len, groups))])
    fit.camera.calibration = CameraCalibration(
        name=camera_name(cameras[0], "camera 1"),
        covariance=half.T @ half,
        setting=LensSetting(values=dict(setting), interpolated_from=tuple(names)),
    )
    return InterpolatedCamera(
        camera=fit.camera,
        weights=tuple(weights.tolist()),
        calibration_px=_far_sigma(fit.camera, calibration),
        interpolation_px=_far_sigma(fit.camera, curve),
        setting_px=_far_sigma(fit.camera, setting_error),
        misfit_px=fit.misfit,
    )


def _errors(known: CameraInformation) -> tuple[Tensor, Tensor]:
    """Errors of a camera's parameters, one sigma each: its own (K, 5 + P), and those by its board (B, 5 + P)."""
    count, board = known.lens_size, known.board_size
    half = triangular(known.half().roll(board, 1))
    # Of one sign, so that the same error of a board is the same row for each camera.
    half = torch.where(half.diagonal() < 0, -1.0, 1.0)[:, None] * half
    by_parameter = half[:, board:] @ known.selection()[:, :count].T
    return by_parameter[board:], by_parameter[:board]


def _far_sigma(camera: Camera, half: Tensor) -> float:
    if not bool(half.any()):
        return 0.0
    found = pixel_covariance(camera, camera.grid(17, 13).reshape(-1, 2), half.T @ half)
    found = found[found.isfinite().all(-1).all(-1)]
    return float(torch.linalg.eigvalsh(found)[:, -1].clamp_min(0.0).sqrt().median())


def _calibrated(cameras: Sequence[Camera], number: int, known: CameraInformation) -> InterpolatedCamera:
    """A setting that was calibrated."""
    return InterpolatedCamera(
        camera=cameras[number],
        weights=tuple(float(i == number) for i in range(len(cameras))),
        calibration_px=_far_sigma(cameras[number], known.by_parameter(known.half())),
        interpolation_px=0.0,
        setting_px=0.0,
        misfit_px=0.0,
    )


# Compare lens models by views that were held out: a tool for research. A calibration needs no such choice.
#
# Groups of views are divided into parts. Each model is fitted without one part at a time. In the views of that part the
# board's poses are solved again; camera and board stay as fitted. Models are compared by paired differences over the
# same groups, so that errors that all models share cancel.

# Blocks are runs of at least five views, at most twenty of them.
_RUN, _MOST_BLOCKS = 5, 20


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ComparisonResult:
    """How well models predict views that were held out.

    Args:
        models: names of the models.
        costs: (M, G) squared residuals of each group, pixels². Infinite where a held-out corner has no image under the
            model, or where the model could not be fitted.
        corners: (G,) how many corners each group has.
        failures: model -> why it could not be fitted, for those to which that happened.

    Example:
        >>> costs = torch.tensor([[4.0, 1.0, 4.0], [4.0, 2.0, 5.0]], dtype=torch.float64)
        >>> result = ComparisonResult(models=("a", "b"), costs=costs, corners=torch.tensor([100, 50, 50]))
        >>> {name: round(rms, 4) for name, rms in result.rms.items()}
        {'a': 0.2121, 'b': 0.2345}
        >>> [round(value, 4) for value in result.difference("b", "a")]
        [0.0224, 0.0154]
    """

    __repr__ = brief

    models: tuple[str, ...]
    costs: Tensor
    corners: Tensor
    failures: dict[str, str] = dataclasses.field(default_factory=dict)

    @property
    def rms(self) -> dict[str, float]:
        """Model -> sqrt(mean ‖r‖²) over all held-out corners, pixels."""
        return dict(zip(self.models, (self.costs.sum(-1) / self.corners.sum()).sqrt().tolist(), strict=True))

    @property
    def ranking(self) -> list[tuple[str, float, float, float]]:
        """The best first: name, RMS, how much more that is than the best, and the standard error of the difference."""
        order = sorted(self.rms.items(), key=lambda entry: entry[1])
        return [(name, rms, *self.difference(name, order[0][0])) for name, rms in order]

    def difference(self, one: str, other: str) -> tuple[float, float]:
        """RMS of one model minus that of another, and its standard error over groups, pixels.

        NaN where either is infinite.
        """
        count, groups = self.corners.sum(), len(self.corners)
        deviations = []
        for name in (one, other):
            costs, rms = self.costs[self.models.index(name)], self.rms[name]
            # To first order, what each group adds to the RMS.
            deviations.append((costs - self.corners * rms**2) / (2.0 * count * max(rms, 1e-300)))
        error = float((deviations[0] - deviations[1]).square().sum().sqrt()) * math.sqrt(groups / (groups - 1))
        return self.rms[one] - self.rms[other], error


@in_one_thread
def compare_models(
    observations: Observations,
    models: Sequence[str | LensModel],
    *,
    groups: Literal["blocks", "views"] | Sequence[Hashable] = "blocks",
    parts: int = 5,
    options: CalibrationOptions | None = None,
    progress: Progress = lambda _: None,
) -> ComparisonResult:
    """Fit models without some of the views, and measure how well they predict these.

    Args:
        observations: the views of one camera.
        models: names of lens models, or `LensModel`s; "hybrid" is the lens that `calibrate_camera` fits by default,
            "network" the same with a small network as its field, or with that of `options`.
        groups: which views are held out together. "blocks": runs of views in their order, for videos and captures with
            similar neighbors; "views": each view for itself; or a label for each view. The result tells about new
            views that differ from the others as the groups differ from each other.
        parts: the groups are dealt into so many parts, each of which is held out once. As many parts as groups leave
            out one group at a time.
        options: for the parametric models; not given: with the board's warp. The hybrid takes
            `board`, `motion`, `bending`, `weighted`, `focal` and `field_of_view` of them.
        progress: called after each fit.

    Returns:
        held-out residuals, which are weighted by the corners' covariances where all views have them. Where views move
            while their rows are read, the motion of each held-out view is solved again too, for all models alike.

    Raises:
        InputError: fewer groups than parts, labels that do not fit the views, or the same model twice.
        KcalError: no model could be fitted.

    Example:
        >>> from kcal import Board, Camera, View
        >>> from kcal.lens import rotation_from_vector
        >>> board = Board(columns=7, rows=6, square=0.05)
        >>> truth = Camera.build(focal=(800, 805), center=(322, 238), size=(640, 480), coefficients=[-0.3, 0.1])
        >>> noise, views = torch.Generator().manual_seed(0), []
        >>> for i in range(10):
        ...     tilt = 0.5 * torch.tensor([[math.cos(i), math.sin(i), 0.2]], dtype=torch.float64)
        ...     points = board.points @ rotation_from_vector(tilt)[0].T
        ...     pixels, _ = truth.project(points + torch.tensor([-0.15, -0.14, 0.7], dtype=torch.float64))
        ...     pixels = pixels + 0.1 * torch.randn(pixels.shape, dtype=torch.float64, generator=noise)
        ...     views.append(View(name=str(i), pixels=pixels.tolist()))
        >>> seen = Observations(board=board, image_size=(640, 480), views=views)
        >>> result = compare_models(seen, ["pinhole", "opencv4"], groups="views")
        >>> result.rms["pinhole"] > 5 * result.rms["opencv4"]
        True
    """
    options = options or CalibrationOptions(model="opencv5", board_warp=True)
    if options.camera is not None:
        raise InputError("compare_models: a known camera leaves no models to compare")
    names = tuple(str(model if model in (HYBRID, NETWORK) else LensModel.named(model)) for model in models)
    if not names or len(set(names)) < len(names):
        raise InputError(f"compare_models: one or more different models are needed, got {', '.join(names) or 'none'}")
    members = _groups(observations, groups, parts)
    weights = torch.eye(2, dtype=torch.float64).expand(*observations.pixels().shape[:2], 2, 2)
    weighted = False
    try:
        # A fit of all views, which tells how much they move: the same for all models.
        judge = calibrate_camera(observations, _options(HYBRID, options)).hybrid
    except KcalError:
        judge = None
    costs = torch.full((len(names), len(members)), torch.inf, dtype=torch.float64)
    failures: dict[str, KcalError] = {}
    # Groups are dealt at random, so that no part is one end of the capture.
    order = torch.randperm(len(members), generator=torch.Generator().manual_seed(0)).tolist()
    for part in range(parts):
        held = order[part::parts]
        out = [i for g in held for i in members[g]]
        train = observations.subset([name for i, name in enumerate(observations.names) if i not in out])
        for number, model in enumerate(models):
            progress(f"{names[number]}, part {part + 1} of {parts}")
            try:
                found = calibrate_camera(train, _options(model, options))
            except KcalError as error:
                failures[names[number]] = error
                continue
            covariances = observations.covariances() if options.weighted else None
            if covariances is not None and not weighted:
                weights, weighted = whitening(covariances, 0.5 * found.rms**2), True
            test = Views(board_points=found.board_points, pixels=observations.pixels()[out], whitening=weights[out])
            by_view, _ = held_out_squares(found.camera, test, judge, *poses_under(found.camera, test, POSES))
            for g in held:
                costs[number, g] = by_view[[out.index(i) for i in members[g]]].sum()
    if not bool(costs.isfinite().any()) and failures:
        raise next(iter(failures.values()))
    seen = torch.isfinite(observations.pixels()).all(-1).sum(-1)
    return ComparisonResult(
        models=names,
        costs=costs,
        corners=torch.stack([seen[group].sum() for group in members]),
        failures={name: str(error) for name, error in failures.items()},
    )


def _options(model: str | LensModel, options: CalibrationOptions) -> CalibrationOptions:
    """The options for one model; the hybrid takes those that are its own."""
    if model not in (HYBRID, NETWORK):
        return dataclasses.replace(options, model=model, board="printed", field=None)
    own = ["board", "motion", "bending", "weighted", "focal", "field_of_view"]
    own += ["field", "training"] if model == NETWORK else []
    return CalibrationOptions(model=str(model), **{name: getattr(options, name) for name in own})


def _groups(
    observations: Observations, groups: Literal["blocks", "views"] | Sequence[Hashable], parts: int
) -> list[list[int]]:
    """Indices of the views that are held out together."""
    views = len(observations.views)
    if groups == "blocks":
        count = min(_MOST_BLOCKS, max(views // _RUN, min(views, parts)))
        found = [part.tolist() for part in torch.arange(views).tensor_split(count)]
    elif groups == "views":
        found = [[i] for i in range(views)]
    else:
        labels = list(groups)
        if isinstance(groups, str) or len(labels) != views:
            raise InputError(f"groups: 'blocks', 'views' or a label for each of the {views} views, got {groups!r}")
        found = [[i for i, label in enumerate(labels) if label == one] for one in dict.fromkeys(labels)]
    if not 2 <= parts <= len(found):
        raise InputError(f"{len(found)} groups of views cannot be held out in {parts} parts; add views or groups")
    return found
