"""Smooth random fields that have a value everywhere: clouds, waves, rock, grass."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_SIZE = 256


@functools.cache
def _random_lattice() -> NDArray[np.float32]:
    return np.random.default_rng(7).uniform(-1.0, 1.0, _SIZE * _SIZE).astype(np.float32)


def smooth_noise(x: Floats, y: Floats, octaves: int = 3) -> Floats:
    """Values about -1 to 1 at positions of any shape; details are one wide, and half and a quarter for more octaves.

    Random values on a lattice are joined smoothly (K. Perlin's value noise), each octave with half the weight.

    Example:
        >>> x = np.linspace(0.0, 3.0, 4)
        >>> smooth_noise(x, x, octaves=1).shape
        (4,)
    """
    total: Floats = np.zeros(np.broadcast(x, y).shape)
    for octave in range(octaves):
        scale = 2.0**octave
        total += _one_octave(x * scale + 17.3 * octave, y * scale + 5.1 * octave) / scale
    return total / (2.0 - 2.0 ** (1 - octaves))


def _one_octave(x: Floats, y: Floats) -> NDArray[np.float32]:
    lattice = _random_lattice()
    column, row = np.floor(x), np.floor(y)
    u, v = (x - column).astype(np.float32), (y - row).astype(np.float32)
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    left, top = column.astype(np.int32) % _SIZE, row.astype(np.int32) % _SIZE * _SIZE
    right, bottom = (left + 1) % _SIZE, (top + _SIZE) % lattice.size
    upper = lattice[top + left]
    upper += u * (lattice[top + right] - upper)
    lower = lattice[bottom + left]
    lower += u * (lattice[bottom + right] - lower)
    mixed: NDArray[np.float32] = upper + v * (lower - upper)
    return mixed
