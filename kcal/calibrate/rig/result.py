"""A solved rig: cameras, residuals by source and by item, what was left out and why, joint covariances."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import Source
from kcal.calibrate.rig.problem import RigProblem
from kcal.calibrate.rig.uncertainty import SharedSpread, mounting_rows, parameter_rows, relative_rows
from kcal.errors import DegenerateError
from kcal.lens.camera import Camera
from kcal.lens.rig import StereoRig
from kcal.solve.result import SolverStatus, State


@dataclasses.dataclass(frozen=True, kw_only=True)
class ItemResidual:
    """One thing that was seen or measured, and how well it agrees with the rest.

    Args:
        source: which kind it is.
        name: its name.
        pixels: RMS distance in px in each camera, of what was left out from where the others put it; None where a
            camera did not see it.
        meters: of a landmark between survey and adjusted position, of a measured position between measured and solved,
            of a baseline its error; None for the others.
        sigmas: root of χ² over its degrees of freedom; 1 is typical.
        used: whether it is part of the solution.
        reason: why it was left out.
    """

    source: Source
    name: str
    pixels: tuple[float | None, ...] = ()
    meters: float | None = None
    sigmas: float
    used: bool = True
    reason: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SourceResidual:
    """All items of one source together.

    Args:
        source: which.
        used: how many are part of the solution.
        left_out: how many are not.
        rms_px: sqrt(mean ‖r‖²) over its pixels; None where it has none.
        rms_m: root of the mean squared meters of the items that have them.
        sigmas: root of χ² over the degrees of freedom; 1 where the stated sigmas are right.
    """

    source: Source
    used: int
    left_out: int
    rms_px: float | None
    rms_m: float | None
    sigmas: float


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RigSolution:
    """What `solve_rig` found.

    Convention: `cam_from_local` of camera c is p = rotation[c] (x - center[c]); the local frame is east-north-up of the
    data's origin if `absolute`, otherwise the first camera's.

    Args:
        cameras: as solved; the same as given where intrinsics are fixed.
        names: of the cameras.
        rotation: (C, 3, 3).
        center: (C, 3) meters.
        absolute: see above.
        sources: residuals by source.
        items: residuals by item, those left out included.
        flipped: boards that had been read from the other end and were turned.
        rms_px: sqrt(mean ‖r‖²) over the pixels of each camera; NaN for a camera with none.
        chi2: sum of squares of all residuals over their sigmas.
        freedom: degrees of freedom.
        variance: by which covariances are multiplied, because residuals are larger than their sigmas say; 1 if not.
        sigma_corner: of a board's corner along an axis, px, as used; None without boards.
        undetermined: what the data leave open, in words; none of it concerns the cameras' relative poses.
        status: why the solver stopped.
        warnings: sentences about what the user should doubt.
    """

    cameras: tuple[Camera, ...]
    names: tuple[str, ...]
    rotation: Tensor
    center: Tensor
    absolute: bool
    sources: tuple[SourceResidual, ...]
    items: tuple[ItemResidual, ...]
    flipped: tuple[str, ...]
    rms_px: tuple[float, ...]
    chi2: float
    freedom: int
    variance: float
    sigma_corner: float | None
    undetermined: tuple[str, ...]
    status: SolverStatus
    warnings: tuple[str, ...]
    _problem: RigProblem
    _state: State
    _spread: SharedSpread
    _places: dict[Source, tuple[tuple[str, ...], Tensor]]

    @property
    def left_out(self) -> tuple[ItemResidual, ...]:
        """What is not part of the solution."""
        return tuple(item for item in self.items if not item.used)

    def stereo(self, first: int = 0, second: int = 1) -> StereoRig:
        """Two of the cameras as a rig."""
        rotation = self.rotation[second] @ self.rotation[first].T
        translation = self.rotation[second] @ (self.center[first] - self.center[second])
        return StereoRig(self.cameras[first], self.cameras[second], rotation, translation)

    def places(self) -> dict[Source, dict[str, Tensor]]:
        """Where boards (their middle), landmarks and features stand: (3,) meters in the local frame, by name.

        Features as far away as their inverse range says, at most 100 km.
        """
        return {source: dict(zip(names, points, strict=True)) for source, (names, points) in self._places.items()}

    def relative_covariance(self, first: int = 0, second: int = 1) -> Tensor:
        """(6, 6) of second_from_first: rotation vector about the second camera's axes, translation along them."""
        return self._spread.of(relative_rows(self._problem, self._state, first, second))[0]

    def joint_covariance(self, first: int = 0, second: int = 1) -> Tensor:
        """Of both cameras' parameters and their relative pose, ordered as in `RigCovariance`."""
        rows = [parameter_rows(self._problem, first), parameter_rows(self._problem, second)]
        return self._spread.of(torch.cat([*rows, relative_rows(self._problem, self._state, first, second)]))[0]

    def mounting_link(self, first: int = 0, second: int = 1) -> Tensor:
        """(P, 6) covariance of `joint_covariance`'s P quantities with the mounting of the first camera."""
        rows = [parameter_rows(self._problem, first), parameter_rows(self._problem, second)]
        rows.append(relative_rows(self._problem, self._state, first, second))
        rows.append(mounting_rows(self._problem, self._state, first))
        return self._spread.of(torch.cat(rows))[0][:-6, -6:]

    def mounting_covariance(self, camera: int = 0) -> Tensor:
        """(6, 6) of a camera's center (meters) and of small turns of it (radians), both about the local frame's axes.

        Infinite variances where the data leave something open; zeros for the first camera of a rig that is not
        `absolute`.
        """
        return self._spread.of(mounting_rows(self._problem, self._state, camera))[0]


def check_determined(
    spread: SharedSpread, problem: RigProblem, state: State, names: tuple[str, ...], open_: tuple[str, ...]
) -> None:
    """Raise `DegenerateError` if a relative pose is open; what is open is named."""
    for second in range(1, len(names)):
        _, determined = spread.of(relative_rows(problem, state, 0, second))
        if not bool(determined.all()):
            what = "; ".join(open_[:3]) + (" and more" if len(open_) > 3 else "")
            raise DegenerateError(
                f"the data do not determine how {names[second]} stands from {names[0]}: {what} "
                "could be anything; add boards seen by both, surveyed landmarks, far features of known range, a "
                "measured baseline or measured positions"
            )
