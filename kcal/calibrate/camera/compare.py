"""Compare lens models by views that were held out: a tool for research. A calibration needs no such choice.

Groups of views are divided into parts. Each model is fitted without one part at a time. In the views of that part the
board's poses are solved again; camera and board stay as fitted. Models are compared by paired differences over the same
groups, so that errors that all models share cancel.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Hashable, Sequence
from typing import Literal

import torch
from torch import Tensor

from kcal.calibrate.camera.calibrate import calibrate_camera
from kcal.calibrate.camera.result import HYBRID, NETWORK, CalibrationOptions, Progress
from kcal.calibrate.hybrid.fit import HybridFit
from kcal.calibrate.hybrid.fitted_views import moving_residuals
from kcal.calibrate.problem.poses import poses_under
from kcal.calibrate.problem.views import Views, whitening
from kcal.corners.observations import Observations
from kcal.errors import InputError, KcalError
from kcal.lens.model import LensModel
from kcal.solve.lm import LMOptions
from kcal.texts import brief
from kcal.threads import in_one_thread

_POSES = LMOptions(max_iterations=60, tolerance=1e-12)
# Blocks are runs of at least five views, at most twenty of them.
_RUN, _MOST_BLOCKS = 5, 20


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ComparisonResult:
    """How well models predict views that were held out.

    Args:
        models: names of the models.
        costs: (M, G) squared residuals of each group, pixels². Infinite where a held-out corner has no image under the
            model, or where the model could not be fitted.
        corners: (G,) how many corners each group has.
        failures: model -> why it could not be fitted, for those to which that happened.

    Example:
        >>> costs = torch.tensor([[4.0, 1.0, 4.0], [4.0, 2.0, 5.0]], dtype=torch.float64)
        >>> result = ComparisonResult(models=("a", "b"), costs=costs, corners=torch.tensor([100, 50, 50]))
        >>> {name: round(rms, 4) for name, rms in result.rms.items()}
        {'a': 0.2121, 'b': 0.2345}
        >>> [round(value, 4) for value in result.difference("b", "a")]
        [0.0224, 0.0154]
    """

    __repr__ = brief

    models: tuple[str, ...]
    costs: Tensor
    corners: Tensor
    failures: dict[str, str] = dataclasses.field(default_factory=dict)

    @property
    def rms(self) -> dict[str, float]:
        """Model -> sqrt(mean ‖r‖²) over all held-out corners, pixels."""
        values = (self.costs.sum(-1) / self.corners.sum()).sqrt()
        return dict(zip(self.models, values.tolist(), strict=True))

    def difference(self, one: str, other: str) -> tuple[float, float]:
        """RMS of one model minus that of another, and its standard error over groups, pixels.

        NaN where either is infinite.
        """
        count, groups = self.corners.sum(), len(self.corners)
        deviations = []
        for name in (one, other):
            costs, rms = self.costs[self.models.index(name)], self.rms[name]
            # To first order, what each group adds to the RMS.
            deviations.append((costs - self.corners * rms**2) / (2.0 * count * max(rms, 1e-300)))
        error = float((deviations[0] - deviations[1]).square().sum().sqrt()) * math.sqrt(groups / (groups - 1))
        return self.rms[one] - self.rms[other], error


@in_one_thread
def compare_models(
    observations: Observations,
    models: Sequence[str | LensModel],
    *,
    groups: Literal["blocks", "views"] | Sequence[Hashable] = "blocks",
    parts: int = 5,
    options: CalibrationOptions | None = None,
    progress: Progress = lambda _: None,
) -> ComparisonResult:
    """Fit models without some of the views, and measure how well they predict these.

    Args:
        observations: the views of one camera.
        models: names of lens models, or `LensModel`s; "hybrid" is the lens that `calibrate_camera` fits by default,
            "network" the same with a small network as its field, or with that of `options`.
        groups: which views are held out together. "blocks": runs of views in their order, for videos and captures with
            similar neighbors; "views": each view for itself; or a label for each view. The result tells about new
            views that differ from the others as the groups differ from each other.
        parts: the groups are dealt into so many parts, each of which is held out once. As many parts as groups leave
            out one group at a time.
        options: for the parametric models; not given: with the board's warp. The hybrid takes
            `board`, `motion`, `bending`, `weighted`, `focal` and `field_of_view` of them.
        progress: called after each fit.

    Returns:
        held-out residuals, which are weighted by the corners' covariances where all views have them. Where views move
            while their rows are read, the motion of each held-out view is solved again too, for all models alike.

    Raises:
        InputError: fewer groups than parts, labels that do not fit the views, or the same model twice.
        KcalError: no model could be fitted.

    Example:
        >>> from kcal import Board, Camera, View
        >>> from kcal.lens import rotation_from_vector
        >>> board = Board(columns=7, rows=6, square=0.05)
        >>> truth = Camera.build(focal=(800, 805), center=(322, 238), size=(640, 480), coefficients=[-0.3, 0.1])
        >>> noise, views = torch.Generator().manual_seed(0), []
        >>> for i in range(10):
        ...     tilt = 0.5 * torch.tensor([[math.cos(i), math.sin(i), 0.2]], dtype=torch.float64)
        ...     points = board.points @ rotation_from_vector(tilt)[0].T
        ...     pixels, _ = truth.project(points + torch.tensor([-0.15, -0.14, 0.7], dtype=torch.float64))
        ...     pixels = pixels + 0.1 * torch.randn(pixels.shape, dtype=torch.float64, generator=noise)
        ...     views.append(View(name=str(i), pixels=pixels.tolist()))
        >>> seen = Observations(board=board, image_size=(640, 480), views=views)
        >>> result = compare_models(seen, ["pinhole", "opencv4"], groups="views")
        >>> result.rms["pinhole"] > 5 * result.rms["opencv4"]
        True
    """
    options = options or CalibrationOptions(model="opencv5", board_warp=True)
    if options.camera is not None:
        raise InputError("compare_models: a known camera leaves no models to compare")
    names = tuple(str(model if model in (HYBRID, NETWORK) else LensModel.named(model)) for model in models)
    if not names or len(set(names)) < len(names):
        raise InputError(f"compare_models: one or more different models are needed, got {', '.join(names) or 'none'}")
    members = _groups(observations, groups, parts)
    weights = torch.eye(2, dtype=torch.float64).expand(*observations.pixels().shape[:2], 2, 2)
    weighted = False
    judge = _motion(observations, options)
    costs = torch.full((len(names), len(members)), torch.inf, dtype=torch.float64)
    failures: dict[str, KcalError] = {}
    # Groups are dealt at random, so that no part is one end of the capture.
    order = torch.randperm(len(members), generator=torch.Generator().manual_seed(0)).tolist()
    for part in range(parts):
        held = order[part::parts]
        out = [i for g in held for i in members[g]]
        train = observations.subset([name for i, name in enumerate(observations.names) if i not in out])
        for number, model in enumerate(models):
            progress(f"{names[number]}, part {part + 1} of {parts}")
            try:
                found = calibrate_camera(train, _options(model, options))
            except KcalError as error:
                failures[names[number]] = error
                continue
            covariances = observations.covariances() if options.weighted else None
            if covariances is not None and not weighted:
                weights, weighted = whitening(covariances, 0.5 * found.rms**2), True
            test = Views(board_points=found.board_points, pixels=observations.pixels()[out], whitening=weights[out])
            poses, by_view = poses_under(found.camera, test, _POSES)
            by_view = torch.nan_to_num(2.0 * by_view, nan=math.inf)
            if judge is not None and judge.readout is not None:
                residuals = moving_residuals(
                    found.camera, found.board_points, observations.pixels()[out], poses.rotation, poses.translation,
                    judge.readout, judge.stillness,
                )  # fmt: skip
                white = torch.einsum("vnij,vnj->vni", weights[out], residuals)
                by_view = torch.where(by_view.isfinite(), white.square().nansum((1, 2)), torch.inf)
            for g in held:
                costs[number, g] = by_view[[out.index(i) for i in members[g]]].sum()
    if not bool(costs.isfinite().any()) and failures:
        raise next(iter(failures.values()))
    seen = torch.isfinite(observations.pixels()).all(-1).sum(-1)
    return ComparisonResult(
        models=names,
        costs=costs,
        corners=torch.stack([seen[group].sum() for group in members]),
        failures={name: str(error) for name, error in failures.items()},
    )


def _motion(observations: Observations, options: CalibrationOptions) -> HybridFit | None:
    """A fit of all views, which tells how much they move: the same for all models; None: they stand still."""
    try:
        fit = calibrate_camera(observations, _options(HYBRID, options)).hybrid
    except KcalError:
        return None
    return fit if fit is not None and fit.readout is not None else None


def _options(model: str | LensModel, options: CalibrationOptions) -> CalibrationOptions:
    """The options for one model; the hybrid takes those that are its own."""
    if model not in (HYBRID, NETWORK):
        return dataclasses.replace(options, model=model, board="printed", field=None)
    own = ["board", "motion", "bending", "weighted", "focal", "field_of_view"]
    own += ["field", "training"] if model == NETWORK else []
    return CalibrationOptions(model=str(model), **{name: getattr(options, name) for name in own})


def _groups(
    observations: Observations, groups: Literal["blocks", "views"] | Sequence[Hashable], parts: int
) -> list[list[int]]:
    """Indices of the views that are held out together."""
    views = len(observations.views)
    if groups == "blocks":
        count = min(_MOST_BLOCKS, max(views // _RUN, min(views, parts)))
        found = [part.tolist() for part in torch.arange(views).tensor_split(count)]
    elif groups == "views":
        found = [[i] for i in range(views)]
    else:
        labels = list(groups)
        if isinstance(groups, str) or len(labels) != views:
            raise InputError(f"groups: 'blocks', 'views' or a label for each of the {views} views, got {groups!r}")
        found = [[i for i, label in enumerate(labels) if label == one] for one in dict.fromkeys(labels)]
    if not 2 <= parts <= len(found):
        raise InputError(f"{len(found)} groups of views cannot be held out in {parts} parts; add views or groups")
    return found
