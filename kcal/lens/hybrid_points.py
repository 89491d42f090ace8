"""Project and unproject many points of a hybrid camera by polynomials, fitted once to its formulas and checked.

Points pass through three stages, each a polynomial on a disc a little smaller than the valid one:

* base map and entrance pupil at once: with R the distance of the point, (X, Y) / (R + Z) is the stereographic chart;
  the place on the lens's plane is that times a polynomial in its squared radius and 1 / R;
* lens: a `kcal.lens.plane_map.PlaneMap`;
* back: a second such map from distorted places approximates the inverse to 1e-6; applied again to the place plus what
  was missed, to 1e-11, and what is missed then is small enough to be added as it is. Rays follow by a polynomial in r².

Camera and polynomials agree to 5e-10 px where they were compared when fitted; otherwise there are none. Points close to
the camera or near the edge of its valid region are left to the formulas, and so are derivatives, compiled graphs,
batches of cameras and small calls.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.lens.plane_map import PlaneMap, Polynomials

# Calls with fewer points do not repay a fit: measured on a busy core, 30 ms for `project` and 50 more for `unproject`.
FEWEST = 8192
# Points in one piece: each call to torch costs as much as some thousand of them.
PIECE = 32768


class Forward(NamedTuple):
    """The polynomials of one camera from points to pixels.

    Attributes:
        base: of each power of 1 / R, a polynomial of 2 (x² + y²) / widest - 1 on the chart.
        widest: largest x² + y² on the chart.
        nearest: smallest distance R of a point, meters.
        radius: of the disc on the plane of the lens.
        reach: of the disc about the origin of the distorted plane all of which the lens reaches from there.
        lens: from the first disc to the second.
        intrinsics: fx, fy, cx, cy, skew.
    """

    base: Polynomials
    widest: float
    nearest: float
    radius: float
    reach: float
    lens: PlaneMap
    intrinsics: tuple[float, ...]

    @property
    def rows(self) -> int:
        """How many rows of memory a call needs."""
        return max(len(self.base.places), self.lens.rows)

    def __call__(self, points: Tensor, work: Tensor) -> tuple[Tensor, Tensor | None]:
        """Map points (n, 3) to pixels (n, 2), with a mask of where they are found (None: everywhere)."""
        X, Y, Z = _planes(points)
        square = torch.addcmul(X * X, Y, Y)
        distance = torch.addcmul(square, Z, Z)
        nearness = torch.rsqrt(distance)
        scale = distance.mul_(nearness).add_(Z).reciprocal_()
        square.mul_(scale).mul_(scale)
        variable = torch.addcmul(square.new_tensor(-1.0), square, square.new_tensor(2.0 / self.widest))
        *rest, stretch = self.base(variable, work)
        for row in reversed(rest):
            stretch = torch.addcmul(row, stretch, nearness, out=row)
        scale.mul_(stretch)
        x, y, place = self.lens(X.mul_(scale), Y.mul_(scale), work)
        fx, fy, cx, cy, skew = self.intrinsics
        pixels = points.new_empty((len(points), 2))
        u, v, f = (points.new_tensor(value) for value in (cx, cy, fx * self.reach))
        torch.addcmul(u, x, f, out=pixels[:, 0])
        torch.addcmul(v, y, points.new_tensor(fy * self.reach), out=pixels[:, 1])
        if skew:
            pixels[:, 0].add_(y, alpha=skew * self.reach)
        return pixels, _within((square, self.widest), (nearness, 1.0 / self.nearest), (place, 1.0))


class Backward(NamedTuple):
    """The polynomials of one camera from pixels to rays.

    Attributes:
        forward: of the same camera.
        guess: approximate inverse of `forward.lens`.
        chart: tan(θ/2) / r as a polynomial of 2 r² - 1 on the disc.
        remainder: largest squared error of the second guess, in units of `forward.reach`.
    """

    forward: Forward
    guess: PlaneMap
    chart: Polynomials
    remainder: float

    @property
    def rows(self) -> int:
        """How many rows of memory a call needs."""
        return self.guess.rows + self.forward.lens.rows

    def __call__(self, pixels: Tensor, work: Tensor) -> tuple[Tensor, Tensor | None]:
        """Map pixels (n, 2) to rays (n, 3), with a mask of where they are found (None: everywhere)."""
        lens, guess = self.forward.lens, self.guess
        work_lens, work_guess = work.split((lens.rows, guess.rows))
        fx, fy, cx, cy, skew = self.forward.intrinsics
        u, v = _planes(pixels)
        y = v.sub_(cy).mul_(1.0 / (fy * self.forward.reach))
        x = u.sub_(cx).mul_(1.0 / (fx * self.forward.reach))
        if skew:
            x.add_(y, alpha=-skew / fx)
        place_x, place_y, square = guess(x, y, work_guess)
        reached_x, reached_y, _ = lens(place_x, place_y, work_lens)
        place_x, place_y, _ = guess(2.0 * x - reached_x, 2.0 * y - reached_y, work_guess)
        reached_x, reached_y, _ = lens(place_x, place_y, work_lens)
        missed_x, missed_y = x.sub_(reached_x), y.sub_(reached_y)
        found = _within((square, 1.0), (torch.addcmul(missed_x * missed_x, missed_y, missed_y), self.remainder))
        unit = self.forward.reach / self.forward.radius
        place_x.add_(missed_x, alpha=unit)
        place_y.add_(missed_y, alpha=unit)
        square = torch.addcmul(place_x * place_x, place_y, place_y)
        (half,) = self.chart(2.0 * square - 1.0, work_lens)
        across = square.mul_(half).mul_(half)
        inverse = (1.0 + across).reciprocal_().mul_(2.0)
        half = inverse * half
        rays = pixels.new_empty((len(pixels), 3))
        torch.mul(place_x, half, out=rays[:, 0])
        torch.mul(place_y, half, out=rays[:, 1])
        torch.sub(inverse, 1.0, out=rays[:, 2])
        return rays, found


def _planes(points: Tensor) -> tuple[Tensor, ...]:
    """The coordinates of points (n, K), each in its own memory; NumPy copies four times as fast."""
    array = points.numpy()
    return torch.from_numpy(np.ascontiguousarray(array.T)).unbind()


def _within(*limits: tuple[Tensor, float]) -> Tensor | None:
    """Where no value exceeds its limit; None: nowhere. NaN does."""
    if all(bool(value.amax() <= limit) for value, limit in limits):
        return None
    return torch.stack([value <= limit for value, limit in limits]).all(0)


def map_points(
    polynomials: Forward | Backward,
    formulas: Callable[[Tensor], tuple[Tensor, Tensor]],
    points: Tensor,
    width: int,
) -> tuple[Tensor, Tensor]:
    """Map points (..., N, K) to values (..., N, width) and valid (..., N): by `formulas` where not by `polynomials`."""
    flat = points.detach().reshape(-1, points.shape[-1])
    values = flat.new_empty((len(flat), width))
    valid = torch.ones(len(flat), dtype=torch.bool)
    memory = flat.new_empty(polynomials.rows * min(PIECE, len(flat)))
    for begin in range(0, len(flat), PIECE):
        piece = flat[begin : begin + PIECE]
        work = memory[: polynomials.rows * len(piece)].view(-1, len(piece))
        values[begin : begin + PIECE], found = polynomials(piece, work)
        if found is not None:
            valid[begin : begin + PIECE] = found
    rest = (~valid).nonzero()[:, 0]
    if len(rest):
        values[rest], valid[rest] = formulas(flat[rest])
    return values.unflatten(0, points.shape[:-1]), valid.unflatten(0, points.shape[:-1])
