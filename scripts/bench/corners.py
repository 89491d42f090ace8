"""Accuracy of corner refinement on rendered boards with known truth, and on real images.

Boards of 9x6 corners are seen through a distorting lens at tilts up to 45 degrees; light is blurred, vignetted, encoded
with a gamma of 2.2, given noise, rounded and compressed as JPEG (quality 95). Refiners start 0.3 px from the truth;
detectors start from nothing. Errors beyond 2 px count as lost and are shown as a share.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import get_args

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal import Board, Camera
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.corners.grid import local_side
from kcal.corners.refine import Refinement, refine_corners
from kcal.corners.saddle import saddle
from kcal.lens import rotation_from_vector
from kcal.sim.captures import BoardSize, project_board
from kcal.sim.scene import RenderOptions, render_light
from scripts.bench.found import by_sector
from scripts.shared.page import Lines, table
from scripts.shared.real_captures import stereo_images
from scripts.shared.sections import section

BOARD = Board(columns=9, rows=6, square=0.025)
SQUARES, BLURS, NOISES = (8, 10, 20, 40), (0.5, 1.0, 2.0), (0, 2, 5)
SHOWN = 2  # gray levels of noise in the table; the summary is about all
LOST = 2.0  # pixels
GAMMA = 2.2
QUALITY = 95
Image = NDArray[np.uint8]


@dataclass
class Errors:
    """Errors of one method in one cell, px, with predicted covariances where the method has them."""

    error: list[Tensor] = field(default_factory=list)
    covariance: list[Tensor] = field(default_factory=list)

    def row(self) -> tuple[float, float, float, float, float]:
        """RMS per axis, bias in x and y, share lost, sqrt of predicted over true variance."""
        error = torch.cat(self.error)
        good = torch.linalg.vector_norm(error, dim=-1) < LOST
        lost = 1.0 - float(good.double().mean())
        kept = error[good]
        if not len(kept):
            return math.nan, math.nan, math.nan, lost, math.nan
        ratio = math.nan
        if self.covariance:
            predicted = torch.cat(self.covariance)[good].diagonal(dim1=-2, dim2=-1)
            ratio = float((predicted.mean() / kept.square().mean()).sqrt())
        return float(kept.square().mean().sqrt()), float(kept[:, 0].mean()), float(kept[:, 1].mean()), lost, ratio


def scenes(square: int, blur: float, noise: float, count: int) -> Iterator[tuple[Image, Tensor, Tensor, Tensor]]:
    """Image, true corners, starts and local sides of `count` boards whose squares are about `square` pixels."""
    generator = torch.Generator().manual_seed(1000 * square + int(100 * blur))
    width, height = 16 * square + 40, 13 * square + 40
    focal = 0.9 * width
    camera = Camera.build(
        focal=(focal, focal),
        center=((width - 1) / 2 + 1.3, (height - 1) / 2 - 0.7),
        size=(width, height),
        coefficients=[-0.25, 0.08, 0.0006, -0.0004],
    )
    size = BoardSize(BOARD.columns, BOARD.rows, BOARD.square)
    options = RenderOptions(black=12, white=175, background=80, blur=blur, noise=0.0, vignetting=0.3)
    middle = BOARD.points.mean(0)
    while count:
        tilt, turn, roll = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
        tilt, turn, roll = math.radians(45 * tilt), 2 * math.pi * turn, math.radians(50 * roll - 25)
        lean = rotation_from_vector(torch.tensor([[tilt * math.cos(turn), tilt * math.sin(turn), 0.0]]).double())[0]
        spin = rotation_from_vector(torch.tensor([[0.0, 0.0, roll]]).double())[0]
        rotation = lean @ spin
        depth = focal * BOARD.square / square
        shift = (torch.rand(2, generator=generator, dtype=torch.float64) - 0.5) * 3 * BOARD.square
        place = torch.cat([shift, torch.tensor([depth], dtype=torch.float64)])
        pose = rotation, place - rotation @ middle
        truth, visible = project_board(camera, pose, size)
        edge = torch.minimum(truth, torch.tensor([width - 1.0, height - 1.0]) - truth).min()
        if not bool(visible.all()) or float(edge) < 1.2 * square:
            continue
        count -= 1
        light = render_light(camera, pose, size, options)
        encoded = 255.0 * (light / 255.0) ** (1.0 / GAMMA)
        encoded += noise * torch.randn(encoded.shape, generator=generator, dtype=torch.float64)
        raw = encoded.round().clamp(0, 255).to(torch.uint8).numpy()
        packed = cv2.imencode(".jpg", raw, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
        image = np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
        away = 0.3 * torch.randn(truth.shape, generator=generator, dtype=torch.float64)
        yield image, truth, truth + away.clamp(-0.8, 0.8), local_side(truth, BOARD.columns, BOARD.rows)


def fixed_window(half: int) -> Callable[[Image, Tensor, Tensor], Tensor]:
    def refine(image: Image, start: Tensor, side: Tensor) -> Tensor:
        corners = np.ascontiguousarray(start.numpy(), dtype=np.float32)
        found = cv2.cornerSubPix(image, corners, (half, half), (-1, -1), (3, 100, 1e-4))
        return torch.from_numpy(found.reshape(-1, 2).astype(np.float64))

    return refine


def sector(image: Image, start: Tensor, side: Tensor) -> Tensor:
    """`findChessboardCornersSB` from nothing, its corners in the order of the starts."""
    if (corners := by_sector(image, BOARD)) is None:
        return torch.full_like(start, math.nan)
    pixels = torch.from_numpy(corners.reshape(-1, 2).astype(np.float64))
    nearest = torch.cdist(start, pixels).argmin(1)
    return pixels[nearest]


def run_cell(square: int, blur: float, noise: float, count: int) -> dict[str, Errors]:
    """Every method on the same images."""
    peers: dict[str, Callable[[Image, Tensor, Tensor], Tensor]] = {
        "cornerSubPix 5": fixed_window(5),
        "cornerSubPix 11": fixed_window(11),
        "cornerSubPix adaptive": lambda image, start, side: refine_corners(image, start, side, "opencv").pixels,
        "scikit-image": lambda image, start, side: refine_corners(image, start, side, "skimage").pixels,
        "SB": sector,
    }
    cell = {name: Errors() for name in ("kcal saddle", "kcal erf", *peers)}
    for image, truth, start, side in scenes(square, blur, noise, count):
        light = torch.from_numpy(image).double()
        first = saddle(light, start, side).pixels
        cell["kcal saddle"].error.append(_lost(first, truth))
        fit = refine_corners(image, start, side, "erf", (BOARD.columns, BOARD.rows))
        cell["kcal erf"].error.append(_lost(fit.pixels, truth))
        assert fit.covariance is not None
        cell["kcal erf"].covariance.append(fit.covariance)
        for name, refine in peers.items():
            cell[name].error.append(_lost(refine(image, start, side), truth))
    return cell


def _lost(pixels: Tensor, truth: Tensor) -> Tensor:
    return torch.nan_to_num(pixels - truth, nan=1e3)


def summary(cells: dict[tuple[int, float, int], dict[str, Errors]]) -> str:
    """What the table says of the erf fit, in a sentence or two."""
    ratios = {key: cell["kcal erf"].row()[4] for key, cell in cells.items()}
    noisy = [ratio for (_, _, noise), ratio in ratios.items() if noise > 0]
    clean = [ratio for (_, _, noise), ratio in ratios.items() if noise == 0]
    bias = max(max(map(abs, cell["kcal erf"].row()[1:3])) for cell in cells.values())
    worse = [
        f"{square} px, blur {blur:g}, noise {noise:g} ({name})"
        for (square, blur, noise), cell in cells.items()
        for name, errors in cell.items()
        if name != "kcal erf" and errors.row()[0] < cell["kcal erf"].row()[0]
    ]
    return (
        f"Predicted over true σ is {min(noisy):.2f} to {max(noisy):.2f} where there is noise and {min(clean):.2f} to "
        f"{max(clean):.2f} where there is none but rounding and JPEG. The largest mean error is {bias:.4f} px. Cells "
        f"in which another method has a smaller RMS than the erf fit: {', '.join(worse) or 'none'}."
    )


@section("corners.md", "refinement", squares=(40,), boards=1)
def refinement(squares: tuple[int, ...] = SQUARES, boards: int = 20) -> Lines:
    """RMS per axis of every method at the usual noise, then the predicted over the true standard deviation of erf."""
    places = itertools.product(squares, BLURS, NOISES)
    cells = {place: run_cell(*place, boards) for place in places}
    names = list(next(iter(cells.values())))
    yield ["square", "blur", *names, "predicted/true σ"]
    for (square, blur, noise), cell in cells.items():
        if noise == SHOWN:
            shown = [errors.row() for errors in cell.values()]
            lost = [f" ({100 * row[3]:.1f} %)" if 5e-4 < row[3] < 1 else "" for row in shown]
            rms = [f"{row[0]:.4f}{more}".replace("nan", "lost") for row, more in zip(shown, lost, strict=True)]
            yield [square, f"{blur:g}", *rms, f"{cell['kcal erf'].row()[4]:.2f}"]
    yield summary(cells)


@section("corners.md", "real", refinements=("saddle",))
def real(refinements: tuple[Refinement, ...] = get_args(Refinement)) -> Iterator[str]:
    """RMS of a 5-coefficient calibration of OpenCV's sample images, all corners alike, for every refinement."""

    def cell(side: str, refine: Refinement) -> str:
        seen = stereo_images(side, refine)
        result = calibrate_camera(seen, CalibrationOptions(weighted=False))
        unseen = sum(view.pixels.count(None) for view in seen.views)
        lost = f" ({unseen} of {BOARD.corners * len(seen.views)} corners rejected as glaring)" if unseen else ""
        return f"{result.rms:.4f}{lost}"

    sides = ("left", "right")
    return table(["refinement", *sides], ([refine, *(cell(side, refine) for side in sides)] for refine in refinements))
