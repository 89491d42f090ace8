"""Rigs solved from stars: recovery, coverage, clocks, and what stars leave open."""

import dataclasses
import datetime
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import ran

from kcal import DegenerateError, InputError, Landmarks, RigOptions, load_rig, save_camera, solve_rig
from kcal.io.images import write_png
from kcal.lens import rotation_from_vector, vector_from_rotation
from kcal.locate import enu_from_cam
from kcal.stars.sky import StarCatalog, pole_in_enu
from scripts.check.stars import LOOKS, PLACE, TIME, night_camera, rendered, star_pixels, star_rig

CAMERA = night_camera(1600.0, (1920, 1080))
STRAIGHT = RigOptions(refraction=0.0, refraction_sigma=0.0)


def turn_error(found: Any, truth: torch.Tensor) -> torch.Tensor:
    relative = found.rotation[1] @ found.rotation[0].T
    return vector_from_rotation(relative @ (truth[1] @ truth[0].T).T)


@pytest.mark.slow
@pytest.mark.parametrize(("named", "seeds", "least", "most"), [(True, 12, 16, 66), (False, 2, 0.3, 23)])
def test_the_relative_attitude_has_its_sigma(named: bool, seeds: int, least: float, most: float) -> None:
    """χ² of the relative rotation over 3 degrees of freedom, the clock being drawn from its sigma."""
    squares = []
    for seed in range(seeds):
        late = float(np.random.default_rng(1000 + seed).normal(0, 0.5))
        data, truth, _ = star_rig(
            CAMERA, seed=seed, named=named, positions=named, clock=late, clock_sigma=0.5, faintest=4.5
        )
        found = solve_rig(data, STRAIGHT)
        error = turn_error(found, truth)
        squares.append(float(error @ torch.linalg.solve(found.relative_covariance()[:3, :3], error)))
        assert not found.left_out
    # χ² of 36 and of 6 degrees of freedom, all but one of a thousand times.
    assert least < sum(squares) < most


def test_an_offset_of_a_clock_is_in_the_sigma() -> None:
    sigmas = {}
    for stated in (0.0001, 1.0):
        data, _, _ = star_rig(CAMERA, seed=1, named=True, clock_sigma=stated)
        sigmas[stated] = solve_rig(data, STRAIGHT).sigma_rotation.norm()
    grown = math.sqrt(float(sigmas[1.0] ** 2 - sigmas[0.0001] ** 2))
    assert grown == pytest.approx(7.292e-5, rel=0.5)  # of a second; positions and matches tell some of it


def test_a_clock_that_drifts_is_found_and_in_the_sigma() -> None:
    """.2 s an hour over 5 h: as an unknown it is found, otherwise the rig is wrong by far more than it says."""
    squares = {}
    for stated in (0.0, 0.2):
        data, truth, _ = star_rig(
            CAMERA, seed=2, named=True, moments=12, faintest=4.0, clock_sigma=0.002, drift=0.2, drift_sigma=stated
        )
        found = solve_rig(data, STRAIGHT)
        error = turn_error(found, truth)
        squares[stated] = float(error @ torch.linalg.solve(found.relative_covariance()[:3, :3], error))
    assert squares[0.2] < 16.3 < squares[0.0]  # one in a thousand


@pytest.mark.parametrize(("seconds", "message"), [(20.0, "contradict the stars"), (3600.0, "time, zone and place")])
def test_landmarks_tell_a_wrong_time(seconds: float, message: str) -> None:
    """Of the stars' attitude and that by surveyed landmarks."""
    data, truth, center = star_rig(CAMERA, seed=3, named=True, faintest=4.5, matches=0)
    draw = np.random.default_rng(1)
    rays = torch.nn.functional.pad(torch.from_numpy(draw.uniform((-0.4, -0.2), (0.4, 0.2), (12, 2))), (0, 1), value=1.0)
    points = torch.from_numpy(draw.uniform(50, 950, (12, 1))) * rays @ truth[0]
    at = torch.stack([CAMERA.project((points - c) @ r.T)[0] for r, c in zip(truth, center, strict=True)], 1)
    marks = Landmarks(
        names=tuple(f"post {k}" for k in range(12)), points=points + torch.from_numpy(draw.normal(0, 0.02, (12, 3))),
        sigma=torch.full((12, 3), 0.02).double(), pixels=at + torch.from_numpy(draw.normal(0, 0.1, at.shape)),
        pixel_sigma=0.1,
    )  # fmt: skip
    turn = rotation_from_vector(torch.from_numpy(pole_in_enu(PLACE.lat)) * 7.292e-5 * seconds)
    stars = dataclasses.replace(data.stars, direction=data.stars.direction @ turn.T)
    wrong = dataclasses.replace(data, stars=stars, landmarks=marks)
    try:
        said = " ".join(solve_rig(wrong, STRAIGHT).warnings)
    except InputError as error:
        said = str(error)
    assert message in said


def test_stars_alone_say_what_is_missing() -> None:
    data, _, _ = star_rig(CAMERA, seed=1, named=False, positions=False, matches=0)
    with pytest.raises(DegenerateError, match="add matches of unknown range"):
        solve_rig(data, STRAIGHT)


def test_named_stars_need_a_frame_on_the_earth() -> None:
    with pytest.raises(InputError, match="need a frame on the Earth"):
        star_rig(CAMERA, seed=1, named=True, positions=False)


def test_wrong_names_and_an_aircraft_are_left_out() -> None:
    data, truth, _ = star_rig(CAMERA, seed=3, named=True)
    names, direction, pixels = data.stars.names, data.stars.direction.clone(), data.stars.pixels.clone()
    direction[[4, 9]] = direction[[9, 4]]
    pixels[20, 1] += torch.tensor([3.0, -2.0])
    data = dataclasses.replace(data, stars=dataclasses.replace(data.stars, direction=direction, pixels=pixels))
    found = solve_rig(data, STRAIGHT)
    assert {item.name for item in found.left_out} == {names[i] for i in (4, 9, 20)}
    assert all(item.source == "stars" for item in found.left_out)
    assert float(turn_error(found, truth).norm()) < 4 * float(found.sigma_rotation.norm())


@pytest.mark.slow
def test_the_command(tmp_path: Path) -> None:
    """Two pairs of rendered images, matches of unknown range and a taped baseline, on the Earth and without a place."""
    cameras = [night_camera(1100.0, (1280, 800)), night_camera(1101.0, (1280, 800))]
    catalog, files = StarCatalog.bundled(), [str(tmp_path / f"{side}.camera.json") for side in ("left", "right")]
    truth = torch.stack([enu_from_cam(*look).T for look in LOOKS])
    center = torch.stack([torch.zeros(3).double(), 10.0 * enu_from_cam(*LOOKS[0])[:, 0]])
    for side, camera in enumerate(cameras):
        save_camera(camera, files[side])
        folder = tmp_path / ("left", "right")[side]
        folder.mkdir()
        for minute in (0, 10):
            time = TIME + datetime.timedelta(minutes=minute)
            pixels, index = star_pixels(camera, LOOKS[side], time, faintest=6.0)
            image = rendered(camera, pixels, catalog.magnitude[index], seed=10 * side + minute)
            write_png(folder / f"{time:%Y-%m-%dT%H%M%S}.png", image)
    draw = np.random.default_rng(1)
    rays = torch.nn.functional.pad(torch.from_numpy(draw.uniform((-0.4, -0.2), (0.4, 0.2), (12, 2))), (0, 1), value=1.0)
    points = torch.from_numpy(draw.uniform(100, 1500, (12, 1))) * rays @ truth[0]
    at = torch.cat(
        [camera.project((points - c) @ r.T)[0] for camera, r, c in zip(cameras, truth, center, strict=True)], 1
    )
    lines = [",".join(map(str, row)) for row in (at + 0.1 * torch.from_numpy(draw.normal(size=at.shape))).tolist()]
    (tmp_path / "far.csv").write_text("\n".join(["left_u,left_v,right_u,right_v", *lines]))
    common = [
        "rig", *files, "--features", str(tmp_path / "far.csv"), "--baseline", "10.000±0.002", "--pixel-sigma", "0.1",
        "--refraction", "0±0",
    ]  # fmt: skip
    stars = ["--stars", str(tmp_path / "left"), str(tmp_path / "right"), "--json"]
    for more in (["--time", "name:Z", "--site", f"{PLACE.lat},{PLACE.lon},{PLACE.height}", "--dut1", "0"], []):
        done = ran(*common, *stars, *more, "-o", tmp_path / "rig.json")
        assert done.exit_code == 0, done.output
        rig = load_rig(tmp_path / "rig.json")
        error = vector_from_rotation(rig.right_from_left_rotation @ (truth[1] @ truth[0].T).T)
        assert float(error @ torch.linalg.solve(rig.covariance.matrix[-6:-3, -6:-3], error)) < 16
        assert float(error.norm()) < 1e-4
        assert (rig.mounting is not None) == bool(more)
        if more:
            assert rig.mounting.heading_deg == pytest.approx(LOOKS[0][0], abs=0.004)
    done = ran(*common[:3], "--baseline", "10±0.002", *stars, "-o", tmp_path / "no.json")
    assert "add matches of unknown range" in str(done.exception)
    assert not (tmp_path / "no.json").exists()
