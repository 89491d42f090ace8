"""Which relative pose do pairs of views agree on, before anything is refined jointly?"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.calibrate.bundle.closed_form import homographies, poses_from_homographies
from kcal.calibrate.bundle.poses import refine_poses, unflip
from kcal.calibrate.bundle.views import Views
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.solve.lm import LMOptions

MINIMUM_CORNERS = 6
# A camera that leaves its own boards this far off (pixels) is not the camera that took them.
_FOREIGN_RMS = 5.0
# A turned order of corners is believed only if it leaves less than this share of the error.
_TURNED = 0.2


@dataclasses.dataclass(frozen=True)
class Poses:
    """Rigid motions: rotation (..., 3, 3) and translation (..., 3) meters."""

    rotation: Tensor
    translation: Tensor

    def after(self, other: Poses) -> Poses:
        """This motion applied after another."""
        return Poses(
            self.rotation @ other.rotation,
            (self.rotation @ other.translation[..., None])[..., 0] + self.translation,
        )

    def inverse(self) -> Poses:
        """The motion back."""
        back = self.rotation.transpose(-1, -2)
        return Poses(back, -(back @ self.translation[..., None])[..., 0])

    def __getitem__(self, index: int) -> Poses:
        return Poses(self.rotation[index], self.translation[index])


def pose_alone(board: Tensor, pixels: Tensor, camera: Camera, solver: LMOptions) -> tuple[Poses, float]:
    """Board poses from one camera alone, both tilts tried, and the median RMS of its views."""
    normalized, valid = camera.normalize(pixels)
    # Unseen corners are NaN and thereby not valid.
    normalized = torch.where(valid[..., None], normalized, torch.nan)
    if int(valid.sum(-1).min()) < MINIMUM_CORNERS:
        return Poses(torch.empty(0), torch.empty(0)), math.inf
    homography = homographies(board, normalized)
    pinhole = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    state = BoardState.flat(camera.params.detach(), *poses_from_homographies(homography, pinhole))
    views = Views(board_points=board, pixels=pixels)
    state, _ = refine_poses(views, camera.model, state, solver, camera.field)
    state, flipped = unflip(views, camera.model, state, camera.field)
    if flipped:
        state, _ = refine_poses(views, camera.model, state, solver, camera.field)
    problem = views.problem(camera.model, field=camera.field)
    rms = float(torch.sqrt((problem.residuals(state) ** 2).sum(-1) / problem.seen.sum(-1)).median())
    return Poses(state.rotation, state.translation), rms if math.isfinite(rms) else math.inf


def check_fit(
    board: Tensor, pixels: Tensor, cameras: tuple[Camera, Camera], alone: tuple[float, ...], solver: LMOptions
) -> None:
    """Refuse cameras that do not fit their observations, or that fit each other's clearly better."""
    for c, word in enumerate(("left", "right")):
        if not alone[c] <= _FOREIGN_RMS:
            raise InputError(
                f"the {word} observations do not fit the {word} camera (RMS {alone[c]:.1f} px): are cameras or "
                "observations swapped?"
            )
    if cameras[0].size == cameras[1].size:
        swapped = [pose_alone(board, pixels[:, c], cameras[1 - c], solver)[1] for c in (0, 1)]
        if all(other < 0.9 * own for other, own in zip(swapped, alone, strict=True)):
            raise InputError(
                f"the left observations fit the right camera better (RMS {swapped[0]:.2f} against {alone[0]:.2f} px), "
                "and the right ones the left camera: the cameras are swapped"
            )


def pair_rms(problem: BoardProblem, state: BoardState, pixels: Tensor) -> Tensor:
    """RMS (V,) in pixels of each view, over all cameras."""
    residuals = problem.residuals(state)
    count = torch.isfinite(pixels).all(-1).sum((-2, -1))
    return torch.sqrt((residuals**2).sum(-1) / count)


def consensus(
    board: Tensor, pixels: Tensor, cameras: tuple[Camera, Camera], left: Poses, right: Poses
) -> tuple[Poses, Tensor, Tensor]:
    """The relative pose that most pairs agree with, which pairs are turned under it, and each pair's error (px)."""
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    turn = Poses(half_turn, board.amin(0) + board.amax(0))
    proposals = [right[i].after(left[i].inverse()) for i in range(len(pixels))]
    proposals += [right[i].after(turn).after(left[i].inverse()) for i in range(len(pixels))]
    as_read, other_end = pixels[:, 1], pixels[:, 1].flip(-2)
    points_left = board @ left.rotation.transpose(-1, -2) + left.translation[:, None]
    best: tuple[float, Poses, Tensor, Tensor] | None = None
    for number, proposal in enumerate(proposals):
        projected, valid = cameras[1].project(points_left @ proposal.rotation.T + proposal.translation)
        projected = torch.where(valid[..., None], projected, torch.inf)
        errors = torch.stack([_distance(projected, as_read), _distance(projected, other_end)])
        turned = errors[1] < _TURNED * errors[0]
        error = torch.where(turned, errors[1], errors[0])
        # At least two pairs must agree, or every proposal would be right about its own pair.
        rank = min(len(error), max(2, (len(error) + 1) // 2))
        score = float(error.sort().values[rank - 1])
        # One pair, or boards that hardly moved, fit a turned proposal as well: then the order is as read.
        if best is None or score < (_TURNED if number >= len(pixels) else 1.0) * best[0]:
            best = (score, proposal, turned, error)
    assert best is not None
    return best[1:]


def _distance(projected: Tensor, observed: Tensor) -> Tensor:
    """Root mean square distance (P,) over the corners that were seen."""
    return torch.sqrt(torch.nanmean(((projected - observed) ** 2).sum(-1), -1))
