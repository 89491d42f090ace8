"""Lenses of other programs: read as their published formulas have them, all over the image, and written."""

import re
from pathlib import Path
from typing import Any

import pytest
import torch

from kcal import Camera, FileError, InputError
from kcal.io.foreign_lenses import ForeignCamera, fit_foreign, foreign_camera
from kcal.lens import export_cameras, import_cameras
from scripts.check.foreign_lenses import (
    CX,
    CY,
    FILES,
    FISHEYE,
    FX,
    FY,
    OUT,
    PYCOLMAP,
    READ,
    SIZE,
    TWELVE,
    WIDE,
    agisoft,
    by_colmap,
    error_of,
    error_of_written,
    kalibr,
    opensfm,
    rays_of_matlab,
    written,
)


def stated(notes: tuple[str, ...]) -> float:
    """The largest error that the note on a hybrid lens states, px."""
    (note,) = (note for note in notes if "became kcal's hybrid lens" in note)
    return float(note.split("at most ")[1].split(" px")[0])


@pytest.mark.parametrize("case", READ)
def test_read_as_published_all_over_the_image(tmp_path: Path, case: str) -> None:
    file, project = READ[case]
    found = import_cameras(written(tmp_path, file))
    camera = found.cameras[0]
    assert bool(camera.unproject(camera.grid(9, 7))[1].all())
    error = error_of(camera, project)
    assert error < 1e-9 or error <= 1.5 * stated(found.notes) < 0.05


@pytest.mark.parametrize("inner", [True, False])
def test_fisheye_of_matlab(tmp_path: Path, inner: bool) -> None:
    content = {"params": {"Intrinsics": FISHEYE, "NumPatterns": 9.0} if inner else FISHEYE}
    found = import_cameras(written(tmp_path, ("f.mat", content)))
    pixels = found.cameras[0].grid(41, 31).reshape(-1, 2)
    seen, shown = found.cameras[0].project_rays(torch.from_numpy(rays_of_matlab(pixels.numpy())))
    assert bool(shown.all())
    assert float((seen - pixels).abs().max()) <= 1.5 * stated(found.notes) < 0.05
    turning = content["params"].get("Intrinsics", FISHEYE) | {"MappingCoefficients": [290.0, 0.05, 0.0, 0.0]}
    with pytest.raises(FileError, match="has no ray for most of the image"):
        import_cameras(written(tmp_path, ("f.mat", {"params": turning})))


@pytest.mark.parametrize("model", PYCOLMAP)
def test_colmap_projects_the_same(tmp_path: Path, model: str) -> None:
    pytest.importorskip("pycolmap")
    path, project = by_colmap(model, tmp_path)
    camera = import_cameras(path).cameras[0]
    assert error_of(camera, project) < (0.02 if camera.model.hybrid else 1e-9)
    again = import_cameras(path.with_suffix(".bin")).cameras[0]
    assert torch.allclose(again.params, camera.params, rtol=1e-12, atol=1e-12)


def test_every_model_of_colmap_is_known() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    from kcal.io.format_photos import COLMAP_MODELS

    for name, number in pycolmap.CameraModelId.__members__.items():
        if int(number) >= 0:
            known = COLMAP_MODELS[name]
            default = pycolmap.Camera.create_from_model_id(1, number, 500, 640, 480)
            assert (known.number, len(known.parameters)) == (int(number), len(default.params))


@pytest.mark.parametrize("kind", sorted({known for _, known in OUT} | {"fov", "division", "dual"}))
def test_a_lens_is_found_again(kind: str) -> None:
    own = {"omni-radtan": [0.9, -0.1, 0.02, 1e-3, -5e-4], "ds": [-0.2, 0.55], "eucm": [0.6, 1.1], "fov": [0.9],
           "division": [-0.3], "dual": [0.3, -0.05, 0.01]}.get(kind, TWELVE)  # fmt: skip
    truth = ForeignCamera(kind, (FX, FY, CX, CY, 0.0, *own), SIZE, "")
    pixels = WIDE.grid(33, 25).reshape(-1, 2)
    rays, valid = truth.unproject(pixels)
    assert bool(valid.all())
    assert float((truth.project(5.0 * rays)[0] - pixels).abs().max()) < 1e-7

    class Shown(Camera):
        def unproject(self, pixels: Any, *, start: Any = None) -> Any:
            return truth.unproject(torch.as_tensor(pixels))

    found = fit_foreign(kind, Shown(WIDE.params, size=SIZE, model=WIDE.model))
    assert float((found.project(rays)[0] - pixels).norm(dim=-1).max()) < 1e-3


@pytest.mark.parametrize("own", [(-0.2, 0.59), (0.183, 0.809)])
def test_pixels_that_have_no_ray_get_none(own: tuple[float, float]) -> None:
    """A double sphere ends at r² = 1 / (2 alpha - 1) (Usenko et al. 2018, Eq. 45), here inside the image."""
    notes: list[str] = []
    camera = foreign_camera("ds", "c", (300.0, 300.0, 639.5, 479.5), (1280, 960), own, notes)
    pixels = camera.grid(97, 73).reshape(-1, 2)
    _, valid = camera.unproject(pixels)
    square = ((pixels - torch.tensor([639.5, 479.5])) / 300.0).square().sum(-1) * (2.0 * own[1] - 1.0)
    assert not bool(valid[square > 1.0].any())
    assert bool(valid[square < 0.95].all())
    share = float((~valid).double().mean())
    assert 0.03 < share < 0.7
    assert float(re.findall(r"([0-9.]+)% of the image has no ray", notes[0])[0]) == pytest.approx(100 * share, abs=1.0)


@pytest.mark.parametrize(("form", "model"), OUT)
def test_a_lens_that_is_asked_for_is_written(tmp_path: Path, form: str, model: str) -> None:
    if form == "colmap":
        pytest.importorskip("pycolmap")
    done = export_cameras(WIDE, tmp_path / FILES[form], format=form, model=model)
    (misfit,) = done.misfits
    assert done.models == (model,)
    assert misfit is not None
    assert error_of_written(form, model, done.paths[0]) <= misfit.largest < 1.0
    (camera,) = import_cameras(done.paths[0]).cameras
    pixels = WIDE.grid(21, 16).reshape(-1, 2)
    seen, shown = camera.project_rays(WIDE.unproject(pixels)[0])
    assert bool(shown.all())
    assert float((seen - pixels).norm(dim=-1).max()) < misfit.largest + 0.01


def test_a_lens_that_shows_too_little_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="fov does not show the whole image"):
        export_cameras(WIDE, tmp_path / "c.yaml", format="kalibr", model="fov")
    with pytest.raises(InputError, match=r"do not hold dual; choose one of .*omni-radtan, ds"):
        export_cameras(WIDE, tmp_path / "c.yaml", format="kalibr", model="dual")


def test_parameters_out_of_range_and_lenses_without_rays_are_refused(tmp_path: Path) -> None:
    for file, words in (
        (kalibr("ds", "none", [-0.2, 1.4], []), "ds with a parameter of 1.4; from 0 to 1"),
        (opensfm("fisheye62", k1=-50.0), "has no ray for most of the image"),
        (
            ("a.xml", agisoft("frame")[1].replace("<k1>", "<corrections><c>1</c></corrections><k1>")),
            "with additional corr",
        ),
        (("a.xml", agisoft("spherical")[1]), "a lens of type spherical: kcal reads frame"),
        (opensfm("spherical"), "projection_type spherical: kcal reads .*fisheye624, dual"),
    ):
        with pytest.raises(FileError, match=words):
            import_cameras(written(tmp_path, file))
