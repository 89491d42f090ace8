"""A rig file becomes a localizer with the same errors as on the command line."""

import dataclasses
from functools import partial
from pathlib import Path

import pytest
import torch
from command_line import Command, rows_of

from kcal import InputError, Localizer, Origin, load_rig, save_rig
from kcal.locate import Marks, check_ranges
from kcal.locate.budget import range_sigmas
from kcal.locate.siting import sites_of
from kcal.report import rig_verdict
from kcal.rig import Mounting

SAMPLE = Path(__file__).parents[2] / "assets" / "sample-rig.json"
LEFT, RIGHT = torch.tensor([[960.0, 540.0], [700.0, 600.0]]), torch.tensor([[925.0, 535.0], [620.0, 592.0]])


def test_the_same_intervals_as_the_command(tmp_path: Path, command: Command) -> None:
    marks = tmp_path / "points.csv"
    rows = [f"{left[0]},{left[1]},{right[0]},{right[1]}" for left, right in zip(LEFT, RIGHT, strict=True)]
    marks.write_text("\n".join(["left_u,left_v,right_u,right_v", *rows]) + "\n")
    out = tmp_path / "positions.csv"
    command("locate", SAMPLE, marks, "--pixel-sigma 0.1 -o", out)
    for localize in (Localizer(load_rig(SAMPLE), pixel_sigma=0.1), Localizer.from_file(SAMPLE, pixel_sigma=0.1)):
        assert localize.included == ("marks", "calibration", "mounting")
        found = localize(LEFT, RIGHT)
        for i, row in enumerate(rows_of(out)):
            assert float(row["range_low_m"]) == float(found.range_low[i])
            assert float(row["range_high_m"]) == float(found.range_high[i])
            assert float(row["cov_ee_m2"]) == float(found.covariance[i, 0, 0])
            assert float(row["lat"]) == float(found.geodetic[i, 0])


def test_what_is_given_replaces_what_the_rig_knows() -> None:
    rig = load_rig(SAMPLE)
    own = Localizer(rig)(LEFT, RIGHT)
    elsewhere = Localizer(rig.placed(origin=Origin(lat=0.0, lon=0.0, height=0.0), heading_deg=0.0))
    assert elsewhere.included == ("marks", "calibration")
    torch.testing.assert_close(elsewhere(LEFT, RIGHT).inverse_range_sigma, own.inverse_range_sigma, rtol=1e-9, atol=0.0)
    # What is set is independent of the rest: another covariance than that of both together.
    rig.mounting = rig.mounting
    assert not torch.allclose(Localizer(rig)(LEFT, RIGHT).covariance, own.covariance, rtol=1e-5)
    rig.covariance = None
    narrow = Localizer(rig)
    assert narrow.included == ("marks", "mounting")
    assert (narrow(LEFT, RIGHT).inverse_range_sigma < own.inverse_range_sigma).all()


def test_marks_have_the_noise_that_the_file_states(tmp_path: Path) -> None:
    rig = load_rig(SAMPLE)
    assert rig.calibration is not None
    for stated, sigma in ((0.7, 0.7), (None, 0.3)):
        rig.calibration = dataclasses.replace(rig.calibration, pixel_sigma=stated)
        read = load_rig(save_rig(rig, tmp_path / "rig.json"))
        assert [float(Localizer(read, weights=how).pixel_sigma) for how in (None, "all")] == [sigma, sigma]
        assert torch.equal(range_sigmas(read).total, range_sigmas(read, pixel_sigma=sigma).total)
        ranges = 0.99 / Localizer(read)(LEFT, RIGHT).inverse_range
        check = partial(check_ranges, read, Marks.of_pair("ab", LEFT, RIGHT), ranges, 0.01 * ranges)
        assert check().chi2 == check(pixel_sigma=sigma).chi2 != check(pixel_sigma=0.1).chi2
        station = Localizer(read).apart()
        station.calibration = rig.calibration
        assert sites_of(station) == sites_of(station, sigma)
        assert float(Localizer(read, pixel_sigma=0.1).pixel_sigma) == 0.1
        assert f"with marks to {sigma:g} px" in rig_verdict(read).basis


def test_half_a_mounting_is_refused() -> None:
    rig = load_rig(SAMPLE)
    origin = Origin(lat=0.0, lon=0.0, height=0.0)
    for options in ({"origin": origin}, {"heading_deg": 10.0}, {"pitch_deg": 1.0}):
        with pytest.raises(InputError, match="belong together"):
            rig.placed(**options)
    rig.mounting = None
    assert not Localizer(rig).on_earth
    for options in ({"covariance": torch.eye(6)}, {"refraction": 0.1}):
        with pytest.raises(InputError, match="does not say where it stands"):
            rig.placed(**options)
    rig.mounting = Mounting(origin=origin, heading_deg=10.0)
    assert Localizer(rig).attitude_deg == (10.0, 0.0, 0.0)


@pytest.mark.parametrize("shape", [(0, 4, 2), (4, 0, 2)])  # a batch of no images, and of images without marks
def test_nothing_to_locate_through_the_default_lens(shape: tuple[int, ...]) -> None:
    nothing = torch.zeros(shape, dtype=torch.float64)
    localize = Localizer.from_file(SAMPLE)
    for module in (localize, localize.weighing_all()):
        assert module(nothing, nothing).enu.shape == (*shape[:-1], 3)
