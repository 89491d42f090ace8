import copy
import functools
import json
from pathlib import Path

import pytest
import torch
from locate_rigs import real_rig, spread_points, tensor
from torch import Tensor

from kcal import Camera, Landmarks, Localizer, MeasuredPosition, Origin, Rig, RigData, solve_rig
from kcal.errors import DegenerateError, FileError, InputError
from kcal.io.rig_file import load_pair, load_rig, save_rig
from kcal.lens import CameraCalibration
from kcal.locate import enu_from_cam, enu_to_geodetic, geodetic_to_enu
from kcal.locate.mounting import placed_rig, station_mounting
from kcal.rig import Mounting, RigCovariance, stated_mounting, station_rig
from scripts.shared.station_scenes import ORIGIN, marks, ring, targets

RIG = Path(__file__).parents[1] / "io" / "rig.json"


def survey(count: int = 4, seed: int = 0) -> tuple[Rig, RigData]:
    """Stations 5 km from the middle that see landmarks of their own, and few in common."""
    rig, generator = ring(count, 5000.0), torch.Generator().manual_seed(seed)
    groups = [targets(8, generator, 800.0)]
    for center in rig.center:
        share = 0.1 + 0.6 * torch.rand(6, 1, dtype=torch.float64, generator=generator)
        groups.append(center + share * (targets(6, generator, 1500.0) - center) - tensor(0.0, 0.0, 60.0))
    points = torch.cat(groups)
    seen = torch.zeros(len(points), count, dtype=torch.bool)
    seen[:8] = torch.rand(8, count, generator=generator) < 0.4
    for c in range(count):
        seen[8 + 6 * c : 14 + 6 * c, c] = True
    pixels = marks(rig, points)
    seen &= torch.stack([camera.inside(pixels[:, c]) for c, camera in enumerate(rig.each)], 1)
    pixels = pixels + 0.3 * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
    pixels = torch.where(seen[..., None], pixels, torch.nan)
    kept = seen.any(1)
    surveyed = points + 0.05 * torch.randn(points.shape, dtype=torch.float64, generator=generator)
    names = tuple(f"post {i}" for i in range(int(kept.sum())))
    sigma = torch.full((len(names), 3), 0.05, dtype=torch.float64)
    landmarks = Landmarks(names=names, points=surveyed[kept], sigma=sigma, pixels=pixels[kept])
    positions = tuple(
        MeasuredPosition(camera=c, point=center + 0.3, sigma=tensor(0.5, 0.5, 0.5))
        for c, center in enumerate(rig.center)
    )
    return rig, RigData(cameras=tuple(rig.each), names=rig.names, landmarks=landmarks, positions=positions)


@functools.cache
def solved(seed: int = 0) -> Rig:
    return solve_rig(survey(seed=seed)[1]).stations(ORIGIN)


@pytest.mark.slow
def test_stations_are_solved_from_landmarks_of_their_own_and_their_file_says_all() -> None:
    truth, found = survey()[0], solved()
    errors = torch.cat([found.center - truth.center, torch.zeros(len(found), 0)], 1)
    assert found.root is not None
    spread = torch.cat([found.root[:, found.pose_columns(c)] for c in range(len(found))], 1)
    variance = spread.square().sum(0).unflatten(0, (-1, 6))
    assert ((errors / variance[:, :3].sqrt()).abs() < 4.0).all()
    # A kilometer of lens and 0.3 px of noise: attitudes to some thousandths of a degree.
    assert variance[:, 3:].sqrt().rad2deg().max() < 0.02
    assert found.calibration is not None
    assert found.calibration.undetermined == ()


@pytest.mark.slow
def test_positions_from_solved_stations_are_inside_their_ellipses() -> None:
    squares = []
    for seed in range(4):
        truth = survey(seed=seed)[0]
        points = targets(50, torch.Generator().manual_seed(100 + seed))
        noise = 0.3 * torch.randn(50, len(truth), 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
        located = Localizer(solved(seed))(marks(truth, points) + noise)
        error = located.enu - points
        squares.append((error * torch.linalg.solve(located.covariance, error)).sum(-1))
    inside = float((torch.cat(squares) < 7.815).double().mean())
    # Four rigs, each with errors of its own.
    assert 0.80 < inside <= 1.0


def test_one_camera_alone() -> None:
    truth, data = survey(count=2)
    marks_of_one = data.landmarks
    assert marks_of_one is not None
    seen = marks_of_one.pixels[:, 0].isfinite().all(-1)
    alone = Landmarks(
        names=tuple(name for name, own in zip(marks_of_one.names, seen.tolist(), strict=True) if own),
        points=marks_of_one.points[seen], sigma=marks_of_one.sigma[seen], pixels=marks_of_one.pixels[seen, :1],
    )  # fmt: skip
    result = solve_rig(RigData(cameras=data.cameras[:1], names=("mast",), landmarks=alone))
    stands = station_mounting(result.stations(ORIGIN), 0)
    there = station_mounting(truth, 0)
    assert stands.covariance is not None
    assert abs(stands.heading_deg - there.heading_deg) < 5 * float(stands.covariance[5, 5].sqrt().rad2deg())
    assert abs(stands.origin.height - there.origin.height) < 5 * float(stands.covariance[2, 2].sqrt())
    few = Landmarks(names=alone.names[:3], points=alone.points[:3], sigma=alone.sigma[:3], pixels=alone.pixels[:3])
    with pytest.raises(DegenerateError, match="mast"):
        solve_rig(RigData(cameras=data.cameras[:1], names=("mast",), landmarks=few))


def test_file_of_many_cameras(tmp_path: Path) -> None:
    rig = solved()
    path = save_rig(rig, tmp_path / "rig.json")
    again = load_rig(path)
    assert again.names == rig.names
    assert again.origin == ORIGIN
    assert torch.equal(again.rotation, rig.rotation)
    assert again.root is not None
    assert torch.equal(again.root, rig.root)
    assert again.calibration == rig.calibration
    with pytest.raises(FileError, match="a rig of 4 cameras; a rig of two is needed here"):
        load_pair(path)
    assert Localizer.from_file(path).rig.names == rig.names
    content = json.loads(path.read_text())
    content["poses"].pop()
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match="4 names, 4 cameras and 3 poses"):
        load_rig(path)


def test_rigs_of_two_load() -> None:
    two = load_rig(RIG)
    assert two.names == ("left", "right")
    assert float((two.center[1] - two.center[0]).norm()) == pytest.approx(float(load_rig(RIG).baseline))


@pytest.mark.parametrize("mounted", [True, False])
def test_a_stereo_rig_gives_the_same_positions_and_covariances(tmp_path: Path, mounted: bool) -> None:
    rig, generator = real_rig(), torch.Generator().manual_seed(1)
    size = rig.left.values.shape[-1] + rig.right.values.shape[-1] + 6
    scale = torch.cat([torch.full((size - 6,), 1e-5), tensor(1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.01)])
    half = torch.randn(8, size + 7, dtype=torch.float64, generator=generator)
    half *= torch.cat([scale, tensor(0.1, 0.1, 0.2, 1e-4, 2e-4, 3e-4, 0.05)])
    rig.covariance = RigCovariance(half=half[:, :size])
    if mounted:
        rig.mounting = Mounting(origin=ORIGIN, heading_deg=35.0, pitch_deg=-1.0, roll_deg=0.5, refraction=0.1)
        rig.relative_root = half
    left, right = rig(spread_points(torch.linspace(80.0, 400.0, 5, dtype=torch.float64)))[0].unbind(-2)
    right = right + tensor(0.05, 0.0)
    many = Localizer(load_rig(save_rig(rig, tmp_path / "rig.json")))
    found = many(torch.stack([left, right], 1))
    if mounted:
        other = Localizer(rig)(left, right)
        assert torch.allclose(found.geodetic, other.geodetic, atol=1e-6)
        # Here ranges count from where the left camera is said to stand, 0.1 to 0.2 m off.
        assert torch.allclose(found.range_high, other.range_high, atol=0.3)
    else:
        # Without a place on the Earth there are straight lines, in the left camera's frame.
        other = Localizer(rig.placed(origin=ORIGIN, heading_deg=0.0, refraction=0.0, refraction_sigma=0.0))(left, right)
        assert torch.allclose(found.enu, other.enu @ tensor([1, 0, 0], [0, 0, 1], [0, -1, 0]), atol=0.01)
    assert (found.enu.norm(dim=-1) - other.enu.norm(dim=-1)).abs().max() < 0.01
    if mounted:
        # The same errors, which also weigh the marks here: no direction is worse for it.
        gained = torch.linalg.eigvalsh(other.covariance - found.covariance)
        assert (gained[:, 0] > -1e-3 * torch.linalg.eigvalsh(other.covariance)[:, -1]).all()
        rig.covariance = None
        found = Localizer(rig, weights="all")(torch.stack([left, right], 1))
        other = Localizer(rig)(left, right)
        scale = other.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        off = (found.covariance - other.covariance) / scale[:, :, None] / scale[:, None]
        assert off.abs().max() < 1e-3


def test_a_placed_rig_and_its_stations_stand_alike() -> None:
    result = solve_rig(survey(count=2)[1])
    stereo, stations = placed_rig(result, ORIGIN), result.stations(ORIGIN)
    ours, theirs = station_mounting(stations, 0), stereo.mounting
    assert theirs is not None
    assert ours.heading_deg == pytest.approx(theirs.heading_deg, abs=1e-9)
    assert torch.allclose(ours.covariance, theirs.covariance, rtol=1e-9, atol=1e-18)


# Stations of which the pose is known beforehand.

APART = (Origin(lat=46.0, lon=7.0, height=1500.0), Origin(lat=46.4, lon=7.5, height=900.0))


def placed(lens: Camera, sigma: float = 0.0) -> Rig:
    """One lens at two places some 60 km apart, each of which looks at what is between them from its own vertical."""
    stands = [
        stated_mounting(APART[0], heading_deg=(62.0, sigma), pitch_deg=(5.0, sigma), roll_deg=(2.0, sigma),
                        sigma_m=(100.0 * sigma, 100.0 * sigma, 200.0 * sigma)),
        stated_mounting(APART[1], heading_deg=(200.0, 2 * sigma), pitch_deg=(12.0, sigma), roll_deg=(-3.0, 3 * sigma)),
    ]  # fmt: skip
    return station_rig({"west": lens, "east": lens}, stands, refraction=0.0, refraction_sigma=0.0)


def seen_from_each(lens: Camera, point: Tensor, stands: list[Mounting]) -> Tensor:
    """Pixels (V, 2) of a geodetic place, by the attitude of each camera at its own vertical alone."""
    pixels = []
    for stand in stands:
        enu = geodetic_to_enu(point, stand.origin)
        ray = enu @ enu_from_cam(stand.heading_deg, stand.pitch_deg, stand.roll_deg)
        pixels.append(lens.project(ray[None])[0][0])
    return torch.stack(pixels)


def test_known_poses_have_each_its_own_vertical() -> None:
    lens = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), coefficients=[-0.1, 0.01, 0, 0])
    rig = placed(lens)
    assert 55_000.0 < float((rig.center[1] - rig.center[0]).norm()) < 65_000.0
    stands = [station_mounting(rig, camera) for camera in range(2)]
    assert stands[1].origin.lat == pytest.approx(46.4, abs=1e-9)
    assert (stands[1].heading_deg, stands[1].pitch_deg, stands[1].roll_deg) == pytest.approx(
        (200.0, 12.0, -3.0), abs=1e-9
    )
    airplane = tensor(46.15, 7.4, 9000.0)
    pixels = seen_from_each(lens, airplane, stands)
    assert all(bool(lens.inside(pixel)) for pixel in pixels)
    located = Localizer(rig)(pixels[None])
    here = geodetic_to_enu(airplane, APART[0])
    assert float((located.enu[0] - here).norm()) < 1e-3
    # With the west's vertical in the east, the airplane would be hundreds of meters higher or lower.
    level = enu_from_cam(200.0, 12.0, -3.0).T
    wrong = Rig(rig.each, rig.names, torch.stack([rig.rotation[0], level]), center=rig.center, origin=rig.origin)
    assert float((Localizer(wrong)(pixels[None]).enu[0] - here).norm()) > 100.0


@pytest.mark.parametrize("count", [1, 2])
def test_errors_of_known_poses_are_those_of_positions(count: int) -> None:
    """Of an airplane that two cameras see, and of a place whose height is known and one: scatter is as it is told."""
    lens = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), coefficients=[-0.1, 0.01, 0, 0])
    nominal = [tensor(62.0, 5.0, 2.0), tensor(200.0, 12.0, -3.0)] if count == 2 else [tensor(62.0, -20.0, 2.0)]
    angle = 0.05 * tensor([1.0, 1.0, 1.0], [2.0, 1.0, 3.0])[:count]
    spread = tensor([5.0, 5.0, 10.0], [0.0, 0.0, 0.0])[:count]
    thing = tensor(46.15, 7.4, 9000.0) if count == 2 else tensor(46.008, 7.02, 600.0)

    def stands(angles: list[Tensor], places: list[Origin], sigma: Tensor) -> list[Mounting]:
        return [
            stated_mounting(place, heading_deg=(h, s[0]), pitch_deg=(p, s[1]), roll_deg=(r, s[2]), sigma_m=tuple(m))
            for (h, p, r), place, s, m in zip(
                map(Tensor.tolist, angles), places, sigma.tolist(), spread.tolist(), strict=True
            )
        ]

    lenses = dict.fromkeys(("west", "east")[:count], lens)
    rig = station_rig(lenses, stands(nominal, [*APART[:count]], angle), refraction=0.0, refraction_sigma=0.0)
    drawn, generator = [], torch.Generator().manual_seed(0)
    for _ in range(300):
        turned, moved = torch.randn(2, count, 3, dtype=torch.float64, generator=generator)
        places = [Origin.at(enu_to_geodetic(m * by, at)) for m, by, at in zip(moved, spread, APART, strict=False)]
        truth = stands([one + t * s for one, t, s in zip(nominal, turned, angle, strict=True)], places, angle)
        drawn.append(seen_from_each(lens, thing, truth))
    height = torch.full((300,), float(thing[2])).double() if count == 1 else None
    located = Localizer(rig, pixel_sigma=1e-3)(torch.stack(drawn), height=height, height_sigma=1e-3)
    assert not located.status.any()
    free = 3 if count == 2 else 2
    error, covariance = located.enu - geodetic_to_enu(thing, APART[0]), located.covariance[:, :free, :free]
    squares = (error[:, :free] * torch.linalg.solve(covariance, error[:, :free])).sum(-1)
    # The mean of 300 chi-squares, ± 0.14 or 0.12.
    assert float(squares.mean()) == pytest.approx(free, abs=0.4)


def test_a_lens_at_two_places_errs_alike() -> None:
    lens = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
    variance = torch.diag(tensor(4.0, 4.0, 1.0, 1.0, 0.0))
    lens.calibration = CameraCalibration(covariance=variance)
    rig = placed(lens)
    assert rig.root is not None
    covariance = rig.root.T @ rig.root
    assert torch.allclose(covariance[:5, :5], variance)
    assert torch.allclose(covariance[:5, 5:10], variance)
    other = copy.deepcopy(lens)
    rig = station_rig({"a": lens, "b": other}, [stated_mounting(place, heading_deg=(0.0, 1.0), pitch_deg=(0.0, 1.0))
                                                for place in APART])  # fmt: skip
    assert rig.root is not None
    covariance = rig.root.T @ rig.root
    assert torch.allclose(covariance[5:10, 5:10], variance)
    assert not covariance[:5, 5:10].any()
    with pytest.raises(InputError, match="one for each"):
        station_rig({"a": lens}, [])
    with pytest.raises(InputError, match="sigmas"):
        stated_mounting(APART[0], heading_deg=(0.0, -1.0), pitch_deg=(0.0, 1.0))
