"""`kcal rig` from more than boards: reads the sources, prints what was found, writes the rig file."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING

from kcal.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from kcal.calibrate.rig.result import RigSolution
    from kcal.calibrate.rig.sources import Baseline, Boards, MeasuredPosition, RigData
    from kcal.io.camera_file import CameraFile
    from kcal.io.rig_file import RigFile
    from kcal.lens.mounting import Mounting
    from kcal.locate.geodesy import Origin

CAMERAS = ("left", "right")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sources:
    """What the user gave, as on the command line."""

    pairs: tuple[Path, Path] | None = None
    match: Path | None = None
    landmarks: Path | None = None
    marks: Path | None = None
    features: Path | None = None
    positions: Path | None = None
    baseline: str | None = None
    origin: str | None = None
    mark_sigma: float = 0.3

    @property
    def only_boards(self) -> bool:
        """Whether there is nothing but boards."""
        return not any((self.landmarks, self.marks, self.features, self.positions, self.baseline))

    @property
    def files(self) -> list[Path]:
        """All that is read."""
        single = (self.match, self.landmarks, self.marks, self.features, self.positions)
        return [*(self.pairs or ()), *(path for path in single if path is not None)]


def parse_baseline(text: str) -> Baseline:
    """`"10.02±0.005"` or `"10.02+-0.005"`, meters."""
    from kcal.calibrate.rig.sources import Baseline

    parts = text.replace("+-", "±").split("±")
    try:
        length, sigma = (float(part) for part in parts)
    except ValueError:
        raise InputError(f"baseline {text!r}: write LENGTH±SIGMA in meters, for example 10.02±0.005") from None
    return Baseline(first=0, second=1, length=length, sigma=sigma)


def gather(cameras: tuple[CameraFile, CameraFile], sources: Sources, *, prior: bool) -> tuple[RigData, Origin | None]:
    """Read everything into one frame."""
    from kcal.calibrate.rig.sources import RigData
    from kcal.cli.console import err
    from kcal.locate.geodesy import Origin
    from kcal.locate.marks import read_marks
    from kcal.locate.survey import camera_positions, match_landmarks, read_features, read_survey

    origin = None if sources.origin is None else Origin.parse(sources.origin)
    if (sources.landmarks is None) != (sources.marks is None):
        raise InputError("--landmarks and --marks belong together: places by name, and where they are in the images")
    landmarks = None
    positions: tuple[MeasuredPosition, ...] = ()
    if sources.positions is not None:
        placed = read_survey(sources.positions, origin)
        origin, positions = placed.origin, camera_positions(placed, CAMERAS)
    if sources.landmarks is not None and sources.marks is not None:
        survey = read_survey(sources.landmarks, origin)
        if sources.positions is not None and survey.origin != origin:
            raise InputError("landmarks and positions: one has latitudes, the other local meters; give an --origin")
        origin = survey.origin
        found = match_landmarks(survey, read_marks(sources.marks, single=True), sources.mark_sigma)
        landmarks = found.landmarks
        for names, text in ((found.unmarked, "surveyed, but not marked"), (found.unsurveyed, "marked, not surveyed")):
            if names:
                err.print(f"[yellow]warning:[/] {text}:", ", ".join(names), markup=True)
    features = None if sources.features is None else read_features(sources.features, sources.mark_sigma)
    covariances = None
    if prior:
        covariances = tuple(_prior(file, name) for file, name in zip(cameras, CAMERAS, strict=True))
        err.print(
            "[yellow]warning:[/] camera files hold sigmas without correlations; taken as independent, the priors are "
            "looser in some directions and tighter in others than the calibrations were"
        )
    data = RigData(
        cameras=(cameras[0].camera(), cameras[1].camera()),
        names=CAMERAS,
        covariances=covariances,
        boards=None if sources.pairs is None else read_boards(sources.pairs, sources.match),
        landmarks=landmarks,
        features=features,
        baselines=() if sources.baseline is None else (parse_baseline(sources.baseline),),
        positions=positions,
    )
    return data, origin


def read_boards(pairs: tuple[Path, Path], match: Path | None) -> Boards:
    """Boards seen by both cameras, paired by name or by a CSV."""
    import torch

    from kcal.calibrate.rig.pairs import pair_by_name, read_pairs
    from kcal.calibrate.rig.sources import Boards
    from kcal.corners.observations import Observations

    seen = [Observations.load(path) for path in pairs]
    if seen[0].board != seen[1].board:
        raise InputError(f"the cameras saw different boards: {seen[0].board} and {seen[1].board}")
    names = seen[0].names, seen[1].names
    matched = read_pairs(match, *names) if match is not None else pair_by_name(*names)
    sides = [file.subset([pair[side] for pair in matched]) for side, file in enumerate(seen)]
    covariances = [side.covariances() for side in sides]
    known = [value for value in covariances if value is not None]
    return Boards(
        board=seen[0].board,
        pixels=torch.stack([side.pixels() for side in sides], 1),
        names=tuple(" ".join(dict.fromkeys(pair)) for pair in matched),
        covariance=torch.stack(known, 1) if len(known) == 2 else None,
    )


def _prior(file: CameraFile, name: str) -> Tensor:
    import torch

    if file.standard_deviations is None:
        raise InputError(f"the {name} camera file has no standard deviations to hold its parameters with")
    camera = file.camera()
    sigma = torch.tensor([file.standard_deviations[key] or 0.0 for key in camera.names], dtype=torch.float64)
    return torch.diag(sigma**2)


def mounting(solution: RigSolution, origin: Origin | None) -> Mounting | None:
    """How the left camera stands on the Earth; None where no latitude is known or the data leave it open."""
    import torch

    from kcal.locate.mounting import mounting_of

    if origin is None or not solution.absolute:
        return None
    covariance = solution.mounting_covariance(0)
    if not bool(torch.isfinite(covariance).all()):
        return None
    return mounting_of(solution.rotation[0], solution.center[0], covariance, origin, solution.mounting_link())


def record(
    solution: RigSolution, cameras: tuple[CameraFile, CameraFile], there: Mounting | None, *, fixed: bool
) -> RigFile:
    """The rig file of a solution; camera files are kept whole where the cameras were not solved again."""
    from kcal.io.camera_file import provenance
    from kcal.io.rig_file import RigMounting, rig_to_file
    from kcal.lens.calibration import Exclusion, RigCalibration, RigSource

    rig = solution.stereo()
    known = [rms for rms in solution.rms_px if not math.isnan(rms)]
    pairs = {
        item.name: math.sqrt(sum(p**2 for p in item.pixels if p is not None) / max(1, len(item.pixels)))
        for item in solution.items
        if item.source == "boards" and item.used
    }
    return rig_to_file(
        rig,
        left=cameras[0] if fixed else None,
        right=cameras[1] if fixed else None,
        covariance=solution.joint_covariance(),
        mounting=None if there is None else RigMounting.of(there),
        calibration=RigCalibration(
            rms=math.sqrt(sum(rms**2 for rms in known) / max(1, len(known))),
            rms_left=0.0 if math.isnan(solution.rms_px[0]) else solution.rms_px[0],
            rms_right=0.0 if math.isnan(solution.rms_px[1]) else solution.rms_px[1],
            pairs=len(pairs),
            per_pair_rms=pairs,
            flipped=solution.flipped,
            excluded=tuple(
                Exclusion(name=f"{item.source} {item.name}", reason=item.reason) for item in solution.left_out
            ),
            sources=tuple(
                RigSource(
                    name=source.source,
                    used=source.used,
                    left_out=source.left_out,
                    rms_px=source.rms_px,
                    rms_m=source.rms_m,
                    sigmas=None if math.isnan(source.sigmas) else source.sigmas,
                )
                for source in solution.sources
            ),
            baseline_m=float(rig.baseline),
            **provenance(),
        ),
    )


def show(solution: RigSolution, there: Mounting | None) -> None:
    """Print residuals by source, the relative pose with its sigmas, and what was left out."""
    from kcal.cli.console import err, out

    rows = [["source", "used", "left out", "RMS px", "RMS m", "sigmas"]]
    for source in solution.sources:
        cells = ["" if value is None else f"{value:.4f}" for value in (source.rms_px, source.rms_m)]
        sigmas = "" if math.isnan(source.sigmas) else f"{source.sigmas:.2f}"
        rows.append([source.source, f"{source.used}", f"{source.left_out}", *cells, sigmas])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for first, *rest in rows:
        out.print("  ".join([first.ljust(widths[0]), *map(str.rjust, rest, widths[1:])]).rstrip(), markup=False)
    rig, sigma = solution.stereo(), solution.relative_covariance().diagonal().sqrt()
    pitch, yaw, roll = (math.degrees(value) for value in sigma[:3].tolist())
    out.print(
        f"baseline [bold]{float(rig.baseline):.6f} m[/] ± {_along(solution):.6f}; "
        f"σ of yaw {yaw:.5f}°, pitch {pitch:.5f}°, roll {roll:.5f}°; {solution.status.message}"
    )
    if there is not None and there.covariance is not None:
        spread = there.covariance.diagonal().sqrt().tolist()
        out.print(
            f"left camera at {there.origin.lat:.7f}, {there.origin.lon:.7f}, {there.origin.height:.3f} m above the "
            f"ellipsoid (± {max(spread[:2]):.3f} m level, {spread[2]:.3f} m up), heading {there.heading_deg:.4f}° ± "
            f"{math.degrees(spread[5]):.4f}, pitch {there.pitch_deg:.4f}°, roll {there.roll_deg:.4f}°"
        )
    for name in solution.flipped:
        out.print(f"turned by 180°: {name} (the board was read from its other end)", markup=False)
    for item in solution.left_out:
        err.print("[yellow]left out:[/]", f"{item.source} {item.name}: {item.reason}")
    for text in solution.warnings:
        err.print("[yellow]warning:[/]", text)


def _along(solution: RigSolution) -> float:
    """σ of the baseline's length, meters."""
    rig = solution.stereo()
    direction = rig.right_from_left_translation / rig.baseline
    return math.sqrt(float(direction @ solution.relative_covariance()[3:, 3:] @ direction))
