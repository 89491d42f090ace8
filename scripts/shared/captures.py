"""Simulate the corners of a board in many views, with noise, without rendering images; poses that both cameras see.

Ray-traced lenses, boards as they are printed, and captures of boards by such lenses.

Compare a calibrated camera with the true lens at infinity, where errors matter at long range.

More lenses for simulations than kcal's own: a machine vision lens of spheres, and a webcam's of aspheres.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from kcal import Board, Camera, InputError, Observations, Rig, View
from kcal.lens import LensModel
from kcal.lens.model import HybridForm, radius_over_angle
from kcal.lens.pose import Pose, rotation_between, rotation_from_vector
from kcal.lens.projection import project_components
from kcal.lens.zernike import ZernikeModes
from kcal.sim.captures import (
    BoardLike,
    BoardSize,
    LensLike,
    PoseOptions,
    PrintedBoard,
    TrueRig,
    board_points,
    check_draws,
    choose_poses,
    draw_poses,
    project_board,
    sample_board_poses,
)
from kcal.sim.raytrace import SURVEILLANCE, Prescription, Surface, spheres
from kcal.sim.truth import TruthLens

_STEPS, _GOAL = 30, 1e-15


@dataclasses.dataclass(frozen=True, kw_only=True)
class Asphere(Surface):
    """z = c r² / (1 + sqrt(1 - (1 + conic) c² r²)) + even[0] r⁴ + even[1] r⁶ + ..., met by Newton's method.

    Args:
        conic: conic constant; 0 is a sphere.
        even: aspheric coefficients of r⁴, r⁶ and on, in millimeters to the power of -3, -5 and on.
    """

    conic: float = 0.0
    even: tuple[float, ...] = ()

    def scaled(self, scale: float) -> Self:
        """See `Surface`."""
        even = tuple(value / scale ** (2 * i + 3) for i, value in enumerate(self.even))
        return dataclasses.replace(super().scaled(scale), even=even)

    def meet(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """See `Surface`; a line may miss the conic and still meet the asphere."""
        # From the plane, not from the conic: where the asphere is far from it, another root may be nearer.
        at, forward = self._from_vertex(points, directions)
        L, M, N = forward.unbind(-1)
        longest = 0.2 * abs(self.radius)
        for _ in range(_STEPS):
            height, slope = self.sag((at[..., :2] ** 2).sum(-1))
            across = 2 * slope * (at[..., 0] * L + at[..., 1] * M)
            step = ((height - at[..., 2]) / (N - across)).clamp(-longest, longest)
            at = at + step[..., None] * forward
            if not bool((step.abs() > _GOAL).any()):
                break
        return at, (step.abs() < 1e-12) & torch.isfinite(at).all(-1)

    def sag(self, r2: Tensor) -> tuple[Tensor, Tensor]:
        """See `Surface`."""
        c, k = self.curvature, self.conic
        root = torch.sqrt((1 - (1 + k) * c**2 * r2).clamp_min(1e-12))
        height, slope = c * r2 / (1 + root), 0.5 * c / root
        power = r2
        for i, value in enumerate(self.even):
            slope = slope + (i + 2) * value * power
            power = power * r2
            height = height + value * power
        return height, slope


# Refractive indices at the d line, from the makers' catalogs.
_N_SK10, _SK15, _BASF2, _FK3, _SF15, _N_LAK12 = 1.62278, 1.62299, 1.66446, 1.46450, 1.69895, 1.67790


def _parabolas(*rows: tuple[float, float, float, tuple[float, ...]]) -> tuple[Asphere, ...]:
    return tuple(Asphere(radius=row[0], thickness=row[1], index=row[2], conic=-1.0, even=row[3]) for row in rows)


MACHINE_VISION = Prescription(
    name="machine-vision",
    source="reverse telephoto, 60 degrees, a sample of optiland (MIT): samples.objectives.ReverseTelephoto",
    surfaces=spheres(
        (1.69111096, 0.08259680, _N_SK10),
        (0.94414496, 0.8),
        (4.32100401, 0.080256, _SK15),
        (1.78117621, 0.5),
        (2.64050282, 0.27638160, _BASF2),
        (-3.86177348, 0.1),
        (1.05627661, 0.2, _FK3),
        (-4.06933311, 0.2001384),
        (math.inf, 0.06688),
        (-2.61246583, 0.064372, _SF15),
        (0.99117409, 0.3),
        (9.03045960, 0.18743120, _N_LAK12),
        (-1.35680743, 2.35130547),
    ),
    stop=8,
    tolerance=0.003,
)

WEBCAM = Prescription(
    name="webcam",
    source="US patent 7,535,658: four plastic aspheres and a filter; its profiles, published with odd powers "
    "too, fitted with even ones to 1.3 µm",
    surfaces=(
        *spheres((math.inf, 0.0)),
        *_parabolas(
            (1.97378, 1.19, 1.471, (-0.012078, 0.181459, -0.69462, 1.28702, -0.930784)),
            (34.29, 0.93, 1.0, (-0.0327156, 0.0711206, -0.27758, 0.516964, -0.406918)),
            (-2.11766, 0.75, 1.603, (-0.118339, 0.107778, -0.119367, 0.0667901, -0.0231792)),
            (-4.66183, 0.1, 1.0, (-0.171663, 0.155596, -0.0719066, 0.0172037, -1.43605e-3)),
            (9.57112, 0.89, 1.51, (-0.0505526, 0.0350105, -0.0141519, 2.35332e-3, -1.59633e-4)),
            (8.5927, 0.16, 1.0, (3.22416e-3, -4.72162e-3, 5.23296e-4, -3.73407e-05, -4.22958e-08)),
            (1.6689, 0.85, 1.51, (-0.104593, 0.0143573, -1.51141e-3, 1.14048e-4, -3.70705e-06)),
            (1.59731, 0.7, 1.0, (-0.0887896, 0.0121398, -1.27989e-3, 8.19958e-05, -2.39836e-06)),
        ),
        *spheres((math.inf, 0.40, 1.516), (math.inf, 0.64)),
    ),
    stop=0,
    focal=2000.0,
    tolerance=0.0003,
)

PRESCRIPTIONS = {lens.name: lens for lens in (SURVEILLANCE, MACHINE_VISION, WEBCAM)}


_TURN_STEPS = 4
_TURN_NUDGE = 1e-6  # radians, for central differences


class InfinityError(NamedTuple):
    """Difference of a camera from the truth at infinity, after the best rotation.

    Attributes:
        rms: sqrt(mean ‖e‖²) over the image, pixels.
        maximum: largest ‖e‖, pixels.
        rotation: (3, 3) camera_from_truth: the turn of the camera frame, which no board determines and no rig needs.
        pixels: (rows, columns, 2) where it was measured.
        errors: (rows, columns, 2) pixel at which the camera sees what the truth sees at `pixels`, minus that pixel;
            NaN where the camera does not see it.
        valid: share of `pixels` that the camera sees.
    """

    rms: float
    maximum: float
    rotation: Tensor
    pixels: Tensor
    errors: Tensor
    valid: float


@torch.no_grad()
def error_at_infinity(camera: LensLike, truth: LensLike, *, columns: int = 49, rows: int = 28) -> InfinityError:
    """Measure over the whole image how far a camera's pixels of distant points are from the true ones.

    Each pixel of a grid has a true direction. The camera projects these directions after the rotation that makes the
    RMS smallest. This is mrcal's projection difference with its
    implied rotation fitted at infinity (mrcal.secretsauce.org/differencing.html).

    Args:
        camera: the calibrated camera: a `Camera`, or anything that projects.
        truth: the true lens: anything that unprojects.
        columns: of the grid, whose outermost pixels are the image's.
        rows: of the grid.

    Raises:
        InputError: images of different sizes, or a camera that sees none of the directions.

    Example:
        >>> from kcal import Camera
        >>> truth = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480))
        >>> camera = Camera.build(focal=(800, 800), center=(329.5, 239.5), size=(640, 480))
        >>> found = error_at_infinity(camera, truth)  # a shifted center is a rotation, nearly
        >>> round(found.rms, 2), round(found.maximum, 2), found.valid
        (0.62, 1.52, 1.0)
    """
    if tuple(camera.size) != tuple(truth.size):
        raise InputError(f"images of {tuple(camera.size)} and {tuple(truth.size)}: the same size is needed")
    width, height = truth.size
    x = torch.linspace(0, width - 1, columns, dtype=torch.float64)
    y = torch.linspace(0, height - 1, rows, dtype=torch.float64)
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    rays, known = truth.unproject(pixels.reshape(-1, 2))
    seen_rays, seen = camera.unproject(pixels.reshape(-1, 2))
    both = known & seen
    if int(both.sum()) < 3:
        raise InputError("error_at_infinity: the camera and the truth have no rays in common")
    rotation = rotation_between(rays[both], seen_rays[both])
    flat = pixels.reshape(-1, 2)
    errors, valid = _errors_after_turn(camera, flat, rays, known, rotation)
    for _ in range(_TURN_STEPS):
        used = valid
        slopes = []
        for axis in torch.eye(3, dtype=torch.float64):
            ends = [
                _errors_after_turn(camera, flat, rays, known, rotation_from_vector(s * _TURN_NUDGE * axis) @ rotation)
                for s in (1, -1)
            ]
            used = used & ends[0][1] & ends[1][1]
            slopes.append((ends[0][0] - ends[1][0]) / (2 * _TURN_NUDGE))
        jacobian = torch.stack([slope[used].reshape(-1) for slope in slopes], -1)
        step = torch.linalg.lstsq(jacobian, -errors[used].reshape(-1, 1)).solution[:, 0]
        rotation = rotation_from_vector(step) @ rotation
        errors, valid = _errors_after_turn(camera, flat, rays, known, rotation)
    length = torch.linalg.vector_norm(errors[valid], dim=-1)
    return InfinityError(
        rms=float(torch.sqrt((length**2).mean())),
        maximum=float(length.max()),
        rotation=rotation,
        pixels=pixels,
        errors=torch.where(valid[:, None], errors, torch.nan).reshape(pixels.shape),
        valid=float(valid.double().mean()),
    )


def _errors_after_turn(
    camera: LensLike, pixels: Tensor, rays: Tensor, known: Tensor, rotation: Tensor
) -> tuple[Tensor, Tensor]:
    found, valid = camera.project((rays @ rotation.T) * 1e9)
    return found - pixels, valid & known


# The board of the paper: 6 x 7 corners, squares of 5 cm.
PAPER_BOARD = BoardSize(7, 6, 0.05)


class Capture(NamedTuple):
    """Views of a board and the truth about them.

    Attributes:
        pixels: (V, N, 2) corners with noise, in the order of `board_points`.
        true_pixels: (V, N, 2) without.
        rotation: (V, 3, 3) cam_from_board.
        translation: (V, 3) meters.
        points: (N, 3) corners on the board, meters.
    """

    pixels: Tensor
    true_pixels: Tensor
    rotation: Tensor
    translation: Tensor
    points: Tensor


def capture_corners(
    lens: LensLike,
    views: int,
    *,
    sigma: float,
    seed: int,
    board: BoardLike = PAPER_BOARD,
    fill: tuple[float, float] = (0.25, 0.8),
) -> Capture:
    """Simulate the corners of a board in poses that cover the image, with Gaussian noise.

    Args:
        lens: true lens.
        views: how many.
        sigma: noise in pixels along each axis.
        seed: of poses and noise; another sigma scales the same noise.
        board: its size.
        fill: smallest and largest share of the image's width or height that the board takes.

    Raises:
        InputError: see `sample_board_poses`; or a sigma that is negative.
    """
    if not 0 <= sigma < math.inf:
        raise InputError(f"sigma {sigma}: pixels, not negative, are needed")
    generator = torch.Generator().manual_seed(seed)
    poses = sample_board_poses(lens, board, views, generator, fill=fill)
    true = torch.stack([project_board(lens, pose, board)[0] for pose in poses])
    noise = torch.randn(true.shape, dtype=torch.float64, generator=generator)
    return Capture(
        true + sigma * noise,
        true,
        torch.stack([pose.rotation for pose in poses]),
        torch.stack([pose.translation for pose in poses]),
        board_points(board),
    )


def sample_pair_poses(
    rig: Rig | TrueRig,
    board: BoardLike,
    count: int,
    generator: torch.Generator,
    *,
    distance: tuple[float, float],
    options: PoseOptions | None = None,
) -> list[Pose]:
    """Choose poses that both cameras of a rig see completely, tilted against the line from the rig's middle.

    Args:
        rig: two cameras.
        board: its size.
        count: how many poses.
        generator: source of the draws; the same state gives the same poses.
        distance: nearest and farthest distance of the board's center from the left camera, meters.
        options: limits of tilt, roll and margins.

    Returns:
        left_from_board poses; `rig_pose` gives those of the right camera.

    Raises:
        InputError: fewer than `count` of 4096 drawn boards are completely seen by both, or an argument out of range.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480))
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> from kcal.sim.captures import BoardSize, project_board
        >>> board = BoardSize(9, 6, 0.1)
        >>> poses = sample_pair_poses(rig, board, 4, torch.Generator().manual_seed(1), distance=(4.0, 6.0))
        >>> bool(project_board(rig.right, rig_pose(rig, poses[0]), board)[1].all())
        True
    """
    options = options or PoseOptions()
    check_draws(count, "distance", distance)
    rotation, translation = rig.right_from_left_rotation, rig.right_from_left_translation
    middle = -0.5 * rotation.T @ translation
    drawn = draw_poses(rig.left, board, distance, middle, generator, options)
    still = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    return choose_poses(drawn, [(rig.left, *still), (rig.right, rotation, translation)], board, count, options)


def rig_pose(rig: Rig | TrueRig, left_from_board: tuple[Tensor, Tensor]) -> Pose:
    """Convert left_from_board to right_from_board."""
    rotation, translation = left_from_board
    return Pose(rig.right_from_left_rotation @ rotation, rig.right_from_left(translation))


BOARD = Board(columns=7, rows=6, square=0.05)


def printed(points: Tensor, seed: int) -> Tensor:
    """The board as a printer and a wall leave it."""
    return points + PrintedBoard(BOARD.columns, BOARD.rows, BOARD.square, seed).errors(points)


def capture(lens: LensLike, views: int, sigma: float, seed: int, *more: Any, **options: Any) -> Observations:
    """Views of a board by a lens, as those of `captures`, which has further options, with noise of one size."""
    return captures(lens, views, [sigma], seed, *more, **options)[0]


def captures(
    lens: LensLike,
    views: int,
    sigmas: Sequence[float],
    seed: int,
    points: Tensor = BOARD.points,
    fill: tuple[float, float] = (0.25, 0.8),
    posed_by: LensLike | None = None,
) -> list[Observations]:
    """Views of a board, whose corners truly are at `points`, with noise of several sizes, each drawn by itself.

    `posed_by` is a lens that draws poses sooner.
    """
    found = capture_corners(posed_by or lens, views, sigma=1.0, seed=seed, fill=fill)
    seen, valid = lens.project(points @ found.rotation.transpose(-1, -2) + found.translation[:, None])
    # Poses that another lens drew may reach beyond this one's image.
    valid &= ((seen > -0.5) & (seen < seen.new_tensor(lens.size) - 0.5)).all(-1)
    noise = found.pixels - found.true_pixels
    # Noise of other corners is other noise.
    noisy = (seen + sigma * noise.roll(k, 1) for k, sigma in enumerate(sigmas))
    return [as_observations(torch.where(valid[..., None], pixels, torch.nan), lens.size) for pixels in noisy]


def as_observations(
    pixels: Tensor,
    size: tuple[int, int],
    board: Board = BOARD,
    *,
    covariance: Tensor | None = None,
    names: Sequence[str] = (),
) -> Observations:
    """Corners (V, N, 2) of a board, NaN where not seen, with covariances (V, N, 2, 2) if given, as observations."""
    spread = [None] * len(pixels) if covariance is None else covariance.flatten(-2)[..., [0, 1, 3]].tolist()
    views = []
    for i, (view, own) in enumerate(zip(pixels.tolist(), spread, strict=True)):
        corners = tuple(None if u != u else (u, v) for u, v in view)
        known = own and tuple(c and (a, b, d) for c, (a, b, d) in zip(corners, own, strict=True))
        views.append(View(name=names[i] if names else f"{i:03d}", pixels=corners, covariance=known))
    return Observations(board=board, image_size=size, views=tuple(views))


def as_camera(lens: TruthLens) -> Camera:
    """The lens itself as a camera of kcal: a hybrid lens that follows its rays, so that kcal's rigs can take it.

    Its pixels are within 3e-4 px of the truth from 30 m to infinity. Its origin is on the lens's axis where rays along
    the axis start, some mm from that of the truth.
    """
    pixels = grid(lens, 41)
    rays = lens.unproject(pixels)[0]
    middle = 0.5 * (torch.tensor(lens.size, dtype=torch.float64) - 1.0)
    theta, radius = torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2]), (pixels - middle).norm(dim=-1)
    best = (math.inf, 0.0, 0.0)
    for shape in torch.linspace(-1.0, 1.5, 251, dtype=torch.float64):
        plane = theta * radius_over_angle(shape * theta**2)
        focal = float(plane @ radius / (plane @ plane))
        best = min(best, (float((focal * plane - radius).square().sum()), float(shape), focal))
    _, shape, focal = best
    model = LensModel(
        hybrid=HybridForm(shape=shape, radius=0.54 * math.hypot(*lens.size) / focal, modes=ZernikeModes())
    )
    points = torch.cat([rays * 30.0, rays * 300.0, rays * 1e9])
    target = lens.project(points)[0].T
    origin, values = torch.zeros(3, dtype=torch.float64), torch.zeros(5 + model.size, dtype=torch.float64)
    values[:4] = torch.tensor([focal, focal, *middle.tolist()])
    free = [0, 2, 3, *range(5, len(values))]  # Aspect and skew are modes of the field.
    for _ in range(4):
        found = project_components((points - origin).T, values, model, free)
        slopes = torch.cat([-found.by_point, found.by_camera]).flatten(1).T
        scale = slopes.norm(dim=0)
        off = (target - found.pixels).reshape(-1, 1)
        step = torch.linalg.lstsq(slopes / scale, off, driver="gelsd").solution[:, 0] / scale
        origin, values[free] = origin + step[:3], values[free] + step[3:]
    return Camera(values, size=lens.size, model=model)


def grid(lens: TruthLens, count: int) -> Tensor:
    """(count², 2) pixels from edge to edge of the image."""
    x, y = (torch.linspace(0, extent - 1, count, dtype=torch.float64) for extent in lens.size)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)
