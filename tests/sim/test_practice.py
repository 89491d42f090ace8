"""The practice site: pictures whose geometry is exact, and a film in which ships are where the truth says."""

import itertools

import numpy as np
import pytest
import torch

from kcal.mark.shapes import snap
from kcal.sim.coast import EARTH, WHITE, Coast, box_outline, cut, exposed, facet_windows, facing, paint
from kcal.sim.practice import (
    BLUR,
    LANDMARKS,
    SIDES,
    TARGETS,
    PracticeSite,
    Side,
    frames,
    night_picture,
    practice_scene,
    practice_truth,
    ship_boxes,
    ships_at,
)

THINGS = (*LANDMARKS, *TARGETS)
LUMA = np.array([0.299, 0.587, 0.114])


@pytest.fixture(scope="module")
def site() -> PracticeSite:
    return PracticeSite(practice_scene())


@pytest.fixture(scope="module")
def small() -> PracticeSite:
    return PracticeSite(practice_scene(scale=0.5))


def miss(site: PracticeSite, side: Side) -> dict[str, float]:
    """Pixels between what a click finds in the picture and where the true camera sees it."""
    image = exposed(site.light(side) @ LUMA, BLUR, 0.0, np.random.default_rng(0))
    enu = torch.cat([site.scene.landmarks.enu, site.scene.targets.enu])
    things = [(thing.name, at) for thing, at in zip(THINGS, site.true_pixels(side, enu), strict=True)]
    return {
        # A click that is as far off as a hand is.
        name: float(np.hypot(*(np.array(snap(image, u + 0.8, v - 0.7)[:2]) - (u, v))))
        for name, (u, v) in things
    }


@pytest.mark.slow
@pytest.mark.parametrize("side", SIDES)
def test_everything_to_mark_is_where_the_true_camera_sees_it(site: PracticeSite, side: Side) -> None:
    found = miss(site, side)
    assert len(found) == 19
    assert max(found.values()) < 0.1, found


def test_true_pixels_are_those_of_the_lens_and_bent_light(small: PracticeSite) -> None:
    scene = small.scene
    lifted = scene.targets.enu.clone()
    lifted[:, 2] += 0.13 * lifted[:, :2].square().sum(-1) / (2 * EARTH)
    left, right = scene.rig(lifted @ scene.enu_from_rig)[0].unbind(-2)
    for side, pixels in zip(SIDES, (left, right), strict=True):
        np.testing.assert_allclose(small.true_pixels(side, scene.targets.enu), pixels.numpy(), atol=1e-6)


def test_the_horizon_is_that_of_a_round_earth(small: PracticeSite) -> None:
    coast = Coast()
    dip = np.sqrt(2 * coast.sea / (EARTH / (1 - coast.refraction)))
    angle = np.radians(small.scene.heading_deg - 3.0)
    pixels, _ = small.eyes["left"].project(1e6 * np.array([[np.sin(angle), np.cos(angle), -np.tan(dip)]]))
    column, row = pixels[0].round().astype(int)
    levels = (small.light("left")[row - 3 : row + 4, column] @ LUMA).round(1)
    steepest = row - 3 + int(np.abs(np.diff(levels)).argmax()) + 0.5
    assert abs(steepest - pixels[0, 1]) <= 1.0


def test_a_facet_covers_its_area(small: PracticeSite) -> None:
    """A white plate on black: its light is its area in pixels, its middle that of the plate."""
    camera = small.eyes["left"]
    plate = facing(small.at(300.0, 10.0, 3.0), box_outline((-4.0, -2.0, 4.0, 2.0)), WHITE)
    (window,) = facet_windows(camera, [plate])
    assert window is not None
    part = np.zeros((*camera.looks[window].shape[:2], 3))
    paint(part, plate, cut(camera, plate, window), Coast().haze._replace(length=1e12))
    share = part[..., 0] / WHITE[0]
    x, y = camera.project(plate.corners)[0].T
    area = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    assert share.sum() == pytest.approx(area, rel=1e-3)
    rows, columns = np.mgrid[window]
    middle = np.array([(columns * share).sum(), (rows * share).sum()]) / share.sum()
    np.testing.assert_allclose(middle, camera.project(plate.origin[None])[0][0], atol=0.02)


def test_ships_in_the_film_are_where_the_truth_says(small: PracticeSite) -> None:
    boxes = ship_boxes(small, "left", 3)
    empty = np.median(np.stack(list(frames(small, "left", 3))), 0)
    for number, frame in enumerate(frames(small, "left", 3)):
        change = np.abs(frame.astype(float) - empty)
        for (u, v), each in zip(boxes[number], ships_at(small, number / 2), strict=True):
            pixels, _ = small.eyes["left"].project(np.concatenate([facet.corners for facet in each.facets]))
            low, high = pixels.min(0), pixels.max(0)
            # The sun does not shine on it: the box is what is seen, the middle what is located.
            np.testing.assert_allclose(0.5 * (low + high), (u, v), atol=0.3)
            inner = change[int(low[1]) + 1 : int(high[1]), int(low[0]) + 1 : int(high[0])]
            assert (inner > 8).mean() > 0.2, each.passage.name


def test_what_does_not_move_is_the_same_in_all_frames(small: PracticeSite) -> None:
    first, second = itertools.islice(frames(small, "right", 2), 2)
    assert (first == second).mean() > 0.98


def test_numbers_of_the_truth(small: PracticeSite) -> None:
    truth = practice_truth(small, 3)
    assert set(truth["marks"]) == {thing.name for thing in THINGS}
    far = truth["pairs"][-1]
    left, right = (torch.tensor(far[side], dtype=torch.float64) for side in SIDES)
    assert len(left) > 30
    assert bool(small.scene.rig.right.inside(right).all())
    assert truth["ships"]["times"] == [0.0, 0.2, 0.4]
    assert np.array(truth["ships"]["places"]["coaster"]).shape == (3, 3)


def test_a_star_is_where_the_camera_sees_it(small: PracticeSite) -> None:
    heading = small.scene.enu_from_rig[:, 2].numpy() + np.array([0.0, 0.0, 0.15])
    direction = heading / np.linalg.norm(heading)
    image = night_picture(small, "left", direction[None], np.array([4.0])).astype(float)
    (u, v), _ = (each[0] for each in small.eyes["left"].project(1e9 * direction[None]))
    rows, columns = np.mgrid[round(v) - 5 : round(v) + 6, round(u) - 5 : round(u) + 6]
    light = image[rows, columns] - 14.0
    assert abs((columns * light).sum() / light.sum() - u) < 0.1
    assert abs((rows * light).sum() / light.sum() - v) < 0.1
