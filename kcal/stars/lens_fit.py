"""Fit the default lens to stars: one lens, a rotation for each image, every star at infinity.

Projection, derivatives, prior families and evidence are those of `kcal.calibrate.hybrid`. Only the poses differ: three
unknowns each. The entrance pupil is held at zero, since no star depends on it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import BoardModes
from kcal.calibrate.hybrid.evidence import maximize_evidence
from kcal.calibrate.hybrid.families import PriorFamilies, prior_families, typical_hyperprior
from kcal.calibrate.hybrid.quadratic import still_data
from kcal.calibrate.hybrid.unknowns import hybrid_unknowns
from kcal.errors import InputError
from kcal.gaussian import Gaussian, posterior_half
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.hybrid_terms import HybridForm
from kcal.lens.information import CameraInformation
from kcal.lens.model import LensModel
from kcal.lens.zernike import ZernikeModes
from kcal.stars.star_problem import StarField, StarProblem, free_unknowns, independent_lens

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
