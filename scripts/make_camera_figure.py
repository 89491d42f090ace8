"""Draw docs/explanation/camera.png (entrance pupil, uncertainty) and board.png, from real captures.

KCAL_DATA=DATA python -m scripts.make_camera_figure
"""

from __future__ import annotations

from pathlib import Path

import torch

from kcal.calibrate.camera.calibrate import calibrate_camera
from kcal.calibrate.hybrid.cameras_fit import measure_board
from kcal.lens.projection import pupil_depth
from kcal.lens.uncertainty import image_sigma
from kcal.report.calibration import board_figure
from kcal.report.figures import ACCENT, frame_image, new_figure, save_picture
from scripts.shared.real_captures import load, stereo_images

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "explanation"


def main() -> None:
    figure = new_figure(11.0, 4.4)
    left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1.0, 1.2], "wspace": 0.22})
    wide = calibrate_camera(load("wide").seen)
    rays, valid = wide.camera.unproject(wide.camera.grid(33, 25).reshape(-1, 2))
    widest = float(torch.acos(rays[valid][:, 2].clamp(-1.0, 1.0)).max())
    angle = torch.linspace(0.0, widest, 100, dtype=torch.float64)
    depth = 1e3 * pupil_depth(angle**2, wide.camera.params.detach()[5:])
    place = [wide.camera.names.index(name) for name in ("pupil1", "pupil2")]
    slope = 1e3 * torch.stack([angle**2, angle**4], -1)
    spread = ((slope @ wide.covariance[place][:, place]) * slope).sum(-1).sqrt()
    degrees = torch.rad2deg(angle).numpy()
    left.plot(degrees, depth.numpy(), color=ACCENT)
    left.fill_between(degrees, (depth - 2 * spread).numpy(), (depth + 2 * spread).numpy(), color=ACCENT, alpha=0.25)
    left.set(xlabel="angle from the axis, degrees", ylabel="start of the ray, mm")
    left.set_title("Entrance pupil of a 150° lens, ± 2 σ", fontsize=10, loc="left")

    sides = [stereo_images(side) for side in ("left", "right")]
    print(f"wrote {save_picture(FOLDER / 'board.png', board_figure(measure_board(sides, names=('left', 'right'))[0]))}")
    camera = calibrate_camera(sides[0]).camera
    sigma, places = image_sigma(camera, 65, 49), camera.grid(65, 49).numpy()
    levels = [0.05, 0.1, 0.2, 0.5, 1.0]
    shown = right.contourf(places[..., 0], places[..., 1], sigma, levels=levels, cmap="viridis_r", extend="both")
    frame_image(right, camera.size)
    right.set_title("σ of points at infinity, pixels", fontsize=10, loc="left")
    figure.colorbar(shown, ax=right, fraction=0.035, pad=0.02)
    print(f"wrote {save_picture(FOLDER / 'camera.png', figure)}")


if __name__ == "__main__":
    main()
