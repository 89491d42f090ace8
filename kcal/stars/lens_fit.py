"""Fit the default lens to stars: one lens, and a rotation for each image."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from kcal.calibrate.hybrid.board_modes import BoardModes
from kcal.calibrate.hybrid.evidence import Amplitudes
from kcal.calibrate.hybrid.families import PUPIL, prior_families, typical_hyperprior
from kcal.calibrate.hybrid.fitted_views import LAST, Estimate, FittedViews, run_rounds
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.parameters import FreeParameters, Term
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import information_of
from kcal.errors import InputError
from kcal.gaussian import triangular
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.model import HybridForm, LensModel
from kcal.lens.projection import FAR
from kcal.lens.zernike import ZernikeModes

# Night images of one camera as views of `BoardProblem`: each shows points of its own, infinitely far.


class StarField(NamedTuple):
    """The named stars of one image: (N, 3) unit directions in any frame, (N, 2) pixels, (N,) sigma of these."""

    directions: Tensor
    pixels: Tensor
    sigma: Tensor


class StarViews(NamedTuple):
    """The named stars of V images, N of each at most.

    Attributes:
        points: (V, N, 3) in the frames of their directions.
        pixels: (V, N, 2), NaN where an image has fewer stars.
        stated: (V, N) one over the sigma of each star; 0 where there is none.
        weights: (V, N) the same of the stars that are used; 0 leaves a star out.
        variance: by which squared residuals are larger than the sigmas of the stars say.
    """

    points: Tensor
    pixels: Tensor
    stated: Tensor
    weights: Tensor
    variance: float = 1.0

    @classmethod
    def of(cls, fields: Sequence[StarField]) -> StarViews:
        """All stars of all images."""
        stated = pad_sequence([1.0 / field.sigma for field in fields], batch_first=True)
        points = pad_sequence([FAR * field.directions for field in fields], batch_first=True)
        pixels = pad_sequence([field.pixels for field in fields], batch_first=True, padding_value=math.nan)
        return cls(points, pixels, stated, stated)

    @property
    def noise(self) -> float:
        """By which stated sigmas are multiplied; they are not narrowed where residuals happen to be smaller."""
        return math.sqrt(max(self.variance, 1.0))

    def problem(
        self, model: LensModel, free: Sequence[int] | FreeParameters = (), terms: Sequence[Term] = ()
    ) -> BoardProblem:
        """Least squares of a lens and the rotations of all images."""
        shapes = self.points.new_zeros(0, 3, self.points.shape[1])
        return BoardProblem(
            self.points, self.pixels, model, free, shapes=shapes, weights=self.weights, terms=terms, turning=True
        )

    def errors(self, model: LensModel, state: BoardState) -> Tensor:
        """(V, N, 2) projected minus seen, px, of all stars; NaN where the lens has no image of a star."""
        return self._replace(weights=self.stated).problem(model).corner_residuals(state)

    def near(self, model: LensModel, state: BoardState, cut: float) -> StarViews:
        """Without stars that are off by more than `cut` typical sigmas, and with the variance estimated."""
        size = self.errors(model, state).norm(dim=-1) * self.stated
        typical = float(size[torch.isfinite(size)].median()) / 1.18
        weights = torch.where(size < cut * typical, self.stated, 0.0)
        return self._replace(weights=weights, variance=max(typical**2, 1e-12))

    def fitted(self, size: tuple[int, int]) -> FittedViews:
        """These for the default lens, of images (width, height): views of a board that has no modes."""
        count, none = self.points.shape[1], self.points.new_zeros(0)
        return FittedViews(
            points=self.points,
            board=BoardModes(self.points.new_zeros(0, 3, count), none, torch.zeros(0, dtype=torch.int64)),
            pixels=self.pixels,
            size=size,
            weights=self.weights,
            hyperprior=typical_hyperprior(),
            exact=True,
            turning=True,
        )


def star_state(parameters: Tensor, rotations: Sequence[Tensor]) -> BoardState:
    """A lens (5 + P,) and the rotation (3, 3) of each image: camera from the frame of its directions."""
    rotation = torch.stack(list(rotations))
    return BoardState.still(parameters, parameters.new_zeros(0), rotation, rotation.new_zeros(len(rotation), 3))


def lens_rows(problem: BoardProblem, state: BoardState, noise: float) -> Tensor:
    """(S, S + 1) triangle of what stars say of the lens, rotations eliminated, in standard deviations."""
    return triangular(problem.reduced_rows(state)[:, [*problem.moving.tolist(), -1]] / noise)[:-1]


# Fit the default lens to stars: one lens, a rotation for each image, every star at infinity.
#
# Problem, prior families and evidence are those of boards. Only the poses differ: three unknowns each. The entrance
# pupil is held at zero, since no star depends on it.

# Of the field's disc over the image's half diagonal.
_REACH = 1.08
_SHAPES = (1.0, 0.5, 0.25, 0.0, -0.3)
# Stars farther off than so many typical sigmas are left out, first and later.
_FIRST_CUT, CUT = 7.0, 5.0
# Steps of the solver on the base projection, and squared standard deviations that one must gain.
_BASE_EFFORT = (15, 1e-4)
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
    modes, stars = ZernikeModes(), StarViews.of(fields)
    radius = _REACH * 0.5 * math.hypot(*size)

    def model_of(shape: float) -> LensModel:
        return LensModel(hybrid=HybridForm(shape=shape, radius=radius / focal, modes=modes))

    parameters = torch.zeros(5 + model_of(1.0).size, dtype=torch.float64)
    parameters[:4] = torch.tensor([focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2])
    state = star_state(parameters, rotations)
    costs = {shape: float(stars.problem(model_of(shape)).cost(state)) for shape in _SHAPES}
    shape = min((cost, shape) for shape, cost in costs.items() if math.isfinite(cost))[1]
    for _ in range(4):  # the constants of the form follow what is found
        model = model_of(shape)
        estimate = _typical_estimate(model, focal, stars, size, state)
        held = torch.arange(len(estimate.families.mean)) >= PUPIL.start
        _, estimate, _ = stars.fitted(size).solved(estimate, _BASE_EFFORT, last_step=True, held=held)
        state, parameters = estimate.state, estimate.state.parameters.clone()
        stars = stars.near(model, state, _FIRST_CUT)
        focal, shape = float(parameters[0]), shape + min(max(float(parameters[5]), -1.0), 1.0)
        parameters[5] = 0.0
        state = state._replace(parameters=parameters)
    model = model_of(shape)
    estimate = _typical_estimate(model, focal, stars, size, state)

    def without_far(capture: FittedViews, estimate: Estimate) -> FittedViews:
        return dataclasses.replace(capture, weights=stars.near(model, estimate.state, CUT).weights)

    rounds = run_rounds(stars.fitted(size), estimate, reweigh=without_far)
    stars = stars._replace(weights=rounds.capture.weights, variance=rounds.estimate.variance)
    _, estimate, _ = rounds.capture.solved(rounds.estimate, LAST, last_step=True)
    state = estimate.state
    amplitudes = estimate.amplitudes._replace(variance=stars.noise**2)
    stated = rounds.capture.problem(estimate._replace(amplitudes=amplitudes))
    information = information_of(stated, state, stars.noise)
    camera = Camera(state.parameters, size=size, model=model)
    return star_lens(stars, state, camera, information.rows, information)


def _typical_estimate(
    model: LensModel, focal: float, stars: StarViews, size: tuple[int, int], state: BoardState
) -> Estimate:
    """With typical amplitudes, and noise as residuals tell it."""
    form = model.hybrid
    assert form is not None
    families = prior_families(form, focal, stars.fitted(size).board, size, 1.0)
    return Estimate(model, families, state, Amplitudes(typical_hyperprior().mean, stars.variance))


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


def star_lens(
    stars: StarViews, state: BoardState, camera: Camera, rows: Tensor, information: CameraInformation
) -> StarLens:
    """What a fit found, and the camera with what is known of it.

    Args:
        stars: as they were used.
        state: the minimum.
        camera: that of the minimum.
        rows: (R, S) derivatives of the stars by the lens, in standard deviations.
        information: of stars and all else.
    """
    sigma = information.covariance().diagonal().sqrt().tolist()
    named = {name: value or None for name, value in zip(camera.names, sigma, strict=True)}
    camera.calibration = CameraCalibration(sigma=named, information=information)
    errors, used = stars.errors(camera.model, state), stars.weights > 0
    counts = (stars.stated > 0).sum(1).tolist()
    # Of all that is known, the share that stars tell.
    told = rows @ information.without_board().half().T
    return StarLens(
        camera=camera,
        rotations=tuple(state.rotation),
        residuals=tuple(own[:count] for own, count in zip(errors, counts, strict=True)),
        used=tuple(own[:count] for own, count in zip(used, counts, strict=True)),
        rms_px=float(errors[used].square().mean().sqrt()),
        widened=math.sqrt(stars.variance),
        effective=float(told.square().sum()),
    )
