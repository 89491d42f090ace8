"""The same sightings through Stone Soup's filter and smoother, with models written independently: the same numbers."""

import datetime

import numpy as np
import pytest
import torch
from track_scenes import pairs_of, seen_by, tracked_site

from kcal.track import Motion, Tracker, TrackOptions

pytest.importorskip("stonesoup", reason="an oracle of the tests only")
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.base import TransitionModel
from stonesoup.predictor.kalman import ExtendedKalmanPredictor
from stonesoup.smoother.kalman import ExtendedKalmanSmoother
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track
from stonesoup.updater.kalman import KalmanUpdater

POWER, START = 0.5**2, datetime.datetime(2026, 1, 1)


class StraightLine(TransitionModel):
    """Cartesian straight motion, in the coordinates of the filter; derivatives are Stone Soup's own differences."""

    ndim_state = 6
    rvs = pdf = None  # not needed

    def function(self, state, noise=False, time_interval=None, **_):
        x, y, inverse, *pace = np.asarray(state.state_vector, float).ravel()
        place = np.array([x, y, 1.0]) / inverse + time_interval.total_seconds() * np.array(pace) / inverse
        return np.array([[place[0] / place[2]], [place[1] / place[2]], [1 / place[2]],
                         *[[p / inverse / place[2]] for p in pace]])  # fmt: skip

    def jacobian(self, state, **options):
        step = np.array([1e-6, 1e-6, 1e-8, 1e-6, 1e-6, 1e-6])
        columns = []
        for i in range(6):
            ends = []
            for sign in (1.0, -1.0):
                moved = GaussianState(np.asarray(state.state_vector, float).copy(), np.eye(6))
                moved.state_vector[i] += sign * step[i]
                ends.append(np.asarray(self.function(moved, **options), float).ravel())
            columns.append((ends[0] - ends[1]) / (2 * step[i]))
        return np.array(columns).T

    at = None

    def covar(self, time_interval=None, **_):
        dt = time_interval.total_seconds()
        cartesian = POWER * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(3))
        x, y, inverse, *pace = np.asarray(self.at.state_vector, float).ravel()
        place, velocity = np.array([x, y, 1.0]) / inverse, np.array(pace) / inverse
        place = place + dt * velocity
        slope = np.zeros((6, 6))
        slope[0, [0, 2]] = 1 / place[2], -place[0] / place[2] ** 2
        slope[1, [1, 2]] = 1 / place[2], -place[1] / place[2] ** 2
        slope[2, 2] = -1 / place[2] ** 2
        slope[3:, 3:] = np.eye(3) / place[2]
        slope[3:, 2] = -velocity / place[2] ** 2
        return slope @ cartesian @ slope.T


def test_filter_and_smoother_are_those_of_stone_soup() -> None:
    localize = tracked_site()
    # Stone Soup has no errors that last.
    options = TrackOptions(motions=(Motion(acceleration=POWER**0.5),), speed_mps=10.0, confirm_hits=1, lasting_px=0.0)
    tracker = Tracker(localize, options, record=True)
    generator = torch.Generator().manual_seed(0)
    start, velocity = torch.tensor([[5.0, -10.0, 800.0]]).double(), torch.tensor([[7.0, 1.0, -9.0]]).double()
    filtered, track = [], Track()
    motion = StraightLine()
    predictor = ExtendedKalmanPredictor(motion)
    for frame in range(15):
        time = frame / 5.0
        pairs = pairs_of(*seen_by(localize.rig, start + time * velocity, 0.3, generator), time)
        found = localize(pairs.left, pairs.right, pairs.covariance)
        tracker(pairs)
        belief = tracker.beliefs.summary()
        filtered.append((belief.mean[0], belief.noise[0]))
        when = START + datetime.timedelta(seconds=time)
        if frame == 0:
            first = belief.mean[0][:, None].numpy(), belief.noise[0].numpy()
            track.append(GaussianState(*first, timestamp=when))
            frame_axes = tracker.frame[..., 0] @ localize.enu_from_rig
            continue
        # The position and its covariance from the localizer, by numpy into the filter's coordinates.
        place = (frame_axes @ (localize.enu_from_rig.T @ found.enu[0])).numpy()
        slope = np.array([[1 / place[2], 0, -place[0] / place[2] ** 2], [0, 1 / place[2], -place[1] / place[2] ** 2],
                          [0, 0, -1 / place[2] ** 2]]) @ (frame_axes @ localize.enu_from_rig.T).numpy()  # fmt: skip
        noise = slope @ found.covariance[0].numpy() @ slope.T
        measured = np.array([place[0] / place[2], place[1] / place[2], 1 / place[2]])[:, None]
        updater = KalmanUpdater(LinearGaussian(6, (0, 1, 2), noise), use_joseph_cov=True)
        # Stone Soup does not tell a model from where it is asked for its noise.
        StraightLine.at = track[-1]
        prediction = predictor.predict(track[-1], timestamp=when)
        track.append(updater.update(SingleHypothesis(prediction, Detection(measured, timestamp=when))))
    scale = np.array([1e-4, 1e-4, 1e-5, 1e-4, 1e-4, 1e-4])
    for (mean, noise), state in zip(filtered, track, strict=True):
        np.testing.assert_allclose(mean.numpy() / scale, np.asarray(state.state_vector, float).ravel() / scale,
                                   rtol=1e-6, atol=1e-5)  # fmt: skip
        unit = np.sqrt(np.diag(np.asarray(state.covar, float)))
        np.testing.assert_allclose(noise.numpy() / np.outer(unit, unit), np.asarray(state.covar, float)
                                   / np.outer(unit, unit), atol=1e-5)  # fmt: skip
    smoothed = ExtendedKalmanSmoother(motion).smooth(track)
    state = tracker.smoothed()[0].state
    # Stone Soup leaves the first state, which was not predicted, as it is.
    for step in range(1, 15):
        vector = np.asarray(smoothed[step].state_vector, float).ravel()
        covariance = np.asarray(smoothed[step].covar, float)
        length = np.sqrt(1 + vector[0] ** 2 + vector[1] ** 2)
        slope = np.array([-vector[2] * vector[0] / length**3, -vector[2] * vector[1] / length**3, 1 / length, 0, 0, 0])
        assert float(state.inverse_range[step]) == pytest.approx(vector[2] / length, rel=1e-5)
        sigma = float(np.sqrt(slope @ covariance @ slope))
        assert float(state.inverse_range_sigma[step]) == pytest.approx(sigma, rel=1e-3)
