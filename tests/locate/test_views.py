"""Marks of any number of cameras: long tables as they are read, and the positions and texts that come of them.

Rows of a filter: against the rig's projection, and against what fits points to their optimum.
"""

import math
from pathlib import Path

import pytest
import torch
from locate_rigs import tensor

from kcal import Camera, FileError, InputError, Localizer, Origin, PositionStatus, Rig, locate_points
from kcal.locate import enu_from_cam, enu_to_geodetic, write_positions
from kcal.locate.marks import Marks, is_long, read_marks
from kcal.locate.views import shared_pixels
from kcal.pipeline.measurements import ALONE_M, known_views, sightings
from kcal.rig import Survey, match_landmarks, read_features
from kcal.watch.turned import seen_again
from scripts.shared.station_scenes import ORIGIN, marks, ring, targets

NAMES = ("a", "b", "c")


def table(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "marks.csv"
    path.write_text(text)
    return path


class TestTables:
    def test_lines_of_one_name_and_time_belong_together(self, tmp_path: Path) -> None:
        text = ("name,camera,u,v,time,sigma,kind\nmast,a,10,20,0,0.5,steel\nmast,c,30,40,0,,wood\nmast,b,1,2,1,0.25,\n"
                "mill,b,5,6,1,2,x\n")  # fmt: skip
        path = table(tmp_path, text)
        assert is_long(path)
        views = read_marks(path, NAMES)
        # A name that is seen at two moments needs its time, another does not.
        assert views.names == ("mast 0", "mast 1", "mill")
        nan = math.nan
        wanted = tensor(
            [[10, 20], [nan, nan], [30, 40]], [[nan, nan], [1, 2], [nan, nan]], [[nan, nan], [5, 6], [nan, nan]]
        )
        torch.testing.assert_close(views.pixels, wanted, equal_nan=True, rtol=0, atol=0)
        sigma = tensor([0.5, nan, nan], [nan, 0.25, nan], [nan, 2.0, nan])
        torch.testing.assert_close(views.sigma, sigma, equal_nan=True, rtol=0, atol=0)
        assert views.sigmas(0.3)[0].nan_to_num(nan=-1.0).tolist() == [0.5, -1.0, 0.3]
        assert views.extras == {"time": ["0", "1", "1"], "kind": ["steel", "", "x"]}

    def test_a_name_twice_without_times_is_one_thing(self, tmp_path: Path) -> None:
        views = read_marks(table(tmp_path, "name,camera,u,v\nmast,a,10,20\nmast,b,1,2\n"), NAMES)
        assert views.names == ("mast",)
        assert views.extras == {}
        assert views.pixels[0, :2].tolist() == [[10.0, 20.0], [1.0, 2.0]]

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("name,camera,u,v\nmast,d,1,2\n", r"no camera is named 'd'; they are a, b, c"),
            ("name,camera,u,v\nmast,a,1,2\nmill,a,1,2\nmast,a,1,2\n", r"line 4.*'mast' was marked in a before"),
            ("name,camera,u,v\nmast,a,1,x\n", "pixel coordinate"),
            ("name,camera,u,v,sigma\nmast,a,1,2,-1\n", "sigma"),
            ("name,left_u,left_v,right_u,right_v\nmast,1,2,3,4\n", "marks of 3 cameras need the columns"),
        ],
    )
    def test_refused(self, text: str, message: str, tmp_path: Path) -> None:
        with pytest.raises(FileError, match=message):
            read_marks(table(tmp_path, text), NAMES)

    def test_marks_of_other_cameras_are_skipped_on_request(self, tmp_path: Path) -> None:
        path = table(tmp_path, "name,camera,u,v\nmast,d,1,2\nmast,a,3,4\n")
        assert read_marks(path, NAMES, others=True).pixels[0, 0].tolist() == [3.0, 4.0]
        with pytest.raises(FileError, match="no mark of b"):
            read_marks(path, ("b",), others=True)

    def test_a_table_of_pairs(self, tmp_path: Path) -> None:
        path = table(tmp_path, "name,left_u,left_v,right_u,right_v\nmast,1,2,3,4\nmill,5,6,7,8\n")
        assert not is_long(path)
        views = read_marks(path, ("left", "right"))
        assert views.names == ("mast", "mill")
        assert views.pixels.tolist() == [[[1, 2], [3, 4]], [[5, 6], [7, 8]]]

    def test_features_have_ranges(self, tmp_path: Path) -> None:
        text = ("name,camera,u,v,range,range_sigma,beyond\nmast,a,1,2,500,10,\nmast,b,3,4,,,\nmill,a,5,6,,,\n"
                "hill,a,5,6,,,inf\n")  # fmt: skip
        found = read_features(table(tmp_path, text), 0.4, NAMES)
        assert found.names == ("mast", "mill", "hill")
        assert found.each_sigma.nan_to_num().tolist() == [[0.4, 0.4, 0.0], [0.4, 0.0, 0.0], [0.4, 0.0, 0.0]]
        assert found.inverse_range.tolist() == [1 / 500, 0.0, 0.0]
        assert found.inverse_range_sigma[:2].tolist() == [10 / 500**2, math.inf]
        assert 0.0 < float(found.inverse_range_sigma[2]) < 1e-6

    def test_places_are_matched_by_name(self) -> None:
        pixels = torch.arange(12.0).double().reshape(3, 2, 2)
        sigma = tensor([0.5, math.nan], [math.nan, math.nan], [1.0, 2.0])
        views = Marks(("mast", "mill", "post"), pixels, sigma=sigma)
        survey = Survey(
            ("post", "lone", "mast"), torch.arange(9.0).double().reshape(3, 3), torch.ones(3, 3).double(), None
        )
        found = match_landmarks(survey, views, views.sigmas(0.3))
        landmarks = found.landmarks
        assert landmarks.names == ("post", "mast")
        assert landmarks.points.tolist() == [[0, 1, 2], [6, 7, 8]]
        assert torch.equal(landmarks.pixels, pixels[[2, 0]])
        assert torch.as_tensor(landmarks.pixel_sigma).tolist() == [[1.0, 2.0], [0.5, 0.3]]
        assert found[1:] == (("lone",), ("mill",))
        with pytest.raises(InputError, match="must be the same in both files"):
            match_landmarks(Survey(("x",), torch.zeros(1, 3).double(), torch.ones(1, 3).double(), None), views, 0.3)


class TestPositions:
    RIG = ring(4, 5000.0)

    def views(self, **changes: object) -> tuple[torch.Tensor, Marks]:
        points = targets(5, torch.Generator().manual_seed(1))
        pixels = marks(self.RIG, points)
        pixels[1, 3] = math.nan
        pixels[2, :3] = math.nan
        # Forty pixels: what a wrong mark is.
        pixels[3, 1, 0] += 40.0
        pixels[4] = math.nan
        return points, Marks(tuple(f"thing {i}" for i in range(5)), pixels, extras={"time": list("01234")})

    def test_positions_and_what_is_said_of_them(self) -> None:
        points, views = self.views()
        found = locate_points(self.RIG, views)
        status = [position.status for position in found.positions]
        assert status == [
            PositionStatus.OK, PositionStatus.OK, PositionStatus.BEARING_ONLY, PositionStatus.OK,
            PositionStatus.NOT_FINITE,
        ]  # fmt: skip
        enu = torch.tensor([found.positions[i].enu for i in (0, 1, 3)], dtype=torch.float64)
        assert float((enu - points[[0, 1, 3]]).norm(dim=-1).max()) < 0.05
        extras = found.columns.extras
        names = self.RIG.names
        assert extras["time"] == list("01234")
        assert extras["cameras"][0] == " ".join(names)
        assert extras["cameras"][1] == " ".join(names[:3])
        assert extras["cameras"][3] == " ".join((names[0], *names[2:]))
        assert extras["left_out"] == ["", "", "", names[1], ""]
        reason = found.columns.reasons[3]
        assert reason.startswith(f"left out: the mark in {names[1]} contradicts the others (")
        assert not reason.endswith("; ")
        # 40 px against .3 px, shared with the others.
        assert 50 < float(reason.split("(")[1].split(" ")[0]) < 134
        assert "only the bearing is known" in found.columns.reasons[2]
        assert found.columns.reasons[4] == "no camera has a mark"
        misfits = dict(part.split("=") for part in extras["misfit_sigmas"][3].replace("tower ", "tower").split())
        assert max(misfits, key=lambda name: float(misfits[name])) == "tower2"
        assert found.included == ("marks",)
        assert found.origin == ORIGIN
        assert found.geoid is None

    def test_ranges_and_bearings_are_from_the_first_camera_at_its_own_vertical(self) -> None:
        points, views = self.views()
        position = locate_points(self.RIG, views).positions[1]
        center = self.RIG.center[0]
        assert position.range_m == pytest.approx(float((points[1] - center).norm()), rel=1e-4)
        # Azimuths at the station and here differ by the convergence of meridians, 5 km · tan 45° / 6371 km.
        east, north, _ = (points[1] - center).tolist()
        flat = math.degrees(math.atan2(east, north)) % 360.0
        lon = float(enu_to_geodetic(center, ORIGIN)[1]) - ORIGIN.lon
        assert position.azimuth_deg == pytest.approx(flat + lon * math.sin(math.radians(45.0)), abs=2e-3)

    def test_noise_of_marks_by_table_and_by_default(self) -> None:
        _, views = self.views()
        plain = locate_points(Localizer(self.RIG, pixel_sigma=0.3), views)
        twice = locate_points(Localizer(self.RIG, pixel_sigma=0.6), views)
        stated = views._replace(sigma=torch.full((5, 4), 0.6).double())
        tabled = locate_points(Localizer(self.RIG, pixel_sigma=0.3), stated)
        sigma = [found.positions[0].cep50_m for found in (plain, twice, tabled)]
        assert sigma[1] == pytest.approx(2.0 * sigma[0], rel=1e-3)  # type: ignore[operator]
        assert sigma[2] == pytest.approx(sigma[1], rel=1e-6)

    def test_a_height_places_what_one_camera_saw(self) -> None:
        points, views = self.views()
        height = float(enu_to_geodetic(points[2], ORIGIN)[2])
        found = locate_points(self.RIG, views, height=(height, 0.5)).positions[2]
        assert found.status == PositionStatus.OK
        assert found.enu is not None
        assert float((torch.tensor(found.enu).double() - points[2]).norm()) < 1.0
        wider = locate_points(self.RIG, views, height=(height, 5.0)).positions[2]
        assert wider.cep95_m is not None
        assert found.cep95_m is not None
        assert wider.cep95_m > 2.0 * found.cep95_m

    def test_a_rig_without_a_place_has_positions_in_its_own_frame(self, tmp_path: Path) -> None:
        straight = [Rig(list(self.RIG.each), self.RIG.names, self.RIG.rotation, center=self.RIG.center,
                        origin=origin, refraction=0.0) for origin in (None, ORIGIN)]  # fmt: skip
        bare, placed = (locate_points(rig, self.views()[1]) for rig in straight)
        assert bare.origin is None
        torch.testing.assert_close(bare.enu, placed.enu, equal_nan=True)
        ranges = [[position.range_m for position in found.positions] for found in (bare, placed)]
        assert ranges[0] == pytest.approx(ranges[1], nan_ok=True)
        one = bare.positions[0]
        assert (one.status, one.lat, one.height, one.azimuth_deg, one.cep95_m) == (PositionStatus.OK, *[None] * 4)
        assert one.covariance == placed.positions[0].covariance
        head, first, *_ = write_positions(tmp_path / "own.csv", bare).read_text().splitlines()
        assert head.startswith("name,status,reason,frame,x_m,y_m,z_m,range_m,")
        assert "cov_xz_m2" in head
        assert ',"x, y, z of the rig",' in first
        for name in ("own.geojson", "own.kml", "own.cot", "own.geojsonl"):
            with pytest.raises(InputError, match=rf"{name}: this rig has no place on the Earth.* or write .csv"):
                write_positions(tmp_path / name, bare)
        assert [path.name for path in tmp_path.iterdir()] == ["own.csv"]
        with pytest.raises(InputError, match="no place on the Earth"):
            locate_points(straight[0], self.views()[1], height=(3.0, 1.0))


def test_things_that_are_marked_again() -> None:
    then = Marks.of_pair(("a", "b", "d"), tensor([1, 2], [3, 4], [5, 6]), tensor([7, 8], [9, 10], [11, 12]))
    now = Marks.of_pair(("d", "c", "a"), tensor([21, 22], [23, 24], [25, 26]), tensor([27, 28], [29, 30], [31, 32]))
    found = seen_again(then, now, 0.4)
    assert found.names == ("a", "d")
    assert found.pixels[0].tolist() == [[1, 2], [7, 8], [25, 26], [31, 32]]
    assert found.pixels[1].tolist() == [[5, 6], [11, 12], [21, 22], [27, 28]]
    assert found.inverse_range.tolist() == [0.0, 0.0]
    assert found.inverse_range_sigma.tolist() == [math.inf] * 2
    assert found.each_sigma.tolist() == [[0.4] * 4] * 2
    stated = then._replace(sigma=tensor([0.1, 0.2], [1, 1], [math.nan, 0.3]))
    assert seen_again(stated, now, 0.4).each_sigma.tolist() == [[0.1, 0.2, 0.4, 0.4], [0.4, 0.3, 0.4, 0.4]]
    with pytest.raises(InputError, match="no name is in both"):
        seen_again(then, Marks.of_pair(("x",), tensor([1, 2]), tensor([1, 2])), 0.4)


def mixed_stations() -> Rig:
    """Three cameras of two lens models, 1.5 km apart, with errors of attitude, lens and refraction."""
    curved = Camera.build(focal=(2000, 2010), center=(960, 540), size=(1920, 1080), coefficients=[-0.2, 0.05, 1e-3])
    plain = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
    look = torch.stack([enu_from_cam(heading).T for heading in (0.0, 345.0, 15.0)])
    places = torch.tensor([[0.0, 0.0, 30.0], [1500.0, 0.0, 40.0], [-1500.0, 0.0, 35.0]], dtype=torch.float64)
    origin = Origin(lat=45.0, lon=6.0, height=100.0)
    rig = Rig([curved, curved, plain], ["a", "b", "c"], look, center=places, origin=origin, refraction=0.0)
    lens = torch.zeros(3, rig.quantities, dtype=torch.float64)
    lens[0, 0], lens[1, 5], lens[2, sum(rig.sizes[:2]) + 1], lens[2, -1] = 0.5, 1e-3, 0.7, 0.02
    rig.root = torch.cat([rig.with_errors(attitude_deg=0.01), lens])
    return rig


def test_rows_are_those_of_the_rig() -> None:
    rig = mixed_stations()
    localize = Localizer(rig)
    points = torch.tensor([[0.0, 5000.0, 100.0], [300.0, 4000.0, 50.0], [-200.0, 6000.0, 80.0]], dtype=torch.float64)
    pixels, seen = rig(points)
    assert bool(seen.all())
    seen[1, 0], seen[2, :2] = False, False
    mix = torch.randn(6, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    covariance = (mix @ mix.T + torch.eye(6)).expand(3, 6, 6)
    posed, common = localize.posed, localize.common
    marks = torch.where(seen[..., None], pixels + torch.tensor([0.3, 0.0]), torch.nan)
    found = sightings(known_views(posed, common), marks, seen, covariance, torch.zeros(3, 3).double())
    assert found.anchor.tolist() == [0, 1, 2]
    assert found.alone.tolist() == [False, False, True]
    assert bool(found.usable.all())
    torch.testing.assert_close(float(found.inverse[2]) * ALONE_M, 1.0)
    # Pixels at the place that rows are linear around, and where it moves.
    steps = torch.cat([torch.zeros(1, 3), torch.eye(3)]).double() * torch.tensor([1e-6, 1e-6, 1e-9])
    first, second, _ = found.by_ray
    around = [
        rig((found.place + (found.direction + a * first + b * second) / (found.inverse + c)).T)[0]
        for a, b, c in steps.tolist()
    ]
    there = seen[..., None]
    slopes = [
        torch.where(there, (one - around[0]) / steps[axis, axis - 1], 0.0) for axis, one in enumerate(around[1:], 1)
    ]
    assert common is not None
    at = found.place.T, found.direction.T, found.inverse
    shared = shared_pixels(posed, common, at, seen, torch.ones(()).double())
    off = torch.where(there, marks - around[0], 0.0).flatten(1)
    changes = [off, *(slope.flatten(1) for slope in slopes), *(-shared).movedim(-1, 1)]
    # Rows have unit noise: their products are those of pixels, weighed by the inverse covariance of what was seen.
    both = seen.repeat_interleave(2, -1)
    whole = torch.where(both[:, :, None] & both[:, None], covariance, torch.eye(6).double())
    rows = [found.value, *found.late.sum(0).unbind(1), *found.shared.unbind(1)]
    wanted = torch.stack(changes, -1)
    wanted = wanted.mT @ torch.linalg.solve(whole, wanted)
    given = torch.stack(rows, -1).movedim(1, 0)
    scale = wanted.diagonal(dim1=-2, dim2=-1).sqrt().clamp_min(1e-3)
    scale = scale[:, :, None] * scale[:, None]
    torch.testing.assert_close(given.mT @ given / scale, wanted / scale, rtol=0, atol=2e-3)
    assert not bool(given[2, :4].any())
