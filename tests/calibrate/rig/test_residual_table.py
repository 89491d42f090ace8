"""Residuals of calibrations as tables of Arrow."""

import pandas
import polars
from drawn_scenes import calibrated, landmarks_rig


def test_items_of_a_rig_are_rows() -> None:
    result = landmarks_rig()
    ours, theirs = polars.DataFrame(result), pandas.DataFrame.from_arrow(result)
    assert ours["name"].to_list() == list(theirs["name"]) == [item.name for item in result.items]
    assert ours["used"].to_list() == [item.used for item in result.items]
    assert False in ours["used"].to_list()
    assert ours["sigmas"].to_list() == [item.sigmas for item in result.items]
    pixels = zip(ours["left_px"].to_list(), ours["right_px"].to_list(), strict=True)
    assert list(pixels) == [item.pixels for item in result.items]
    assert ours["reason"].to_list() == [item.reason for item in result.items]


def test_corners_of_a_camera_have_their_residuals() -> None:
    result = calibrated()
    ours = polars.DataFrame(result)
    seen = result.residuals.isfinite().all(-1)
    assert len(ours) == int(result.observations.pixels().isfinite().all(-1).sum())
    assert ours["residual_u"].drop_nulls().to_list() == result.residuals[seen][:, 0].tolist()
    assert pandas.DataFrame.from_arrow(result)["view"].nunique() == len(result.observations.views)
