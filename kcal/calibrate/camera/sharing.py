"""Cameras that are calibrated together: they share the boards that they saw, and what lenses of one type have alike.

Each camera is calibrated alone first. Whether two saw one board is told by the evidence; each camera is then fitted
again with the board as the others measured it (`kcal.calibrate.hybrid.cameras_fit`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from kcal.calibrate.camera.hybrid import hybrid_result
from kcal.calibrate.camera.leave_out import lasting_warnings
from kcal.calibrate.camera.options import CalibrationOptions
from kcal.calibrate.camera.repeats import copied_views, copy_warnings, pose_warnings
from kcal.calibrate.camera.result import CameraCalibrationResult, SharedBoard
from kcal.calibrate.hybrid.board_orders import turned_corners
from kcal.calibrate.hybrid.cameras_fit import Run, fit_cameras
from kcal.calibrate.hybrid.fit import HybridFit
from kcal.calibrate.hybrid.fleet import LEAST_CAMERAS
from kcal.corners.observations import Observations
from kcal.errors import KcalError

Outcome = CameraCalibrationResult | KcalError
# Said of each camera when all of them together could not be fitted.
ALONE = "calibrated alone, without what other cameras tell of the board"


def sharing(
    outcomes: Sequence[Outcome],
    options: CalibrationOptions,
    *,
    one_type: bool = False,
    run: Run | None = None,
    advance: Callable[[str], None] | None = None,
) -> list[Outcome]:
    """Calibrate cameras again, each with what the others tell.

    Args:
        outcomes: of each camera alone, with these options; errors stay what they are.
        options: of all of them.
        one_type: the cameras are of one type: from four cameras on, each learns from the others what its lens is like.
        run: makes the fits, see `fit_cameras`.
        advance: called after each fit.

    Raises:
        KcalError: the cameras cannot be fitted together.
    """
    found = list(outcomes)
    known = {i: outcome for i, outcome in enumerate(outcomes) if isinstance(outcome, CameraCalibrationResult)}
    boards = [result.observations.board for result in known.values()]
    together = options.board == "printed" and len(set(boards)) < len(boards)
    if not options.hybrid or not (together or (one_type and len(known) >= LEAST_CAMERAS)):
        return found
    used = {i: result.per_view_rms.isfinite().nonzero()[:, 0].tolist() for i, result in known.items()}
    alone = [_hybrid_of(result).only(used[i]) for i, result in known.items()]
    fitted = fit_cameras(
        [result.observations.subset([result.observations.names[k] for k in used[i]]) for i, result in known.items()],
        names=[str(i + 1) for i in known],
        weights=[fit.weights for fit in alone],
        board=options.board,
        one_type=one_type,
        first=alone,
        run=run,
        advance=advance,
    )
    for camera, first, (i, before) in zip(fitted.cameras, alone, known.items(), strict=True):
        others = tuple(j for j, c in zip(known, fitted.cameras, strict=True) if c.board == camera.board >= 0 and j != i)
        shared = SharedBoard(others=others, evidence=camera.nats) if others else None
        if camera.fit is first:
            found[i] = dataclasses.replace(before, shared_board=shared)
            continue
        seen = _in_order(before.observations, used[i], camera.turns)
        after = hybrid_result(seen, camera.fit.among(used[i], len(seen.views)), options)
        pixels = before.observations.pixels()
        copied = {k: of for k, of in copied_views(pixels, before.noise).items() if k not in used[i]}
        repeats = (*copy_warnings(before.observations.names, copied), *pose_warnings(pixels[used[i]]))
        found[i] = dataclasses.replace(
            after,
            warnings=(*lasting_warnings(before), *after.warnings, *repeats),
            rejected_corners=before.rejected_corners,
            rejected_views=before.rejected_views,
            shared_board=shared,
        )
    return found


def _hybrid_of(result: CameraCalibrationResult) -> HybridFit:
    assert result.hybrid is not None
    return result.hybrid


def _in_order(seen: Observations, used: Sequence[int], turns: Tensor) -> Observations:
    """With the corners of views that were read from another end in the order of the others."""
    views, corners = list(seen.views), torch.arange(seen.board.corners)[None]
    for k, turn in zip(used, turns, strict=True):
        if turn:
            order = turned_corners(corners, seen.board, turn[None])[0].tolist()
            there, spread = views[k].pixels, views[k].covariance
            covariance = None if spread is None else tuple(spread[n] for n in order)
            views[k] = views[k].model_copy(update={"pixels": tuple(there[n] for n in order), "covariance": covariance})
    return seen.model_copy(update={"views": tuple(views)})
