"""Training of inverse nets (`kcal.nets.inverse`) for a given camera, by Levenberg-Marquardt."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.plane import plane_from_points, rays_from_plane
from kcal.lens.projection import from_pixels
from kcal.lens.residual import undo_components
from kcal.nets.fit import NetProblem
from kcal.nets.inverse import InverseNet
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.result import SolverStatus

# Nets correct well inside the data they have seen: pixels up to 5 % beyond the image's edges are in it.
_MARGIN = 1.05
# Off the training grid and dense enough to find the largest error to a few per cent.
_CHECK = (97, 55)


@dataclasses.dataclass(frozen=True, kw_only=True)
class InverseNetOptions:
    """Options of `train_inverse`.

    Args:
        hidden: features of each hidden layer.
        radial: see `InverseNet`.
        samples: (columns, rows) of pixels to learn from; they crowd towards the image's edges as Chebyshev's do.
        iterations: trial steps of Levenberg-Marquardt at the most.
        seed: of the first weights.
    """

    hidden: int = 12
    radial: bool = True
    samples: tuple[int, int] = (40, 26)
    iterations: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        if self.hidden < 1 or min(self.samples) < 2 or self.iterations < 1:
            raise InputError("InverseNetOptions: hidden and iterations must be at least 1, samples at least 2 x 2")


@dataclasses.dataclass(frozen=True, kw_only=True)
class InverseFit:
    """A trained inverse net, and how good it is alone.

    Args:
        net: the network.
        rms: of the distance, in pixels, between a pixel and the projection of what the net makes of it, over a grid of
            pixels of the image that have a ray; none of them was learnt from.
        largest: the greatest of these distances; infinite where the net's answer lies outside the lens's valid region.
        start_rms: the same for the closed-form guess that the net corrects.
        start_largest: likewise.
        iterations: trial steps taken.
        status: why the training stopped.
    """

    net: InverseNet
    rms: float
    largest: float
    start_rms: float
    start_largest: float
    iterations: int
    status: SolverStatus


@torch.no_grad()
def train_inverse(camera: Camera, options: InverseNetOptions | None = None) -> InverseFit:
    """Train an inverse net for a camera: least squares of net(distorted) - undistorted (Eq. 12's term of y1 and y4).

    The paper trains by Adam on points of its boards. The lens is known here, so that pixels all over the image and
    their exact rays serve (compared on the chart of `InverseNet`), and a hundred parameters are a case for
    Levenberg-Marquardt. The same seed gives the same net but for rounding.

    Args:
        camera: a single camera.
        options: see `InverseNetOptions`.

    Raises:
        InputError: a batch of cameras.
        DegenerateError: fewer than half as many pixels with a ray as the net needs to be determined.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="opencv5",
        ...                       coefficients=[-0.2, 0.05, 0.01, -0.01, 0.0])
        >>> fit = train_inverse(camera, InverseNetOptions(hidden=4, iterations=40))
        >>> fit.start_largest > 1.0, fit.largest < 0.1
        (True, True)
    """
    options = options or InverseNetOptions()
    net = InverseNet(camera, hidden=options.hidden, radial=options.radial, seed=options.seed)
    pixels = _chebyshev(camera, options.samples)
    rays, valid = camera.unproject(pixels)
    if 4 * int(valid.sum()) < net.weights.numel():
        raise DegenerateError(f"only {int(valid.sum())} of the pixels to learn from have a ray; the net needs more")
    X, Y, Z = rays[valid].unbind(-1)
    truth = torch.stack(net.to_chart(*plane_from_points(X, Y, Z, camera.model)))
    guess = net.closed_form(*_distorted(camera, pixels[valid]))
    net.reach.copy_(_largest(guess))
    net.amplitude.copy_(_largest(truth - guess))
    problem = NetProblem(guess / net.reach, (truth - guess) / net.amplitude, net.widths)
    # A correction of 1e-9 of its greatest value is more than any start needs.
    limits = LMOptions(max_iterations=options.iterations, tolerance=1e-6, residual_floor=1e-9)
    result = minimize(problem, (net.weights.detach(),), limits)
    net.weights.copy_(result.state[0])
    pixels = camera.grid(*_CHECK).reshape(-1, 2)
    pixels = pixels[camera.unproject(pixels)[1]]
    x, y = _distorted(camera, pixels)
    p, q = net.closed_form(x, y)
    before = _errors(camera, pixels, *net.from_chart(p, q))
    after = _errors(camera, pixels, *net(torch.stack([x, y], -1)).unbind(-1))
    return InverseFit(
        net=net,
        rms=_rms(after),
        largest=float(after.max()),
        start_rms=_rms(before),
        start_largest=float(before.max()),
        iterations=int(result.iterations),
        status=SolverStatus(int(result.status)),
    )


def _chebyshev(camera: Camera, counts: tuple[int, int]) -> Tensor:
    """Pixels (columns * rows, 2) at Chebyshev's places of the image and its margin."""
    axes = []
    for size, count in zip(camera.size, counts, strict=True):
        place = -torch.cos(math.pi * (torch.arange(count, dtype=torch.float64) + 0.5) / count)
        axes.append(0.5 * (size - 1) + 0.5 * size * _MARGIN * place)
    grid = torch.stack(torch.meshgrid(*axes, indexing="xy"), -1).reshape(-1, 2)
    return grid.to(camera.params.device)


def _distorted(camera: Camera, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Distorted coordinates x, y (N,) of pixels (N, 2); of a hybrid camera, before its residual field."""
    x, y = from_pixels(pixels[:, 0], pixels[:, 1], camera.params)
    return (x, y) if camera.field is None else undo_components(x, y, camera.field)[:2]


def _errors(camera: Camera, pixels: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Distances (N,) between pixels (N, 2) and where points x, y (N,) of the lens's plane are seen."""
    again, seen = camera.project(torch.stack(rays_from_plane(x, y, camera.model), -1))
    return torch.where(seen, torch.linalg.vector_norm(again - pixels, dim=-1), torch.inf)


def _largest(values: Tensor) -> Tensor:
    """Greatest length of vectors (2, N), at least so much that dividing by it makes sense."""
    return torch.linalg.vector_norm(values, dim=0).amax().clamp(min=1e-12)


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())
