"""Pictures of a terrain: what both cameras see is the same thing where the truth says so, in any light."""

import functools

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from kcal.sim.captures import drawn_rig
from kcal.sim.raytrace import SURVEILLANCE
from kcal.sim.scene import FOCAL_MM
from scripts.shared.terrain import Terrain, Weather


@functools.cache
def terrain() -> Terrain:
    return Terrain(drawn_rig(SURVEILLANCE, 1.0, 1, focal_mm=FOCAL_MM, wander=1.0, scale=0.25), 1)


def shift_between(weather: Weather, *, ground: bool) -> np.ndarray:
    """Pixels by which the right picture is beside the truth, by least squares over what both cameras see."""
    site = terrain()
    width, height = site.rig.left.size
    axes = [torch.arange(8.0, size - 8.0, 3.0, dtype=torch.float64) for size in (width, height)]
    left = torch.stack(torch.meshgrid(*axes, indexing="xy"), -1).reshape(-1, 2)
    pictures = [site.picture(side, 1, weather) for side in (0, 1)]
    right, distance = site.true_right(left, 1, weather)
    near, there = left.long(), right.round().long().clamp(torch.zeros(2).long(), torch.tensor([width - 1, height - 1]))
    depth, other = (
        torch.from_numpy(one.depth)[at[:, 1], at[:, 0]] for one, at in zip(pictures, (near, there), strict=True)
    )
    level = torch.from_numpy(pictures[0].ground)[near[:, 1], near[:, 0]]
    seen = site.rig.right.inside(right) & (distance < 2000.0) & ((other / depth - 1.0).abs() < 0.02) & (level == ground)
    places = right[seen].numpy()[:, ::-1].T
    here = pictures[0].light[near[seen, 1], near[seen, 0]]
    step = np.stack([map_coordinates(part, places, order=1) for part in np.gradient(pictures[1].light)], -1)
    off = here - map_coordinates(pictures[1].light, places, order=3)
    # Edges have parts of two things.
    plain = (np.abs(off) < 3.0) & (np.abs(step) < 15.0).all(-1)
    assert plain.sum() > 1000
    return np.linalg.lstsq(step[plain], off[plain], rcond=None)[0]


@pytest.mark.parametrize(
    "weather",
    [Weather(), Weather(hour=16.5, haze=3000.0, season=0.5), Weather(shutter=0.02)],
    ids=["noon", "dim", "roll"],
)
@pytest.mark.parametrize("ground", [False, True])
def test_both_cameras_see_the_same_where_the_truth_says(weather: Weather, ground: bool) -> None:
    assert np.abs(shift_between(weather, ground=ground)).max() < 0.05


def test_light_follows_the_hour() -> None:
    site = terrain()
    mean = {hour: float(site.picture(0, None, Weather(hour=hour)).light.mean()) for hour in (9.0, 12.0, 18.0, 19.5)}
    assert mean[12.0] > mean[9.0] > mean[18.0] > 3.0 * mean[19.5] > 0.0
    # The sun is in the south at noon, behind the cameras, which look north-east; it is in their back right before.
    assert Weather().sun[1] < 0.0
    assert Weather(hour=8.0).sun[0] > Weather(hour=16.0).sun[0]


def test_shadows_turn_with_the_sun() -> None:
    site = terrain()
    dark = []
    for hour in (8.0, 16.5):
        picture = site.picture(0, None, Weather(hour=hour))
        level = np.median(picture.light[picture.ground & (picture.depth < 150.0)])
        dark.append(picture.ground & (picture.light < 0.62 * level) & (picture.depth < 400.0))
    assert min(one.sum() for one in dark) > 100
    assert (dark[0] & dark[1]).sum() < 0.4 * min(one.sum() for one in dark)


def test_season_changes_the_ground_and_no_block() -> None:
    site = terrain()
    summer, winter = (site.picture(0, None, Weather(season=share)) for share in (0.0, 1.0))
    block = ~summer.ground & (summer.depth < 1000.0)
    ground = summer.ground & (summer.depth < 300.0)
    # But for edges, which have a part of the ground.
    assert (summer.light[block] == winter.light[block]).mean() > 0.9
    assert abs(np.corrcoef(summer.light[ground], winter.light[ground])[0, 1]) < 0.6


def test_what_moves_is_elsewhere_at_another_moment() -> None:
    site = terrain()
    one, two = (site.picture(0, moment, Weather()).moving for moment in (1, 2))
    assert one.any()
    assert two.any()
    assert (one & two).sum() < 0.3 * one.sum()


def test_a_rolling_shutter_shears() -> None:
    still, rolled = (terrain().picture(0, None, Weather(shutter=shutter)).light for shutter in (0.0, 0.02))
    height, width = still.shape
    for row, expected in ((height // 2, 0.0), (height - 12, -0.02 * 400.0 * (0.5 - 12.0 / height))):
        middle = slice(width // 4, 3 * width // 4)
        misses = {
            shift: float(np.abs(np.roll(still[row], shift)[middle] - rolled[row][middle]).mean())
            for shift in range(-8, 9)
        }
        assert min(misses, key=lambda shift: misses[shift]) == pytest.approx(expected, abs=0.8)
