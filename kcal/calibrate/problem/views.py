"""Views of a board: their poses in closed form, what they show, and what is known of camera and board from them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor

from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.parameters import FreeParameters, GaussianPrior, ParameterConstraints, Term
from kcal.calibrate.problem.state import BoardState
from kcal.corners.grid import direct_equations
from kcal.gaussian import Covariance, triangular, whitened
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.model import LensModel
from kcal.lens.pose import nearest_rotation
from kcal.lens.projection import parameter_names, project_components
from kcal.solve.lm import LMOptions, RobustLoss, minimize
from kcal.solve.schur import SchurLinearization

# Board poses: closed forms to begin with (Algorithm 1 of the paper), and each view refined under a known camera.

# Closed forms for calibration: homographies and the poses that follow from them (Algorithm 1 of the paper).


def homographies(board_points: Tensor, pixels: Tensor) -> Tensor:
    """Homographies board → image (Algorithm 1, step 1), by the normalized direct linear transform.

    Args:
        board_points: (N, 3), z = 0.
        pixels: (V, N, 2), NaN where not seen; at least four corners per view.

    Returns:
        (V, 3, 3), scaled so that the last element is 1.
    """
    seen = torch.isfinite(pixels).all(-1)
    board, board_scale = _centered(board_points[None, :, :2], seen)
    image, image_scale = _centered(pixels.nan_to_num(0.0), seen)
    equations = direct_equations(board, image, seen)
    _, vectors = torch.linalg.eigh(equations.mT @ equations)
    normalized = vectors[..., 0].unflatten(-1, (3, 3))
    found: Tensor = torch.linalg.solve(image_scale, normalized @ board_scale)
    return found / found[:, 2:, 2:]


def _centered(points: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Points (V, N, 2) about the middle of those that are seen (V, N), √2 away on average; the maps (V, 3, 3) to these.

    Source: Hartley and Zisserman, Multiple View Geometry, section 4.4.4.
    """
    weight = seen.to(points.dtype)[..., None]
    count = weight.sum(1, keepdim=True)
    middle = (points * weight).sum(1, keepdim=True) / count
    distance = ((points - middle) * weight).norm(dim=-1, keepdim=True).sum(1, keepdim=True) / count
    scale = math.sqrt(2.0) / distance[..., 0]
    to = torch.diag_embed(torch.cat([scale, scale, torch.ones_like(scale)], -1))
    to[:, :2, 2] = -scale * middle[:, 0]
    return (points - middle) * scale[..., None], to


def spread_out(board_points: Tensor, pixels: Tensor) -> Tensor:
    """Whether the corners seen in each view determine a homography: not all, nor all but one, on one line.

    The equations of the direct linear transform from the board to itself have then rank eight.

    Args:
        board_points: (N, 3), z = 0.
        pixels: (V, N, 2), NaN where not seen.

    Returns:
        (V,) bool.
    """
    low, high = board_points[:, :2].amin(0), board_points[:, :2].amax(0)
    board = ((2.0 * board_points[:, :2] - low - high) / (high - low))[None]
    values = torch.linalg.svdvals(direct_equations(board, board, torch.isfinite(pixels).all(-1)))
    return values[..., 7] > 1e-9 * values[..., 0]


def poses_from_homographies(homography: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Board poses (Algorithm 1, step 3): cam_from_board rotation (V, 3, 3) and translation (V, 3).

    Args:
        homography: (V, 3, 3) board → image.
        intrinsics: (4,) fx, fy, cx, cy.
    """
    fx, fy, cx, cy = intrinsics
    x = (homography[:, 0] - cx * homography[:, 2]) / fx
    y = (homography[:, 1] - cy * homography[:, 2]) / fy
    m = torch.stack([x, y, homography[:, 2]], 1)
    scale = 2.0 / (torch.linalg.vector_norm(m[..., 0], dim=-1) + torch.linalg.vector_norm(m[..., 1], dim=-1))
    # The board is in front of the camera.
    scale = scale * torch.where(m[:, 2, 2] < 0, -1.0, 1.0)
    m = m * scale[:, None, None]
    third = torch.linalg.cross(m[..., 0], m[..., 1])
    return nearest_rotation(torch.stack([m[..., 0], m[..., 1], third], -1)), m[..., 2]


def flipped_poses(board_points: Tensor, rotation: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
    """The other pose of each view that explains a small or distant plane almost as well.

    Seen along the direction d to the board's center, planes tilted by +φ and by -φ differ only in perspective. In a
    frame whose z axis is d, the other pose is D R D with D = diag(1, 1, -1), about the board's center (Schweighofer and
    Pinz 2006; Collins and Bartoli 2014).

    Args:
        board_points: (N, 3) meters.
        rotation: (V, 3, 3) cam_from_board.
        translation: (V, 3) meters.

    Returns:
        rotation and translation of the flipped poses.
    """
    middle = board_points.mean(0)
    center = rotation @ middle + translation
    d = center / torch.linalg.vector_norm(center, dim=-1, keepdim=True)
    # In any frame: D becomes M = 1 - 2 d dᵀ on the left, and stays D on the right.
    mirror = torch.eye(3, dtype=d.dtype) - 2.0 * d[:, :, None] * d[:, None, :]
    flip = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=d.dtype))
    turned = mirror @ rotation @ flip
    return turned, center - turned @ middle


# Board poses under a known camera: find and refine each view alone, and correct those that stopped at a wrong tilt.

# Enough to tell which of two tilts fits; the chosen one is refined with everything else afterwards.
_ROUGH = LMOptions(max_iterations=10, tolerance=1e-4)
# Most flipped poses are still this many times worse after four steps, and are dropped.
_FIRST_STEPS = LMOptions(max_iterations=4, tolerance=1e-4)
_HOPELESS = 30.0
# Cosine of the angle from the middle of a view's rays, from which they have a place on its plane.
_AHEAD = 0.05


def poses_under(camera: Camera, views: Views, options: LMOptions) -> tuple[BoardState, Tensor]:
    """Find each view's board pose under a known camera: in closed form from its rays, refined, with both tilts tried.

    Args:
        camera: a single camera; it stays as it is.
        views: V views of a board.
        options: of the solver.

    Returns:
        the state, and the cost of each view (V,) as in `refine_poses`. Both are NaN for a view whose corners with a ray
        do not determine a homography (`spread_out`).
    """
    rays, valid = camera.unproject(views.pixels)
    # The plane of each view's homography stands across its own rays: wide lenses also see boards beside the camera.
    turn = _to_axis(torch.where(valid[..., None], rays, 0.0).sum(1))
    ahead = rays @ turn.transpose(-1, -2)
    shown = (valid & (ahead[..., 2] > _AHEAD))[..., None]
    ideal = torch.where(shown, ahead[..., :2] / ahead[..., 2:], torch.nan)
    good = spread_out(views.board_points, ideal).nonzero()[:, 0]
    count = len(views.pixels)
    rotation, translation = ideal.new_full((count, 3, 3), torch.nan), ideal.new_full((count, 3), torch.nan)
    cost = ideal.new_full((count,), torch.nan)
    if len(good):
        some, model, back = views.some(good), camera.model, turn[good].transpose(-1, -2)
        pinhole = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
        turned, moved = poses_from_homographies(homographies(views.board_points, ideal[good]), pinhole)
        poses = back @ turned, (back @ moved[..., None])[..., 0]
        state, cost[good] = refine_poses(some, model, BoardState.flat(camera.params.detach(), *poses), options)
        state, flipped = unflip(some, model, state)
        if flipped:
            state, cost[good] = refine_poses(some, model, state, options)
        rotation[good], translation[good] = state.rotation, state.translation
    return BoardState.flat(camera.params.detach(), rotation, translation), cost


def _to_axis(directions: Tensor) -> Tensor:
    """Rotations (V, 3, 3) that turn directions (V, 3) to the z axis."""
    z = torch.nn.functional.normalize(directions, dim=-1)
    least = torch.nn.functional.one_hot(z.abs().argmin(-1), 3).to(z.dtype)
    x = torch.nn.functional.normalize(torch.linalg.cross(least, z), dim=-1)
    return torch.stack([x, torch.linalg.cross(z, x), z], -2)


def refine_poses(views: Views, model: LensModel, state: BoardState, options: LMOptions) -> tuple[BoardState, Tensor]:
    """Minimize over each view's board pose alone, with everything else held.

    Args:
        views: V views of a board.
        model: the lens model.
        state: whose poses are the initial ones.
        options: of the solver.

    Returns:
        the state with refined board poses, and the cost of each view (V,), without a robust loss; NaN where the initial
        pose had none.
    """
    count, weights = len(views.pixels), None if views.whitening is None else views.whitening[:, None]
    problem = BoardProblem(views.board_points, views.pixels[:, None], model, weights=weights, batch=(count,))
    camera = state.parameters.expand(count, -1), state.board.expand(count, -1)
    start = BoardState.still(*camera, state.rotation[:, None], state.translation[:, None])
    result = minimize(problem, start, options)
    poses = result.state
    return state._replace(rotation=poses.rotation[:, 0], translation=poses.translation[:, 0]), result.cost


def unflip(views: Views, model: LensModel, state: BoardState) -> tuple[BoardState, list[int]]:
    """Replace every board pose whose counterpart with the opposite tilt fits better (see `flipped_poses`).

    A view from far away or nearly face-on has two poses of almost equal cost, and a solver that starts at the wrong one
    stays there. In 200 and more measured views, one or two such views raise the RMS of a whole calibration by up to a
    quarter.

    Args:
        views: V views of a board.
        model: the lens model.
        state: with board poses that are already refined.

    Returns:
        the state with the better poses, roughly refined, and the indices of the views that changed.
    """
    cost = 0.5 * (views.problem(model).residuals(state) ** 2).sum(-1)
    rotation, translation = flipped_poses(views.board_points, state.rotation, state.translation)
    flipped = state._replace(rotation=rotation, translation=translation)
    flipped, flipped_cost = refine_poses(views, model, flipped, _FIRST_STEPS)
    near = (flipped_cost < _HOPELESS * cost).nonzero()[:, 0]
    if not len(near):
        return state, []
    flipped, flipped_cost = refine_poses(views.some(near), model, flipped.views(near), _ROUGH)
    better = flipped_cost < 0.999 * cost[near]
    changed = near[better]
    rotation, translation = state.rotation.clone(), state.translation.clone()
    rotation[changed], translation[changed] = flipped.rotation[better], flipped.translation[better]
    return state._replace(rotation=rotation, translation=translation), changed.tolist()


# Views of a board by one camera: weights, problems, regular region, and what they say of camera and board.

# Weights of residuals, from the covariances of corners.


def whitening(covariances: Tensor, variance: float) -> Tensor:
    """Matrices that make residuals of unequal corners equally uncertain.

    Residuals of a calibration contain more than the noise of the corners: boards are not flat and lenses differ from
    their models. So the same variance is added to every corner, as much as the residuals have beyond what the
    covariances predict; where the corners' noise is the smaller error, all count nearly alike. The scale is chosen for
    a mean information of one, so that weighted residuals remain pixels.

    Args:
        covariances: (..., N, 2, 2) px²; NaN where a corner was not seen.
        variance: of the residuals along an axis when all corners count alike, px².

    Returns:
        W (..., N, 2, 2) with Wᵀ W = s² (C + f² 1)⁻¹; NaN where not seen.

    Example:
        >>> corners = torch.eye(2, dtype=torch.float64) * torch.tensor([0.01, 0.04]).double()[:, None, None] ** 2
        >>> weights = whitening(corners, 0.00085)  # the mean variance: nothing beyond the corners' own
        >>> round(float(weights[0, 0, 0] / weights[1, 0, 0]), 4)
        4.0
    """
    seen = torch.isfinite(covariances).all(-1).all(-1)
    identity = torch.eye(2, dtype=covariances.dtype, device=covariances.device)
    filled = torch.where(seen[..., None, None], covariances, identity)
    own = float(covariances[seen].diagonal(dim1=-2, dim2=-1).mean())
    factor = torch.linalg.cholesky(filled + max(variance - own, 0.0) * identity)
    inverse = torch.linalg.solve_triangular(factor, identity.expand_as(factor), upper=False)
    information = inverse[seen].square().sum((-2, -1)).mean() / 2.0
    return torch.where(seen[..., None, None], inverse / information.sqrt(), torch.nan)


# Views of a board by one camera: their least-squares problems, and where the lens must be regular.

# Noise of a corner (pixels) that is assumed at least, where data are exact.
LEAST_NOISE = 1e-3
# A lens must be regular this far beyond the outermost point; the image's corners move a little with the lens.
_MARGIN = 1.05
# Points per side of the image's border.
_SIDE = 8
# Stretches in which the image's border is unprojected: Newton's method from afar may leave a strongly distorting lens.
_SHARES = (0.5, 0.8, 1.0)


def among(values: Tensor, views: Sequence[int], count: int) -> Tensor:
    """(count, ...) values of some views put among all of them: NaN for the others.

    Example:
        >>> among(torch.tensor([2.0]), [1], 3).tolist()
        [nan, 2.0, nan]
    """
    out = values.new_full((count, *values.shape[1:]), torch.nan)
    out[list(views)] = values
    return out


@dataclasses.dataclass(frozen=True, kw_only=True)
class Views:
    """Views of a board by one camera.

    Args:
        board_points: (N, 3) meters.
        pixels: (..., V, N, 2), NaN where not seen.
        whitening: (..., V, N, 2, 2) weights of the corners, or None: all count alike.
        loss: a robust loss, or None.
        free_warp: whether the board's warp is estimated.
    """

    board_points: Tensor
    pixels: Tensor
    whitening: Tensor | None = None
    loss: RobustLoss | None = None
    free_warp: bool = False

    def problem(
        self, model: LensModel, free: Sequence[int] | FreeParameters = (), *, terms: Sequence[Term] = ()
    ) -> BoardProblem:
        """The least-squares problem of these views; without free parameters, of the poses (and the warp) alone."""
        return BoardProblem(
            self.board_points,
            self.pixels,
            model,
            free,
            free_board=self.free_warp,
            weights=self.whitening,
            loss=self.loss,
            terms=terms,
        )

    def some(self, chosen: Sequence[int] | Tensor) -> Self:
        """Some of the views, in that order."""
        weights = None if self.whitening is None else self.whitening[chosen]
        return dataclasses.replace(self, pixels=self.pixels[chosen], whitening=weights)

    def noise(self, state: BoardState, model: LensModel) -> float:
        """Standard deviation (pixels) of the residuals along an axis."""
        problem = self.problem(model)
        return math.sqrt(2.0 * float(problem.cost(state)) / problem.residual_count)

    def observed_radius(self, state: BoardState) -> float:
        """Largest undistorted radius at which a corner was seen."""
        points = self.board_points @ state.rotation.transpose(-1, -2) + state.translation[..., None, :]
        radius = torch.linalg.vector_norm(points[..., :2] / points[..., 2:], dim=-1)
        return float(torch.where(torch.isfinite(self.pixels).all(-1), radius, 0.0).max())


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraViews(Views):
    """Views with what is known about the camera, for the fit of its lens.

    Args:
        size: (width, height) of the image.
        constraints: what is known about the camera's parameters.
        prior_noise: pixels of a corner's noise, in proportion to which priors count.
    """

    size: tuple[int, int]
    constraints: ParameterConstraints = dataclasses.field(default_factory=ParameterConstraints)
    prior_noise: float = 0.3

    def lens_problem(self, model: LensModel, terms: Sequence[Term] = ()) -> BoardProblem:
        """The least-squares problem of a lens model under the constraints, with their priors."""
        terms = (*terms, *self.constraints.terms(model, self.prior_noise))
        return self.problem(model, self.constraints.free_parameters(model), terms=terms)

    def with_noise_of(self, state: BoardState, model: LensModel) -> CameraViews:
        """The same with priors in proportion to the noise of a solution."""
        return dataclasses.replace(self, prior_noise=max(self.noise(state, model), LEAST_NOISE))

    def seen_radius(self, state: BoardState) -> float:
        """Radius on the plane z = 1 around all corners that were seen, with a margin."""
        return _MARGIN * self.observed_radius(state)

    def regular_radius(self, state: BoardState, model: LensModel) -> float:
        """Likewise around the whole image, if the lens reaches it."""
        border = _border(state.parameters, model, self.size)
        seen = self.seen_radius(state)
        return seen if border is None else max(seen, _MARGIN * float(torch.hypot(*border).max()))


def _border(parameters: Tensor, model: LensModel, size: tuple[int, int]) -> Tensor | None:
    """Points (2, K) on the plane z = 1 that the image's border shows; None where the lens does not reach all of it."""
    t = torch.linspace(0.0, 1.0, _SIDE + 1, dtype=torch.float64)[:-1]
    zero, one = torch.zeros_like(t), torch.ones_like(t)
    u, v = torch.cat([t, one, 1.0 - t, zero]), torch.cat([zero, t, one, 1.0 - t])
    border = torch.stack([u * (size[0] - 1.0), v * (size[1] - 1.0)])
    center = torch.stack([parameters[2], parameters[3]])[:, None]
    x, y = _SHARES[0] * (border - center) / torch.stack([parameters[0], parameters[1]])[:, None]
    for share in _SHARES:
        wanted = center + share * (border - center)
        for _ in range(12):
            seen = project_components(torch.stack([x, y, torch.ones_like(x)]), parameters, model, ())
            error = wanted - seen.pixels
            if not bool(seen.regular.all()):
                return None
            if float(error.abs().max()) < 1e-3:
                break
            ux, vx, uy, vy = seen.by_point[:2].flatten(0, 1)
            scale = 1.0 / (ux * vy - uy * vx)
            x, y = x + (vy * error[0] - uy * error[1]) * scale, y + (ux * error[1] - vx * error[0]) * scale
        else:
            return None
    return torch.stack([x, y])


def free_parameters(model: LensModel) -> list[int]:
    """Indices of all parameters but the skew."""
    return [i for i, name in enumerate(parameter_names(model)) if name != "skew"]


# Covariances of a solution, and which parameters the data do not determine.

# Eigenvalues of the scaled information below this share of the largest are rounding errors.
_RANK_TOLERANCE = 1e-13
# A parameter with this squared component in an undetermined direction counts as undetermined.
_UNDETERMINED_SHARE = 1e-2
# Standard deviations by which scores scatter more than independent corners explain, from which on that is no chance.
_CHANCE = 2.0


def uncertainty_of(linear: SchurLinearization, variance: float) -> Covariance:
    """Covariance of the shared parameters from the information at a minimum, all other parameters free.

    With `noise_variance` it is (JᵀJ)⁻¹ ‖r‖² / (residuals - parameters), whose diagonal is the square of what
    `cv2.calibrateCameraExtended` reports: the noise is assumed independent and equal. Where the linearization is not
    finite, because a corner lies on a fold of the lens, nothing is determined.

    Args:
        linear: the linearization at the minimum, not a batch.
        variance: of a residual.
    """
    return Covariance(*linear.information(), variance, tolerance=_RANK_TOLERANCE, lost=_UNDETERMINED_SHARE)


def noise_variance(linear: SchurLinearization, residual_count: int, parameter_count: int) -> Tensor:
    """Variance of a residual, estimated from the cost, where so many parameters were free, poses included."""
    return 2.0 * linear.cost / max(residual_count - parameter_count, 1)


def dispersion_of(problem: BoardProblem, state: BoardState, variance: float) -> float:
    """How much more the views contradict each other than corners with independent errors do; 1 where chance may do it.

    Where boards bend, cameras move or a lens differs from its model, residuals repeat within a view, and a view counts
    for as many corners as it has though it has fewer independent ones. The derivatives of each view's χ² by lens and
    board then scatter more from view to view than its information says, and variances are too small by that factor.
    (`kcal.calibrate.hybrid.evidence.overdispersion` is of lenses with priors, from the sum over all views alone.)

    Args:
        problem: with corners alone, or with priors, which do not count.
        state: its minimum.
        variance: of a residual.

    Source:
        R. Wedderburn, "Quasi-likelihood functions", Biometrika 61 (1974); per view, as in the variance of clustered
        data, K.-Y. Liang and S. Zeger, Biometrika 73 (1986).
    """
    if not variance > LEAST_NOISE**2:
        return 1.0
    rows = problem.off_poses(state)[:, [*problem.moving.tolist(), -1]]
    if not bool(rows.isfinite().all()):
        return 1.0
    flat = rows.transpose(0, 1).flatten(1).T
    change, _, known = whitened(flat[:, :-1], flat[:, -1])
    unit = change[:, known].T @ rows[:, :-1]
    score = (unit @ rows[:, -1:].transpose(1, 2))[..., 0]
    # A view pulls the minimum towards itself, the more so the larger its share of the information.
    shared = float((unit @ unit.transpose(1, 2)).square().sum())
    freedom = max(int(known.sum()) - shared, 0.0)
    expected, chance = variance * freedom, variance * math.sqrt(2.0 * shared)
    squared = float(score.square().sum())
    return squared / expected if squared > expected + _CHANCE * chance else 1.0


# What corners and priors say of a camera and of its board, for every lens alike.


def information_of(
    problem: BoardProblem, state: BoardState, noise: float, reduced: Tensor | None = None
) -> CameraInformation:
    """Square roots of information about all unknowns that are not held, poses and motions eliminated.

    Args:
        problem: with the Gaussian priors that count; barriers are no information.
        state: its minimum.
        noise: px, of a corner of weight one.
        reduced: `BoardProblem.reduced_rows`, if these are known already.
    """
    reduced = problem.reduced_rows(state) if reduced is None else reduced
    moving = problem.moving
    rows = reduced[:, [*moving.tolist(), -1]] / noise
    triangle = triangular(rows)[:-1]
    precision = rows.new_zeros(len(moving))
    mean = torch.zeros_like(precision)
    for term in problem.terms:
        if isinstance(term, GaussianPrior):
            place, weight = problem.slots[term.index], (term.weight / noise).square()
            free = place >= 0
            # Parameters that are equal may have a prior each: the product of both.
            precision.index_add_(0, place[free], weight[free])
            mean.index_add_(0, place[free], (weight * term.mean)[free])
    return CameraInformation(
        slots=tuple(problem.slots[: len(state.parameters)].tolist()),
        estimate=problem.unknowns(state)[moving],
        rows=triangle[:, :-1],
        residuals=triangle[:, -1],
        mean=torch.where(precision > 0, mean / precision, 0.0),
        sigma=precision.rsqrt(),
    )
