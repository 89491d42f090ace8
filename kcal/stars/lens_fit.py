"""Fit the default lens to stars: one lens, a rotation for each image, every star at infinity.

Projection, derivatives, prior families and evidence are those of `kcal.calibrate.hybrid`. Only the poses differ: three
unknowns each. The entrance pupil is held at zero, since no star depends on it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import BoardModes
from kcal.calibrate.hybrid.evidence import maximize_evidence
from kcal.calibrate.hybrid.families import PriorFamilies, prior_families, typical_hyperprior
from kcal.calibrate.hybrid.quadratic import view_data
from kcal.calibrate.hybrid.unknowns import hybrid_unknowns
from kcal.errors import InputError
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.hybrid_terms import HybridForm
from kcal.lens.information import CameraInformation
from kcal.lens.model import LensModel
from kcal.lens.pose import rotation_from_vector, step_rows
from kcal.lens.projection import project_components
from kcal.lens.zernike import ZernikeModes
from kcal.stars.attitude import FAR

# Of the field's disc over the image's half diagonal.
_REACH = 1.08
# The pupil's two places among the unknowns, after focal length, principal point and shape.
_PUPIL = slice(4, 6)
_SHAPES = (1.0, 0.5, 0.25, 0.0, -0.3)
_CUT = 5.0
_ROUNDS = 6
# Stars beyond which a lens of four numbers is not enough; fewer tell no field.
_LEAST_STARS = 12


class StarField(NamedTuple):
    """The named stars of one image: (N, 3) unit directions in any frame, (N, 2) pixels, (N,) sigma of these."""

    directions: Tensor
    pixels: Tensor
    sigma: Tensor


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


class _Fit:
    """Gauss-Newton on one lens and the rotations of all images, under a normal prior on the lens."""

    def __init__(self, fields: Sequence[StarField], rotations: Sequence[Tensor]) -> None:
        self.fields, self.rotations = list(fields), [rotation.clone() for rotation in rotations]
        self.weights = [torch.ones(len(field.pixels), dtype=torch.float64) for field in fields]
        self.variance = 1.0

    def _rows(self, number: int, rotation: Tensor, parameters: Tensor, model: LensModel) -> tuple[Tensor, Tensor]:
        """(3 + S + 1, 2, N) derivatives by turn and lens, and last the residuals; these again with NaN where none."""
        field, unknowns = self.fields[number], hybrid_unknowns(model)
        points = FAR * (rotation @ field.directions.T)
        seen = project_components(points, parameters, model, unknowns.indices)
        error = seen.pixels - field.pixels.T
        lens = unknowns.collapse(seen.by_camera, -3)
        rows = torch.cat([step_rows(seen.by_point, points)[:3], lens, error[None]], 0)
        return torch.where(seen.regular, rows, 0.0), torch.where(seen.regular, error, torch.nan)

    def reduced(self, parameters: Tensor, model: LensModel) -> tuple[Tensor, list[tuple[Tensor, Tensor, Tensor]]]:
        """(S + 1, R) rows of all images with their rotations projected out, and what gives the rotations back."""
        out, back = [], []
        for number, rotation in enumerate(self.rotations):
            rows, _ = self._rows(number, rotation, parameters, model)
            flat = (rows * (self.weights[number] / self.fields[number].sigma)).flatten(1)
            q, r = torch.linalg.qr(flat[:3].T)
            out.append(flat[3:] - (flat[3:] @ q) @ q.T)
            back.append((q, r, flat))
        return torch.cat(out, 1), back

    def errors(self, parameters: Tensor, model: LensModel) -> list[Tensor]:
        """(2, N) of each image."""
        return [self._rows(n, rotation, parameters, model)[1] for n, rotation in enumerate(self.rotations)]

    def cost(self, parameters: Tensor, model: LensModel, rotations: Sequence[Tensor]) -> float:
        """χ² of all stars that are not left out."""
        total = 0.0
        for number, rotation in enumerate(rotations):
            error = self._rows(number, rotation, parameters, model)[1]
            weight = self.weights[number] / self.fields[number].sigma
            total += float(torch.where(weight > 0, error * weight, 0.0).square().sum())
        return total

    def minimize(self, parameters: Tensor, model: LensModel, mean: Tensor, deviation: Tensor, steps: int) -> Tensor:
        """The parameters of least squares; unknowns whose deviation is zero are held."""
        unknowns, free, damping = hybrid_unknowns(model), deviation > 0, 0.0

        def objective(values: Tensor, rotations: Sequence[Tensor]) -> float:
            prior = ((_unknowns_of(values) - mean) / deviation)[free].square().sum()
            return self.cost(values, model, rotations) + self.variance * float(prior)

        now = objective(parameters, self.rotations)
        for _ in range(steps):
            rows, back = self.reduced(parameters, model)
            lens, error = rows[:-1][free], rows[-1]
            precision = self.variance / deviation[free] ** 2
            normal = lens @ lens.T + torch.diag(precision)
            slope = lens @ error + precision * (_unknowns_of(parameters) - mean)[free]
            scale = normal.diagonal().sqrt()
            unit, better = normal / scale / scale[:, None], False
            for _ in range(8):
                step = torch.zeros_like(deviation)
                eye = damping * torch.eye(len(unit), dtype=torch.float64)
                step[free] = -torch.linalg.solve(unit + eye, slope / scale) / scale
                trial = parameters.clone()
                for index, slot in zip(unknowns.indices, unknowns.slots, strict=True):
                    trial[index] += step[slot]
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
    count = sum(len(field.pixels) for field in fields)
    if count < _LEAST_STARS:
        raise InputError(
            f"{count} named stars tell no lens; {_LEAST_STARS} are needed at least, and some hundred are good"
        )
    modes, fit = ZernikeModes(), _Fit(fields, rotations)
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
        parameters = fit.minimize(parameters, model, families.mean, base, 15)
        fit.leave_out(parameters, model, 7.0)
        focal, shape = float(parameters[0]), shape + min(max(float(parameters[5]), -1.0), 1.0)
        parameters = parameters.clone()
        parameters[5] = 0.0
    model = model_of(shape)
    families = _families(model, focal, nothing, size)
    for turn in range(_ROUNDS):
        parameters = fit.minimize(parameters, model, families.mean, _held(families.deviation(h)), 10)
        rows = fit.reduced(parameters, model)[0]
        rows[:-1][_PUPIL] = 0.0
        freedom = sum(2.0 * float((w > 0).sum()) - 3.0 for w in fit.weights)
        data = view_data(rows[None], _unknowns_of(parameters) - families.mean, torch.zeros(1, 0).double(), freedom)
        before = h
        best = maximize_evidence(data, families, h, fit.variance, hyperprior)
        h, variance = best.h, best.variance
        if turn < 3:
            fit.leave_out(parameters, model, _CUT)
        fit.variance = variance
        if float((h - before).abs().max()) < 0.05:
            break
    deviation = _held(families.deviation(h))
    parameters = fit.minimize(parameters, model, families.mean, deviation, 10)
    return _star_lens(fit, parameters, model, families, deviation, size)


def _families(model: LensModel, focal: float, nothing: BoardModes, size: tuple[int, int]) -> PriorFamilies:
    form = model.hybrid
    assert form is not None
    return prior_families(form, focal, nothing, size, 1.0)


def _held(deviation: Tensor) -> Tensor:
    deviation = deviation.clone()
    deviation[_PUPIL] = 0.0
    return deviation


def _unknowns_of(parameters: Tensor) -> Tensor:
    """(S,) focal length, principal point, and the coefficients."""
    return torch.cat([parameters[[0, 2, 3]], parameters[5:]])


def _star_lens(
    fit: _Fit, parameters: Tensor, model: LensModel, families: PriorFamilies, deviation: Tensor, size: tuple[int, int]
) -> StarLens:
    rows = fit.reduced(parameters, model)[0]
    errors = fit.errors(parameters, model)
    kept = deviation.nonzero()[:, 0]
    unknowns, place = hybrid_unknowns(model), {int(k): number for number, k in enumerate(kept)}
    slots = dict(zip(unknowns.indices, unknowns.slots, strict=True))
    # Sigmas as stated are not narrowed where residuals happen to be smaller.
    spread = math.sqrt(max(fit.variance, 1.0))
    triangle = torch.linalg.qr(rows[[*kept.tolist(), -1]].T / spread, mode="r").R[: len(kept)]
    information = CameraInformation(
        slots=tuple(place.get(slots.get(index, -1), -1) for index in range(5 + model.size)),
        estimate=_unknowns_of(parameters)[kept],
        rows=triangle[:, :-1],
        residuals=triangle[:, -1],
        mean=families.mean[kept],
        sigma=deviation[kept],
    )
    camera = Camera(parameters, size=size, model=model)
    sigma = information.covariance().diagonal().sqrt().tolist()
    named = {name: value or None for name, value in zip(camera.names, sigma, strict=True)}
    camera.calibration = CameraCalibration(sigma=named, information=information)
    normal = rows[:-1] @ rows[:-1].T
    whole = torch.eye(len(deviation), dtype=torch.float64) + normal * deviation[:, None] * deviation / spread**2
    used = tuple(weight > 0 for weight in fit.weights)
    good = torch.cat([error[:, use] for error, use in zip(errors, used, strict=True)], 1)
    return StarLens(
        camera=camera,
        rotations=tuple(fit.rotations),
        residuals=tuple(error.T for error in errors),
        used=used,
        rms_px=float(good.square().mean().sqrt()),
        widened=math.sqrt(fit.variance),
        effective=len(deviation) - float(torch.linalg.inv(whole).trace()),
    )
