"""Covariances of a solution, and which parameters the data do not determine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.model import LensModel
from kcal.lens.projection import project_components
from kcal.solve.schur import SchurLinearization

# Eigenvalues of the scaled information below this share of the largest are rounding errors.
_RANK_TOLERANCE = 1e-13
# A parameter with this squared component in an undetermined direction counts as undetermined.
_UNDETERMINED_SHARE = 1e-2


class Uncertainty(NamedTuple):
    """Covariance of the shared parameters (S, S), and whether the data determine each (S,).

    Where the linearization is not finite, because a corner lies on a fold of the lens, the covariance is NaN and no
    parameter counts as determined.
    """

    covariance: Tensor
    determined: Tensor

    @property
    def computed(self) -> bool:
        """Whether the covariance is finite."""
        return bool(torch.isfinite(self.covariance).all())

    @property
    def sigma(self) -> Tensor:
        """(S,) standard deviations, infinite where not determined."""
        return torch.where(self.determined, self.covariance.diagonal().sqrt(), torch.inf)


class Covariance(NamedTuple):
    """Covariance of all parameters of a least-squares solution with poses, in blocks.

    The matrix of all S + 6 V parameters is never formed; `block` returns any part of it.

    Args:
        shared: (S, S) of the shared parameters (free intrinsics and lens coefficients, then the warp).
        determined: (S,) whether the data determine each. Others have a large variance that only rounding limits.
        response: (V, 6, S) derivatives of each pose's step by the shared parameters.
        own: (V, 6, 6) of each pose's step if the shared parameters were known.
    """

    shared: Tensor
    determined: Tensor
    response: Tensor
    own: Tensor

    @property
    def poses(self) -> Tensor:
        """(V, 6, 6) of the step (ω, v) of each pose (`kcal.calibrate.bundle.twist.apply_twist`), radians and meters."""
        return self.own + self.response @ self.shared @ self.response.transpose(-1, -2)

    def block(self, view: int, other: int | None = None) -> Tensor:
        """(6, S) of a view's pose with the shared parameters, or (6, 6) with another view's pose."""
        across = self.response[view] @ self.shared
        if other is None:
            return across
        alone = self.own[view] if view == other else torch.zeros_like(self.own[view])
        return across @ self.response[other].T + alone


def uncertainty_of(linear: SchurLinearization, residual_count: int, parameter_count: int) -> Uncertainty:
    """Covariance of the shared parameters from the information at a minimum, all other parameters free.

    (JᵀJ)⁻¹ ‖r‖² / (residuals - parameters), whose diagonal is the square of what `cv2.calibrateCameraExtended` reports:
    the noise is estimated from the residuals themselves and assumed independent and equal.

    Args:
        linear: the linearization at the minimum, not a batch.
        residual_count: scalar residuals.
        parameter_count: all parameters that were free, poses included.
    """
    inverse, scale, determined = _invert(linear)
    noise = noise_variance(linear, residual_count, parameter_count)
    return Uncertainty(inverse * scale[:, None] * scale * noise, determined)


def covariance(linear: SchurLinearization, residual_count: int, parameter_count: int) -> Covariance:
    """Covariance of the shared parameters and the poses at a minimum, by the Schur complement.

    (JᵀJ)⁻¹ ‖r‖² / (residuals - parameters), as `uncertainty_of`; its blocks follow from the inverse of the reduced
    normal matrix and the factors of the 6 x 6 blocks, with work that grows linearly with the views.

    Args:
        linear: the linearization at the minimum, not a batch.
        residual_count: scalar residuals.
        parameter_count: all parameters that were free, poses included.

    Example:
        >>> gram = torch.eye(8, dtype=torch.float64)[None]  # one view: six of its pose, one shared, the residuals
        >>> found = covariance(SchurLinearization.of_gram(gram, 6), residual_count=9, parameter_count=7)
        >>> found.shared.tolist(), round(float(found.poses[0].trace()), 9)
        ([[0.5]], 3.0)
    """
    shared, determined = uncertainty_of(linear, residual_count, parameter_count)
    response, own = linear.local_response()
    return Covariance(shared, determined, response, own * noise_variance(linear, residual_count, parameter_count))


def projection_covariance(
    shared: Tensor, points: Tensor, parameters: Tensor, model: LensModel, free: Sequence[int]
) -> Tensor:
    """Covariance in pixels of where points of the camera's frame are seen, by first-order propagation.

    J Σ Jᵀ with J the derivatives of the projection by the free parameters: the scatter of the image of a fixed
    direction if the calibration were repeated. A shift of cx that a rotation of all poses would compensate counts as
    uncertainty here.

    Args:
        shared: (S, S) covariance whose first rows are the free parameters, as `Covariance.shared`.
        points: (N, 3) in the camera's frame.
        parameters: (5 + P,) of the camera.
        model: its lens model.
        free: indices of the free parameters, in the order of `shared`.

    Returns:
        (N, 2, 2) pixels²; NaN where the lens gives no image (behind the camera, beyond a pole or a fold).

    Raises:
        InputError: shapes that do not fit each other.

    Example:
        >>> camera = torch.tensor([800.0, 800.0, 320.0, 240.0, 0.0], dtype=torch.float64)
        >>> sigma = torch.diag(torch.tensor([4.0, 4.0, 1.0, 1.0], dtype=torch.float64))  # fx, fy, cx, cy
        >>> point = torch.tensor([[0.5, 0.0, 1.0]], dtype=torch.float64)
        >>> projection_covariance(sigma, point, camera, LensModel.named("pinhole"), [0, 1, 2, 3]).tolist()
        [[[2.0, 0.0], [0.0, 1.0]]]
    """
    count = len(free)
    if shared.ndim != 2 or shared.shape[0] != shared.shape[1] or len(shared) < count:
        raise InputError(
            f"projection_covariance: {count} free parameters need a covariance of at least ({count}, {count}), "
            f"got {tuple(shared.shape)}"
        )
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"projection_covariance: points must be (N, 3), got {tuple(points.shape)}")
    seen = project_components(points.T, parameters, model, free)
    jacobian = seen.by_camera.permute(2, 1, 0)  # (N, 2, F)
    found = jacobian @ shared[:count, :count] @ jacobian.transpose(-1, -2)
    return torch.where(seen.regular[:, None, None], found, torch.nan)


def _invert(linear: SchurLinearization) -> tuple[Tensor, Tensor, Tensor]:
    """The inverse of the scaled information (S, S), the scale of each parameter, and whether each is determined."""
    information, scale = linear.information()
    if not bool(torch.isfinite(information).all() & torch.isfinite(linear.cost)):
        return torch.full_like(information, torch.nan), scale, torch.zeros_like(scale, dtype=torch.bool)
    eigenvalues, vectors = torch.linalg.eigh(information)
    floor = _RANK_TOLERANCE * eigenvalues[-1]
    undetermined = (vectors[:, eigenvalues <= floor] ** 2).sum(-1)
    # Below the floor an eigenvalue is unknown; the floor gives the smallest possible variance.
    inverse = (vectors / eigenvalues.clamp_min(floor)) @ vectors.T
    return inverse, scale, undetermined < _UNDETERMINED_SHARE


def noise_variance(linear: SchurLinearization, residual_count: int, parameter_count: int) -> Tensor:
    """Variance of a residual, estimated from the cost."""
    return 2.0 * linear.cost / max(residual_count - parameter_count, 1)
