"""Files of priors, information and boards."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from kcal import Board, Camera, FileError, InputError, load_camera, save_camera
from kcal.calibrate.hybrid.board_modes import board_modes
from kcal.calibrate.hybrid.measured_board import MeasuredBoard, load_measured_board, save_measured_board
from kcal.io.foreign import Hints
from kcal.io.format_prior import Parameter, arranged, prior_of, read_prior, write_priors
from kcal.io.formats import FORMATS, held_exactly, import_cameras
from kcal.io.record import Packed
from kcal.lens import CameraCalibration
from kcal.lens.information import CameraInformation

# Priors for other programs: parameters as each program counts them, and the information about exactly these.


LENS = {"opencv4": (-0.1, 0.02, 1e-3, -5e-4), "opencv5": (-0.1, 0.02, 1e-3, -5e-4, 3e-3), "pinhole": ()}

LENS["fisheye4"] = (0.02, -0.003, 0.004, -0.0005)


def known(model: str, size: tuple[int, int] = (640, 480)) -> Camera:
    """A camera with a full covariance of all but the skew."""
    camera = Camera.build(focal=(800, 805), center=(321, 238), size=size, coefficients=LENS[model], model=model)
    count = len(camera.params)
    draw = torch.randn(count, count, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    scale = torch.tensor([0.5] * 4 + [0.0] + [1e-3] * (count - 5), dtype=torch.float64)
    half = (torch.eye(count) + 0.3 * draw) * scale
    camera.calibration = CameraCalibration(name="north", covariance=half.T @ half)
    return camera


# Names and values of fx, fy, cx, cy as each program's documentation has them: where its first pixel's center is, and in
# what units it counts.
HALF = (800, 805, 321.5, 238.5)

EXPECTED = [
    ("colmap", "opencv4", "OPENCV", "fx fy cx cy k1 k2 p1 p2", HALF),
    ("colmap", "fisheye4", "OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4", HALF),
    ("nerfstudio", "opencv4", "OPENCV", "fl_x fl_y cx cy k1 k2 p1 p2", HALF),
    ("nerfstudio", "fisheye4", "OPENCV_FISHEYE", "fl_x fl_y cx cy k1 k2 k3 k4", HALF),
    ("kalibr", "opencv4", "pinhole-radtan", "fu fv pu pv k1 k2 r1 r2", (800, 805, 321, 238)),
    ("kalibr", "fisheye4", "pinhole-equi", "fu fv pu pv k1 k2 k3 k4", (800, 805, 321, 238)),
    ("gtsam", "pinhole", "Cal3_S2", "fx fy s u0 v0", (800, 805, 0, 321)),
    ("gtsam", "opencv4", "Cal3DS2", "fx fy s u0 v0 k1 k2 p1 p2", (800, 805, 0, 321)),
    ("opensfm", "opencv5", "brown", "focal_x focal_y c_x c_y k1 k2 p1 p2 k3",
     (800 / 640, 805 / 640, (321 - 319.5) / 640, (238 - 239.5) / 640)),
    ("opensfm", "fisheye4", "fisheye_opencv", "focal_x focal_y c_x c_y k1 k2 k3 k4",
     (800 / 640, 805 / 640, (321 - 319.5) / 640, (238 - 239.5) / 640)),
    ("matlab", "opencv5", "cameraIntrinsics",
     "FocalLength(1) FocalLength(2) PrincipalPoint(1) PrincipalPoint(2) Skew RadialDistortion(1) RadialDistortion(2) "
     "TangentialDistortion(1) TangentialDistortion(2) RadialDistortion(3)", (800, 805, 322, 239)),
    ("mrcal", "opencv4", "LENSMODEL_OPENCV4", "fx fy cx cy k1 k2 p1 p2", (800, 805, 321, 238)),
    ("mrcal", "pinhole", "LENSMODEL_PINHOLE", "fx fy cx cy", (800, 805, 321, 238)),
]  # fmt: skip


@pytest.mark.parametrize(("program", "model", "kind", "names", "first"), EXPECTED, ids=lambda value: str(value)[:12])
def test_parameters_are_those_of_the_program(
    program: str, model: str, kind: str, names: str, first: tuple[float, ...]
) -> None:
    camera = known(model)
    prior = prior_of(program, camera)
    assert (prior["model"], prior["parameters"], prior["size"]) == (kind, names.split(), [640, 480])
    assert prior["mean"][:4] == pytest.approx(first, rel=1e-14, abs=1e-15)
    scale = [parameter.scale for parameter in arranged(program, camera)[1]]
    chosen = [camera.names.index(parameter.kcal) for parameter in arranged(program, camera)[1]]
    lens = list(LENS[model])
    assert prior["mean"][len(chosen) - len(lens) :] == pytest.approx(lens)
    root = np.array(prior["sqrt_information"])
    assert np.array_equal(root, np.triu(root))
    assert bool((np.diag(root) > 0).all())
    wanted = camera.calibration.covariance[chosen][:, chosen].numpy() * np.outer(scale, scale)
    spread = np.sqrt(np.diag(wanted))
    free = spread > 0
    unit = np.outer(spread[free], spread[free])
    assert np.abs((np.linalg.inv(root.T @ root)[free][:, free] - wanted[free][:, free]) / unit).max() < 1e-7


def test_an_upright_image_is_counted_by_its_height() -> None:
    _, order = arranged("opensfm", known("opencv5", (480, 640)))
    assert order[0] == Parameter("focal_x", "fx", 1.0 / 640)
    assert order[2] == Parameter("c_x", "cx", 1.0 / 640, -239.5 / 640)
    assert order[3] == Parameter("c_y", "cy", 1.0 / 640, -319.5 / 640)


@pytest.mark.parametrize("suffix", [".json", ".npz"])
@pytest.mark.parametrize("program", ["matlab", "opensfm", "colmap"])
def test_a_camera_comes_back(program: str, suffix: str, tmp_path: Path) -> None:
    """Parameters, covariance, name, size, and what fit it is: whatever units and offsets the program has."""
    model = "opencv4" if program == "colmap" else "opencv5"
    cameras = [known(model), known(model, (800, 600))]
    priors = [prior_of(program, cameras[0], (0.01, 0.25)), prior_of(program, cameras[1])]
    found = read_prior(write_priors(program, priors, tmp_path / f"a{suffix}"), Hints())
    assert found.format == program
    assert found.notes == ("north: a fit to another lens, RMS 0.01 px",)
    for back, camera in zip(found.cameras, cameras, strict=True):
        assert back.size == camera.size
        assert back.calibration.name == "north"
        torch.testing.assert_close(back.params, camera.params, rtol=1e-13, atol=1e-13)
        spread = camera.calibration.covariance.diagonal().sqrt() + 1e-30
        away = (back.calibration.covariance - camera.calibration.covariance) / (spread * spread[:, None])
        assert float(away.abs().max()) < 1e-7


def changed(tmp_path: Path, **changes: Any) -> Path:
    path = write_priors("colmap", [prior_of("colmap", known("opencv4"))], tmp_path / "a.json")
    content = json.loads(path.read_text())
    content["cameras"][0] |= changes
    path.write_text(json.dumps(content))
    return path


def order(*names: str) -> dict[str, Any]:
    return {"model": "opencv4", "parameters": [[name, 1.0, 0.0] for name in names]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kcal": order("fx", "fx"), "mean": [1.0, 2.0]}, "twice"),
        ({"kcal": order(*map(str, range(65))), "mean": [0.0] * 65}, "too many"),
        ({"kcal": order("fx", "fy", "cx", "cy", "k9"), "mean": [800.0, 800.0, 320.0, 240.0, 0.1]}, "no parameter k9"),
        ({"mean": [800.0]}, "mean"),
        ({"sqrt_information": [[1.0]]}, "sqrt_information"),
    ],
)
def test_a_prior_that_fits_nothing_is_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(FileError, match=message):
        import_cameras(changed(tmp_path, **changes))


def test_a_prior_without_information_is_a_camera(tmp_path: Path) -> None:
    (camera,) = read_prior(changed(tmp_path, sqrt_information=None), Hints()).cameras
    assert camera.calibration is None or camera.calibration.covariance is None
    (camera,) = read_prior(changed(tmp_path, held=["k1", "cx"]), Hints()).cameras
    variance = dict(zip(camera.names, camera.calibration.covariance.diagonal().tolist(), strict=True))
    assert {name for name, value in variance.items() if value == 0.0} == {"k1", "cx", "skew"}


def test_the_first_model_that_contains_a_lens() -> None:
    """A parameter of zero needs no place; error bars do not go along, the name does."""
    camera = known("opencv5")
    assert held_exactly(camera, ("pinhole", "opencv4")) is None
    camera = camera.with_parameters(torch.cat([camera.params[:-1], torch.zeros(1).double()]))
    camera.calibration = CameraCalibration(name="north", covariance=torch.eye(10).double())
    found = held_exactly(camera, ("pinhole", "fisheye4", "opencv4", "opencv8"))
    assert str(found.model) == "opencv4"
    assert torch.equal(found.params, camera.params[:-1])
    assert (found.calibration.name, found.calibration.covariance) == ("north", None)
    camera.params.data[4] = 0.5
    assert held_exactly(camera, ("opencv8",)) is None
    assert held_exactly(camera, ("opencv8",), skew=True).params[[4, 5]].tolist() == camera.params[[4, 5]].tolist()
    # A lens of a pinhole by its numbers is one, a fisheye's is none.
    fisheye = Camera.build(focal=(8, 8), center=(3, 2), size=(6, 4), coefficients=[0.0] * 4, model="fisheye4")
    assert held_exactly(fisheye, ("pinhole", "opencv4")) is None
    assert str(held_exactly(fisheye, ("pinhole", "fisheye4")).model) == "fisheye4"  # type: ignore[union-attr]


def test_only_gtsam_has_a_skew() -> None:
    assert {name for name, kind in FORMATS.items() if kind.prior and kind.skew} == {"gtsam"}


# What a calibration says of a camera survives its file to the last bit.


@pytest.fixture
def camera() -> Camera:
    """Focal lengths tied, skew held, two board modes, a prior on k1 and on the board."""
    camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1], model="opencv4")
    generator = torch.Generator().manual_seed(3)
    slots = (0, 0, 1, 2, -1, 3, 4, 5, 6)
    sigma = torch.tensor([math.inf, math.inf, math.inf, 0.1, math.inf, math.inf, math.inf, 1e-3, 2e-3]).double()
    camera.calibration = CameraCalibration(
        information=CameraInformation(
            slots=slots,
            estimate=torch.cat([camera.params[[0, 2, 3, 5, 6, 7, 8]].detach(), torch.tensor([3e-4, -1e-4]).double()]),
            rows=torch.randn(30, 9, generator=generator, dtype=torch.float64),
            residuals=torch.randn(30, generator=generator, dtype=torch.float64),
            mean=torch.zeros(9).double(),
            sigma=sigma,
        )
    )
    return camera


def stored_information(camera: Camera) -> CameraInformation:
    found = camera.calibration.known(camera.params)
    assert found is not None
    return found


def test_read_back(camera: Camera, tmp_path: Path) -> None:
    """The same after one trip, and bit for bit after the next."""
    first = save_camera(camera, tmp_path / "first.json")
    again = load_camera(first)
    old, new = stored_information(camera), stored_information(again)
    assert new.slots == old.slots
    for name in ("estimate", "mean", "sigma"):
        assert torch.equal(getattr(new, name), getattr(old, name))
    torch.testing.assert_close(new.covariance(), old.covariance(), rtol=1e-9, atol=0)
    torch.testing.assert_close(new.rows.T @ new.residuals, old.rows.T @ old.residuals, rtol=1e-12, atol=1e-12)
    assert save_camera(again, tmp_path / "second.json").read_bytes() == first.read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"unknowns": [["fx"], ["fx"]]}, "twice"),
        ({"sigma": [1.0]}, "unknowns"),
        ({"triangle": {"shape": [1], "float64": "AAAA"}}, "whole doubles"),
        ({"triangle": {"shape": [54], "float64": "!"}}, "base64"),
        ({"unknowns": [[name] for name in ("fx", "cx", "cy", "k1", "k2", "p1", "k9")]}, "k9"),
        # Their squares overflow, or those of their inverses.
        ({"sigma": [5e-324, *[None] * 8]}, r"camera\.json.*below 1e-100"),
        ({"triangle": Packed.of(1e200 * torch.ones(54).double()).model_dump()}, r"camera\.json.*beyond 1e\+100"),
        ({"triangle": Packed.of(1e-200 * torch.ones(54).double()).model_dump()}, r"camera\.json.*less than 1e-100"),
    ],
)
def test_damaged(camera: Camera, tmp_path: Path, change: dict[str, object], message: str) -> None:
    """Files that contradict themselves are refused, and say where."""
    path = save_camera(camera, tmp_path / "camera.json")
    content = json.loads(path.read_text())
    content["information"] |= change
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match=message):
        load_camera(path)


def test_packed_refuses_nan() -> None:
    """NaN in base64 does not get past the check of numbers."""
    with pytest.raises(ValueError, match="finite"):
        Packed.of(torch.tensor([1.0, math.nan]))


# Files of measured boards: lossless, and refused where they do not fit; what a board says of itself.


BOARD = Board(columns=9, rows=6, square=0.025)


def awkward_board(scale: float = 1e-4) -> MeasuredBoard:
    generator = torch.Generator().manual_seed(5)
    amplitudes = scale * torch.randn(28, generator=generator, dtype=torch.float64)
    return MeasuredBoard(
        name="π",
        board=BOARD,
        amplitudes=amplitudes,
        half=1e-6 * torch.randn(28, 28, generator=generator, dtype=torch.float64),
        log_evidence=1.0 / 3.0,
        observations=("left", "right"),
    )


def test_file_is_lossless(tmp_path: Path) -> None:
    board = awkward_board()
    read = load_measured_board(save_measured_board(board, tmp_path / "x.board.json"))
    assert (read.name, read.board, read.log_evidence, read.observations) == ("π", BOARD, 1.0 / 3.0, ("left", "right"))
    for ours, theirs in ((board.amplitudes, read.amplitudes), (board.half, read.half), (board.points, read.points)):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"kcal": "rig"}, "this is a kcal rig file"),
        ({"version": 2}, "version 2 of the board format"),
        ({"amplitudes": [0.0] * 27, "half": [[0.0] * 27] * 28}, "28 amplitudes"),
        ({"half": [[0.0] * 28] * 27}, "28 x 28"),
        ({"half": [[0.0] * 27] * 28}, "as many columns"),
        ({"amplitudes": ["x"] * 28}, "amplitudes"),
        ({"board": {"columns": 1, "rows": 6, "square": 0.025}}, "columns"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, change: dict[str, Any], complaint: str) -> None:
    path = save_measured_board(awkward_board(), tmp_path / "x.board.json")
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | change), encoding="utf-8")
    with pytest.raises(FileError, match=complaint):
        load_measured_board(path)


def test_values_that_are_not_finite() -> None:
    with pytest.raises(InputError, match="finite"):
        MeasuredBoard(
            name="",
            board=BOARD,
            amplitudes=torch.full((28,), math.nan, dtype=torch.float64),
            half=torch.eye(28, dtype=torch.float64),
            log_evidence=0.0,
        )


def test_summary() -> None:
    """Numbers of a board that is stretched, sheared and bent by known amounts, whose amplitudes have one sigma."""
    modes = board_modes(BOARD.points)
    x, y, _ = (BOARD.points - BOARD.points.mean(0)).T
    # Width over height 1.001; rows and columns at a cosine of 5e-4; a saddle of .2 mm at the corners.
    wanted = torch.stack([1e-3 * x + 5e-4 * y, torch.zeros_like(x), 2e-4 * x * y / (x * y).abs().max()], 1)
    amplitudes = torch.linalg.lstsq(modes.shapes.flatten(1).T, wanted.T.flatten()).solution
    half = 1e-5 * torch.eye(28, dtype=torch.float64)
    board = MeasuredBoard(name="a", board=BOARD, amplitudes=amplitudes, half=half, log_evidence=0.0)
    torch.testing.assert_close(board.points - BOARD.points, wanted, rtol=0, atol=1e-12)
    assert board.stretch.value == pytest.approx(1e-3, rel=1e-9)
    assert board.shear.value == pytest.approx(5e-4, rel=1e-9)
    assert board.bending.value == pytest.approx(2e-4, rel=1e-9)
    assert board.print_error.value == pytest.approx(0.0, abs=1e-12)
    # Twelve modes of one sigma, nearly one each at the corner of the board.
    assert 2e-5 < board.bending.sigma < 4e-5
    assert 1e-5 < board.print_error.sigma < 3e-5
    # Displacements are those of the corners, off what cameras cannot tell: half of the stretch each way.
    moved = torch.stack([5e-4 * x + 2.5e-4 * y, 2.5e-4 * x - 5e-4 * y, wanted[:, 2]], 1)
    torch.testing.assert_close(board.displacements(), moved, rtol=0, atol=1e-12)
    torch.testing.assert_close(board.displacements(BOARD.points[5:9]), moved[5:9], rtol=0, atol=1e-12)


def test_sigmas_of_the_summary() -> None:
    """Over draws of the amplitudes, the numbers scatter by their sigmas."""
    board = awkward_board()
    generator = torch.Generator().manual_seed(6)
    names = ("bending", "stretch", "shear", "print_error")
    draws = []
    for _ in range(200):
        amplitudes = board.amplitudes + torch.randn(28, generator=generator, dtype=torch.float64) @ board.half
        other = MeasuredBoard(name="", board=BOARD, amplitudes=amplitudes, half=board.half, log_evidence=0.0)
        draws.append([getattr(other, name).value for name in names])
    sigma = torch.tensor([getattr(board, name).sigma for name in names])
    torch.testing.assert_close(torch.tensor(draws).std(0), sigma, rtol=0.2, atol=0)
