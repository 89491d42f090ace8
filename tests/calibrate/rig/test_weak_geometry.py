"""Landmarks in a row, a plane or one place: rigs are refused or intervals widened; ordinary rigs are left alone."""

import dataclasses
import math

import pytest
import torch
from rig_scenes import CAMERAS, CENTER, NAMES, ROTATION, generator, landmarks, normal, posts, see, tensor
from torch import Tensor

from kcal import Camera, DegenerateError, Landmarks, Localizer, MeasuredPosition, Origin, RigData, RigOptions, solve_rig
from kcal.calibrate.rig.assess import OpenPlace, _first_order, _targets, open_place
from kcal.calibrate.rig.result import RigResult
from kcal.lens import CameraCalibration, LensModel
from kcal.locate import enu_from_cam
from kcal.rig import RigCovariance

HELD = RigOptions(intrinsics="fixed")
ORIGIN = Origin(lat=19.07, lon=72.87, height=14.0)
FAR = 1000.0


def box(size: tuple[float, float, float], middle: tuple[float, float, float], seed: int, count: int = 12) -> Tensor:
    """(count, 3) meters in the left camera's frame: right, down, forward."""
    draw = torch.rand(count, 3, dtype=torch.float64, generator=generator(seed)) - 0.5
    return draw * tensor(*size) + tensor(*middle)


def surveyed(points: Tensor, seed: int, *, mark: float = 0.3, survey: float = 0.05) -> Landmarks:
    """Points of the left camera's frame, marked and surveyed with noise."""
    points = points @ ROTATION[0] + CENTER[0]
    pixels = torch.stack([see(points, camera) for camera in (0, 1)], 1)
    seeds = (1000 + seed, 2000 + seed)
    return posts(points, pixels, noise=mark, error=survey, survey=survey, sigma=mark, seeds=seeds)


def solved(seen: Landmarks, options: RigOptions = HELD, sigma: float | None = None) -> RigResult:
    """The rig; `sigma` in meters of measured positions of the cameras, if there are any."""
    places = () if sigma is None else tuple(
        MeasuredPosition(camera=c, point=CENTER[c], sigma=torch.full((3,), sigma).double()) for c in (0, 1)
    )  # fmt: skip
    return solve_rig(RigData(cameras=CAMERAS[:2], names=NAMES[:2], landmarks=seen, positions=places), options)


def place(found: RigResult) -> OpenPlace:
    checked = open_place(found._solution, 0, 1)
    assert checked is not None
    return checked


def row(seed: int, high: float) -> Landmarks:
    return surveyed(box((800.0, high, 0.0), (0.0, 0.0, FAR), seed), seed)


class TestRefused:
    @pytest.mark.parametrize("high", [0.0, 40.0])
    @pytest.mark.parametrize("seed", [0, 1])
    def test_a_row(self, seed: int, high: float) -> None:
        with pytest.raises(DegenerateError, match=r"where right stands: ± .* m \(up and down .* nearly in one line"):
            solved(row(seed, high))

    def test_one_place(self) -> None:
        points = box((30.0, 20.0, 20.0), (150.0, 40.0, FAR), 3)
        with pytest.raises(DegenerateError, match="close together"):
            solved(surveyed(points, 3))

    @pytest.mark.slow
    def test_the_remedy_helps(self) -> None:
        found = solved(row(0, 0.0), sigma=0.05)
        assert found.warnings == ()
        assert place(found).share < 0.02

    def test_whoever_wants_to_keep_all_is_warned(self) -> None:
        found = solved(row(0, 40.0), dataclasses.replace(HELD, reject=False))
        (text,) = found.warnings
        assert "ranges could be anything" in text
        # Whoever gets the rig is warned, too.
        calibration = found.stereo().calibration
        assert calibration is not None
        assert calibration.warnings == found.warnings


class TestWidened:
    @pytest.mark.slow
    def test_intervals_contain_the_truth(self) -> None:
        """Walls that face the cameras: widened intervals contain the truth, first-order ones too seldom."""
        targets = box((0.9, 0.5, 0.0), (0.0, 0.0, 1.0), 5, 40) * torch.linspace(250.0, 5000.0, 40).double()[:, None]
        pixels = [see(targets @ ROTATION[0] + CENTER[0], camera) for camera in (0, 1)]
        far, both = targets.norm(dim=-1), torch.isfinite(torch.cat(pixels, -1)).all(-1)
        shares = []
        for seed in (0, 23, 24, 26):
            found = solved(surveyed(box((900.0, 450.0, 0.0), (0.0, 0.0, FAR), seed), seed))
            rig = found.stereo()
            known = rig.covariance
            assert known is not None
            (text,) = found.warnings
            assert "intervals were widened" in text
            assert "nearly in one plane" in text
            inside = []
            for widen in (1.0, 1.0 / math.sqrt(found.variance)):
                rig.covariance = RigCovariance(half=widen * known.half)
                localize = Localizer(rig.placed(origin=ORIGIN, heading_deg=0.0), pixel_sigma=0.1)
                answer = localize(*(value[both] for value in pixels))
                good = (answer.range_low <= far[both]) & (far[both] <= answer.range_high)
                inside.append(float(good.double().mean()))
            shares.append(inside)
        widened, plain = torch.tensor(shares).mean(0).tolist()
        assert len(shares) == 4
        assert widened > 0.93
        assert plain < widened - 0.02


class TestOrdinary:
    @pytest.mark.parametrize("seed", range(3))
    def test_nothing_is_said(self, seed: int) -> None:
        found = solved(landmarks(noise=0.2, error=0.02, seed=seed))
        assert found.warnings == ()
        assert found.variance == 1.0
        assert place(found).share < 0.05
        assert place(found).ratio < 1.0

    def test_a_turn_that_a_lens_undoes_says_nothing(self) -> None:
        """Tilts of the sensor, open by themselves, undo what a turn of the camera does to ranges."""
        spread = tensor(30, 30, 60, 60, 0, *[0.05, 0.1, 1.5e-3, 1.5e-3, 0.1], *[0.05] * 3, *[0.03] * 4, *[0.1] * 2)
        cameras = []
        for camera in CAMERAS[:2]:
            params = torch.cat([camera.params.detach(), torch.zeros(9).double()])
            rich = Camera(params, size=camera.size, model=LensModel.named("opencv14"))
            rich.calibration = CameraCalibration(covariance=torch.diag(spread.square()))
            cameras.append(rich)
        data = RigData(cameras=tuple(cameras), names=NAMES[:2], landmarks=landmarks(noise=0.05, error=0.02))
        found = solve_rig(data)
        assert found.warnings == ()
        assert place(found).ratio < 1.0

    def test_sigmas_are_those_of_the_localizer(self) -> None:
        found = solved(landmarks(noise=0.2, error=0.02))
        rig = found.stereo()
        targets = _targets(found._solution, 0, 1, 1.0 / 200.0)
        assert targets is not None
        localize = Localizer(rig.placed(origin=ORIGIN, heading_deg=0.0), pixel_sigma=0.1)
        for far in (200.0, 370.0, 900.0, 5000.0):
            pixels, good = rig(far * targets.rays)
            (left, right), good = pixels.unbind(-2), good.all(-1)
            wanted = localize(left, right).inverse_range_sigma[good]
            by_rig = targets.at(torch.full((len(targets.rays),), 1.0 / far).double()).square().sum(-1)
            # The variance by the marks is that at infinity.
            torch.testing.assert_close((targets.own + by_rig).sqrt()[good], wanted, rtol=0.03, atol=0.0)
            assert math.isfinite(float(wanted.max()))


def test_first_order_is_the_slope() -> None:
    """Of the inverse range at which a target is found from a place that is not known to have moved."""
    random = generator(1)
    rays = torch.nn.functional.normalize(torch.randn(5, 3, generator=random, dtype=torch.float64) + tensor(0, 0, 3))
    true, center = torch.tensor([0.1, 0.01]).double()[:, None, None], tensor(-10.0, 0.3, 0.5)
    moved = 0.1 * torch.randn(4, 3, generator=random, dtype=torch.float64)

    def seen_from(moved: Tensor) -> Tensor:
        sight = torch.nn.functional.normalize(rays - true[..., None] * (center + moved)[:, None], dim=-1)
        base = center - (sight @ center)[..., None] * sight
        return (base * rays).sum(-1) / base.square().sum(-1)

    step = 1e-5
    slope = (seen_from(step * moved) - seen_from(-step * moved)) / (2 * step)
    torch.testing.assert_close(_first_order(rays, true, center, moved), slope, rtol=1e-6, atol=1e-12)


def station(extent: tuple[float, float, float], seed: int, count: int = 6) -> tuple[RigData, Tensor]:
    """One camera that looks north from 3 m above the ground at landmarks 40 m away, and where it stands."""
    camera = Camera.build(focal=(1400, 1400), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
    center = tensor(0.0, 0.0, 3.0)
    # Walls are turned by 35 degrees, so that they have another pose with the turn reversed.
    turn = enu_from_cam(35.0 if extent[1] == 0.0 else 0.0) @ enu_from_cam(0.0).T
    points = box(extent, (0.0, 0.0, 1.0), seed, count) @ turn.T + tensor(0.0, 40.0, 0.0)
    pixels, _ = camera.project((points - center) @ enu_from_cam(0.0))
    noise = normal(pixels.shape, 100 + seed), normal(points.shape, 200 + seed)
    marks = Landmarks(
        names=tuple(f"post {i}" for i in range(count)), points=points + 0.02 * noise[1], pixel_sigma=0.3,
        sigma=torch.full_like(points, 0.02), pixels=(pixels + 0.3 * noise[0])[:, None],
    )  # fmt: skip
    return RigData(cameras=(camera,), names=("cam",), landmarks=marks), center


class TestOneCamera:
    @pytest.mark.parametrize(
        ("extent", "count", "text"),
        [
            ((14.0, 0.0, 0.0), 6, r"where cam stands: ± .* nearly in one line: turning the camera about that line"),
            ((2.5, 0.0, 1.75), 14, r"cam may stand in 2 places up to 4[0-9.]+ m apart, which fit alike"),
        ],
        ids=["line", "small wall"],
    )
    @pytest.mark.parametrize("seed", [0, 1])
    def test_refused(self, extent: tuple[float, float, float], count: int, text: str, seed: int) -> None:
        """Landmarks in a line determine no turn about it; a plane that is small looks alike from two places."""
        with pytest.raises(DegenerateError, match=text):
            solve_rig(station(extent, seed, count)[0], HELD)

    @pytest.mark.slow
    def test_others_are_not(self) -> None:
        """Spread landmarks, also flat ground, give a place within its error bars, however open it is."""
        shares = []
        for seed in range(4):
            for extent in ((12.0, 15.0, 3.0), (12.0, 15.0, 0.0), (14.0, 1.5, 1.0)):
                data, center = station(extent, seed, 8)
                result = solve_rig(data, HELD)
                assert not any("determine" in text for text in result.warnings)
                sigma = result.mounting_covariance()[:3, :3].diagonal().sqrt()
                shares.append(((result.center[0] - center).abs() < 1.96 * sigma).double().mean())
        assert float(torch.stack(shares).mean()) > 0.8
