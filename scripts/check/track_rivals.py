"""Stone Soup's Kalman filters (the package `stonesoup`) on the sightings of a simulated site, told whose each is."""

from __future__ import annotations

import datetime
from typing import Any

import numpy as np
import torch
from stonesoup.base import Property
from stonesoup.models.measurement.base import MeasurementModel
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.array import StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import KalmanUpdater, UnscentedKalmanUpdater
from torch import Tensor

from kcal.locate.localizer import Localizer
from kcal.pipeline.pairing import ObjectViews

START = datetime.datetime(2026, 1, 1)


class CartesianFilters:
    """One filter for each target, with straight motion in east, north and up.

    Args:
        acceleration: white noise, as that of `Motion`.
        speed: standard deviation of a new target's velocity along each axis.
    """

    def __init__(self, acceleration: float, speed: float) -> None:
        self.predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(acceleration**2)] * 3))
        self.speed = speed
        self.states: dict[int, Any] = {}

    def begin(self, target: int, mean: Any, covariance: Any, time: float) -> None:
        """A new target with the state (6,): place and velocity of each axis in turn."""
        when = START + datetime.timedelta(seconds=time)
        self.states[target] = GaussianState(mean[:, None], covariance, timestamp=when)

    def update(self, target: int, updater: Any, seen: Any, time: float) -> None:
        """Move a target to a time and take in a sighting (K,)."""
        when = START + datetime.timedelta(seconds=time)
        prediction = self.predictor.predict(self.states[target], timestamp=when)
        made = updater.update(SingleHypothesis(prediction, Detection(np.asarray(seen)[:, None], timestamp=when)))
        self.states[target] = GaussianState(made.state_vector, made.covar, timestamp=when)

    def places(self, time: float) -> tuple[list[int], Tensor]:
        """Targets and where they are believed to be."""
        when = START + datetime.timedelta(seconds=time)
        found = [self.predictor.predict(state, timestamp=when) for state in self.states.values()]
        rows = [np.asarray(state.state_vector, float).ravel()[::2] for state in found]
        return list(self.states), torch.from_numpy(np.array(rows))


class OfPositions(CartesianFilters):
    """Takes in positions with covariances, as one would without kcal's tracker."""

    def take(self, targets: Tensor, enu: Tensor, covariance: Tensor, ok: Tensor, time: float) -> None:
        """Take in the sightings of a moment."""
        for i, target in enumerate(targets.tolist()):
            if not bool(ok[i]):
                continue
            if target not in self.states:
                mean, spread = np.zeros(6), np.diag([0.0, self.speed**2] * 3)
                mean[::2], spread[::2, ::2] = enu[i].numpy(), covariance[i].numpy()
                self.begin(target, mean, spread, time)
                continue
            updater = KalmanUpdater(LinearGaussian(6, (0, 2, 4), covariance[i].numpy()))
            self.update(target, updater, enu[i].numpy(), time)


class Pixels(MeasurementModel):
    """Four pixel coordinates of a target, of which the right two are seen `delay` seconds later; pinholes only."""

    ndim_state: int = 6
    mapping: Any = (0, 2, 4)
    cameras: Any = Property(doc="Matrix, rotation from east, north and up, and shift of both cameras.")
    delay: float = Property(doc="Seconds.")
    covariance: Any = Property(doc="Of the pixels.")

    @classmethod
    def of(cls, localize: Localizer, delay: float, covariance: Tensor) -> Pixels:
        """The model of a rig that stands somewhere."""
        rig, turn = localize.rig, localize.enu_from_rig.T
        cameras = [
            (camera.matrix.numpy(), rotation.numpy(), shift.numpy())
            for camera, rotation, shift in (
                (rig.left, turn, torch.zeros(3)),
                (rig.right, rig.right_from_left_rotation @ turn, rig.right_from_left_translation),
            )
        ]
        return cls(cameras=cameras, delay=delay, covariance=covariance.numpy())

    @property
    def ndim_meas(self) -> int:
        """Four."""
        return 4

    def covar(self, **_: Any) -> Any:
        """Of the pixels."""
        return self.covariance

    def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
        """Where states are seen."""
        return StateVectors(self.seen_at(np.asarray(state.state_vector, float)))

    def seen_at(self, vector: Any) -> Any:
        """Pixels (4, N) of states (6, N)."""
        rows: list[Any] = []
        for (matrix, rotation, shift), delay in zip(self.cameras, (0.0, self.delay), strict=True):
            seen = matrix @ (rotation @ (vector[::2] + delay * vector[1::2]) + shift[:, None])
            rows += [seen[0] / seen[2], seen[1] / seen[2]]
        return np.array(rows)

    def born(self, seen: Any, place: Any, speed: float) -> tuple[Any, Any]:
        """State and covariance of a new target at about a place (3,), by Gauss and Newton's method."""
        state = np.zeros(6)
        state[::2] = place
        weight, prior = np.linalg.inv(self.covariance), np.diag([0.0, speed**-2] * 3)
        for _ in range(6):
            steps = np.diag([1.0, 0.1] * 3)
            ends = np.hstack([state[:, None] + steps, state[:, None] - steps, state[:, None]])
            values = self.seen_at(ends)
            slope = (values[:, :6] - values[:, 6:12]) / (2 * np.diag(steps))
            information = slope.T @ weight @ slope + prior
            state = state + np.linalg.solve(information, slope.T @ weight @ (seen - values[:, 12]) - prior @ state)
        return state, np.linalg.inv(information)

    def rvs(self, *_: Any, **__: Any) -> Any:
        """Not needed."""
        raise NotImplementedError

    def pdf(self, *_: Any, **__: Any) -> Any:
        """Not needed."""
        raise NotImplementedError


class OfPixels(CartesianFilters):
    """Takes in the pairs themselves, unscented: the same information as kcal's tracker, in other coordinates."""

    def take(self, targets: Tensor, pairs: ObjectViews, places: Tensor, localize: Localizer, offset: float) -> None:
        """Take in the pairs of a moment.

        Args:
            targets: whose each pair is.
            pairs: of one moment.
            places: (N, 3) of the pairs alone, east, north, up: where the search for new targets begins.
            localize: the rig.
            offset: seconds by which the right images are later than their times say.
        """
        for i, target in enumerate(targets.tolist()):
            time = float(pairs.time[i, 0])
            seen = torch.cat([pairs.left[i], pairs.right[i]]).numpy()
            delay = float(pairs.time[i, 1]) + offset - time
            model = Pixels.of(localize, delay, pairs.covariance[i])
            if target not in self.states:
                self.begin(target, *model.born(seen, places[i].numpy(), self.speed), time)
                continue
            self.update(target, UnscentedKalmanUpdater(model, alpha=1.0, kappa=0.0), seen, time)
