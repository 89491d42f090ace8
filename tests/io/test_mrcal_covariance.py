"""The covariance of a camera from the corners in mrcal's file, as mrcal's own problem has it."""

from __future__ import annotations

import base64
import io
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from kcal.io.formats import import_cameras
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector

CAMERA = Camera.build(
    focal=(1000, 1001), center=(640, 360), size=(1280, 720), coefficients=[-0.1, 0.02, 1e-3, -5e-4], model="opencv4"
)
SPACING, NOISE = 0.05, 0.2
# mrcal's own derivatives at its solution, without its regularization; noise by degrees of freedom, as kcal has it.
BY_MRCAL = """
import sys, numpy as np, mrcal
model = mrcal.cameramodel(sys.argv[1])
inputs = model.optimization_inputs()
_, x, slopes, _ = mrcal.optimizer_callback(**inputs)
count = inputs["observations_board"].size // 3 * 2
slopes = slopes.toarray()[:count]
unpacked = np.eye(slopes.shape[1])
mrcal.unpack_state(unpacked, **inputs)
covariance = unpacked @ np.linalg.inv(slopes.T @ slopes) @ unpacked.T
number = mrcal.num_intrinsics_optimization_params(**inputs)
np.save(sys.argv[2], covariance[:number, :number] * np.square(x[:count]).sum() / (count - len(covariance)))
"""


def inputs(**changes: Any) -> dict[str, Any]:
    """What mrcal stores of twelve views, at the truth."""
    draw = np.random.default_rng(0)
    frames = np.concatenate(
        [draw.uniform(-0.4, 0.4, (12, 3)), draw.uniform([-0.5, -0.3, 0.8], [0.2, 0.0, 1.4], (12, 3))], 1
    )
    x, y = np.meshgrid(np.arange(7.0), np.arange(7.0))
    warp = np.array([1e-3, -5e-4])
    height = warp[0] * 4 * x / 6 * (1 - x / 6) + warp[1] * 4 * y / 6 * (1 - y / 6)
    board = torch.from_numpy(np.stack([SPACING * x, SPACING * y, height], -1))
    corners = np.ones((12, 7, 7, 3))
    for corner, frame in zip(corners, torch.from_numpy(frames), strict=True):
        seen, _ = CAMERA.project(board.reshape(-1, 3) @ rotation_from_vector(frame[:3]).T + frame[3:])
        corner[..., :2] = seen.reshape(7, 7, 2).numpy() + draw.normal(0, NOISE, (7, 7, 2))
    number = np.arange(12, dtype=np.int32)
    return {
        "intrinsics": np.concatenate([CAMERA.params[:4].numpy(), CAMERA.coefficients.numpy()])[None],
        "extrinsics_rt_fromref": np.zeros((0, 6)),
        "frames_rt_toref": frames,
        "points": "",
        "observations_board": corners,
        "indices_frame_camintrinsics_camextrinsics": np.stack([number, 0 * number, 0 * number - 1], 1).astype(np.int32),
        "observations_point": "",
        "indices_point_camintrinsics_camextrinsics": "",
        "lensmodel": "LENSMODEL_OPENCV4",
        "imagersizes": np.array([[1280, 720]], dtype=np.int32),
        "calobject_warp": warp,
        "do_optimize_intrinsics_core": True,
        "do_optimize_intrinsics_distortions": True,
        "do_optimize_extrinsics": True,
        "do_optimize_frames": True,
        "do_optimize_calobject_warp": True,
        "calibration_object_spacing": SPACING,
        "do_apply_regularization": True,
        "verbose": False,
    } | changes


def written(path: Path, **changes: Any) -> Path:
    return written_as(inputs(**changes), path)


def written_as(stored: dict[str, Any], path: Path) -> Path:
    data = io.BytesIO()
    np.savez_compressed(data, **stored)
    values = [*CAMERA.params[:4].tolist(), *CAMERA.coefficients.tolist()]
    content = {"lensmodel": "LENSMODEL_OPENCV4", "intrinsics": values, "extrinsics": [0.0] * 6,
               "imagersize": [1280, 720], "icam_intrinsics": 0,
               "optimization_inputs": base64.b85encode(data.getvalue())}  # fmt: skip
    path.write_text(repr(content))
    return path


def covariance_of(path: Path) -> np.ndarray:
    (camera,) = import_cameras(path).cameras
    assert camera.calibration is not None
    assert camera.calibration.covariance is not None
    free = [index for index, name in enumerate(camera.names) if name != "skew"]
    found: np.ndarray = camera.calibration.covariance[free][:, free].numpy()
    return found


def test_it_is_that_of_a_dense_problem(tmp_path: Path) -> None:
    """Against a Jacobian by automatic differentiation of everything at once, and noise as it was drawn."""
    stored = inputs()
    modes = torch.from_numpy(np.stack([4 * t / 6 * (1 - t / 6) for t in np.meshgrid(np.arange(7.0), np.arange(7.0))]))
    flat = torch.from_numpy(np.stack([SPACING * t for t in np.meshgrid(np.arange(7.0), np.arange(7.0))], -1))

    def residuals(state: torch.Tensor) -> torch.Tensor:
        values, warp, frames = state[:8], state[8:10], state[10:].reshape(12, 6)
        height = (warp[:, None, None] * modes).sum(0)
        board = torch.cat([flat, height[..., None]], -1).reshape(-1, 3)
        seen = []
        for frame in frames:
            there = board @ rotation_from_vector(frame[:3]).T + frame[3:]
            x, y = (there[:, :2] / there[:, 2:]).unbind(1)
            r2 = x * x + y * y
            fx, fy, cx, cy, k1, k2, p1, p2 = values
            radial = 1 + k1 * r2 + k2 * r2 * r2
            seen += [fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx,
                     fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy]  # fmt: skip
        return torch.stack(seen).reshape(12, 2, 49)

    start = torch.from_numpy(
        np.concatenate([stored["intrinsics"][0], stored["calobject_warp"], stored["frames_rt_toref"].ravel()])
    )
    slopes = torch.func.jacfwd(residuals)(start).flatten(0, 2)
    corners = torch.from_numpy(stored["observations_board"][..., :2]).reshape(12, 49, 2).movedim(-1, 1)
    errors = residuals(start) - corners
    noise = float(errors.square().sum()) / (errors.numel() - len(start))
    wanted = noise * torch.linalg.inv(slopes.T @ slopes)[:8, :8].numpy()
    found = covariance_of(written(tmp_path / "a.cameramodel"))
    spread = np.sqrt(np.diag(wanted))
    assert np.abs((found - wanted) / (spread[:, None] * spread)).max() < 1e-6
    assert noise == pytest.approx(NOISE**2, rel=0.1)


def test_what_is_not_stored_is_mrcals_default_and_what_was_held_is_certain(tmp_path: Path) -> None:
    """Poses, center, focal lengths and lens are estimated unless the file says otherwise."""
    whole = covariance_of(written(tmp_path / "a.cameramodel"))
    stored = inputs()
    for key in ("do_optimize_frames", "do_optimize_intrinsics_core", "do_optimize_intrinsics_distortions"):
        del stored[key]
    assert np.allclose(covariance_of(written_as(stored, tmp_path / "b.cameramodel")), whole, rtol=1e-12)
    for held, lens in (("core", False), ("distortions", True)):
        found = covariance_of(written(tmp_path / "c.cameramodel", **{f"do_optimize_intrinsics_{held}": False}))
        zero = np.diag(found) == 0
        assert zero.tolist() == [not lens] * 4 + [lens] * 4
        # The others are known better than where all were estimated.
        assert bool((np.diag(found)[~zero] < np.diag(whole)[~zero]).all())
    both = {"do_optimize_intrinsics_core": False, "do_optimize_intrinsics_distortions": False}
    found = import_cameras(written(tmp_path / "d.cameramodel", **both))
    assert "the camera was held" in found.notes[0]


def test_it_is_mrcals_own(tmp_path: Path) -> None:
    if subprocess.run(["/usr/bin/python3", "-c", "import mrcal"], capture_output=True, check=False, env={}).returncode:
        pytest.skip("mrcal is not installed")
    path = written(tmp_path / "a.cameramodel")
    command = ["/usr/bin/python3", "-c", BY_MRCAL, str(path), str(tmp_path / "c.npy")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={})
    assert done.returncode == 0, done.stderr
    wanted = np.load(tmp_path / "c.npy")
    spread = np.sqrt(np.diag(wanted))
    assert np.abs((covariance_of(path) - wanted) / (spread[:, None] * spread)).max() < 1e-6


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"do_optimize_frames": False}, "poses of boards were held"),
        ({"intrinsics": np.full((1, 8), 3.0)}, "are of other intrinsics than the file"),
        ({"observations_board": np.zeros((0, 7, 7, 3))}, "without boards"),
        ({"frames_rt_toref": np.zeros((1, 6))}, "name boards that they do not have"),
    ],
)
def test_inputs_that_say_nothing_are_told(tmp_path: Path, changes: dict[str, Any], reason: str) -> None:
    found = import_cameras(written(tmp_path / "a.cameramodel", **changes))
    assert found.cameras[0].calibration is not None
    assert found.cameras[0].calibration.covariance is None
    assert found.notes[0].startswith("no error bars: ")
    assert reason in found.notes[0]
