"""What views of the board leave open: advice on the next pictures, and refusal where too much is open."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import board_modes
from kcal.calibrate.hybrid.fit import check_tilts
from kcal.calibrate.problem.views import Views, poses_under
from kcal.corners.board import Board
from kcal.corners.observations import Observations
from kcal.errors import DegenerateError
from kcal.finding import Finding
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.model import LensModel
from kcal.lens.pose import rotation_from_vector, step_rows
from kcal.lens.projection import FAR, project_components
from kcal.lens.uncertainty import paraxial_focal, pixel_covariance, pixel_slopes
from kcal.solve.lm import LMOptions

# Tell what the next pictures of the board should show, from what the present ones leave open.

# Pixels of the longer side on which areas are counted.
_RASTER = 160
# A calibration from fewer views leaves σ of the focal length above one part in a thousand with 0.1 px of noise.
_FEW_VIEWS = 10
# Names of more parts of the image than this are not read.
_MANY_PARTS = 3
# In a share of the image that is larger than this no board was seen: worth a picture.
_LARGE_SHARE = 0.1
# Rolls within ±25° more than double σ of the principal point; rolls up to 90° are nearly as good as any.
ROLL_SPAN = 60.0
STEEP = 20.0
# Boards that are rolled by less than this about one direction leave aspect, print and principal point confounded.
_UPRIGHT = 20.0


def reached(observations: Observations, columns: int, rows: int) -> Tensor:
    """(rows, columns) which parts of the image lie within the corners of some view's board.

    Example:
        >>> from kcal import Board, View
        >>> view = View(name="a", pixels=((0.0, 0.0), (50.0, 0.0), (0.0, 99.0), (50.0, 99.0)))
        >>> seen = Observations(board=Board(columns=2, rows=2, square=0.1), image_size=(100, 100), views=(view,))
        >>> 0.45 < float(reached(seen, 100, 100).double().mean()) < 0.55
        True
    """
    width, height = observations.image_size
    x = (np.arange(columns) + 0.5) * (width / columns) - 0.5
    y = (np.arange(rows) + 0.5) * (height / rows) - 0.5
    open_places = np.ones((rows, columns), dtype=bool)
    for view in observations.pixels().numpy():
        corners = view[np.isfinite(view).all(-1)]
        if len(corners) < 3:
            continue
        (left, top), (right, bottom) = corners.min(0), corners.max(0)
        across = slice(np.searchsorted(x, left), np.searchsorted(x, right, "right"))
        down = slice(np.searchsorted(y, top), np.searchsorted(y, bottom, "right"))
        around = open_places[down, across]
        # Most views show nothing that others have not shown.
        if around.any():
            hull = _convex_hull(corners)
            side_x, side_y = (np.roll(hull, -1, 0) - hull).T
            row, column = around.nonzero()
            places = np.stack([x[across][column], y[down][row]], -1)[:, None] - hull
            around[row, column] = ~(side_x * places[..., 1] >= side_y * places[..., 0]).all(-1)
    return torch.from_numpy(~open_places)


def _convex_hull(points: np.ndarray) -> np.ndarray:
    """(K, 2) of points (N, 2), one after the other towards y from x.

    Source: A. Andrew 1979, the monotone chain. Loading SciPy's takes longer than many a calibration.
    """
    ordered, hull = sorted(map(tuple, points.tolist())), list[tuple[float, float]]()
    for way in (ordered, ordered[::-1]):
        begin = len(hull) + 1
        for x, y in way:
            while len(hull) > begin:
                (x0, y0), (x1, y1) = hull[-2:]
                if (x1 - x0) * (y - y0) > (y1 - y0) * (x - x0):
                    break
                hull.pop()
            hull.append((x, y))
        hull.pop()
    return np.array(hull)


def unreached_share(observations: Observations) -> float:
    """Share of the image that no board reached."""
    return 1.0 - float(_raster(observations).double().mean())


def what_to_photograph(observations: Observations, camera: Camera, rotation: Tensor) -> tuple[str, ...]:
    """What the next pictures should show, the most useful first.

    Args:
        observations: the views.
        camera: as calibrated.
        rotation: (V, 3, 3) cam_from_board; NaN for views that were left out.
    """
    rotation = rotation[rotation.isfinite().all(-1).all(-1)]
    advice = []
    if int((board_tilts(rotation) > STEEP).sum()) < 4:
        advice.append("tilt the board by 30 to 45 degrees in different directions: tilts determine the focal length")
    if (span := roll_span(rotation)) < ROLL_SPAN:
        advice.append(
            f"roll the board by 90 degrees in a third of the views (so far within {span:.0f} degrees): rolls tell the "
            "principal point from the print of the board"
        )
    place = _emptiest(_raster(observations))
    if place:
        advice.append(f"show the board in the {place} of the image: where no board was, the lens is extrapolated")
    if len(rotation) < _FEW_VIEWS:
        advice.append(f"take more views: {len(rotation)} are few, 20 to 40 are good")
    return tuple(advice)


def _raster(observations: Observations) -> Tensor:
    width, height = observations.image_size
    step = max(width, height) / _RASTER
    return reached(observations, max(1, round(width / step)), max(1, round(height / step)))


def board_tilts(rotation: Tensor) -> Tensor:
    """(V,) degrees between the boards' normals and the optical axis, of cam_from_board rotations (V, 3, 3).

    Example:
        >>> board_tilts(torch.eye(3)[None]).tolist()
        [0.0]
    """
    return torch.rad2deg(torch.acos(rotation[:, 2, 2].abs().clamp(max=1.0)))


def board_rolls(rotation: Tensor) -> Tensor:
    """(V,) degrees by which boards are turned about the optical axis, of cam_from_board rotations (V, 3, 3).

    Example:
        >>> board_rolls(torch.eye(3)[None]).tolist()
        [0.0]
    """
    return torch.rad2deg(torch.atan2(rotation[:, 1, 0] - rotation[:, 0, 1], rotation[:, 0, 0] + rotation[:, 1, 1]))


def roll_span(rotation: Tensor) -> float:
    """Degrees within which the rolls of all views lie; a half turn of a board counts as a roll."""
    ordered = board_rolls(rotation).sort().values
    gaps = torch.cat([ordered.diff(), (ordered[:1] + 360.0 - ordered[-1:])])
    return 360.0 - float(gaps.max()) if len(gaps) else 0.0


def roll_findings(rotation: Tensor) -> list[Finding]:
    """A doubt where every view shows the board the same way up, or upside down.

    The height of the image's pixels over their width, the same ratio of the board's squares, and the principal point
    then do nearly the same to all views.

    Args:
        rotation: (V, 3, 3) cam_from_board; NaN for views that were left out.

    Example:
        >>> roll_findings(torch.eye(3).expand(12, 3, 3))[0].text[:57]
        'all 12 views show the board upright (rolled by at most 0°'
    """
    rolls = board_rolls(rotation[rotation.isfinite().all(-1).all(-1)])
    for middle, held in ((0.0, "upright"), (90.0, "on its side")):
        away = ((rolls - middle + 90.0) % 180.0 - 90.0).abs()
        if len(away) and float(away.max()) <= _UPRIGHT:
            text = (
                f"all {len(rolls)} views show the board {held} (rolled by at most {float(away.max()):.0f}°): pixels "
                "that are not square, a stretched print and a shifted principal point look alike in such views"
            )
            return [Finding("roll", "doubt", text, "turn the board or the camera by 90° for a third of the views")]
    return []


def _emptiest(seen: Tensor) -> str:
    """The name of the corner or side of the image that boards reached least; empty where all of them were reached."""
    rows, columns = seen.shape
    names = {}
    for i, vertical in enumerate(("top", "", "bottom")):
        for j, horizontal in enumerate(("left", "", "right")):
            part = seen[i * rows // 3 : (i + 1) * rows // 3, j * columns // 3 : (j + 1) * columns // 3]
            name = " ".join(word for word in (vertical, horizontal) if word) or "middle"
            names[name] = 1.0 - float(part.double().mean())
    if 1.0 - float(seen.double().mean()) <= _LARGE_SHARE:
        return ""
    worst = max(names.values())
    poor = [name for name, share in names.items() if share > max(0.5, 0.9 * worst)]
    if len(poor) > _MANY_PARTS:
        return "corners and along the sides" if "middle" not in poor else "middle, the corners and along the sides"
    return ", ".join(poor) if poor else max(names, key=lambda name: names[name])


# Refuse a calibration whose views leave open where the camera sees what they showed.
#
# A parameter with a large σ is no fault by itself: others may make up for it everywhere that a board was. So what
# counts is the projection: how uncertain the directions are in which the corners were seen, after the best-fit
# rotation of the camera, in shares of how far these corners are from their middle. For a pinhole that is the relative
# σ of its focal length.

# Directions less certain than this are no calibration: 5 % of range at every distance.
_MOST = 0.05
# Corners that stand for all: more change nothing.
_CORNERS = 400


def direction_share(parameters: Tensor, model: LensModel, points: Tensor, covariance: Tensor) -> float:
    """σ of the directions in which points are seen, in shares of their distances from their middle in the image.

    Both as root mean squares. A turn of the camera does not count, because no board determines it.

    Args:
        parameters: (5 + P,).
        model: the lens model.
        points: (N, 3) in the camera's frame: the corners that were seen.
        covariance: (5 + P, 5 + P) of the parameters.

    Returns:
        infinite where the covariance is not finite or no corner has an image.

    Example:
        >>> pinhole = torch.tensor([800.0, 800.0, 320.0, 240.0, 0.0], dtype=torch.float64)
        >>> corners = torch.tensor([[-0.02, -0.02, 1], [0.02, -0.02, 1], [-0.02, 0.02, 1], [0.02, 0.02, 1]]).double()
        >>> spread = torch.zeros(5, 5, dtype=torch.float64)
        >>> spread[:2, :2] = 8.0**2  # one focal length, ± 1 %
        >>> round(direction_share(pinhole, LensModel(), corners, spread), 4)
        0.01
    """
    chosen = points[:: max(1, len(points) // _CORNERS)]
    rays = FAR * chosen / torch.linalg.vector_norm(chosen, dim=-1, keepdim=True)
    wanted = [i for i, value in enumerate(covariance.diagonal().tolist()) if value != 0]
    seen = project_components(rays.T, parameters, model, wanted)
    good = seen.regular & seen.pixels.isfinite().all(0)
    if not wanted:
        return 0.0
    if int(good.sum()) < 4 or not bool(covariance.isfinite().all()):
        return math.inf
    by_turn = step_rows(seen.by_point, rays.T)[:3, :, good].flatten(1).T
    by_turn = by_turn / by_turn.norm(dim=0)
    by_camera = seen.by_camera[..., good].flatten(1).T
    by_camera = by_camera - by_turn @ torch.linalg.lstsq(by_turn, by_camera).solution
    variance = ((by_camera @ covariance[wanted][:, wanted]) * by_camera).sum().clamp_min(0.0)
    pixels = seen.pixels[:, good]
    spread = (pixels - pixels.mean(1, keepdim=True)).square().sum()
    return float((variance / spread).sqrt()) if float(spread) > 0 else math.inf


def check_directions(
    parameters: Tensor,
    model: LensModel,
    points: Tensor,
    seen: Tensor,
    covariance: Tensor,
    rotation: Tensor,
    names: Sequence[str] = (),
) -> None:
    """Raise `DegenerateError` where the views hardly determine the directions in which they were seen.

    Args:
        parameters: (5 + P,).
        model: the lens model.
        points: (V, N, 3) corners in the camera's frame.
        seen: (V, N) which of them count.
        covariance: (5 + P, 5 + P) of the parameters; a diagonal that is infinite or NaN: not determined.
        rotation: (V, 3, 3) cam_from_board; NaN for views that were left out.
        names: of the views, for the message.
    """
    used = rotation.isfinite().all(-1).all(-1).nonzero()[:, 0].tolist()
    if float(covariance[0, 0]) > 0.0:
        check_tilts(rotation[used])
    share = direction_share(parameters, model, points[seen], covariance)
    if share <= _MOST:
        return
    known = "not at all" if math.isinf(share) else f"only to ±{100 * share:.1f} %"
    tilts = board_tilts(rotation[used])
    most = int(tilts.argmax())
    name = names[used[most]] if names else f"view {used[most]}"
    smaller = "" if model.hybrid else ", or choose a smaller model"
    tilted = int((tilts > STEEP).sum())
    raise DegenerateError(
        f"the views determine the focal length {known}, measured over the part of the image that they show: the "
        f"board is tilted by more than {STEEP:.0f}° in {tilted} of {len(used)} views (by {float(tilts[most]):.0f}° at "
        f"most, in {name}), or the views are too similar; add views with the board tilted by 30 to 45 degrees to the "
        f"left, right, top and bottom{smaller}"
    )


# Find the view of the board that would tell most about a camera, from what its calibration leaves open.
#
# Of many places, distances, tilts and rolls of the board, each adds rows to the square-root information of the camera
# once its own pose is eliminated. The best one reduces the variance of points at infinity most, averaged over the image
# (A-optimal design; for calibration: Peng and Sturm, "Calibration wizard", ICCV 2019).

# Grid of the image over which variances are averaged.
_GRID = (13, 9)
# What a person can hold: shares of the image's shorter side that a board fills, degrees of tilt, quarter rolls.
_FILLS, _TILT, _ROLLS = (0.35, 0.65), math.radians(40.0), (0.0, 0.5 * math.pi)
_TILTS = {
    (0.0, 0.0): "facing the camera",
    (_TILT, 0.0): "its lower side away from the camera",
    (-_TILT, 0.0): "its upper side away from the camera",
    (0.0, _TILT): "its left side away from the camera",
    (0.0, -_TILT): "its right side away from the camera",
}


class BoardViews(NamedTuple):
    """Views of a board that could be taken.

    Attributes:
        rotation: (C, 3, 3) cam_from_board.
        translation: (C, 3) meters.
        pixels: (C, N, 2) of the corners.
        words: how the board is held.
    """

    rotation: Tensor
    translation: Tensor
    pixels: Tensor
    words: tuple[str, ...]


class NextView(NamedTuple):
    """The view to take next.

    Attributes:
        rotation: (3, 3) cam_from_board.
        translation: (3,) meters.
        pixels: (N, 2) where its corners would be.
        words: how to hold the board.
        sigma: pixels, `far_sigma` of the camera after this view.
    """

    rotation: Tensor
    translation: Tensor
    pixels: Tensor
    words: str
    sigma: float


def possible_views(camera: Camera, board: Board) -> BoardViews:
    """Views of a board all over the image, near and far, facing the camera and tilted, upright and rolled.

    Args:
        camera: as known so far.
        board: whose corners are all in the image.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="pinhole")
        >>> views = possible_views(camera, Board(columns=7, rows=6, square=0.05))
        >>> len(views.words) > 100, bool((views.pixels > 0).all())
        (True, True)
    """
    width, height = camera.size
    side, points = min(width, height), board.points
    middle = 0.5 * (points.amin(0) + points.amax(0))
    extent = float((points.amax(0) - points.amin(0)).max())
    rotations, translations, words = [], [], []
    for fill in _FILLS:
        margin = (0.5 * fill + 0.06) * side
        rows = {"top": margin, "": 0.5 * height, "bottom": height - margin}
        columns = {"left": margin, "": 0.5 * width, "right": width - margin}
        places = list(itertools.product(rows.items(), columns.items()))
        rays, valid = camera.unproject(torch.tensor([[u, v] for (_, v), (_, u) in places], dtype=torch.float64))
        distance = extent * float(paraxial_focal(camera).value.min()) / (fill * side)
        size = "near" if fill == _FILLS[-1] else "far"
        for ((up, _), (across, _)), ray in zip(itertools.compress(places, valid), rays[valid], strict=True):
            place = " ".join(filter(None, (up, across))) or "middle"
            for roll, (tilt, leaning) in itertools.product(_ROLLS, _TILTS.items()):
                turn = _facing(ray) @ _rotation(*tilt, 0.0) @ _rotation(0.0, 0.0, roll)
                rotations.append(turn)
                translations.append(distance * ray - turn @ middle)
                rolled = ", rolled by a quarter" if roll else ""
                words.append(f"{size}, in the {place} of the image, {leaning}{rolled}")
    rotation, translation = torch.stack(rotations), torch.stack(translations)
    pixels, valid = camera.project(points @ rotation.mT + translation[:, None])
    inside = ((pixels >= 0) & (pixels <= torch.tensor([width - 1, height - 1], dtype=pixels.dtype))).all(-1)
    good = (inside & valid).all(-1)
    return BoardViews(rotation[good], translation[good], pixels[good], tuple(itertools.compress(words, good)))


def far_sigma(camera: Camera) -> float:
    """Standard deviation along an axis of where a camera sees far points, RMS over its image, pixels.

    After the best-fit rotation, as `kcal.lens.uncertainty.projection_sigma`. NaN for a camera without error bars.
    """
    if camera.calibration is None or camera.calibration.known(camera.params.detach()) is None:
        return math.nan
    variances = pixel_covariance(camera, camera.grid(*_GRID).reshape(-1, 2), grid=_GRID).diagonal(dim1=-2, dim2=-1)
    return math.sqrt(float(variances.nanmean()))


def next_view(camera: Camera, board: Board, noise: float, taken: Tensor | None = None) -> NextView | None:
    """The view that reduces the uncertainty of points at infinity most.

    Args:
        camera: with its calibration.
        board: that is photographed.
        noise: of its corners along an axis, pixels.
        taken: corners (V, N, 2) of views that the calibration does not know yet, NaN where one was not seen.

    Returns:
        None for a camera without error bars, or whose image no board fits into.
    """
    known = None if camera.calibration is None else camera.calibration.known(camera.params.detach())
    views = possible_views(camera, board)
    if known is None or not views.words:
        return None
    half, shapes = known.half(), board_modes(board.points).shapes
    if taken is not None and len(taken):
        half = _half_after(camera, known, board.points, shapes, half, taken, noise)
    # Derivatives of the image's grid by the unknowns, far away, after the best-fit rotation.
    wanted = [index for index, slot in enumerate(known.slots) if slot >= 0]
    by_camera, by_motion, good = pixel_slopes(camera, camera.grid(*_GRID).reshape(-1, 2), math.inf, wanted)
    flat, by_turn = by_camera[good].flatten(0, 1), by_motion[good][..., :3].flatten(0, 1)
    flat = flat - by_turn @ torch.linalg.lstsq(by_turn, flat).solution
    slopes, gains = flat @ known.selection()[wanted] @ half.T, []
    for rotation, translation in zip(views.rotation, views.translation, strict=True):
        rows = _view_rows(camera, known, board.points, shapes, rotation, translation) @ half.T / noise
        # Variance that this view takes away: G Aᵀ (1 + A Aᵀ)⁻¹ A Gᵀ.
        lower = torch.linalg.cholesky(torch.eye(len(rows), dtype=rows.dtype) + rows @ rows.T)
        gains.append(float(torch.linalg.solve_triangular(lower, rows @ slopes.T, upper=False).square().sum()))
    best = max(range(len(gains)), key=gains.__getitem__)
    sigma = math.sqrt(max(float(slopes.square().sum()) - gains[best], 0.0) / len(slopes))
    return NextView(views.rotation[best], views.translation[best], views.pixels[best], views.words[best], sigma)


def _half_after(
    camera: Camera, known: CameraInformation, points: Tensor, shapes: Tensor, half: Tensor, taken: Tensor, noise: float
) -> Tensor:
    """The half of the covariance after these views as well, each in the pose in which this camera sees it."""
    poses, _ = poses_under(camera, Views(board_points=points, pixels=taken), LMOptions())
    for pixels, rotation, translation in zip(taken, poses.rotation, poses.translation, strict=True):
        seen = torch.isfinite(pixels).all(-1)
        if bool(torch.isfinite(rotation).all()):
            rows = _view_rows(camera, known, points[seen], shapes[..., seen], rotation, translation) @ half.T / noise
            lower = torch.linalg.cholesky(torch.eye(rows.shape[1], dtype=rows.dtype) + rows.T @ rows)
            half = torch.linalg.solve_triangular(lower, half, upper=False)
    return half


def _view_rows(
    camera: Camera, known: CameraInformation, points: Tensor, shapes: Tensor, rotation: Tensor, translation: Tensor
) -> Tensor:
    """(2 N - 6, U) derivatives of a view's corners by the unknowns, off the view's pose; `shapes` are board modes."""
    wanted = [index for index, slot in enumerate(known.slots) if slot >= 0]
    placed = points @ rotation.T + translation
    seen = project_components(placed.T, camera.params.detach(), camera.model, wanted)
    rows = seen.by_camera.flatten(1).T @ known.selection()[wanted]
    if known.board_size:
        by_point = torch.einsum("pcn,pk->kcn", seen.by_point, rotation)
        rows[:, known.lens_size :] = torch.einsum("kcn,bkn->cnb", by_point, shapes).flatten(0, 1)
    by_pose = step_rows(seen.by_point, placed.T).flatten(1).T
    return torch.linalg.qr(by_pose, mode="complete").Q[:, by_pose.shape[1] :].T @ rows


def _rotation(x: float, y: float, z: float) -> Tensor:
    return rotation_from_vector(torch.tensor([x, y, z], dtype=torch.float64))


def _facing(ray: Tensor) -> Tensor:
    """The smallest turn of the optical axis into a ray."""
    axis = torch.stack([-ray[1], ray[0], torch.zeros_like(ray[0])])
    sine = torch.linalg.vector_norm(axis)
    return rotation_from_vector(axis / sine.clamp_min(1e-300) * torch.atan2(sine, ray[2]))
