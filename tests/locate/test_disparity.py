"""Ranges from disparities, errors against a truth, and rows of a file that grows."""

import datetime
import json
import math
from functools import partial

import numpy as np
import pytest
import torch
from locate_rigs import located_pairs, pinhole_rig, real_rig, spread_points, tensor

from kcal import InputError, Localizer, Origin, PositionStatus
from kcal.lens import StereoRectification
from kcal.locate import DisparityRanges
from kcal.locate.export import APPENDED, appended
from kcal.locate.positions import interval_coverage, position_errors
from kcal.locate.views import fit_pairs

ORIGIN = Origin(lat=19.0, lon=72.0, height=10.0)
STRAIGHT = {"refraction": 0.0, "refraction_sigma": 0.0}
RIG = pinhole_rig()


class TestDisparities:
    @pytest.mark.parametrize("rig", [pinhole_rig(), real_rig()], ids=["pinhole", "lenses"])
    def test_single_pixels(self, rig) -> None:  # type: ignore[no-untyped-def]
        """Ranges of the points themselves; sigma r² / (f b) of the disparity's, and the interval around."""
        points = spread_points(torch.tensor([60.0, 150.0, 400.0, 900.0], dtype=torch.float64))
        rectify = StereoRectification(rig)
        there = points @ rectify.rotation
        pixels, _ = rectify.camera.project(there)
        disparity = rectify.camera.focal[0].detach() * rig.baseline / there[:, 2]
        found = DisparityRanges(rectify, disparity_sigma=0.4).at(pixels, disparity)
        assert bool(found.valid.all())
        far = points.norm(dim=-1)
        torch.testing.assert_close(found.range, far, rtol=1e-6, atol=0)
        torch.testing.assert_close(found.sigma, 0.4 * far / disparity, rtol=0.06, atol=0)
        assert bool(((found.low < far) & (far < found.high)).all())
        # 1.96 sigma of a near point to each side.
        assert float(found.high[0] - found.low[0]) == pytest.approx(2 * 1.96 * float(found.sigma[0]), rel=0.05)
        twice = DisparityRanges(rectify, disparity_sigma=0.8).at(pixels, disparity)
        torch.testing.assert_close(twice.sigma[:2], 2.0 * found.sigma[:2], rtol=0.02, atol=0)

    def test_what_has_no_range(self) -> None:
        ranges = DisparityRanges(StereoRectification(RIG))
        found = ranges.at(tensor([960.0, 540.0]).expand(5, 2), tensor(16.0, 0.0, -1.0, math.nan, math.inf))
        assert found.valid.tolist() == [True, False, False, False, False]
        assert bool(found.range[1:].isinf().all())
        assert bool(found.sigma[1:].isinf().all())
        assert bool(found.low[1:].isnan().all())
        assert bool(found.high[1:].isnan().all())
        assert float(found.range[0]) == pytest.approx(1000.0, rel=1e-3)

    def test_a_whole_image_is_its_pixels(self) -> None:
        rectify = StereoRectification(RIG, size=(32, 18))
        ranges = DisparityRanges(rectify)
        width, height = rectify.camera.size
        disparity = 0.2 + torch.rand(2, height, width, generator=torch.Generator().manual_seed(1))
        disparity[0, 3, 5] = math.nan
        found = ranges(disparity)
        assert found.range.shape == (2, height, width)
        assert not bool(found.valid[0, 3, 5])
        single = ranges.at(tensor([5.0, 3.0], [7.0, 2.0]), disparity[1][[3, 2], [5, 7]].double())
        torch.testing.assert_close(found.range[1][[3, 2], [5, 7]], single.range)
        torch.testing.assert_close(found.sigma[1][[3, 2], [5, 7]], single.sigma)
        for wrong in (disparity[0].long(), disparity[0, 1:], disparity[0, :, 1:]):
            with pytest.raises(InputError, match="disparity"):
                ranges(wrong)
        for sigma in (0.0, math.inf, math.nan):
            with pytest.raises(InputError, match="disparity_sigma"):
                DisparityRanges(rectify, disparity_sigma=sigma)

    def test_arrays_and_sixteenths_of_a_pixel(self) -> None:
        """cv2.StereoSGBM returns int16, 16 times the disparity: ranges would be 16 times too small."""
        rectify = StereoRectification(RIG, size=(32, 18))
        ranges, pixels, found = DisparityRanges(rectify), np.array([[16.0, 9.0]]), np.array([4], np.int16)
        of_pixels = (partial(call, pixels) for call in (rectify.points, rectify.source_pixels, ranges.at))
        for call in (rectify.depth, *of_pixels):
            with pytest.raises(InputError, match="sixteenths of a pixel"):
                call(found)
            call(found / 16.0)
        expected = ranges.at(tensor([16.0, 9.0]), tensor(0.25)).range
        assert torch.equal(ranges.at([[16.0, 9.0]], [0.25]).range, expected)
        assert torch.equal(ranges.at(pixels, found / 16.0).range, expected)
        with pytest.raises(InputError, match="float16"):
            rectify.depth(torch.tensor([16.0]).half())


def test_errors_against_a_truth() -> None:
    """Across east and north, along the range, and whether the interval contains it."""
    points = tensor([0.0, 0.0, 500.0], [9.0, 0.0, 800.0], [0.0, 0.0, 900.0])
    left, right = RIG(points)[0].unbind(-2)
    left[2] = math.nan
    located = located_pairs(RIG, left, right, origin=ORIGIN, heading_deg=0.0, **STRAIGHT)
    # The second is said to be 3 m to the east, 4 m to the south and 200 m farther than it is.
    found = position_errors(located, tensor([0.0, 500.0, 0.0], [6.0, 604.0, 0.0], [0.0, 900.0, 0.0]))
    assert found[0] == pytest.approx((0.0, 0.0, True), abs=1e-6)
    assert found[1] is not None
    across, along, inside = found[1]
    assert across == pytest.approx(math.hypot(3.0, 196.0), abs=1e-6)
    assert along == pytest.approx(math.hypot(9.0, 800.0) - math.hypot(6.0, 604.0), abs=1e-6)
    assert not inside
    assert found[2] is None
    assert position_errors(located, tensor([math.nan, 0, 0], [0, 0, 0], [0, 0, 0]))[0] is None
    localize = Localizer(RIG.placed(origin=ORIGIN, heading_deg=0.0, **STRAIGHT))
    assert interval_coverage(localize, left[:2], right[:2], points.norm(dim=-1)[:2]) == 1.0
    assert interval_coverage(localize, left[:2], right[:2], tensor(500.0, 1200.0)) == 0.5
    assert interval_coverage(localize, left[:2], right[:2], tensor(400.0, 300.0)) == 0.0


@pytest.mark.parametrize("suffix", APPENDED)
def test_rows_of_a_file_that_grows(suffix: str) -> None:
    """What begins the file stands before the first rows only; each thing has rows of its own."""
    left, right = RIG(tensor([0.0, 0.0, 500.0], [9.0, 0.0, 800.0]))[0].unbind(-2)
    run = located_pairs(RIG, left, right, origin=ORIGIN, heading_deg=0.0, names=["mast", "mill"], **STRAIGHT)
    time = datetime.datetime(2026, 1, 2, 3, 4, 5, tzinfo=datetime.UTC)
    first, later = (appended(suffix, run, run.columns, time, first=one).decode() for one in (True, False))
    assert first.endswith(later)
    assert len(first) > len(later)
    assert later.count("mast") >= 1
    assert later.count("mill") >= 1
    if suffix == ".geojsonl":
        lines = [json.loads(line) for line in later.splitlines()]
        assert [line["geometry"]["type"] for line in lines] == ["Point", "Point"]
    if suffix == ".csv":
        assert first.startswith("name,")
        assert len(later.splitlines()) == 2
    with pytest.raises(InputError, match="a file that grows needs one of"):
        appended(".kml", run, run.columns, time, first=True)


def test_the_direction_that_no_point_explains() -> None:
    """Of four pixel coordinates: of length one, across the derivatives by the point, so along the epipolar error."""
    rig = real_rig()
    left, right = rig(spread_points(torch.tensor([80.0, 300.0, 2000.0], dtype=torch.float64)))[0].unbind(-2)
    found = fit_pairs(rig, left, right)
    assert found.status.tolist() == [PositionStatus.OK] * 3
    # What the gain does not reach: its null space.
    across = torch.linalg.svd(found.fit.gain.movedim(-1, 0))[2][:, -1].T
    torch.testing.assert_close(across.square().sum(0), torch.ones(3).double())
    # Unknowns reach rows of J; the gain maps to zero what they do not.
    torch.testing.assert_close((found.fit.gain * across).sum(1), torch.zeros(3, 3).double(), rtol=0, atol=1e-9)
    jacobian = found.fit.jacobian
    size = jacobian.square().sum(1, keepdim=True).sqrt()
    torch.testing.assert_close((jacobian / size * across).sum(1), torch.zeros(3, 3).double(), rtol=0, atol=1e-6)
