"""Fit the default lens to stars: one lens, and a rotation for each image."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import BoardModes
from kcal.calibrate.hybrid.evidence import maximize_evidence, still_data
from kcal.calibrate.hybrid.families import PriorFamilies, prior_families, typical_hyperprior
from kcal.calibrate.hybrid.fitted_views import hybrid_unknowns
from kcal.calibrate.problem.parameters import FreeParameters
from kcal.errors import InputError
from kcal.gaussian import Gaussian, numbered, posterior_half, triangular
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.hybrid_terms import HybridForm
from kcal.lens.information import LENS_SLOT, CameraInformation
from kcal.lens.model import LensModel
from kcal.lens.pose import rotation_from_vector, step_rows
from kcal.lens.projection import project_components
from kcal.lens.zernike import ZernikeModes
from kcal.stars.night import FAR

# Least squares of one lens and the rotations of its night images, under what else is known of the lens.


class StarField(NamedTuple):
    """The named stars of one image: (N, 3) unit directions in any frame, (N, 2) pixels, (N,) sigma of these."""

    directions: Tensor
    pixels: Tensor
    sigma: Tensor


def independent_lens(mean: Tensor, deviation: Tensor) -> Gaussian:
    """What is known beforehand of the unknowns (S,) of a lens, each by itself; those without a deviation are held."""
    free = [i for i, value in enumerate(deviation.tolist()) if value > 0]
    return Gaussian.independent(tuple((LENS_SLOT, i) for i in free), mean[free], deviation[free])


def free_unknowns(known: Gaussian, count: int) -> list[int]:
    """Numbers of the lens's unknowns, of so many, that are not held."""
    every = numbered(LENS_SLOT, count)
    return [every.index(slot) for slot in known.slots]


class StarProblem:
    """Gauss-Newton on one lens and the rotations of all images.

    Args:
        fields: named stars of each image.
        rotations: (3, 3) of each: camera from the frame of its directions, roughly.

    Attributes:
        weights: (N,) of each image; 0 leaves a star out.
        variance: by which squared residuals are larger than the sigmas of the stars say.
    """

    def __init__(self, fields: Sequence[StarField], rotations: Sequence[Tensor]) -> None:
        self.fields, self.rotations = list(fields), [rotation.clone() for rotation in rotations]
        self.weights = [torch.ones(len(field.pixels), dtype=torch.float64) for field in fields]
        self.variance = 1.0

    def _points(self, rotations: Sequence[Tensor]) -> Tensor:
        """(3, N) the stars of all images, in the camera's frame: one projection of all is several times faster."""
        turned = [turn @ field.directions.T for turn, field in zip(rotations, self.fields, strict=True)]
        return FAR * torch.cat(turned, 1)

    def _by_image(self, values: Tensor) -> tuple[Tensor, ...]:
        return values.split([len(field.pixels) for field in self.fields], -1)

    def reduced(
        self, parameters: Tensor, model: LensModel, unknowns: FreeParameters
    ) -> tuple[Tensor, list[tuple[Tensor, Tensor, Tensor]]]:
        """(S + 1, R) rows of all images with their rotations projected out, and what gives the rotations back."""
        points = self._points(self.rotations)
        seen = project_components(points, parameters, model, unknowns.indices)
        error = seen.pixels - torch.cat([field.pixels for field in self.fields]).T
        lens = unknowns.collapse(seen.by_camera, -3)
        rows = torch.cat([step_rows(seen.by_point, points)[:3], lens, error[None]], 0)
        rows = torch.where(seen.regular, rows, 0.0)
        out, back = [], []
        for own, weight, field in zip(self._by_image(rows), self.weights, self.fields, strict=True):
            flat = (own * (weight / field.sigma)).flatten(1)
            q, r = torch.linalg.qr(flat[:3].T)
            out.append(flat[3:] - (flat[3:] @ q) @ q.T)
            back.append((q, r, flat))
        return torch.cat(out, 1), back

    def whitened(self, parameters: Tensor, model: LensModel, unknowns: FreeParameters) -> Tensor:
        """(S, S + 1) triangle of `reduced`, in standard deviations, the residuals last.

        Sigmas as stated are not narrowed where residuals happen to be smaller.
        """
        rows = self.reduced(parameters, model, unknowns)[0]
        return triangular(rows.T / math.sqrt(max(self.variance, 1.0)))[:-1]

    def errors(
        self, parameters: Tensor, model: LensModel, rotations: Sequence[Tensor] | None = None
    ) -> tuple[Tensor, ...]:
        """(2, N) of each image, projected minus seen, px; NaN where the lens has no image of a star."""
        seen = project_components(self._points(rotations or self.rotations), parameters, model, ())
        error = seen.pixels - torch.cat([field.pixels for field in self.fields]).T
        return self._by_image(torch.where(seen.regular, error, torch.nan))

    def cost(self, parameters: Tensor, model: LensModel, rotations: Sequence[Tensor]) -> float:
        """χ² of all stars that are not left out."""
        error = torch.cat(self.errors(parameters, model, rotations), 1)
        weight = torch.cat([w / field.sigma for w, field in zip(self.weights, self.fields, strict=True)])
        return float(torch.where(weight > 0, error * weight, 0.0).square().sum())

    def minimize(
        self, parameters: Tensor, model: LensModel, unknowns: FreeParameters, known: Gaussian, steps: int
    ) -> Tensor:
        """The parameters of least squares; the rotations follow. Unknowns of which nothing is known are held."""
        leading, index, every = list(unknowns.leading), list(unknowns.indices), numbered(LENS_SLOT, len(unknowns))
        free = free_unknowns(known, len(unknowns))
        damping, spread = 0.0, math.sqrt(self.variance)

        def objective(values: Tensor, rotations: Sequence[Tensor]) -> float:
            prior = known.placed(every, values[leading]).rows[:, -1].square().sum()
            return self.cost(values, model, rotations) + self.variance * float(prior)

        now = objective(parameters, self.rotations)
        for _ in range(steps):
            rows, back = self.reduced(parameters, model, unknowns)
            stacked = torch.cat([rows.T, spread * known.placed(every, parameters[leading]).rows])
            triangle = torch.linalg.qr(stacked[:, [*free, -1]], mode="r").R
            scale = torch.linalg.vector_norm(triangle[:, :-1], dim=0)
            better = False
            for _ in range(8):
                damped = torch.cat([triangle[:, :-1] / scale, math.sqrt(damping) * torch.eye(len(scale)).double()])
                aim = torch.nn.functional.pad(triangle[:, -1], (0, len(scale)))
                step = parameters.new_zeros(len(every))
                step[free] = -torch.linalg.lstsq(damped, aim[:, None]).solution[:, 0] / scale
                trial = parameters.clone()
                trial[index] += unknowns.expand(step)
                turned = [
                    rotation_from_vector(torch.linalg.solve(r, q.T @ -(flat[-1] + step @ flat[3:-1]))) @ rotation
                    for (q, r, flat), rotation in zip(back, self.rotations, strict=True)
                ]
                new = objective(trial, turned)
                if new <= now * (1 + 1e-12):
                    better = True
                    break
                damping = max(10 * damping, 1e-6)
            if not better:
                break
            damping *= 0.1
            gain, now, parameters, self.rotations = now - new, new, trial, turned
            if gain < 1e-7 * now:
                break
        return parameters

    def leave_out(self, parameters: Tensor, model: LensModel, cut: float) -> None:
        """Leave out stars that are off by more than `cut` typical sigmas, and estimate the variance."""
        errors = self.errors(parameters, model)
        size = [(e / f.sigma).norm(dim=0) for e, f in zip(errors, self.fields, strict=True)]
        whole = torch.cat(size)
        typical = float(whole[torch.isfinite(whole)].median()) / 1.18
        self.weights = [(one < cut * typical).double() for one in size]
        self.variance = max(typical**2, 1e-12)


# Fit the default lens to stars: one lens, a rotation for each image, every star at infinity.
#
# Projection, derivatives, prior families and evidence are those of `kcal.calibrate.hybrid`. Only the poses differ:
# three unknowns each. The entrance pupil is held at zero, since no star depends on it.

# Of the field's disc over the image's half diagonal.
_REACH = 1.08
# The pupil's two places among the unknowns, after focal length, principal point and shape.
_PUPIL = slice(4, 6)
_SHAPES = (1.0, 0.5, 0.25, 0.0, -0.3)
# Stars farther off than so many typical sigmas are left out.
CUT = 5.0
_ROUNDS = 6
# Stars beyond which a lens of four numbers is not enough; fewer tell no field.
_LEAST_STARS = 12


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StarLens:
    """A lens found from stars.

    Args:
        camera: at infinity, without a pupil, with what is known of it.
        rotations: (3, 3) of each image: camera from the frame of its directions.
        residuals: (N, 2) of each image, projected minus seen, px.
        used: (N,) of each image, which stars were not left out.
        rms_px: root of the mean squared residual along an axis, of those used.
        widened: by how much residuals are larger than the sigmas of the stars say.
        effective: how many unknowns of the lens the stars determine.
    """

    camera: Camera
    rotations: tuple[Tensor, ...]
    residuals: tuple[Tensor, ...]
    used: tuple[Tensor, ...]
    rms_px: float
    widened: float
    effective: float


def fit_star_lens(
    fields: Sequence[StarField], rotations: Sequence[Tensor], size: tuple[int, int], focal: float
) -> StarLens:
    """Fit the default lens to the named stars of several images of one camera.

    Args:
        fields: of each image.
        rotations: (3, 3) of each: camera from the frame of its directions, roughly.
        size: of the images.
        focal: px, roughly.

    Raises:
        InputError: too few stars.

    Example:
        >>> fit_star_lens([], [], (1920, 1080), 1600.0)
        Traceback (most recent call last):
        kcal.errors.InputError: 0 named stars tell no lens; 12 are needed at least, and some hundred are good
    """
    require_stars(fields)
    modes, fit = ZernikeModes(), StarProblem(fields, rotations)
    nothing = BoardModes(torch.zeros(0, 3, 0).double(), torch.zeros(0).double(), torch.zeros(0, dtype=torch.int64))
    hyperprior = typical_hyperprior(modes)
    h = hyperprior.mean
    radius = _REACH * 0.5 * math.hypot(*size)

    def model_of(shape: float) -> LensModel:
        return LensModel(hybrid=HybridForm(shape=shape, radius=radius / focal, modes=modes))

    parameters = torch.zeros(5 + model_of(1.0).size, dtype=torch.float64)
    parameters[:4] = torch.tensor([focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2])
    costs = {shape: fit.cost(parameters, model_of(shape), fit.rotations) for shape in _SHAPES}
    shape = min((cost, shape) for shape, cost in costs.items() if math.isfinite(cost))[1]
    for _ in range(4):  # the constants of the form follow what is found
        model, families = model_of(shape), _families(model_of(shape), focal, nothing, size)
        base = torch.zeros(len(families.mean), dtype=torch.float64)
        base[:4] = families.deviation(h)[:4]
        known = independent_lens(families.mean, base)
        parameters = fit.minimize(parameters, model, hybrid_unknowns(model), known, 15)
        fit.leave_out(parameters, model, 7.0)
        focal, shape = float(parameters[0]), shape + min(max(float(parameters[5]), -1.0), 1.0)
        parameters = parameters.clone()
        parameters[5] = 0.0
    model = model_of(shape)
    families, unknowns = _families(model, focal, nothing, size), hybrid_unknowns(model)
    leading = list(unknowns.leading)
    for turn in range(_ROUNDS):
        known = independent_lens(families.mean, _without_pupil(families.deviation(h)))
        parameters = fit.minimize(parameters, model, unknowns, known, 10)
        rows = fit.reduced(parameters, model, unknowns)[0]
        rows[:-1][_PUPIL] = 0.0
        freedom = sum(2.0 * float((w > 0).sum()) - 3.0 for w in fit.weights)
        data = still_data(rows[None], parameters[leading] - families.mean, freedom)
        before = h
        best = maximize_evidence(data, families, h, fit.variance, hyperprior)
        h, variance = best.h, best.variance
        if turn < 3:
            fit.leave_out(parameters, model, CUT)
        fit.variance = variance
        if float((h - before).abs().max()) < 0.05:
            break
    deviation = _without_pupil(families.deviation(h))
    known = independent_lens(families.mean, deviation)
    parameters = fit.minimize(parameters, model, unknowns, known, 10)
    rows = fit.whitened(parameters, model, unknowns)
    kept = free_unknowns(known, len(unknowns))
    slots = dict(zip(unknowns.indices, unknowns.slots, strict=True))
    information = CameraInformation(
        slots=tuple(kept.index(slots[index]) if slots.get(index) in kept else -1 for index in range(len(parameters))),
        estimate=parameters[leading][kept],
        rows=rows[:, kept],
        residuals=rows[:, -1],
        mean=families.mean[kept],
        sigma=deviation[kept],
    )
    return star_lens(fit, Camera(parameters, size=size, model=model), known, rows, information)


def require_stars(fields: Sequence[StarField]) -> None:
    """Refuse fewer stars than tell a lens.

    Raises:
        InputError: too few.
    """
    count = sum(len(field.pixels) for field in fields)
    if count < _LEAST_STARS:
        raise InputError(
            f"{count} named stars tell no lens; {_LEAST_STARS} are needed at least, and some hundred are good"
        )


def _families(model: LensModel, focal: float, nothing: BoardModes, size: tuple[int, int]) -> PriorFamilies:
    form = model.hybrid
    assert form is not None
    return prior_families(form, focal, nothing, size, 1.0)


def _without_pupil(deviation: Tensor) -> Tensor:
    deviation = deviation.clone()
    deviation[_PUPIL] = 0.0
    return deviation


def star_lens(
    fit: StarProblem, camera: Camera, known: Gaussian, rows: Tensor, information: CameraInformation
) -> StarLens:
    """What a fit found, and the camera with what is known of it.

    Args:
        fit: at its minimum.
        camera: that of the minimum.
        known: what was known before.
        rows: (S, S + 1) of the stars (`StarProblem.whitened`).
        information: of stars and all else.
    """
    sigma = information.covariance().diagonal().sqrt().tolist()
    named = {name: value or None for name, value in zip(camera.names, sigma, strict=True)}
    camera.calibration = CameraCalibration(sigma=named, information=information)
    errors = fit.errors(camera.params.detach(), camera.model)
    used = tuple(weight > 0 for weight in fit.weights)
    good = torch.cat([error[:, use] for error, use in zip(errors, used, strict=True)], 1)
    by_stars = rows[:, free_unknowns(known, rows.shape[1] - 1)]
    # Of all that is known, the share that stars tell.
    told = by_stars @ posterior_half(torch.cat([by_stars, known.rows[:, :-1]])).T
    return StarLens(
        camera=camera,
        rotations=tuple(fit.rotations),
        residuals=tuple(error.T for error in errors),
        used=used,
        rms_px=float(good.square().mean().sqrt()),
        widened=math.sqrt(fit.variance),
        effective=float(told.square().sum()),
    )
