"""The lens that shows given lines of sight at given pixels, and how errors of the lines become its own."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.base_map import radius_over_angle
from kcal.lens.camera import Camera
from kcal.lens.carry_over import FIT_PX, fitted_errors, inverse_half
from kcal.lens.information import CameraInformation
from kcal.lens.model import LensModel
from kcal.lens.projection import project_components
from kcal.lens.pupil import FAR

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
