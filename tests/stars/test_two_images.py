"""A lens from two images of the simulated sky, in a few seconds, and the table of pairs that names their stars."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kcal.stars.lens import StarCamera, calibrate_by_stars
from kcal.stars.sky import StarCatalog, cache_folder, pair_table
from scripts.shared.star_lenses import SIZE, lens_difference, star_images, true_lens


@pytest.fixture(scope="module")
def found() -> StarCamera:
    images, views = star_images(35.0, 2, seed=1)
    told: list[str] = []
    made = calibrate_by_stars(images, views, SIZE, focal=1100.0, progress=told.append)
    # The image of most stars comes first; images are counted from one.
    most = max(range(2), key=lambda number: len(images[number].pixels))
    assert told[0] == f"search 1 of 3: image {most + 1}, focal length 1100 px"
    assert [text for text in told if not text.startswith("search 1")] == ["names", "lens", "lens", "lens"]
    return made


def test_the_lens_is_found(found: StarCamera) -> None:
    lens = found.lens
    error = lens_difference(found)
    assert np.sqrt((error**2).mean()) < 0.06
    assert error.max() < 0.3
    assert lens.rms_px == pytest.approx(0.1, rel=0.2)
    # Of 178 stars with two coordinates: a scatter of 5 %.
    assert lens.widened == pytest.approx(1.0, abs=0.15)
    for residuals, used in zip(lens.residuals, lens.used, strict=True):
        assert bool((residuals.abs().amax(-1) < 0.6)[used].all())
        assert int((~used).sum()) <= 2


def test_its_uncertainty(found: StarCamera) -> None:
    known = found.lens.camera.calibration
    assert known is not None
    assert known.sigma is not None
    for name in ("fx", "cx", "cy"):
        place = found.lens.camera.names.index(name)
        sigma = known.sigma[name]
        assert sigma is not None
        assert 0.05 < sigma < 0.6
        assert abs(float(found.lens.camera.params[place] - true_lens().params[place])) < 3.5 * sigma
    # Focal length, center, and as much of the field as some 180 stars tell.
    assert 5 < found.lens.effective < 40


def test_points_that_are_no_stars_get_no_names(found: StarCamera) -> None:
    images, _ = star_images(35.0, 2, seed=1)
    for image, star in zip(images, found.stars, strict=True):
        assert 0.7 * (len(image.pixels) - 5) < len(star) <= len(image.pixels) - 5


def test_all_pairs_of_bright_stars_are_in_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KCAL_CACHE", str(tmp_path))
    for field_deg, limit_deg in ((2.0, 3.0), (7.5, 7.0), (70.0, 60.0), (150.0, 60.0)):
        table = pair_table(StarCatalog.bundled(), np.radians(field_deg))
        assert len(table.pairs) == len(table.angle)
        # Fewer stars take part for wide angles: some 700,000 pairs, each both ways.
        assert len(table.angle) < 2 * 700_000 * 1.2
        if table.stars < len(table.order):
            assert len(table.angle) > 2 * 700_000 * 0.8
        bright = min(150, table.stars)
        angle = np.arccos(np.clip(table.directions[:bright] @ table.directions[:bright].T, -1, 1))
        wanted = np.sort(angle[(angle < np.radians(limit_deg)) & ~np.eye(bright, dtype=bool)])
        own = (table.pairs < bright).all(1)
        np.testing.assert_allclose(np.sort(table.angle[own]), wanted, atol=1e-4)
        assert np.all(np.diff(table.angle) >= 0)


@pytest.mark.parametrize(
    ("platform", "folder"),
    [("win32", "AppData/Local/kcal"), ("darwin", "Library/Caches/kcal"), ("linux", ".cache/kcal")],
)
def test_folders_of_caches(platform: str, folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("KCAL_CACHE", "LOCALAPPDATA", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.setattr("sys.platform", platform)
    assert cache_folder() == tmp_path / folder
    monkeypatch.setenv("LOCALAPPDATA", "/local")
    monkeypatch.setenv("XDG_CACHE_HOME", "/xdg")
    assert str(cache_folder()) == {"win32": "/local/kcal", "linux": "/xdg/kcal"}.get(platform, str(tmp_path / folder))
    monkeypatch.setenv("KCAL_CACHE", "/given")
    assert str(cache_folder()) == "/given"
