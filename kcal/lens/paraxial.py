"""The focal length of a camera as people mean it: pixels per radian on the optical axis.

The parameter fx of a hybrid lens is that of its base projection, part of which the field shifts: it is no focal length
by itself. What every lens has is the derivative of its projection on the axis,

    f_u = ∂u/∂(X/Z),   f_v = ∂v/∂(Y/Z)   at (0, 0, 1),

the paraxial magnification. It is fx, fy for a parametric lens without tilt. It is a smooth function of all parameters,
so that its sigma follows from their covariance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.projection import project_components
from kcal.texts import measured_text

# Standard deviations beyond which both focal lengths are told apart, and relative rounding.
_UNEQUAL, _ROUNDING = 3.0, 1e-9


class ParaxialFocal(NamedTuple):
    """Focal lengths along u and v.

    Attributes:
        value: (2,) pixels per radian.
        sigma: (2,) standard deviations; NaN where the camera's calibration does not tell.
        covariance: (2, 2) px²; NaN likewise.

    Example:
        >>> str(ParaxialFocal(torch.tensor([800.0, 800.0]), torch.ones(2), torch.ones(2, 2)))
        '800.0 ± 1.0 px'
    """

    value: Tensor
    sigma: Tensor
    covariance: Tensor

    @property
    def mean(self) -> tuple[float, float]:
        """The mean of both focal lengths, and its standard deviation."""
        return float(self.value.mean()), math.sqrt(max(float(self.covariance.mean()), 0.0))

    @property
    def aspect(self) -> tuple[float, float]:
        """The second focal length over the first, and its standard deviation."""
        ratio = self.value[1] / self.value[0]
        slope = torch.stack([-ratio, torch.ones_like(ratio)]) / self.value[0]
        variance = float(slope @ self.covariance @ slope)
        return float(ratio), math.sqrt(max(variance, 0.0)) if variance == variance else math.nan

    def __str__(self) -> str:
        """In words: one focal length where both are equal as far as is known."""

        def shown(value: float, sigma: float) -> str:
            return measured_text(value, sigma) if sigma == sigma else f"{value:.3f}"

        (aspect, error), (u, v), (s, t) = self.aspect, self.value.tolist(), self.sigma.tolist()
        if abs(aspect - 1.0) > _UNEQUAL * (error if error == error else 0.0) + _ROUNDING:
            return f"{shown(u, s)} px along rows, {shown(v, t)} px along columns"
        return f"{shown(*self.mean)} px"


def paraxial_focal(camera: Camera) -> ParaxialFocal:
    """The focal lengths of a camera: the derivative of its projection on the optical axis.

    Args:
        camera: a single camera of any lens model; error bars are those of its `calibration`.

    Raises:
        InputError: a batch of cameras.

    Example:
        >>> from kcal.lens import CameraCalibration
        >>> camera = Camera.build(focal=(800, 801), center=(320, 240), size=(640, 480), coefficients=[-0.3, 0.1])
        >>> camera.calibration = CameraCalibration(covariance=torch.diag(torch.tensor([4.0, 1] + 8 * [0]).double()))
        >>> [value.tolist() for value in paraxial_focal(camera)[:2]]
        [[800.0, 801.0], [2.0, 1.0]]
    """
    params = camera.params.detach()
    if params.ndim != 1:
        raise InputError("paraxial_focal: a single camera is needed, not a batch")

    def magnification(values: Tensor) -> Tensor:
        axis = values.new_tensor([[0.0], [0.0], [1.0]])
        by_point = project_components(axis, values, camera.model, ()).by_point[..., 0]
        return torch.stack([by_point[0, 0], by_point[1, 1]])

    with torch.enable_grad():
        slopes: Tensor = torch.autograd.functional.jacobian(magnification, params)
    value = magnification(params)
    variance = _variance(camera, slopes)
    if variance is None:
        variance = value.new_full((2, 2), torch.nan)
    return ParaxialFocal(value, variance.diagonal().clamp_min(0.0).sqrt(), variance)


def _variance(camera: Camera, slopes: Tensor) -> Tensor | None:
    """(2, 2) covariance of the focal lengths with these derivatives (2, 5 + P) by the parameters; None if unknown."""
    known = camera.calibration
    if known is None:
        return None
    if known.covariance is not None:
        if known.information is not None:
            # By the root: a covariance of hundreds of parameters loses what cancels in it to rounding.
            spread = slopes @ known.information.by_parameter(known.information.half()).T
            return spread @ spread.T
        return slopes @ known.covariance.to(slopes) @ slopes.T
    felt = slopes.abs().sum(0).nonzero()[:, 0].tolist()
    sigma = [known.sigma.get(camera.names[i]) if known.sigma else None for i in felt]
    # Files with sigmas alone tell of focal lengths that are parameters, not of how parameters vary together.
    if len(felt) > 2 or None in sigma:
        return None
    return (slopes[:, felt] * slopes.new_tensor(sigma)).square().sum(1).diag()
