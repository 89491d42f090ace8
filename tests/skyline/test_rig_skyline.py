"""Skylines in the adjustment of a rig: shared errors count once, cameras side by side share them."""

import functools
import math
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from kcal import InputError, MeasuredPosition, RigData, solve_rig
from kcal.calibrate.rig.marks import SkylineSource
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.source import PosedCamera
from kcal.lens import rotation_from_vector, vector_from_rotation
from kcal.locate import enu_from_cam
from kcal.locate.stations import station_mounting
from kcal.rig import SkylineImage, skyline_source
from kcal.skyline import attitude
from kcal.skyline.horizon import terrain_horizon
from scripts.check.skyline import HillWeather
from tests.helpers.skyline_site import ANGLES, ERROR, camera, image, small_site

SIGMA = torch.full((2, 3), 0.02).double()
CENTERS = torch.tensor([[0.0, 0, 0], [10.0, 0, 0]]).double()
RIGHT = (40.4, 2.5, 0.0)


@functools.cache
def seen(moment: int, side: int) -> SkylineImage:
    """An image of a camera at a moment."""
    air = HillWeather(haze=9_000.0, seed=2 * moment + side)
    return SkylineImage(
        name=f"{side} at {moment}", camera=side, image=image(RIGHT if side else ANGLES, air, 10.0 * side)
    )


@functools.cache
def source(*moments: int, sides: tuple[int, ...] = (0, 1)) -> SkylineSource:
    """Of two cameras 10 m apart."""
    site = small_site()
    images = [seen(moment, side) for moment in moments for side in sides]
    return skyline_source(images, [camera()] * 2, site.raster, site.place, CENTERS, SIGMA, error=ERROR)[0]


def solved(given: SkylineSource) -> RigResult:
    """With positions of both."""
    # Two cameras of one model are two cameras by their parameters.
    cameras = camera(), camera()
    places = tuple(MeasuredPosition(camera=c, point=CENTERS[c], sigma=SIGMA[c]) for c in (0, 1))
    return solve_rig(RigData(cameras=cameras, names=("left", "right"), positions=places, skyline=given))


@pytest.mark.slow
def test_a_rig_from_skylines_and_positions_alone() -> None:
    result = solved(source(0))
    stations = result.stations(small_site().place)
    for c, angles in enumerate((ANGLES, RIGHT)):
        stands = station_mounting(stations, c)
        sigma = stands.covariance.diagonal()[3:6].sqrt().rad2deg()
        off = np.array([stands.heading_deg, stands.pitch_deg, stands.roll_deg]) - angles
        assert abs(off[0]) < 3 * float(sigma[2])
        assert np.abs(off[1:]).max() < 3 * float(sigma[:2].max())
    (skyline, positions) = result.sources
    assert (skyline.name, skyline.used) == ("skyline", 2)
    assert skyline.rms_px is not None
    assert skyline.rms_px < 0.4
    assert positions.name == "positions"
    assert result.rms == pytest.approx(skyline.rms_px)
    assert result.warnings == ()


def test_cameras_side_by_side_share_the_errors_of_the_raster() -> None:
    result = solved(source(0))
    covariance = result.stereo().covariance
    alone = station_mounting(result.stations(small_site().place), 0).covariance
    relative = covariance.matrix[-6:-3, -6:-3].trace().sqrt()
    # What both are wrong by on the Earth, they are not against each other: independent ones would be 1.4 times as bad.
    assert float(relative) < float(alone.diagonal()[3:6].sum().sqrt())
    true = enu_from_cam(*RIGHT).T @ enu_from_cam(*ANGLES)
    off = vector_from_rotation(result.rotation[1] @ result.rotation[0].T @ true.T)
    assert float(off.norm()) < 4 * math.sqrt(float(covariance.matrix[-6:-3, -6:-3].trace()))


@pytest.mark.slow
def test_more_images_do_not_average_the_terrain() -> None:
    one, three = (station_mounting(solved(source(*m)).stations(small_site().place), 0) for m in ((0,), (0, 1, 2)))
    ratio = (three.covariance.diagonal()[3:6] / one.covariance.diagonal()[3:6]).sqrt()
    assert ((ratio < 1.001) & (ratio > 0.7)).all()  # independent images: 0.58
    assert abs(three.heading_deg - one.heading_deg) < 0.02


def test_images_of_one_camera_share_its_surroundings(monkeypatch: pytest.MonkeyPatch) -> None:
    """All around is looked for once; then once for each image, in its directions alone."""
    seen_from = Mock(wraps=terrain_horizon)
    monkeypatch.setattr(attitude, "terrain_horizon", seen_from)
    site = small_site()
    images = [seen(moment, 0) for moment in (0, 1)]
    skyline_source(images, [camera()], site.raster, site.place, CENTERS[:1], SIGMA[:1], error=ERROR)
    assert [len(call.args[2]) == 3600 for call in seen_from.call_args_list] == [True, False, False]


def test_derivatives_of_the_term() -> None:
    given = source(0)
    spot = camera()
    random = np.random.default_rng(0)
    step = 1e-6

    def posed(change: torch.Tensor) -> list[PosedCamera]:
        found = []
        for c in (0, 1):
            turn, shift = change[6 * c : 6 * c + 3], change[6 * c + 3 : 6 * c + 6]
            rotation = rotation_from_vector(turn) @ given.rotation[c]
            slots = slice(6 * c, 6 * c + 3), slice(6 * c + 3, 6 * c + 6)
            none = torch.zeros(len(spot.params), 0).double()
            found.append(PosedCamera(spot, spot.params.detach(), rotation, given.center[c] + shift, none, *slots))
        return found

    rows = given.rows_at(posed(torch.zeros(12).double()), 12)
    for _ in range(3):
        way = torch.from_numpy(random.standard_normal(12))
        ends = [given.rows_at(posed(sign * step * way), 12)[-1] for sign in (1.0, -1.0)]
        torch.testing.assert_close((ends[0] - ends[1]) / (2 * step), way @ rows[:-1], rtol=1e-5, atol=1e-5)


def test_one_camera_with_a_skyline_is_a_rig() -> None:
    site = small_site()
    given = skyline_source([seen(0, 0)], [camera()], site.raster, site.place, CENTERS[:1], SIGMA[:1], error=ERROR)[0]
    place = MeasuredPosition(camera=0, point=CENTERS[0], sigma=SIGMA[0])
    result = solve_rig(RigData(cameras=(camera(),), names=("mast",), positions=(place,), skyline=given))
    assert station_mounting(result.stations(site.place), 0).heading_deg == pytest.approx(40.0, abs=0.06)


def test_a_skyline_without_a_place_is_refused() -> None:
    given = source(0)
    with pytest.raises(InputError, match="needs a frame on the Earth"):
        RigData(cameras=(camera(), camera()), names=("left", "right"), skyline=given)
    with pytest.raises(InputError, match="attitudes of 2 cameras"):
        RigData(cameras=(camera(),), names=("mast",), skyline=given)


def test_refusals_name_the_image() -> None:
    site = small_site()
    dark = SkylineImage(name="night.png", camera=0, image=np.zeros((270, 480)) + np.eye(270, 480))
    with pytest.raises(InputError, match=r"night\.png: the border"):
        skyline_source([dark], [camera()], site.raster, site.place, CENTERS[:1], SIGMA[:1])
