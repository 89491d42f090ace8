"""What named and nameless stars of several cameras become for a rig: row by row, clocks and nights by hand."""

import dataclasses
import datetime
import math
from typing import Any

import numpy as np
import pytest
import torch

from kcal import Camera, InputError, Origin
from kcal.calibrate.rig.marks import StarSource, star_turns
from kcal.lens import rotation_from_vector
from kcal.stars.detect import DetectedStars
from kcal.stars.night import Attitude, NamedStars, SkyView
from kcal.stars.rig_stars import Moment, moments_of, star_source
from kcal.stars.sky import EARTH_RATE, StarCatalog, pole_in_enu, refraction_sigma

CAMERA = Camera.build(focal=(1000, 1000), center=(320, 240), size=(641, 481), model="pinhole")
CATALOG = StarCatalog.bundled()
START = datetime.datetime(2026, 1, 5, 20, 0, tzinfo=datetime.UTC)
PLACE = Origin(lat=45.0, lon=6.0, height=100.0)
TURN = rotation_from_vector(torch.tensor([0.02, -0.03, 0.1], dtype=torch.float64))
SECOND_OF_ARC = math.radians(1.0 / 3600.0)


def turns_of_one(found: StarSource) -> torch.Tensor:
    """(E, C, 3) turns of the sky by each effect, as the first star sees them without a clock's drift."""
    plain = [dataclasses.replace(effect, factor=None) for effect in found.effects]
    return star_turns(plain, 1, found.pixels.shape[1])[:, :, 0]


def image(
    pixels: list[list[float]],
    star: list[int],
    *,
    hours: float | None = 0.0,
    turn: torch.Tensor | None = None,
    earth: bool = False,
    sigma: float = 0.1,
) -> NamedStars:
    """One image; sigmas of its stars are .1, .2, ... px."""
    time = None if hours is None else START + datetime.timedelta(hours=hours)
    rotation = torch.eye(3, dtype=torch.float64) if turn is None else turn
    count = len(star)
    return NamedStars(
        detected=DetectedStars(np.array(pixels), sigma * np.arange(1.0, count + 1.0), np.ones(count), 0.0, {}),
        view=SkyView(time=time, origin=PLACE if earth else None, time_sigma=0.3, dut1=0.0),
        attitude=Attitude(rotation=rotation, covariance=torch.eye(3).double(), star=np.array(star),
                          residual=np.zeros((count, 2)), rms_px=0.0, widened=1.0),
        directions=CATALOG.directions(),
        on_earth=earth,
        covariance=torch.eye(3).double(),
        warnings=(),
    )  # fmt: skip


def source(moments: list[Moment], count: int = 2, **more: Any) -> Any:
    return star_source(moments, (CAMERA,) * count, **more)


def test_named_stars_of_two_cameras() -> None:
    """A star that only one camera has tells nothing without a place; with one it tells that camera's attitude."""
    left = image([[100, 110], [200, 210], [300, 310]], [7, 9, 11])
    right = image([[120, 111], [220, 211]], [9, 7], sigma=0.3)
    found = source([{0: left, 1: right}, {0: left, 1: right}])
    names = [CATALOG.name_of(int(CATALOG.number[k])) for k in (7, 9)]
    assert found.names == tuple(f"{name} at {k}" for k in (1, 2) for name in names)
    assert found.pixels[:2].tolist() == [[[100, 110], [220, 211]], [[200, 210], [120, 111]]]
    assert found.pixel_sigma[:2].flatten().tolist() == pytest.approx([0.1, 0.6, 0.2, 0.3])
    assert bool(found.direction.isnan().all())
    assert bool(found.direction_sigma.isinf().all())
    on_earth = source(
        [{0: image([[100, 110], [300, 310]], [7, 11], earth=True), 1: image([[120, 111]], [7], earth=True)}],
        origin=PLACE,
    )
    assert len(on_earth.names) == 2
    assert on_earth.direction.numpy() == pytest.approx(CATALOG.directions()[[7, 11]])
    assert on_earth.pixels[1, 1].isnan().all()
    altitude = np.arcsin(CATALOG.directions()[[7, 11], 2])
    assert on_earth.direction_sigma.numpy() == pytest.approx(np.hypot(SECOND_OF_ARC, refraction_sigma(altitude)))
    with pytest.raises(InputError, match="two cameras at the same time"):
        source([{0: left, 1: image([[1, 1]], [30])}])


def test_nameless_lights_are_matched_where_named_stars_put_them() -> None:
    """Within two pixels, the nearest both ways; never one with a name; sigmas and pixels of those."""
    places = np.array([[100.0, 100], [200, 300], [400, 200], [500, 420], [150, 400]])
    rays = torch.from_numpy(np.concatenate([(places - [320, 240]) / 1000.0, np.ones((5, 1))], 1)) @ TURN.T
    there = (1000.0 * rays[:, :2] / rays[:, 2:]).numpy()
    there += np.array([320, 240]) + np.array([[0, 0], [1.2, 1.2], [1.5, 1.5], [0, 0], [0, 0]])
    left = image(places.tolist(), [-1, -1, -1, 50, -1])
    right = image([*there[[2, 1, 0, 3, 4]].tolist(), [620.0, 20.0]], [-1, -1, -1, 50, 60, -1], turn=TURN, sigma=0.2)
    found = source([{0: left, 1: right}])
    # 1.7 px is near enough, 2.1 px is not; what has a name in one image alone is not matched.
    assert found.names[1:] == ("light 0 at 1, 1", "light 1 at 1, 1")
    assert found.pixels[1].numpy() == pytest.approx(np.stack([places[0], there[0]]))
    assert found.pixels[2].numpy() == pytest.approx(np.stack([places[1], there[1]]))
    assert found.pixel_sigma[1:].numpy() == pytest.approx(np.array([[0.1, 0.6], [0.2, 0.4]]))
    assert found.direction[1:].isnan().all()
    # Two lights beside one: only the nearer has it.
    left = image([[100, 100], [100.8, 100], [400, 200]], [-1, -1, 50])
    found = source([{0: left, 1: image([[100.3, 100], [400, 200]], [-1, 50])}])
    assert found.names[1:] == ("light 0 at 1, 1",)
    # Of three cameras each is matched with the first; a light behind is not.
    three = {0: left, 2: image([[100.0, 100.5]], [-1]), 1: image([[100.8, 100.0]], [-1])}
    assert source([three], 3).names == ("light 1 at 1, 1", "light 0 at 1, 2")
    back = rotation_from_vector(torch.tensor([0.0, math.pi, 0.0], dtype=torch.float64))
    with pytest.raises(InputError):
        source([{0: left, 1: image([[540.0, 100.0]], [-1], turn=back)}])


def test_clocks_and_their_drift() -> None:
    """A second later the sky has turned by 15" about the pole, westward; hours count from the start of each night."""
    hours = [0.0, 3.0, 1.0, 30.0, 30.5, 60.0, 61.5]
    moments: list[Moment] = [
        {0: image([[1, 1]], [7], hours=h, turn=TURN), 1: image([[1, 1]], [7], hours=h), 2: image([[1, 1]], [7])}
        for h in hours
    ]
    found = source(moments, 3, clock_sigma=0.5, drift_sigma=0.04)
    names = [effect.name for effect in found.effects]
    clock, other = "the clock of camera 2", "the clock of camera 3"
    assert names == [
        f"{clock} against that of the first", f"drift of {clock}, night 1", f"drift of {clock}, night 3",
        f"{other} against that of the first", f"drift of {other}, night 1", f"drift of {other}, night 3",
    ]  # fmt: skip
    # Without a place the pole of the first camera's frame.
    second = -EARTH_RATE * TURN[:, 2]
    turns = turns_of_one(found)
    assert turns[0, 1].numpy() == pytest.approx(0.5 * second.numpy())
    assert turns[4, 2].numpy() == pytest.approx(0.04 * second.numpy())
    assert bool((turns[:3, [0, 2]] == 0).all() & (turns[3:, [0, 1]] == 0).all())
    factors = [effect.factor for effect in found.effects]
    assert factors[0] is None
    assert factors[1].tolist() == pytest.approx([0.0, 3.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    assert factors[2].tolist() == pytest.approx([0.0] * 5 + [0.0, 1.5])
    assert source(moments, 3, clock_sigma=0.0, drift_sigma=0.0).effects == ()
    north = turns_of_one(source(moments, 3, origin=PLACE))[0, 1]
    assert north.numpy() == pytest.approx(0.1 * -EARTH_RATE * pole_in_enu(45.0))
    # An hour is a night, six hours later another one begins; less than an hour tells no drift.
    for apart, nights in ((0.99, 0), (1.0, 1), (6.0, 1), (6.1, 0)):
        two: list[Moment] = [{k: image([[1, 1]], [7], hours=h) for k in (0, 1)} for h in (0.0, apart)]
        assert len(source(two).effects) == 1 + nights
    untimed: list[Moment] = [{k: image([[1, 1]], [7], hours=None) for k in (0, 1)}]
    assert len(source(untimed).effects) == 1
    with pytest.raises(InputError, match="images of the first camera"):
        source([{1: image([[1, 1]], [7]), 2: image([[1, 1]], [7])}], 3)


def test_on_the_earth_the_clock_and_the_air_are_unknown() -> None:
    """UT1 turns the sky of all cameras alike; the air shifts the stars of each moment, in all cameras."""
    moments: list[Moment] = [
        {k: image([[1, 1], [5, 5]], [7, 9], hours=h, earth=True) for k in (0, 1)} for h in (0.0, 0.5)
    ]
    found = source(moments, origin=PLACE)
    names = [effect.name for effect in found.effects]
    assert names[1:] == ["the clocks against UT1", "the air's temperature", "the air's pressure"]
    assert turns_of_one(found)[1].numpy() == pytest.approx(np.stack([0.3 * -EARTH_RATE * pole_in_enu(45.0)] * 2))
    by_camera = found.shifts()
    shifts = by_camera[:, :, 0]
    assert torch.equal(by_camera[:, :, 1], shifts)
    assert bool((shifts[:2] == 0).all())
    for effect in (0, 1):
        for k, h in enumerate((0.0, 0.5)):
            wanted = image([[1, 1]], [7], hours=h, earth=True).view.by_air(CATALOG, np.array([7, 9]))[effect][1]
            assert shifts[2 + effect, 2 * k : 2 * k + 2].numpy() == pytest.approx(wanted, abs=1e-15)
    assert float(shifts[2:].abs().max()) > 0


@pytest.mark.parametrize("name", ["clock_sigma", "drift_sigma"])
def test_sigmas_of_clocks(name: str) -> None:
    moments: list[Moment] = [{k: image([[1, 1]], [7]) for k in (0, 1)}]
    source(moments, **{name: 0.0})
    for wrong in (-0.1, math.inf, math.nan):
        with pytest.raises(InputError, match=name):
            source(moments, **{name: wrong})


def test_images_of_one_moment() -> None:
    """A millisecond is one moment; alone is left out, but on the Earth; without times by their order."""
    ms = 1 / 3_600_000
    left = [image([[1, 1]], [7], hours=h) for h in (2.0, 0.0, 1.0)]
    right = [image([[2, 2]], [7], hours=h) for h in (0.9 * ms, 1.0 + 1.2 * ms)]
    moments, alone = moments_of([left, right])
    assert alone == 3
    assert [sorted(moment) for moment in moments] == [[0, 1]]
    assert moments[0] == {0: left[1], 1: right[0]}
    moments, alone = moments_of([left, right], tolerance=0.0015)
    assert alone == 1
    assert [moment[0] for moment in moments] == [left[1], left[2]]
    earth = [[image([[1, 1]], [7], hours=h, earth=True) for h in (2.0, 0.0)], [image([[1, 1]], [7], earth=True)]]
    moments, alone = moments_of(earth)
    assert (len(moments), alone) == (2, 1)
    assert [sorted(moment) for moment in moments] == [[0, 1], [0]]
    # Two of one camera at one time are two moments.
    assert len(moments_of([[earth[1][0], earth[1][0]], []])[0]) == 2
    plain = [[image([[1, 1]], [7], hours=None) for _ in range(2)] for _ in range(2)]
    moments, alone = moments_of([plain[0], [], plain[1]])
    assert alone == 0
    assert [sorted(moment) for moment in moments] == [[0, 2], [0, 2]]
    assert moments[1][2] is plain[1][1]
    # One without a time is enough.
    mixed = [plain[0], [plain[1][0], left[0]]]
    assert moments_of(mixed)[0] == [{0: plain[0][k], 1: mixed[1][k]} for k in (0, 1)]
    with pytest.raises(InputError, match="as many are needed"):
        moments_of([plain[0], plain[1][:1]])
