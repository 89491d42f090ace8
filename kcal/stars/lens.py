"""A camera from night images, alone or together with images of boards."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.hybrid.evidence import Amplitudes
from kcal.calibrate.hybrid.families import PriorFamilies, typical_hyperprior
from kcal.calibrate.hybrid.fit import HybridFit
from kcal.calibrate.hybrid.fitted_views import Estimate, FittedViews, hybrid_unknowns, run_rounds
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.parameters import FreeParameters, GaussianTerm
from kcal.calibrate.problem.state import BoardState
from kcal.errors import InputError
from kcal.finding import Finding
from kcal.gaussian import Gaussian, numbered
from kcal.lens.camera import Camera
from kcal.lens.information import LENS_SLOT, CameraInformation
from kcal.solve.lm import LMOptions, minimize
from kcal.stars.detect import DetectedStars
from kcal.stars.lens_fit import (
    CUT,
    StarField,
    StarLens,
    StarViews,
    fit_star_lens,
    lens_rows,
    require_stars,
    star_lens,
    star_state,
)
from kcal.stars.night import SkyView, fit_attitude
from kcal.stars.sky import Identification, StarCatalog, celestial_directions, identify, turn_between
from kcal.texts import brief
from kcal.threads import in_one_thread

# One lens from boards and stars: boards tell the lens and its pupil where they were, stars the field at infinity.

_ROUNDS = 3
# While the lens is that of the boards alone, stars farther off than so many typical sigmas are left out.
_FIRST_CUT = 8.0
# Directions of the lens of which stars say at least so much as boards are compared.
_TOLD = 1.0
# Less probable by chance: boards and stars contradict each other.
_CONTRADICTION = 1e-4
_EFFORT = LMOptions(max_iterations=15, tolerance=1e-10, initial_damping=1e-10)


class Agreement(NamedTuple):
    """How a lens from boards agrees with stars.

    Attributes:
        chi2: squared differences over their variances, in the directions of which stars say as much as boards or more.
        freedom: how many directions these are.
        by_chance: how probable so large a χ², or so large a difference in any one direction, is by chance.
        moved_px: by how much stars move the lens, RMS along an axis over the stars seen, after the images' rotations.
        stated_px: the standard deviation of that, as the boards stated it.

    Example:
        >>> Agreement(chi2=31.0, freedom=28, by_chance=0.3, moved_px=0.2, stated_px=0.3).contradiction is None
        True
    """

    chi2: float
    freedom: int
    by_chance: float
    moved_px: float
    stated_px: float

    @property
    def contradiction(self) -> str | None:
        """What to tell the user; None where chance explains the difference."""
        if self.by_chance > _CONTRADICTION:
            return None
        return (
            f"boards and stars contradict each other (χ² {self.chi2:.0f} in {self.freedom} directions): stars move "
            f"the lens by {self.moved_px:.2f} px, where the boards stated {self.stated_px:.2f} px. Are both of this "
            "camera, with the same focus, zoom and image size? Was one of them taken in another temperature? Calibrate "
            "by each alone and compare them with `kcal diff`"
        )


def refine_by_stars(
    fields: Sequence[StarField], rotations: Sequence[Tensor], boards: CameraCalibrationResult
) -> tuple[StarLens, Agreement]:
    """The posterior of a camera from boards and from the named stars of several images of it.

    The amplitudes of the default lens are those of largest evidence of both together.

    Args:
        fields: of each image.
        rotations: (3, 3) of each: camera from the frame of its directions, roughly.
        boards: the camera as boards calibrated it, which stays as it is.

    Raises:
        InputError: too few stars, or boards that do not say what they know of the camera.
    """
    require_stars(fields)
    whole = boards.information
    if whole is None:
        raise InputError("the boards do not say how well they know the camera, so that stars cannot refine it")
    lens = whole.without_board()
    free = [(index, slot) for index, slot in enumerate(lens.slots) if slot >= 0]
    unknowns = FreeParameters(*zip(*free, strict=True))
    index = torch.tensor(unknowns.leading)
    stars, model = StarViews.of(fields), boards.camera.model
    state = star_state(boards.camera.params.detach(), rotations)
    stars, sigma = stars.near(model, state, _FIRST_CUT), lens.sigma

    def solved(state: BoardState) -> tuple[BoardProblem, BoardState]:
        known = GaussianTerm(index, _known_lens(lens, sigma), stars.noise)
        problem = stars.problem(model, unknowns, [known])
        return problem, minimize(problem, state, _EFFORT).state

    if boards.hybrid is not None:
        sigma, stars, state = _by_evidence(boards.hybrid, lens, index, stars, state)
    else:
        for _ in range(_ROUNDS):
            _, state = solved(state)
            stars = stars.near(model, state, CUT)
    problem, state = solved(state)
    told = lens_rows(problem, state, stars.noise)
    change = state.parameters[index] - lens.estimate
    refined = Camera(state.parameters, size=boards.camera.size, model=model)
    wide = dataclasses.replace(whole, sigma=torch.cat([sigma, whole.sigma[len(sigma) :]]))
    # As they count.
    stars = stars._replace(variance=stars.noise**2)
    found = star_lens(stars, state, refined, told[:, :-1], _with_star_rows(wide, told, change))
    return found, _agreement_with(told, change, lens, *_star_noise(stars))


def joint_calibration(
    boards: CameraCalibrationResult, found: StarLens, agreement: Agreement
) -> CameraCalibrationResult:
    """The calibration by boards with camera, error bars and doubts of both; residuals stay those of boards alone.

    Args:
        boards: before.
        found: by `refine_by_stars`.
        agreement: likewise.
    """
    known = found.camera.calibration
    assert known is not None
    assert known.information is not None
    assert known.sigma is not None
    doubts = [] if agreement.contradiction is None else [Finding("stars", "doubt", agreement.contradiction)]
    return dataclasses.replace(
        boards,
        camera=found.camera,
        sigma={name: known.sigma[name] for name in boards.sigma},
        covariance=known.information.covariance(),
        information=known.information,
        findings=(*boards.findings, *doubts),
    )


def _known_lens(lens: CameraInformation, sigma: Tensor) -> Gaussian:
    """What boards say of the lens, under a prior of standard deviations (S,)."""
    rows = dataclasses.replace(lens, sigma=sigma).whole.rows
    return Gaussian(numbered(LENS_SLOT, len(sigma)), lens.estimate, rows)


def _by_evidence(
    hybrid: HybridFit, lens: CameraInformation, index: Tensor, stars: StarViews, state: BoardState
) -> tuple[Tensor, StarViews, BoardState]:
    """Set amplitudes by the evidence of boards and stars together.

    Args:
        hybrid: how boards were fitted.
        lens: what boards say of its unknowns.
        index: (S,) of the parameters that these are.
        stars: to begin with.
        state: likewise.

    Returns:
        (S,) standard deviations of the lens's unknowns beforehand, and stars and state as they are then.
    """
    every = hybrid_unknowns(hybrid.model, hybrid.square)
    number = dict(zip(every.indices, every.slots, strict=True))
    kept = [number[place] for place in index.tolist()]
    families = PriorFamilies(*(column[: len(every)] for column in hybrid.families))
    slots = tuple((LENS_SLOT, place) for place in kept)
    data = Gaussian(slots, lens.estimate, torch.cat([lens.rows, lens.residuals[:, None]], 1))
    assert hybrid.model.hybrid is not None
    capture = dataclasses.replace(
        stars.fitted(hybrid.size),
        weights=stars.weights / stars.noise,
        hyperprior=typical_hyperprior(hybrid.model.hybrid.modes),
        square=hybrid.square,
        known=data,
    )

    def near(capture: FittedViews, estimate: Estimate) -> FittedViews:
        nonlocal stars
        stars = stars.near(hybrid.model, estimate.state, CUT)
        return dataclasses.replace(capture, weights=stars.weights / stars.noise)

    estimate = Estimate(hybrid.model, families, state, Amplitudes(hybrid.hyperparameters, 1.0))
    rounds = run_rounds(capture, estimate, reweigh=near)
    return rounds.estimate.deviation[kept], stars, rounds.estimate.state


def _with_star_rows(known: CameraInformation, stars: Tensor, change: Tensor) -> CameraInformation:
    """What boards and stars say together, at the lens's new estimate and the board's that follows it.

    Args:
        known: of lens and board, before.
        stars: (S, S + 1) rows of the lens, residuals at the new estimate.
        change: (S,) of the lens.
    """
    lens = known.estimate[: len(change)] + change
    board = known.estimate[len(change) :]
    if known.board_size:
        there = known.whole.placed(known.data.slots, torch.cat([lens, board]))
        board = there.conditioned(known.lens).mean
    moved = dataclasses.replace(known, estimate=torch.cat([lens, board]))
    if known.others is not None:
        moved = dataclasses.replace(moved, others=known.told.placed(known.board, board).rows)
    return moved.with_data(known.data + Gaussian(known.lens, lens, stars))


def _star_noise(stars: StarViews) -> tuple[int, float]:
    """How many residuals of stars there are, and their sigma in px, as it counts."""
    count = int((stars.weights > 0).sum())
    return 2 * count, stars.noise * math.sqrt(count / float(stars.weights.square().sum()))


def _agreement_with(stars: Tensor, change: Tensor, lens: CameraInformation, count: int, sigma: float) -> Agreement:
    """Whether stars ask for more than the covariance of boards allows, to first order."""
    rows, residual = stars[:, :-1], stars[:, -1] - stars[:, :-1] @ change
    spread = rows @ lens.half().T
    left, told, _ = torch.linalg.svd(spread, full_matrices=False)
    use = told.square() > _TOLD
    squares = ((left.T @ residual).square() / (1.0 + told.square()))[use]
    chi2, freedom = float(squares.sum()), int(use.sum())
    # A change of focus is one direction, which the sum over many that agree would hide.
    by_chance = 1.0
    if freedom:
        by_chance = min(float(stats.chi2.sf(chi2, freedom)), freedom * float(stats.chi2.sf(float(squares.max()), 1)))
    return Agreement(
        chi2=chi2,
        freedom=freedom,
        by_chance=min(2.0 * by_chance, 1.0),
        moved_px=sigma * math.sqrt(float((rows @ change).square().sum()) / count),
        stated_px=sigma * math.sqrt(float(spread.square().sum()) / count),
    )


# A camera from night images alone: stars named by their pattern, the field of view unknown, then the lens fitted.

# Degrees between opposite corners: the widest and narrowest lens that is looked for, and steps between.
_WIDEST, _NARROWEST, _STEP = 320.0, 6.0, 1.02
_SCALE_ERROR = 0.012
# Wider lenses are taken to be fisheyes.
_PINHOLES = 115.0
# Of the half diagonal: stars nearer the middle, where all lenses are alike, are named first; and of fisheyes.
_MIDDLE, _WIDE_MIDDLE = 0.5, 0.3
# How many of the brightest stars make triangles in each pass over all fields of view, most of which are wrong.
_FEW_CORNERS, _MORE_CORNERS, _SEARCHED = 4, 6, 24
_ROUGH_PX = 3.0
# Images in which the field of view is looked for.
_TRIES = 3


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StarCamera:
    """A camera that was calibrated by stars.

    Args:
        lens: the fit: camera, residuals, rotations of the images that were used.
        images: their numbers.
        stars: (N,) index in the catalog of each of their named stars.
        pixels: (N, 2) where these were seen.
        refused: number of each other image, and why it was not used.
        agreement: of the stars with the boards that calibrated the camera before; None where none did.
        joint: the calibration by boards, refined by the stars; None likewise.
    """

    __repr__ = brief

    lens: StarLens
    images: tuple[int, ...]
    stars: tuple[np.ndarray, ...]
    pixels: tuple[np.ndarray, ...]
    refused: dict[int, str]
    agreement: Agreement | None = None
    joint: CameraCalibrationResult | None = None


@in_one_thread
def calibrate_by_stars(
    images: Sequence[DetectedStars],
    views: Sequence[SkyView],
    size: tuple[int, int],
    *,
    focal: float | None = None,
    boards: CameraCalibrationResult | None = None,
    catalog: StarCatalog | None = None,
    progress: Callable[[str], object] = lambda _: None,
) -> StarCamera:
    """Calibrate a camera at infinity from the stars of several night images, alone or together with boards.

    Tilt the camera up: stars then cover the whole image, and refraction bends little. By stars alone the camera has no
    entrance pupil: it is right for what is far away. Boards tell the pupil and the lens where they were seen: together
    both give one posterior.

    Args:
        images: the stars of each.
        views: when and where each was taken; with both, refraction is taken out.
        size: of the images, px.
        focal: px, where it is known to 3 %; otherwise it is looked for.
        boards: what boards said of the camera; names are then found with it.
        catalog: the stars; kcal's own if left out.
        progress: called after each step.

    Raises:
        InputError: no image whose stars have names, or too few of them.

    Example:
        >>> calibrate_by_stars([], [], (1920, 1080))  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        kcal.errors.InputError: in none of 0 images stars have names: too few are seen, this is not the night sky, ...
    """
    catalog = catalog or StarCatalog.bundled()
    order = sorted(range(len(images)), key=lambda number: -len(images[number].pixels))
    rotations: dict[int, np.ndarray] = {}

    def fitted(
        camera: Camera, rotations: dict[int, np.ndarray], share: float = math.inf
    ) -> tuple[StarLens, Agreement | None, dict[int, _StarImage]]:
        """The lens from stars within a share of the half diagonal, its agreement with boards, and the stars."""
        near = {number: _near_middle(images[number], size, share) for number in rotations}
        seen = _star_fields(near, views, camera, rotations, catalog)
        fields, turns = [one.field for one in seen.values()], [one.rotation for one in seen.values()]
        if boards is not None:
            return *refine_by_stars(fields, turns, boards), seen
        return fit_star_lens(fields, turns, size, float(camera.params[0])), None, seen

    if boards is None:
        failure: InputError | None = None
        for camera, rotations in _first_lenses(images, order, _plain_cameras(size, focal), catalog, progress):
            try:
                # Stars get names from the middle outward while the lens becomes better known.
                for share in (0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.2) if camera.model.fisheye else (0.6, 0.8, 1.0, 1.2):
                    lens, _, seen = fitted(camera, rotations, share)
                    camera = lens.camera
                    rotations = {n: found.numpy() for n, found in zip(seen, lens.rotations, strict=True)}
                break
            except InputError as error:
                # Another lens may explain a few stars in the middle.
                failure = error
        else:
            raise failure or InputError(
                f"in none of {len(images)} images stars have names: too few are seen, this is not the night sky, or "
                f"its diagonal field of view is not {_NARROWEST:g} to {_WIDEST:g} degrees: start from a camera file "
                "(--camera)"
            )
    else:
        camera = boards.camera
        if camera.size != size:
            width, height = camera.size
            raise InputError(f"the night images have {size[0]}x{size[1]} pixels, those of boards {width}x{height}")
    refused: dict[int, str] = {}
    for number in order:
        if number in rotations:
            continue
        found_here = _by_camera(images[number], camera, catalog)
        if found_here is None:
            refused[number] = f"{len(images[number].pixels)} points of light have no names"
        else:
            rotations[number] = found_here.rotation
    progress("names")
    if not rotations:
        raise InputError(f"in none of {len(images)} images stars have names by the boards' camera: is it of this lens?")
    for _ in range(3):
        lens, agreement, seen = fitted(camera, rotations)
        camera = lens.camera
        rotations = {n: found.numpy() for n, found in zip(seen, lens.rotations, strict=True)}
        progress("lens")
    return StarCamera(
        lens=lens,
        images=tuple(seen),
        stars=tuple(one.star for one in seen.values()),
        pixels=tuple(one.field.pixels.numpy() for one in seen.values()),
        refused=refused,
        agreement=agreement,
        joint=None if boards is None or agreement is None else joint_calibration(boards, lens, agreement),
    )


def _first_lenses(
    images: Sequence[DetectedStars],
    order: Sequence[int],
    cameras: Sequence[Camera],
    catalog: StarCatalog,
    progress: Callable[[str], object],
) -> Iterator[tuple[Camera, dict[int, np.ndarray]]]:
    """Rough cameras, each from an image whose stars have names, and its rotation."""
    # More triangles take five times as long: of one image, where few have failed in all.
    tries = [(_FEW_CORNERS, number) for number in order[:_TRIES]] + [(_MORE_CORNERS, number) for number in order[:1]]
    for count, (corners, number) in enumerate(tries, 1):
        what = f"search {count} of {len(tries)}: image {number + 1}"
        found = _search(images[number], cameras, corners, catalog, progress, what)
        if found is not None:
            named, camera = found
            yield camera, {number: named.rotation}


def _plain_camera(focal: float, size: tuple[int, int], model: str) -> Camera:
    center = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    return Camera.build(focal=(focal, focal), center=center, size=size, model=model)


def _plain_of(degrees: float, size: tuple[int, int]) -> Camera:
    """A pinhole, or an equidistant fisheye if it is wide, with an angle between opposite corners."""
    half, angle = 0.5 * math.hypot(*size), math.radians(degrees) / 2
    wide = degrees > _PINHOLES
    return _plain_camera(half / (angle if wide else math.tan(angle)), size, "fisheye4" if wide else "pinhole")


def _plain_cameras(size: tuple[int, int], focal: float | None) -> list[Camera]:
    """Those to try: from wide to narrow, or about a known focal length."""
    if focal is None:
        count = round(math.log(_WIDEST / _NARROWEST) / math.log(_STEP))
        return [_plain_of(_WIDEST * _STEP**-k, size) for k in range(count + 1)]
    return [_plain_camera(focal * _STEP**k, size, kind) for kind in ("pinhole", "fisheye4") for k in (0, 1, -1, 2, -2)]


def _search(
    found: DetectedStars,
    tried: Sequence[Camera],
    corners: int,
    catalog: StarCatalog,
    progress: Callable[[str], object],
    what: str,
) -> tuple[Identification, Camera] | None:
    """Names of the stars in the middle of an image, and a plain camera, from the first of those tried that fits."""
    size = tried[0].size
    center = np.array([(size[0] - 1) / 2, (size[1] - 1) / 2])
    away = np.linalg.norm(found.pixels - center, axis=1)
    for camera in tried:
        guess, middle = float(camera.params[0]), 0.5 * math.hypot(*size)
        middle *= _WIDE_MIDDLE if camera.model.fisheye else _MIDDLE
        inside = np.flatnonzero(away < middle)[:_SEARCHED]
        progress(f"{what}, focal length {guess:.0f} px")
        if len(inside) < 5:
            continue
        rays, _ = camera.unproject(torch.from_numpy(found.pixels[inside]))
        field = 2 * (middle / guess if camera.model.fisheye else math.atan(middle / guess))
        here = identify(
            rays.numpy(), 1.5 / guess, catalog=catalog, scale_error=_SCALE_ERROR, field=field, corners=corners
        )
        if here is None:
            continue
        known = np.flatnonzero(here.star >= 0)
        seen = torch.from_numpy(catalog.directions()[here.star[known]] @ here.rotation.T)
        plane = (camera.project(seen)[0].numpy() - center) / guess
        star = np.full(len(found.pixels), -1)
        star[inside[: len(here.star)]] = here.star
        scale = float((plane * (found.pixels[inside[known]] - center)).sum() / (plane**2).sum())
        return here._replace(star=star), _plain_camera(scale, size, "fisheye4" if camera.model.fisheye else "pinhole")
    return None


def _by_camera(found: DetectedStars, camera: Camera, catalog: StarCatalog) -> Identification | None:
    rays, valid = camera.unproject(torch.from_numpy(found.pixels))
    focal = float(camera.params[0])
    return identify(rays[valid].numpy(), _ROUGH_PX / focal, catalog=catalog, scale_error=0.003)


def _near_middle(found: DetectedStars, size: tuple[int, int], share: float) -> DetectedStars:
    away = np.linalg.norm(found.pixels - [(size[0] - 1) / 2, (size[1] - 1) / 2], axis=1)
    use = away < share * 0.5 * math.hypot(*size)
    return found._replace(pixels=found.pixels[use], sigma=found.sigma[use], flux=found.flux[use])


class _StarImage(NamedTuple):
    """The named stars of an image, their numbers (N,) in the catalog, and the rotation from the stars' frame."""

    field: StarField
    star: np.ndarray
    rotation: Tensor


def _star_fields(
    images: dict[int, DetectedStars],
    views: Sequence[SkyView],
    camera: Camera,
    rotations: dict[int, np.ndarray],
    catalog: StarCatalog,
) -> dict[int, _StarImage]:
    """Stars with names of each image whose attitude is roughly known, in its own frame, by its number."""
    seen = {}
    for number, rotation in sorted(rotations.items()):
        found, directions = images[number], _directions(views[number], catalog)
        # At another time the axes are the same, but aberration and refraction move stars by some seconds of arc.
        ahead = _ahead(rotation, directions, catalog, views[number])
        best = fit_attitude(found.pixels, found.sigma, directions, catalog.magnitude, camera, ahead)
        if best is None:
            continue
        use = best.star >= 0
        parts = directions[best.star[use]], found.pixels[use], found.sigma[use]
        seen[number] = _StarImage(StarField(*map(torch.from_numpy, parts)), best.star[use], best.rotation)
    return seen


def _directions(view: SkyView, catalog: StarCatalog) -> np.ndarray:
    if not view.on_earth:
        return celestial_directions(catalog, view.time)
    # Refracted, but in the catalog's axes, in which rotations of other images and the first names are.
    there = view.directions(catalog)
    up = there[:, 2] > math.sin(math.radians(3.0))
    celestial = celestial_directions(catalog, view.time)
    return np.where(up[:, None], there @ turn_between(there[up], celestial[up]).T, celestial)


def _ahead(rotation: np.ndarray, directions: np.ndarray, catalog: StarCatalog, view: SkyView) -> np.ndarray:
    near = catalog.directions() @ rotation[2] > 0.95
    return rotation @ turn_between(directions[near], catalog.directions()[near]) if near.sum() > 2 else rotation
