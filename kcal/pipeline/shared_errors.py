"""What all tracks share: errors of calibration, mounting and clocks, which more frames do not average away.

A state's error is noise plus `shared @ b`, with the same unknown b for every track and frame: K independent errors of
the calibration, and three of each clock but the first's. The filter's gain follows the noise alone, and the effect of b
is carried along exactly. Two things follow: the covariance, noise + shared cov(b) sharedᵀ, never falls below the
systematic part; and innovations tell what they know of b, the calibration included, which `SharedErrors` collects to
estimate the clock.

Source: Friedland, "Treatment of bias in recursive filtering" (1969); Schmidt (1966) for considered states.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.pipeline.small_matrices import eliminate, solved

# Offset, drift, slope over the rows.
CLOCK_TERMS = 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClockPrior:
    """What is known of a camera's clock before any target moved, beside the clock of the first camera (the left one).

    Args:
        offset_s: seconds by which its images are later than their times say.
        offset_sigma_s: its standard deviation.
        drift_sigma: of the change of the offset, seconds per second.
        slope_sigma_s: of the difference between the bottom and the top row: two rolling shutters that are unlike.

    Raises:
        InputError: a value that is not finite, or a negative sigma.
    """

    offset_s: float = 0.0
    offset_sigma_s: float = 0.0
    drift_sigma: float = 0.0
    slope_sigma_s: float = 0.0

    def __post_init__(self) -> None:
        if not math.isfinite(self.offset_s) or not all(0 <= value < math.inf for value in self.sigmas):
            raise InputError("clock: a finite offset and finite sigmas, not negative, are needed")

    @property
    def sigmas(self) -> tuple[float, float, float]:
        """Of offset, drift and slope."""
        return self.offset_sigma_s, self.drift_sigma, self.slope_sigma_s


class ClockEstimate(NamedTuple):
    """What the tracks say of a camera's clock beside the first one's.

    Attributes:
        values: (3,) offset (s) at the time of the first frame, drift (s/s), slope (s from top to bottom).
        covariance: (3, 3); calibration errors are included.
        start: seconds, the time at which the drift counts from.
    """

    values: Tensor
    covariance: Tensor
    start: float

    def offset(self, time: float) -> tuple[float, float]:
        """The offset at a time, with its standard deviation: seconds."""
        row = self.values.new_tensor([1.0, time - self.start, 0.0])
        return float(row @ self.values), float((row @ self.covariance @ row).clamp_min(0).sqrt())


class SharedErrors:
    """What is known of b: the calibration's errors stay as they are, the clock's are estimated.

    b counts from `values` for the clock: after each `settle`, the best estimate of b is zero.

    Args:
        calibration: K, how many independent unit errors are not estimated: those of the calibration, and what lasts of
            errors in the marks.
        clocks: what is known of the clock of each camera but the first.
        device: of the tensors.
    """

    def __init__(self, calibration: int, clocks: Sequence[ClockPrior], device: torch.device | None = None) -> None:
        self.calibration = calibration
        # With clocks that are exact, there is nothing to estimate.
        self.estimated = any(any(clock.sigmas) for clock in clocks)
        sigmas = torch.tensor([clock.sigmas for clock in clocks], dtype=torch.float64, device=device)
        known = sigmas.flatten() if self.estimated else sigmas.new_zeros(0)
        self.scale = torch.cat([sigmas.new_ones(calibration), known])
        # Offset, drift and slope of each clock in turn.
        self.values = sigmas.new_tensor([[clock.offset_s, 0.0, 0.0] for clock in clocks]).flatten()
        size = len(self.scale)
        # In units of the prior's sigmas: a sigma of zero is no exception.
        self.information = torch.eye(size, dtype=torch.float64, device=device)
        self.score = torch.zeros(size, dtype=torch.float64, device=device)
        self.start: float | None = None
        self.root = torch.diag(self.scale)

    def add(self, effect: Tensor, innovation: Tensor, covariance: Tensor) -> None:
        """Collect independent innovations (M, N) = effect (M, K + Q, N) b + noise of the covariance (M, M, N)."""
        if not self.estimated:
            return
        scaled = effect * self.scale[:, None]
        white = solved(eliminate(covariance, torch.cat([scaled, innovation[:, None]], 1)))
        both = (scaled[:, :, None] * white[:, None]).sum((0, -1))
        self.information = self.information + both[:, :-1]
        self.score = self.score + both[:, -1]

    def settle(self) -> Tensor:
        """Move `values` to what was collected, and return the move (Q,); `root` is then that of what remains of b.

        The clock's error and the calibration's are correlated as in the joint posterior; the calibration keeps its
        prior, because its errors must not average away where the model of its errors is not exact.
        """
        k = self.calibration
        if not self.estimated:
            return self.values[:0]
        joint = torch.linalg.inv(self.information)
        move = joint @ self.score
        move[:k] = 0.0
        self.score = self.score - self.information @ move
        joint[:k, :k] = torch.eye(k).to(joint)
        values, vectors = torch.linalg.eigh(0.5 * (joint + joint.T))
        self.root = self.scale[:, None] * vectors * values.clamp_min(0.0).sqrt()
        change = (self.scale * move)[k:]
        self.values = self.values + change
        return change

    @property
    def mixing(self) -> Tensor | None:
        """`root`; None where it is the identity."""
        return self.root if self.estimated else None

    @property
    def corrected(self) -> Tensor:
        """(Q,) values of the clocks' errors that are estimated."""
        return self.values if self.estimated else self.values[:0]

    def clock_estimate(self, camera: int = 1) -> ClockEstimate:
        """The clock of a camera, from 1, as now known."""
        mine = slice(CLOCK_TERMS * (camera - 1), CLOCK_TERMS * camera)
        covariance = self.values.new_zeros(CLOCK_TERMS, CLOCK_TERMS)
        if self.estimated:
            part = self.root[self.calibration :][mine]
            covariance = part @ part.T
        return ClockEstimate(self.values[mine].clone(), covariance, self.start or 0.0)
