"""Find grids of circles and the images of their centers."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.corners.board import Board
from kcal.corners.grid import direct_equations
from kcal.corners.images import Gray
from kcal.corners.saddle import CornerStatus, Refined, with_status
from kcal.corners.search import NotFoundError, in_new_thread, search_sizes, to_full_size
from kcal.opencv import cv2

# Fit the edge of a blurred dark or light ellipse: its center with covariance, its shape, its blur.
#
# Light is `out + (in - out) Φ(-d / blur)` plus a ramp, with d the distance from the ellipse |B (p - c)| = 1 to first
# order, (ρ² - ρ) / |B B (p - c)| with ρ = |B (p - c)| and B symmetric. A small batched Levenberg-Marquardt estimates
# the ten parameters of all ellipses at once from the pixels around each.

# cx, cy, B00, B01, B11, light outside, contrast, blur, ramp x, ramp y
PARAMETERS = 10
_STEPS = 30
_CONVERGED = 1e-4  # pixels: the last step of a center that converged is shorter
_LEAST_BLUR = 0.2  # pixels: the pixel's own area alone gives 0.29
_MOST_PIXELS = 1500  # of one ellipse: beyond, every other row and column tells nearly as much


class Ellipses(NamedTuple):
    """Fitted ellipses.

    Args:
        center: (M, 2) pixels.
        shape: (M, 2, 2) B: the ellipse is |B (p - center)| = 1.
        covariance: (M, 2, 2) px² of the centers.
        blur: (M,) pixels.
        contrast: (M,) gray levels by which the inside is lighter.
        misfit: (M,) RMS residual over the contrast.
        converged: (M,).
    """

    center: Tensor
    shape: Tensor
    covariance: Tensor
    blur: Tensor
    contrast: Tensor
    misfit: Tensor
    converged: Tensor


def fit_ellipses(image: npt.NDArray[np.generic], center: Tensor, shape: Tensor, reach: Tensor) -> Ellipses:
    """Fit one ellipse near each start.

    Args:
        image: (H, W) gray levels.
        center: (M, 2) starts, good to a third of the radius; all finite.
        shape: (M, 2, 2) symmetric positive starts of B.
        reach: (M,) pixels are used where |B (p - c)| is at most this: beyond the edge, short of the next ellipse.

    Example:
        >>> y, x = np.mgrid[:40, :40]
        >>> image = 200 - 150 / (1 + np.exp(3 * (np.hypot(x - 19.3, y - 20.6) - 8)))
        >>> start = torch.tensor([[20.0, 20.0]], dtype=torch.float64)
        >>> found = fit_ellipses(image, start, torch.eye(2, dtype=torch.float64)[None] / 7, torch.tensor([1.7]))
        >>> [round(value, 2) for value in found.center[0].tolist()]
        [19.3, 20.6]
    """
    where, levels, weight = _pixels(image, center, shape, reach)
    p = torch.zeros(len(center), PARAMETERS, dtype=torch.float64)
    p[:, 2], p[:, 3], p[:, 4] = shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1]
    rho = torch.linalg.vector_norm(where @ shape.to(where), dim=-1)  # B is symmetric
    inside, outside = weight * (rho < 0.7), weight * (rho > 1.25)
    dark, light = ((share * levels).sum(-1) / share.sum(-1).clamp_min(1e-9) for share in (inside, outside))
    p[:, 5], p[:, 6], p[:, 7] = light, dark - light, 0.8
    # Lengths are in units of the radius, for the normal equations.
    size = torch.linalg.det(shape).clamp_min(1e-12).rsqrt()
    lam = torch.full((len(p),), 1e-3, dtype=torch.float64)
    cost, normal, gradient = _system(p, where, levels, weight)
    # What rounding of the levels may do to a cost.
    rounding = torch.finfo(levels.dtype).eps * (weight * levels.square()).sum(-1).double().sqrt()
    step = torch.full((len(p),), math.inf, dtype=torch.float64)
    on = torch.arange(len(p))  # those that have not converged
    for _ in range(_STEPS):
        diagonal = normal[on].diagonal(dim1=-2, dim2=-1)
        added = lam[on, None] * diagonal + 1e-9 * diagonal.amax(-1, keepdim=True).clamp_min(1e-30)
        damped = normal[on] + torch.diag_embed(added)
        move = -torch.linalg.solve_ex(damped, gradient[on, :, None])[0][..., 0]
        move[:, :2] *= (0.3 * size[on] / move[:, :2].norm(dim=-1).clamp_min(1e-12)).clamp_max(1.0)[:, None]
        trial = p[on] + move
        trial[:, 7] = trial[:, 7].clamp(_LEAST_BLUR, None)
        found = _system(trial, where[on], levels[on], weight[on])
        better = (found[0] < cost[on] + rounding[on] * cost[on].sqrt()) & _is_ellipse(trial)
        moved = on[better]
        step[moved], p[moved] = move[better, :2].norm(dim=-1), trial[better]
        cost[moved], normal[moved], gradient[moved] = (each[better] for each in found)
        lam[on] = torch.where(better, lam[on] / 4, lam[on] * 6).clamp(1e-9, 1e9)
        # Where no damping improves a step, the fit has converged as well.
        on = on[~((better & (step[on] < 0.1 * _CONVERGED)) | (lam[on] > 1e6))]
        if not len(on):
            break
    freedom = (weight.sum(-1).double() - PARAMETERS).clamp_min(1.0)
    noise = cost / freedom
    unit = normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-30).sqrt()
    scaled = normal / (unit[:, :, None] * unit[:, None, :]) + 1e-12 * torch.eye(PARAMETERS, dtype=torch.float64)
    covariance = torch.linalg.inv(scaled)[:, :2, :2] / (unit[:, :2, None] * unit[:, None, :2]) * noise[:, None, None]
    return Ellipses(
        center + p[:, :2],
        p[:, [2, 3, 3, 4]].unflatten(-1, (2, 2)),
        covariance,
        p[:, 7],
        p[:, 6],
        noise.sqrt() / p[:, 6].abs().clamp_min(1e-9),
        step < _CONVERGED,
    )


def _is_ellipse(p: Tensor) -> Tensor:
    return (p[:, 2] > 0) & (p[:, 2] * p[:, 4] > p[:, 3] ** 2) & torch.isfinite(p).all(-1)


def _pixels(
    image: npt.NDArray[np.generic], center: Tensor, shape: Tensor, reach: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Offsets (M, K, 2) of pixels from the starts, their levels and their weights (M, K): 0 outside reach or image."""
    height, width = image.shape
    # The box around |B p| <= reach: its half-widths are the rows' norms of the inverse.
    half = (torch.linalg.vector_norm(torch.linalg.inv(shape), dim=-1) * reach[:, None]).amax()
    size = int(half.ceil()) + 1
    stride = max(1, math.isqrt(int(math.pi * size**2) // _MOST_PIXELS))
    axis = torch.arange(-size, size + 1, stride)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    base = center.round().long()
    places = base[:, None] + torch.stack([x, y], -1).reshape(1, -1, 2)
    u, v = places.unbind(-1)
    within = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    kind = np.float64 if image.dtype == np.float64 else np.float32
    levels = torch.from_numpy(image[v.clamp(0, height - 1).numpy(), u.clamp(0, width - 1).numpy()].astype(kind))
    where = (places - center[:, None]).to(levels)
    rho = torch.linalg.vector_norm(where @ shape.to(where), dim=-1)
    weight = ((rho <= reach[:, None]) & within).to(where)
    used = (weight > 0).any(0)
    return where[:, used], levels[:, used], weight[:, used]


def _system(p: Tensor, where: Tensor, levels: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sum of squared residuals (M,), normal matrices (M, P, P) and gradients (M, P)."""
    cx, cy, b00, b01, b11, light, contrast, blur, ramp_x, ramp_y = p.to(where)[..., None].unbind(1)
    x, y = where.unbind(-1)

    def shaped(u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        return b00 * u + b01 * v, b01 * u + b11 * v

    qx, qy = x - cx, y - cy
    wx, wy = shaped(qx, qy)
    rho = torch.hypot(wx, wy).clamp_min(1e-6)
    gx, gy = shaped(wx, wy)
    length = torch.hypot(gx, gy).clamp_min(1e-9)
    distance = (rho**2 - rho) / length
    t = (distance / blur).clamp(-9.0, 9.0)  # denormal densities are slow
    share = 0.5 * torch.erfc(t / math.sqrt(2.0))
    density = torch.exp(-0.5 * t.square()) / (math.sqrt(2.0 * math.pi) * blur)
    residual = light + contrast * share + ramp_x * x + ramp_y * y - levels
    # d distance by q: (2 - 1/ρ) Bw / |g| - top / |g|³ B B g; by an element of B: dw = E q, d ρ = w·dw / ρ, and
    # dg = E w + B dw.
    scale = -contrast * density
    near, far = scale * (2.0 - 1.0 / rho) / length, scale * distance / length**2
    hx, hy = shaped(gx, gy)
    kx, ky = shaped(hx, hy)
    jacobian = torch.stack(
        [
            far * kx - near * gx,
            far * ky - near * gy,
            near * wx * qx - far * (gx * wx + hx * qx),
            near * (wx * qy + wy * qx) - far * (gx * wy + gy * wx + hx * qy + hy * qx),
            near * wy * qy - far * (gy * wy + hy * qy),
            torch.ones_like(share), share, -scale * t, x, y,
        ], 1
    )  # fmt: skip
    weighted = weight[:, None] * jacobian
    return (
        (weight * residual.square()).sum(-1).double(),
        (weighted @ jacobian.mT).double(),
        (weighted @ residual[..., None])[..., 0].double(),
    )


# The image of a circle's center is not the center of its image: by how much, from the map of board to image around it.
#
# Around a point the image is `J q + ½ K q q` with `q` on the board. A circle of radius r then looks like an ellipse
# whose center is shifted by ½ r² J (m + n), with m and n from K (below). Of a homography this is what the projected
# conic says (J. Heikkilä, "Geometric camera calibration using circular control points", PAMI 2000), to third order in
# r; a lens that bends lines shifts it as well, through its own second derivatives.

_MOST_DEGREE = 5  # of the polynomial that follows the lens
_POINTS_PER_TERM = 2


class LocalMaps(NamedTuple):
    """The map from board to image around N points: first (N, 2, 2) and second derivatives (N, 2, 2, 2)."""

    first: Tensor
    second: Tensor


def local_maps(points: Tensor, pixels: Tensor, known: Tensor | None = None) -> LocalMaps:
    """Derivatives, at points of the board (N, 2), of the map that brings them to pixels (N, 2).

    Those of the homography of all points, which perspective follows exactly, and of a polynomial through what the
    homography leaves, which is the lens.

    Args:
        points: meters.
        pixels: finite where known.
        known: (N,) which of them determine the map; all if not given.

    Example:
        >>> axis = torch.arange(5, dtype=torch.float64)
        >>> points = torch.cartesian_prod(axis, axis)
        >>> maps = local_maps(points, 10 * points / (1 + 0.1 * points[:, :1]))
        >>> [round(value, 3) + 0.0 for value in maps.second[0].flatten().tolist()]  # x: -2 x 10 x 0.1; y: -10 x 0.1
        [-2.0, 0.0, 0.0, 0.0, 0.0, -1.0, -1.0, 0.0]
    """
    known = torch.ones(len(points), dtype=torch.bool) if known is None else known
    h = homography(points[known], pixels[known])
    there = torch.nn.functional.pad(points, (0, 1), value=1.0) @ h.T
    seen = there[:, :2] / there[:, 2:]
    # (a q + b) / (c q + d): J = (A - p cᵀ) / w, K = -(J_i c_j + J_j c_i) / w.
    slope = h[2, :2]
    first = (h[:2, :2] - seen[:, :, None] * slope) / there[:, 2, None, None]
    second = -(first[:, :, :, None] * slope + first[:, :, None, :] * slope[:, None]) / there[:, 2, None, None, None]
    low, high = points.amin(0), points.amax(0)
    scale = 2.0 / (high - low).clamp_min(1e-12)
    terms = [(i, j) for degree in range(_degree(int(known.sum())) + 1) for i in range(degree + 1) for j in [degree - i]]
    values = _term_values((points - low) * scale - 1.0, terms)
    found = torch.linalg.lstsq(values[0][known], (pixels - seen)[known], driver="gelsd").solution  # (terms, 2)
    by_x, by_y, xx, xy, yy = (value @ found for value in values[1:])
    first = first + torch.stack([by_x, by_y], -1) * scale
    second = second + torch.stack([xx, xy, xy, yy], -1).unflatten(-1, (2, 2)) * scale[:, None] * scale
    return LocalMaps(first, second)


def center_shift(maps: LocalMaps, radius: float) -> Tensor:
    """(N, 2) pixels from the image of each circle's center to the center of the ellipse that it looks like.

    Args:
        maps: of `local_maps`.
        radius: of the circles, in the units of the board's points.
    """
    k = torch.linalg.solve(maps.first, maps.second.flatten(2)).unflatten(-1, (2, 2))
    # Along the edge (cos t, sin t) the displacement is ½ r² (mean + half difference cos 2t + mixed sin 2t); its normal
    # part has the first harmonics that a shift has.
    mean, half, mixed = 0.5 * (k[..., 0, 0] + k[..., 1, 1]), 0.5 * (k[..., 0, 0] - k[..., 1, 1]), k[..., 0, 1]
    x = mean[:, 0] + 0.5 * half[:, 0] + 0.5 * mixed[:, 1]
    y = mean[:, 1] - 0.5 * half[:, 1] + 0.5 * mixed[:, 0]
    return 0.5 * radius**2 * (maps.first @ torch.stack([x, y], -1)[..., None])[..., 0]


def _degree(points: int) -> int:
    """The highest degree with at least two points for each term; 0 for few points, where only the homography counts."""
    degrees = range(_MOST_DEGREE + 1)
    return max((d for d in degrees if _POINTS_PER_TERM * (d + 1) * (d + 2) // 2 <= points), default=0)


def _term_values(at: Tensor, terms: list[tuple[int, int]]) -> list[Tensor]:
    """Values, first (x, y) and second derivatives (xx, xy, yy) of x^i y^j at (N, 2): each (N, terms)."""
    x, y = at.unbind(-1)

    def power(t: Tensor, n: int, derivative: int) -> Tensor:
        return math.perm(n, derivative) * t ** (n - derivative) if n >= derivative else torch.zeros_like(t)

    orders = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    return [torch.stack([power(x, i, a) * power(y, j, b) for i, j in terms], -1) for a, b in orders]


def homography(points: Tensor, pixels: Tensor) -> Tensor:
    """(3, 3) image from board of points (N, 2), by linear least squares in normalized coordinates (R. Hartley)."""
    from_points, a = _normalized(points)
    from_pixels, b = _normalized(pixels)
    h = torch.linalg.svd(direct_equations(a, b))[2][-1].reshape(3, 3)
    found = torch.linalg.solve(from_pixels, h @ from_points)
    return found / found[2, 2]


def _normalized(points: Tensor) -> tuple[Tensor, Tensor]:
    middle = points.mean(0)
    scale = 1.0 / (points - middle).norm(dim=-1).mean().clamp_min(1e-12)
    transform = torch.eye(3, dtype=torch.float64)
    transform[0, 0] = transform[1, 1] = scale
    transform[:2, 2] = -scale * middle
    return transform, (points - middle) * scale


# Find grids of circles and the images of their centers.
#
# OpenCV's `findCirclesGrid` finds the grid. kcal fits the edge of each circle as a blurred ellipse
# and corrects the ellipse's center, which is not the image of the circle's center.
# All circles must be in the image.

_MOST_REACH = 1.8  # radii from the center to where pixels tell of the edge and of the light outside
_FOREIGN = 1.5  # pixels short of the next circle's edge, where its blur begins
_MOST_BLUR = 0.5  # of the radius
_MOST_MISFIT = 0.2  # RMS residual over the contrast: above, something covers the circle
_MOST_MOVE = 0.5  # radii from OpenCV's center
_SIZE_RATIO = 1.25  # of the circles' diameter as seen to that of the board's text
_LEAST_KNOWN = 6  # circles: fewer good ones do not tell how the others are shifted, and no board is found
_LATTICE = 0.3  # of a distance: how near a blob beside the grid must be to where its next circle would be


def find_circles(image: npt.NDArray[np.uint8], board: Board) -> tuple[Tensor, float]:
    """OpenCV's centers (corners, 2) of a grid of dark circles on light, or of light ones on dark, in the board's order.

    Second, the circles' radius, meters, about.

    Raises:
        NotFoundError: there is no such grid.

    Example:
        >>> find_circles(np.full((100, 100), 200, np.uint8), Board.parse("circles:7x6", "20mm"))
        Traceback (most recent call last):
        kcal.corners.search.NotFoundError: no grid of 7x6 circles found
    """
    kind = "asymmetric circles" if board.pattern == "asymmetric" else "circles"
    reason, most = f"no grid of {board.columns}x{board.rows} {kind} found", 0
    for _, small, scale in search_sizes(image):
        for picture in (small, 255 - small):
            blobs = round_blobs(picture)
            most = max(most, len(blobs))
            if len(blobs) < board.corners:
                continue
            centers = _find_grid(picture, board)
            if centers is None:
                continue
            ordered = circle_order(centers, board)
            if ordered is None:
                reason = "the grid of circles found is not the board"
                continue
            places = torch.tensor([blob.pt for blob in blobs], dtype=torch.float64)
            if _goes_on(places, ordered, board):
                reason = f"circles go on beyond {board.columns}x{board.rows}: the board has more than that"
                continue
            own = torch.cdist(ordered, places).argmin(1)
            sizes = torch.tensor([blob.size for blob in blobs], dtype=torch.float64)[own]
            first = local_maps(board.points[:, :2], ordered).first
            radius = float((0.5 * sizes / torch.linalg.det(first).abs().sqrt()).median())
            return to_full_size(ordered, scale), radius
    if reason.startswith("no grid") and most:
        reason += f" ({most} round blobs seen, {board.corners} are needed, all in the image)"
    raise NotFoundError(reason)


def refine_circles(image: Gray, pixels: Tensor, board: Board, radius: float) -> tuple[Refined, float]:
    """The images of the circles' centers, and the circles' radius as it is seen, meters.

    Args:
        image: (H, W) uint8 or uint16.
        pixels: (corners, 2) starts in the board's order, all finite.
        board: the board; its diameter, if it has one, is used for the correction of the centers, else that seen.
        radius: of the circles, meters, about.
    """
    points = board.points[:, :2]
    first = local_maps(points, pixels).first
    center, shape = pixels, _symmetric(torch.linalg.inv(first)) / radius
    for _ in range(2):  # the second time with the pixels that belong to what was found
        size = torch.linalg.det(shape).rsqrt()
        reach = (board.spacing / radius - 1.0 - _FOREIGN / size).clamp(1.15, _MOST_REACH)
        found = fit_ellipses(image, center, shape, reach)
        usable = found.converged & ((found.center - pixels).norm(dim=-1) < _MOST_MOVE * size)
        if not bool(usable.any()):
            break
        center = torch.where(usable[:, None], found.center, center)
        shape = torch.where(usable[:, None, None], found.shape, shape)
        radius = float((torch.linalg.det(shape) * torch.linalg.det(first)).rsqrt()[usable].median())
    refined = _with_statuses(image, pixels, found)
    good = refined.status == CornerStatus.GOOD
    if int(good.sum()) < _LEAST_KNOWN:
        return refined, radius
    maps = local_maps(points, found.center, good)
    shift = center_shift(maps, 0.5 * board.diameter if board.diameter is not None else radius)
    return refined._replace(pixels=refined.pixels - shift), radius


def wrong_size(board: Board, radius: float) -> str:
    """Why circles that look this large cannot be the board's; empty if they can."""
    if board.diameter is None:
        return ""
    ratio = 2.0 * radius / board.diameter
    if 1.0 / _SIZE_RATIO < ratio < _SIZE_RATIO:
        return ""
    return (
        f"the circles are {2e3 * radius:.3g} mm wide where their distance is {1e3 * board.square:g} mm, "
        f"the board's are {1e3 * board.diameter:g} mm: check distance and diameter"
    )


def circle_order(pixels: Tensor, board: Board) -> Tensor | None:
    """Centers (corners, 2) in the board's order; None if they fit it in none.

    The order is never mirrored. Where a board looks the same in two orders, the one nearest to upright in the image.
    """
    grid = pixels.reshape(board.rows, board.columns, 2)
    turns = [grid, grid.flip(0), grid.flip(1), grid.flip(0, 1)]
    if board.columns == board.rows and board.pattern == "circles":
        turns += [turn.transpose(0, 1) for turn in turns]
    points = board.points[:, :2]
    fits: list[tuple[float, float, Tensor]] = []
    for turn in turns:
        candidate = turn.reshape(-1, 2)
        there = torch.nn.functional.pad(points, (0, 1), value=1.0) @ homography(points, candidate).T
        if not bool((there[:, 2] > 0).all()):
            continue
        miss = float((there[:, :2] / there[:, 2:] - candidate).norm(dim=-1).square().mean().sqrt())
        first = local_maps(points, candidate).first
        if not bool((torch.linalg.det(first) > 0).all()):
            continue  # mirrored, or folded
        across, down = torch.nn.functional.normalize(first.mean(0), dim=0).unbind(-1)
        side = float(torch.linalg.det(first).sqrt().median()) * board.spacing
        upright = float(across[0] + down[1]) + 1e-6 * float(across[1] - down[0])
        if miss < 0.5 * side:
            fits.append((miss / side, upright, candidate))
    if not fits:
        return None
    best = min(fits)[0]
    return max((fit for fit in fits if fit[0] < 2.0 * best + 0.02), key=lambda fit: fit[1])[2]


def round_blobs(image: npt.NDArray[np.uint8], circularity: float = 0.0) -> list[cv2.KeyPoint]:
    """Dark round spots of an image."""
    return list(_detector(image.size, circularity).detect(image))


def _detector(pixels: int, circularity: float = 0.0) -> cv2.SimpleBlobDetector:
    """Blobs of any size and tilt: OpenCV's own settings lose circles that are small, large, near or seen from aside."""
    options = cv2.SimpleBlobDetector.Params()
    options.minThreshold, options.maxThreshold, options.thresholdStep = 20, 235, 10
    options.minDistBetweenBlobs = 4
    options.filterByArea, options.minArea, options.maxArea = True, 12, 0.05 * pixels
    options.filterByCircularity, options.minCircularity = circularity > 0, max(circularity, 0.01)
    options.filterByInertia, options.minInertiaRatio = True, 0.05
    options.filterByConvexity, options.minConvexity = True, 0.85
    return cv2.SimpleBlobDetector.create(options)


def _find_grid(image: npt.NDArray[np.uint8], board: Board) -> Tensor | None:
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.pattern == "asymmetric" else cv2.CALIB_CB_SYMMETRIC_GRID
    size, detector = (board.columns, board.rows), _detector(image.size)
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        found, centers = in_new_thread(cv2.findCirclesGrid, image, size, None, flags, detector)
        if found:
            return torch.from_numpy(np.asarray(centers, np.float64).reshape(-1, 2))
    return None


def _goes_on(blobs: Tensor, pixels: Tensor, board: Board) -> bool:
    """Whether more than half of the places one row or column beyond the grid have a blob."""
    points = board.points[:, :2] / board.square
    there = torch.nn.functional.pad(blobs, (0, 1), value=1.0) @ homography(pixels, points).T
    seen = there[:, :2] / there[:, 2:]
    step = 2.0 if board.pattern == "asymmetric" else 1.0
    grid = points.reshape(board.rows, board.columns, 2)
    beside = [grid[:, 0] - torch.tensor([step, 0.0]), grid[:, -1] + torch.tensor([step, 0.0])]
    # The next row but one of asymmetric circles is a shift of a row, the next one of the row before.
    up, down = (grid[1], grid[-2]) if board.pattern == "asymmetric" else (grid[0], grid[-1])
    beside += [up - torch.tensor([0.0, step]), down + torch.tensor([0.0, step])]
    return any(float((torch.cdist(side.double(), seen).amin(1) < _LATTICE).double().mean()) > 0.5 for side in beside)


def _symmetric(matrix: Tensor) -> Tensor:
    """The symmetric positive B with |B v| = |matrix v|, for (M, 2, 2)."""
    values, vectors = torch.linalg.eigh(matrix.mT @ matrix)
    return vectors @ torch.diag_embed(values.clamp_min(1e-18).sqrt()) @ vectors.mT


def _with_statuses(image: Gray, start: Tensor, found: Ellipses) -> Refined:
    height, width = image.shape
    size = torch.linalg.det(found.shape).clamp_min(1e-12).rsqrt()
    half = torch.linalg.vector_norm(torch.linalg.inv(found.shape), dim=-1) + found.blur[:, None]
    limit = torch.tensor([width - 1.0, height - 1.0], dtype=torch.float64)
    inside = ((found.center >= half) & (found.center <= limit - half)).all(-1)
    alike = found.contrast.sign() == found.contrast.median().sign()
    result, status = with_status(
        found.center,
        (
            (CornerStatus.OUTSIDE, inside),
            (CornerStatus.NO_SADDLE, alike & torch.isfinite(found.center).all(-1)),
            (CornerStatus.OCCLUDED, found.misfit <= _MOST_MISFIT),
            (CornerStatus.BLURRED, found.blur <= _MOST_BLUR * size),
            (CornerStatus.MOVED, (found.center - start).norm(dim=-1) <= _MOST_MOVE * size),
            (CornerStatus.NOT_CONVERGED, found.converged),
        ),
    )
    good = status == CornerStatus.GOOD
    covariance = torch.where(good[:, None, None], found.covariance, float("nan"))
    return Refined(result, status, covariance, torch.where(good, found.blur, float("nan")))
