"""Assess the solution of a rig: refuse what is not determined or contradicts itself, say what to doubt, and record."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.blocks import PerKind
from kcal.calibrate.rig.contradictions import CERTAIN, contradictions
from kcal.calibrate.rig.initial_poses import InitialPoses
from kcal.calibrate.rig.mixups import swap_warnings
from kcal.calibrate.rig.motion import moved_warnings
from kcal.calibrate.rig.other_places import refuse_several
from kcal.calibrate.rig.records import Reasons, item_records, places, source_records
from kcal.calibrate.rig.redundancy import refuse_exact
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.uncertainty import SharedCovariance, goodness_of_fit, parameter_rows, relative_rows
from kcal.calibrate.rig.weak_geometry import check_places
from kcal.errors import DegenerateError, InputError
from kcal.io.camera_file import provenance
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.solve.result import Result, SolverStatus

# Of fewer boards alone, a wrong one cannot be told from a good one.
_FEW_BOARDS = 3
# px: a higher RMS is not noise.
_HIGH_RMS = 1.0


def rig_result(
    work: Adjustment,
    found: Result,
    masks: PerKind,
    reasons: Reasons,
    initial: InitialPoses,
    warnings: list[str],
    *,
    refuse: bool,
) -> RigResult:
    """The result of a rig from its solution.

    Args:
        work: with the solution of what the masks name.
        found: what the solver said.
        masks: what took part.
        reasons: why the rest did not.
        initial: from where it began.
        warnings: that there are already.
        refuse: raise errors where measurements contradict each other or leave ranges open; otherwise warnings tell.

    Raises:
        InputError: a measured baseline or position that contradicts the rest, or several explanations.
        DegenerateError: relative poses that are not determined, or exactly, or so that no range is known.
    """
    data, state, problem = work.data, work.part(masks), work.problem(masks)
    fit = goodness_of_fit(problem, state)
    covariance = SharedCovariance(problem, state, fit.variance)
    undetermined = covariance.open_directions(data.names, absolute=data.absolute)
    for second in range(1, len(data.cameras)):
        if not bool(covariance.of(relative_rows(problem, state, 0, second))[1].all()):
            what = "; ".join(undetermined[:3]) + (" and more" if len(undetermined) > 3 else "")
            cure = (
                "add boards seen by both, surveyed landmarks, far features of known range, a measured baseline or "
                "measured positions"
            )
            if data.stars is not None:
                cure = (
                    "stars and a baseline tell nothing of the baseline's direction: add matches of unknown range "
                    "(features), or the measured positions of both cameras (GNSS)"
                )
            raise DegenerateError(
                f"the data do not determine how {data.names[second]} stands from {data.names[0]}: {what} could be "
                f"anything; {cure}"
            )
    refuse_exact(problem, data.names, fit.freedom)
    refuse_several(work, masks)
    against = contradictions(work, problem, state)
    certain = [one for one in against if one.sigmas > CERTAIN]
    if refuse and certain and certain[0].stated:
        raise InputError(certain[0].text)
    widen, doubts = check_places(problem, state, covariance, data.names, refuse=refuse)
    if widen > 1.0:
        covariance = SharedCovariance(problem, state, widen**2 * fit.variance)
    squared, counts = torch.zeros(len(data.cameras)).double(), torch.zeros(len(data.cameras)).double()
    for block in problem.blocks:
        squared += block.errors(problem.posed(state), state).square().sum((0, 2, 3))
        counts += block.seen.sum((0, 2))
    if data.skyline is not None:
        for c, many, px in zip(data.skyline.cameras, data.skyline.columns, data.skyline.rms_px, strict=True):
            squared[c], counts[c] = squared[c] + many * px**2, counts[c] + many
    rms, status = math.sqrt(float(squared.sum() / counts.sum())), SolverStatus(int(found.status))
    warnings += [
        f"the {kind} differ from each other by {times:.1f} times what their sigmas say: their sigmas were multiplied "
        f"by {times:.1f}"
        for kind, times in work.widened.items()
        if times > 1.0
    ]
    if fit.variance > 1.0:
        times = math.sqrt(fit.variance)
        warnings.append(f"residuals are {times:.1f} times as large as their sigmas say; the covariance was widened")
    warnings += [one.text for one in against]
    only_boards = len(problem.blocks) == 1 and problem.blocks[0].kind == "boards"
    if only_boards and (count := int(masks.boards.sum())) < _FEW_BOARDS:
        warnings.append(f"{count} pair(s) only: a wrong one could not be noticed; 5 or more are good")
    if only_boards and rms > _HIGH_RMS:
        warnings.append(f"RMS {rms:.2f} px is high: were both views of each pair taken at the same moment?")
    if status not in (SolverStatus.CONVERGED, SolverStatus.EXACT):
        warnings.append(f"the solver {status.message}")
    focal = [float(camera.params[0]) for camera in data.cameras]
    warnings += moved_warnings(data.names, focal, work.motion, work.sigma_corner)
    warnings += doubts
    warnings += [f"not determined by the data: {text}" for text in undetermined]
    whole = [parameter_rows(problem, c) for c in range(len(data.cameras))]
    if not bool(covariance.of(torch.cat(whole))[1].all()):
        warnings.append(
            "the data do not determine all parameters of the cameras: the rig has no covariance, and intervals know "
            "errors of the marks alone"
        )
    warnings += swap_warnings(data, problem, state, covariance)
    items = item_records(work, masks, reasons)
    cameras = data.cameras
    if any(bool(part.any()) for part in problem.unknowns.cameras):
        cameras = tuple(
            _refined(camera, problem.parameters(state)[c], covariance.of(parameter_rows(problem, c))[0])
            for c, camera in enumerate(data.cameras)
        )
    return RigResult(
        data=data,
        cameras=cameras,
        rotation=state.rotation,
        center=state.center,
        board_warp=state.board if len(problem.unknowns.shapes) == 2 else None,
        sources=source_records(work, masks, items),
        items=items,
        flipped=tuple(initial.flipped),
        rms=rms,
        rms_px=tuple((squared / counts).sqrt().tolist()),
        chi2=fit.chi2,
        freedom=fit.freedom,
        variance=widen**2 * fit.variance,
        sigma_corner=None if data.boards is None else work.sigma_corner,
        undetermined=undetermined,
        contradictions=tuple(one.text for one in certain),
        status=status,
        warnings=tuple(warnings),
        _problem=problem,
        _state=state,
        _covariance=covariance,
        _places=places(work),
        _provenance=provenance(),
    )


def _refined(camera: Camera, parameters: Tensor, covariance: Tensor) -> Camera:
    """The camera as the rig found it, with new sigmas; all that is known of it together is the rig's covariance."""
    out, known = camera.with_parameters(parameters), camera.calibration
    spread = covariance.diagonal().sqrt()
    sigma = {
        name: float(value) if 0 < value < math.inf else None for name, value in zip(camera.names, spread, strict=True)
    }
    known = CameraCalibration() if known is None else known
    out.calibration = CameraCalibration(name=known.name, sigma=sigma, record=known.record, setting=known.setting)
    return out
