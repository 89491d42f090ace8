"""Least squares of one lens and the rotations of its night images, under what else is known of the lens."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.problem.parameters import FreeParameters
from kcal.gaussian import Gaussian, numbered, triangular
from kcal.lens.information import LENS_SLOT
from kcal.lens.model import LensModel
from kcal.lens.pose import rotation_from_vector, step_rows
from kcal.lens.projection import project_components
from kcal.stars.attitude import FAR


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
