"""Data near a solution as a quadratic form, and how large each family of unknowns may be by its evidence."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.calibrate.hybrid.families import Hyperprior, PriorFamilies, typical_hyperprior
from kcal.calibrate.problem.state import (
    AXES,
    BENDS,
    LARGEST,
    SMALLEST,
    amplitudes_of,
    by_number,
    stillness,
    usual_motion,
)
from kcal.calibrate.problem.views import LEAST_NOISE
from kcal.solve.schur import Products, matrix_product, products_of

# Data near a solution as a quadratic form of lens and board, with poses and motions eliminated.
#
# Near a solution x₀ residuals are linear in the unknowns: chi² = c - 2 gᵀδ + δᵀKδ with δ = x - x₀, poses eliminated.
# (About x₀, because about zero all digits of c would cancel where noise is small.) Motions of views
# (`kcal.calibrate.problem.state`) are integrated out under a normal prior: with U their columns off the poses, R
# their prior standard deviations in units of the noise, and M = (UᵀU + R⁻²)⁻¹, a view's AᵀA becomes AᵀA - AᵀU M UᵀA,
# and ln det(R UᵀU R + I) is added to -2 ln p.

Array = npt.NDArray[np.float64]


class Quadratic(NamedTuple):
    """Data near a solution: chi² = c - 2 gᵀδ + δᵀKδ at x = `at` + δ, poses eliminated.

    These are the normal equations of a `kcal.gaussian.Gaussian`, because the evidence forms them under hundreds of
    priors.

    Attributes:
        products: (S + 1, S + 1) of its rows, K and in the last row and column -g and c.
        freedom: ν, residuals without those that poses take up.
        at: (S,) x₀.
    """

    products: Tensor
    freedom: float
    at: Tensor

    @property
    def K(self) -> Tensor:
        """(S, S)."""
        return self.products[:-1, :-1]

    @property
    def g(self) -> Tensor:
        """(S,)."""
        return -self.products[:-1, -1]

    @property
    def c(self) -> float:
        """χ² at x₀."""
        return float(self.products[-1, -1])

    def tempered(self, tempering: float) -> Quadratic:
        """The same data, whose log likelihood is divided by the tempering."""
        return Quadratic(self.products / tempering, self.freedom / tempering, self.at) if tempering != 1.0 else self


class ViewData(NamedTuple):
    """Data near a solution, of views with M numbers each: of motion, of bending, of both; or that stood still, M = 0.

    Attributes:
        still: as if they had stood still.
        own: (V, M, M) UᵀU of each view.
        cross: (V, M, S + 1) Uᵀ [A, r], A being the rows and r their residuals as if all views had stood still.
        score: (V, S) Aᵀ r of each view.
        relative: (V,) how much the board bends in each view, relative to the others; None: alike.
    """

    still: Quadratic
    own: Tensor
    cross: Tensor
    score: Tensor
    relative: Tensor | None = None

    @property
    def moving(self) -> bool:
        """Whether views have such numbers."""
        return self.own.shape[-1] > 0

    @property
    def unequal(self) -> float:
        """-ln of the prior density of the factors by which the board bends more in some views, over that at one."""
        if self.relative is None:
            return 0.0
        precision = self.relative.double() ** -2
        return 0.5 * _TAILS * float((precision - 1.0 - precision.log()).sum())

    def only(self, amplitudes: Sequence[int]) -> ViewData:
        """These data with some of the amplitudes of motion and bending; all other motions are zero."""
        bends = self.relative is not None
        count = (self.own.shape[-1] - BENDS * bends) // AXES + bends
        kept = np.isin(amplitudes_of(count), amplitudes)
        relative = self.relative if count - 1 in amplitudes else None
        return self._replace(own=self.own[:, kept][..., kept], cross=self.cross[:, kept], relative=relative)

    def integrated(self, log_ratio: Array) -> Integrated:
        """Integrate motions out, whose standard deviations over the noise have these logarithms."""
        if not self.moving:
            return Integrated(self.still, 0.0, self.own, self.cross)
        ratio = by_number(log_ratio, self.relative)
        matrix = self.own * (ratio[..., :, None] * ratio[..., None, :])
        matrix.diagonal(dim1=-2, dim2=-1).add_(1.0)
        root = torch.linalg.cholesky(matrix)
        inverse = torch.linalg.solve_triangular(root, torch.eye(len(root[0]), dtype=root.dtype), upper=False)
        half = matrix_product(inverse * ratio[..., None, :], self.cross)
        data = self.still._replace(products=self.still.products - products_of(half.flatten(0, 1).T))
        log_determinant = 2.0 * float(root.diagonal(dim1=-2, dim2=-1).log().sum())
        return Integrated(data, log_determinant, inverse, half)

    def scores(self, log_ratio: Array) -> Tensor:
        """(V, S) derivatives of each view's -½ chi² by the shared unknowns, motions integrated out."""
        if not self.moving:
            return self.score
        matrix = self.own + torch.diag_embed(stillness(log_ratio, self.relative))
        best = torch.linalg.solve(matrix, self.cross[..., -1:])
        return self.score - (self.cross[..., :-1].transpose(1, 2) @ best)[..., 0]


class Integrated(NamedTuple):
    """Data with motions integrated out, and what derivatives by the motions' standard deviations need.

    Attributes:
        data: the quadratic form of lens and board.
        log_determinant: ln det(R UᵀU R + I), over the views.
        inverse: (V, M, M) of the Cholesky factor of that.
        half: (V, M, S + 1) inverse times R Uᵀ [A, r].
    """

    data: Quadratic
    log_determinant: float
    inverse: Tensor
    half: Tensor

    def slopes(
        self, step: Array, covariance: Tensor, deviation: Array, y: Array, variance: float, tempering: float,
        amplitudes: int,
    ) -> Slopes:  # fmt: skip
        """Derivatives of -ln p by the logarithms of the ratios.

        Each first one is the sum over motions of 1 less the posterior's second moment in units of the prior. The
        second ones are those of any Gaussian amplitudes, motions among them.

        Args:
            step: (S,) δ of the best lens and board.
            covariance: (S, S) their posterior covariance in units of their priors.
            deviation: (S,) standard deviations of these.
            y: (S,) the best lens and board in the same units.
            variance: of the noise.
            tempering: by which the data count less.
            amplitudes: number of the ratios.
        """
        own = self.inverse.transpose(1, 2) @ self.inverse  # of motions whose lens and board are known
        scaled = matrix_product(self.inverse.transpose(1, 2) / math.sqrt(variance * tempering), self.half)
        mean = scaled[..., :-1] @ torch.from_numpy(step) + scaled[..., -1]
        reach = scaled[..., :-1] * torch.from_numpy(deviation)
        # A row for each motion, times the covariance of lens and board.
        spread = matrix_product(reach.flatten(0, 1), covariance).view(reach.shape)
        kept = own.diagonal(dim1=1, dim2=2)
        # Numbers of one amplitude count together: within a view, and across all views (of single precision, for steps).
        number = torch.from_numpy(amplitudes_of(amplitudes))
        together = torch.nn.functional.one_hot(number, amplitudes).to(own.dtype).T
        G = spread @ reach.transpose(1, 2)
        moment = mean.square() + G.diagonal(dim1=1, dim2=2)
        first = together @ ((1.0 - kept) / tempering - moment).sum(0)
        within = (-0.5 * own.square() / tempering - own * (mean[:, :, None] * mean[:, None]) - own * G).sum(0)
        within.diagonal().add_((0.5 * kept / tempering + 0.5 * moment).sum(0))
        along = (together[:, None] * mean).flatten(1) @ reach.flatten(0, 1)
        mixed = along @ covariance
        if len(mean.flatten()) ** 2 < amplitudes * len(step) ** 2:
            # Few views have fewer rows than there are unknowns.
            pairs = matrix_product(spread.flatten(0, 1).float(), reach.flatten(0, 1).T.float()).square().double()
            across = together @ pairs.unflatten(0, mean.shape).unflatten(2, mean.shape).sum((0, 2)) @ together.T
            squared = together @ spread.square().sum(0)
        else:
            each = number.bincount().tolist()
            parts = zip(spread.float().split(each, 1), reach.float().split(each, 1), strict=True)
            both = torch.stack([matrix_product(one.flatten(0, 1).T, other.flatten(0, 1)) for one, other in parts])
            across = (both.flatten(1) @ both.mT.flatten(1).T).double()
            squared = (both.double() * covariance).sum(2)
        second = 4.0 * (together @ within @ together.T - mixed @ along.T) - 2.0 * across
        Y = torch.from_numpy(y)
        by_noise = together @ mean.square().sum(0) + 2.0 * mixed @ Y + squared.sum(-1)
        return Slopes(first.numpy(), second.numpy(), -(2.0 * mixed * Y + squared).numpy(), by_noise.numpy())


class Slopes(NamedTuple):
    """Derivatives of -ln p by the logarithms of the ratios: first; second; mixed, by 2 ln of priors' sds and ln σ²."""

    first: Array
    second: Array
    by_variance: Array
    by_noise: Array


def view_data(products: Products, x: Tensor, motion: Tensor, freedom: float) -> ViewData:
    """From products off the poses, by motions and by lens and board, at lens and board x and motions (V, M)."""
    own, cross, score, total = products
    if motion.shape[1]:
        # As if all views had stood still: motions are unknowns whose prior is about zero.
        along = (motion[:, None] @ cross)[:, 0]
        moved = (motion[:, None] @ own)[:, 0]
        total, cross = total.clone(), cross.clone()
        change = along.sum(0)
        total[-1] -= change
        total[:, -1] -= change
        total[-1, -1] += (moved * motion).sum()
        cross[..., -1] -= moved
        score = score - along
    return ViewData(still=Quadratic(total, freedom, x), own=own, cross=cross, score=score[:, :-1])


def overdispersion(score: Tensor, K: Tensor, deviation: Tensor, variance: float) -> float:
    """Scatter of the views' scores (V, S) over what independent corners explain, in directions that data determine."""
    score = score - score.mean(0)
    inverse = posterior_root(K, deviation, variance)
    effective = len(K) - float(inverse.square().sum())
    scattered = float((inverse @ (score * deviation / variance).T).square().sum()) * len(score) / (len(score) - 1)
    return max(1.0, scattered / effective)


def posterior_root(K: Tensor, deviation: Tensor, variance: float) -> Tensor:
    """M of MᵀM = (I + √D K √D / σ²)⁻¹."""
    # By eigenvalues: with wrong corners K is so large that a Cholesky factor loses the I to rounding.
    values, vectors = torch.linalg.eigh(K * deviation[:, None] * deviation / variance)
    return (1.0 + values.clamp_min(0.0)).rsqrt()[:, None] * vectors.T


# How large each family of unknowns may be, told by the data: amplitudes and noise that maximize the evidence.
#
# Near a solution residuals are linear in lens and board, poses eliminated. With
# Gaussian priors of variances D(h) the unknowns can be integrated out, and
#
#     -2 ln p(data | h, σ²) = ν ln σ² + rss/σ² + |y|² + ln |I + √D K √D / σ²|,   x = √D y at its best,
#
# is minimized over the hyperparameters h (log amplitudes and decays) and the noise, together with a broad log-normal
# prior on h (type-II maximum likelihood, MacKay 1992; restricted maximum likelihood, Patterson and Thompson 1971).

# Nats by which motions must raise the evidence to be taken for real.
WORTH = 3.0
# Of the next step of Newton's method, in nats, and largest slope: where the maximum is reached; roughly, for another
# round. 1e-2 of ln amplitude is 5e-3 sigma.
_EXACTLY, _ROUGHLY = (1e-9, 1e-4), (5e-3, 0.05)
_STEPS = 60
# Lengths of its steps: first, longest, and that at which it gives up; curvature that is taken where there is less.
_FIRST_STEP, _LONGEST, _SHORTEST, _FLAT = 2.0, 4.0, 1e-7, 0.05
# Logarithm of an amplitude that is none.
_NOWHERE = -40.0
# ln σ² beyond which numbers overflow.
_HIGHEST = 300.0


def negative_log_evidence(
    data: Quadratic, families: PriorFamilies, v: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """The negative logarithm of the evidence of v = (h, ln σ²), (H + 1,), gradient and Hessian; inf beyond numbers."""
    found = _posterior(data, families, v[:-1], v[-1])
    if found is None:
        return math.inf, np.zeros_like(v), np.zeros((len(v), len(v)))
    return found.best.value, found.slope, found.bend


class _Best(NamedTuple):
    """-ln p, and the best lens and board: δ (S,), and in units of their priors y (S,); what derivatives need."""

    value: float
    step: np.ndarray
    y: np.ndarray
    deviation: np.ndarray
    rss: float
    root: Tensor


class _Posterior(NamedTuple):
    """-ln p, its first and second derivatives by h and ln σ², and what those by motions need.

    Attributes:
        slope: (H + 1,).
        bend: (H + 1, H + 1).
        best: lens and board.
        covariance: (S, S) their posterior covariance in units of their priors.
        by_h: (S, H) derivatives of 2 ln (prior standard deviation) by h.
    """

    slope: np.ndarray
    bend: np.ndarray
    best: _Best
    covariance: Tensor
    by_h: np.ndarray


def _best(data: Quadratic, families: PriorFamilies, h: np.ndarray, log_variance: float) -> _Best:
    """The value is infinite where priors are too wide for the precision of numbers, or noise is beyond them."""
    K, g, held = data.K.numpy(), data.g.numpy(), min(log_variance, _HIGHEST)
    s2, d = math.exp(held), families.deviation(torch.from_numpy(h)).numpy()
    A = K * d[:, None]
    A *= d / s2
    A[np.diag_indices(len(d))] += 1.0
    root, info = torch.linalg.cholesky_ex(torch.from_numpy(A))
    # The solution in units of the priors.
    y = np.divide(data.at.numpy(), d, out=np.zeros_like(d), where=d > 0)
    change = torch.cholesky_solve(torch.from_numpy(d / s2 * g - y)[:, None], root)[:, 0].numpy()
    y, step = y + change, d * change
    rss = float(data.c - 2 * g @ step + step @ K @ step)
    value = 0.5 * (data.freedom * held + rss / s2 + float(y @ y)) + float(root.diagonal().log().sum())
    return _Best(value if not int(info) and held < _HIGHEST else math.inf, step, y, d, rss, root)


def _posterior(data: Quadratic, families: PriorFamilies, h: np.ndarray, log_variance: float) -> _Posterior | None:
    """The posterior with its derivatives; None where priors are too wide for the precision of numbers."""
    best = _best(data, families, h, log_variance)
    if not math.isfinite(best.value):
        return None
    covariance = torch.cholesky_inverse(best.root)
    M, y, s2 = covariance.numpy(), best.y, math.exp(-log_variance)
    kept, squared, My = M.diagonal(), M * M, M @ y
    # By a = 2 ln d: -ln p grows by (1 - y² - M) / 2, y by M y da - y da / 2, and M by M² - M (off the diagonal M²).
    by_a = 0.5 * (1.0 - y * y - kept)
    bend = -M * (y[:, None] * y) - 0.5 * squared
    bend[np.diag_indices(len(y))] += 0.5 * (y * y + kept)
    mixed = y * My - 0.5 * (kept - squared.sum(0))
    by_h, again = families.log_variance_slopes(torch.from_numpy(h))
    slope, across = by_a @ by_h, mixed @ by_h
    rss = best.rss
    noise = 0.5 * (data.freedom - (len(y) - float(kept.sum())) - rss * s2)
    by_noise = 0.5 * (float(kept.sum()) - float(squared.sum()) + rss * s2) - float(y @ My)
    whole = np.block([[by_h.T @ bend @ by_h + np.diag(by_a @ again), across[:, None]], [across, by_noise]])
    return _Posterior(np.append(slope, noise), whole, best, covariance, by_h)


# The logarithms of motions' standard deviations over the noise, of views that stand still.
NO_MOTION = np.zeros(0)


class Amplitudes(NamedTuple):
    """What the evidence sets: how large each family of unknowns, the motions of views, and the noise are.

    Attributes:
        h: (H,) hyperparameters of the modes.
        variance: of the noise, px².
        log_ratio: logarithms of standard deviations over the noise, of motions as in `MotionSigma`, and of bending; ()
            where views stand still.
        loss: the negative logarithm of the evidence; infinite before it is known.
    """

    h: Tensor
    variance: float
    log_ratio: np.ndarray = NO_MOTION
    loss: float = math.inf

    @property
    def vector(self) -> np.ndarray:
        """All but the loss: h, logarithms of ratios of motions, ln σ²."""
        return np.concatenate([self.h.numpy(), self.log_ratio, [math.log(self.variance)]])


def maximize_evidence(
    data: ViewData,
    families: PriorFamilies,
    start: Amplitudes,
    hyperprior: Hyperprior | None = None,
    tempering: float = 1.0,
    rough: bool = False,
    known_noise: bool = False,
) -> Amplitudes:
    """The amplitudes of largest evidence.

    Args:
        data: what the views say.
        families: the priors.
        start: of the search, with ratios for views that moved while they were read.
        hyperprior: of h; the typical one of the default field if not given.
        tempering: by which the data count less.
        rough: end within some hundredths of a nat, for data that will change.
        known_noise: the variance of the noise stays as it is.
    """
    prior, log_variance = hyperprior or typical_hyperprior(), math.log(start.variance)
    count = len(prior.mean)
    bounds = hyper_bounds(prior, len(start.log_ratio), log_variance)
    if known_noise:
        bounds[-1] = log_variance, log_variance
    loss, until = EvidenceLoss(data, families, prior, tempering), _ROUGHLY if rough else _EXACTLY
    at, value = _minimum(loss, start.vector, bounds, *until)
    return Amplitudes(torch.from_numpy(at[:count].copy()), math.exp(at[-1]), at[count:-1].copy(), float(value))


def _minimum(
    loss: EvidenceLoss, v: np.ndarray, bounds: list[tuple[float, float | None]], gain: float, steepest: float
) -> tuple[np.ndarray, float]:
    """The minimum within bounds by Newton's method, steps being limited, and the value there."""
    low = np.array([bound for bound, _ in bounds])
    high = np.array([math.inf if bound is None else bound for _, bound in bounds])
    v = np.clip(v, low, high)
    value, slope, bend = loss(v)
    longest = _FIRST_STEP
    for _ in range(_STEPS):
        # What is at a bound and would go beyond stays there.
        free = ~(((v <= low) & (slope > 0)) | ((v >= high) & (slope < 0)))
        curvatures, vectors = np.linalg.eigh(bend[np.ix_(free, free)])
        step = np.zeros_like(v)
        step[free] = -vectors @ (vectors.T @ slope[free] / np.maximum(np.abs(curvatures), _FLAT))
        if -0.5 * float(step @ slope) < gain and np.abs(slope[free]).max(initial=0.0) < steepest:
            break
        length = float(np.abs(step).max())
        trial = np.clip(v + step * min(1.0, longest / length), low, high)
        found = loss(trial)
        if found[0] < value:
            # What a quadratic form predicts, and what came.
            moved = trial - v
            expected = -float(moved @ slope) - 0.5 * float(moved @ bend @ moved)
            longest = min(2.0 * longest, _LONGEST) if value - found[0] > 0.5 * expected else longest
            v, (value, slope, bend) = trial, found
        else:
            longest = 0.25 * min(longest, length)
            if longest < _SHORTEST:
                break
    return v, value


def hyper_bounds(prior: Hyperprior, motions: int, log_variance: float) -> list[tuple[float, float | None]]:
    """Bounds of v = (h, logarithms of the ratios of motions, ln σ²), near a variance of the noise."""
    mean, sd = prior.mean.numpy(), prior.sd.numpy()
    most = mean + 5 * sd if prior.most is None else np.minimum(mean + 5 * sd, prior.most.numpy())
    bounds: list[tuple[float, float | None]] = [*zip(mean - 5 * sd, most, strict=True)]
    bounds += [(math.log(SMALLEST) - 0.5 * log_variance, math.log(LARGEST) - 0.5 * log_variance)] * motions
    return [*bounds, (max(log_variance - 8, 2.0 * math.log(LEAST_NOISE)), None)]


class EvidenceLoss:
    """The negative logarithm of evidence and hyperprior of v = (h, logarithms of ratios of motions, ln σ²).

    Args:
        data: what the views say.
        families: the priors.
        prior: of h.
        tempering: by which the data count less.
    """

    def __init__(self, data: ViewData, families: PriorFamilies, prior: Hyperprior, tempering: float) -> None:
        self._data, self._families, self._tempering = data, families, tempering
        self._mean, self._sd, self._by_hand = prior.mean.numpy(), prior.sd.numpy(), prior.by_hand

    def value(self, v: np.ndarray) -> float:
        """The value without derivatives, far cheaper; infinite where numbers overflow."""
        best, log_determinant = self._best_at(v)
        return best.value + self._beside(v, log_determinant)

    def step(self, v: np.ndarray) -> np.ndarray:
        """(S,) δ of the best lens and board."""
        return self._best_at(v)[0].step

    def _best_at(self, v: np.ndarray) -> tuple[_Best, float]:
        h, ratio, log_variance = self._parts(v)
        one = self._data.integrated(ratio)
        return _best(one.data.tempered(self._tempering), self._families, h, log_variance), one.log_determinant

    def __call__(self, v: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """The value, its gradient, and its Hessian; infinite beyond numbers."""
        h, ratio, log_variance = self._parts(v)
        integrated = self._data.integrated(ratio)
        found = _posterior(integrated.data.tempered(self._tempering), self._families, h, log_variance)
        slope, bend, count, motions = np.zeros(len(v)), np.zeros((len(v), len(v))), len(h), len(ratio)
        if found is None:
            # Priors are far too wide for this precision, or a step was far too long: a shorter one follows.
            return math.inf, slope, bend
        others = [*range(count), len(v) - 1]
        slope[others], bend[np.ix_(others, others)] = found.slope, found.bend
        if motions:
            best = found.best
            own = slice(count, count + motions)
            slopes = integrated.slopes(
                best.step, found.covariance, best.deviation, best.y, math.exp(log_variance), self._tempering,
                motions,
            )  # fmt: skip
            slope[own], bend[own, own] = slopes.first, slopes.second
            bend[own, others] = np.concatenate([slopes.by_variance @ found.by_h, slopes.by_noise[:, None]], 1)
            bend[others, own] = bend[own, others].T
        (z, w), (_, spread) = self._scaled(v), usual_motion(motions, self._by_hand)
        each = np.zeros((motions, len(v)))
        each[:, count:-1], each[:, -1] = np.diag(1.0 / spread), 0.5 / spread
        slope[:count] += z / self._sd
        bend[np.diag_indices(count)] += self._sd**-2.0
        value = found.best.value + self._beside(v, integrated.log_determinant)
        return value, slope + w @ each, bend + each.T @ each

    def _parts(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        count = len(self._mean)
        return v[:count], v[count:-1], float(v[-1])

    def _scaled(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances from the means of the hyperprior, in its standard deviations."""
        h, ratio, log_variance = self._parts(v)
        # The prior of the motions' amplitudes is about these, not about their ratios to the noise.
        usual, spread = usual_motion(len(ratio), self._by_hand)
        return (h - self._mean) / self._sd, (ratio + 0.5 * log_variance - usual) / spread

    def _beside(self, v: np.ndarray, log_determinant: float) -> float:
        z, w = self._scaled(v)
        return 0.5 * (float(z @ z) + log_determinant / self._tempering + float(w @ w)) + self._data.unequal


def with_tempering(loss: float, data_freedom: float, variance: float, own: float, tempering: float) -> float:
    """The loss at a maximum, converted to another tempering: only losses at the same tempering can be compared.

    Otherwise they differ by the choice of the unit of residuals: 5 % of tempering were 200 nats for 24 views. To first
    order in 1/T, which at a maximum is all but exact.

    Args:
        loss: the negative logarithm of the evidence.
        data_freedom: ν, residuals without those that poses take up.
        variance: of the noise there.
        own: T by which the data counted less.
        tempering: that it is asked for.
    """
    return loss + 0.5 * data_freedom * (1.0 / tempering - 1.0 / own) * (math.log(variance) + 1.0)


def evidence_of_motion(
    data: ViewData, best: Amplitudes, families: PriorFamilies, tempering: float, some: Sequence[int] | None = None
) -> float:
    """Gain of the log evidence (nats) by motions, with all other amplitudes unchanged.

    Or some of the amplitudes of views, by their numbers, such as that of bending.
    """
    rest = [k for k in range(len(best.log_ratio)) if some is not None and k not in some]
    less = best._replace(log_ratio=best.log_ratio[rest])
    return loss_at(data.only(rest), less, families, tempering) - loss_at(data, best, families, tempering)


def loss_at(data: ViewData, at: Amplitudes, families: PriorFamilies, tempering: float) -> float:
    """The negative logarithm of the evidence of these amplitudes, without the hyperprior."""
    one = data.integrated(at.log_ratio)
    found = _best(one.data.tempered(tempering), families, at.h.numpy(), math.log(at.variance))
    return found.value + 0.5 * one.log_determinant / tempering + data.unequal


def evidence_of_corners(
    data: ViewData, best: Amplitudes, families: PriorFamilies, tempering: float, sizes: Sequence[float]
) -> np.ndarray:
    """Gain of the log evidence (nats) by corners displaced by each of these amplitudes, all others unchanged."""
    h, log_variance = best.h.numpy().copy(), math.log(best.variance)
    still, values = data.integrated(best.log_ratio).data.tempered(tempering), []
    for h[-1] in (_NOWHERE, *np.log(sizes)):
        values.append(_best(still, families, h, log_variance).value)
    return values[0] - np.array(values[1:])


# How much the board bends in each view, relative to the others.
#
# Most views may show a stiff board and a few one that a hand bends. With one amplitude the few would loosen all. So the
# standard deviation s w of a view's bending has a factor w of its own, and 1/w² has a gamma prior of mean one: bending
# by itself then has Student's t distribution. Its largest posterior density in ln w has a closed form, step by step.

# Degrees of freedom of that distribution.
_TAILS = 3.0
_REPEATS = 30


def relative_bends(data: ViewData, best: Amplitudes, families: PriorFamilies) -> tuple[Tensor, Amplitudes]:
    """(V,) the factors w of each view, at the best lens and board; and the amplitudes, with s that belongs to them."""
    assert data.relative is not None
    step = _best(data.integrated(best.log_ratio).data, families, best.h.numpy(), math.log(best.variance)).step
    left = data.cross @ torch.cat([torch.from_numpy(step), torch.ones(1).double()])
    relative, ratio, (usual, sd) = data.relative, best.log_ratio.copy(), usual_motion(len(best.log_ratio), False)
    for _ in range(_REPEATS):
        inverse = torch.linalg.inv(data.own + torch.diag_embed(stillness(ratio, relative)))
        mean, spread = inverse @ left[..., None], inverse.diagonal(dim1=1, dim2=2)
        moment = (mean[..., 0].square() / best.variance + spread)[:, -BENDS:].sum(1) * math.exp(-2.0 * ratio[-1])
        before, found = relative, ((_TAILS + moment) / (_TAILS + BENDS)).sqrt()
        # Views tell s w alone. A factor goes from w to s, the likeliest one: s and w in turn, each at its own best,
        # would creep (C. Liu, D. B. Rubin, Y. N. Wu 1998: parameter expansion to accelerate EM).
        pull = (ratio[-1] + 0.5 * math.log(best.variance) - usual[-1]) / sd[-1] ** 2
        size = math.sqrt((len(found) - pull / _TAILS) / float(found.square().reciprocal().sum()))
        relative, ratio[-1] = found / size, ratio[-1] + math.log(size)
        if torch.allclose(relative, before, rtol=1e-5, atol=0.0):
            break
    return relative, best._replace(log_ratio=ratio)


# How large amplitudes are on the average, where views tell them only roughly.
#
# The evidence is largest at one amplitude A of a family of modes; others explain the views nearly as well. A mode of
# which the views say nothing then has the variance <A²>, the mean over what they leave. It is larger than that at the
# maximum: with few views of a board its print errors may come out as next to none, and error bars of the lens are too
# small with them (Kass and Steffey 1989 correct covariances for it). Measured: `docs/measured/ordinary.md`.
#
# Each ln A is varied by itself, all others following along the Hessian of -ln p at the maximum.

# Where -ln p is taken, in standard deviations: the upper side has the long tail of <A²>.
_PLACES = np.arange(-2.25, 4.0, 0.75)
# Standard deviations of ln A below which half of them do: the same ½ ln <A²> to .001 (three captures by strangers).
_SURE = 0.3
# Directions in which -ln p does not bend are followed by no more than this standard deviation.
_WIDEST = 2.0


def expected_maximum(
    data: ViewData, families: PriorFamilies, best: Amplitudes, hyperprior: Hyperprior, tempering: float = 1.0
) -> Amplitudes:
    """The maximum of the evidence with all amplitudes in use, those of motions too, replaced by √<A²>.

    Args:
        data: what the views say.
        families: the priors.
        best: where the evidence is largest.
        hyperprior: of the hyperparameters.
        tempering: by which the data counted less there.

    Raises:
        ArithmeticError: the evidence is beyond numbers at its maximum: nothing can be averaged.
    """
    count, log_variance = len(best.h), math.log(best.variance)
    used = families.amplitude
    which = [*used[used >= 0].unique().tolist(), *range(count, count + len(best.log_ratio))]
    loss = EvidenceLoss(data, families, hyperprior, tempering)
    at = best.vector
    value, _, bend = loss(at)
    if not math.isfinite(value):
        raise ArithmeticError("the views contradict each other so far that the evidence of their lens is no number")
    bounds = hyper_bounds(hyperprior, len(best.log_ratio), log_variance)
    found = expected_amplitudes(bend, loss.value, at, which, bounds)
    return best._replace(h=torch.from_numpy(found[:count].copy()), log_ratio=found[count:-1].copy())


def steps_of_amplitudes(
    data: ViewData, families: PriorFamilies, best: Amplitudes, hyperprior: Hyperprior, tempering: float = 1.0
) -> Tensor:
    """(H, S) by how much the best lens and board move with all hyperparameters, for arguments as of `expected_maximum`.

    Each row is the move along a principal direction of their posterior, by one standard deviation. The covariance for
    the best hyperparameters lacks the sum of the rows' outer products (Kass and Steffey 1989).
    """
    loss, log_variance = EvidenceLoss(data, families, hyperprior, tempering), math.log(best.variance)
    at = best.vector
    low, high = np.array(hyper_bounds(hyperprior, len(best.log_ratio), log_variance), dtype=float).T
    values, vectors = np.linalg.eigh(_inverse(loss(at)[2]))
    away = (np.sqrt(values) * vectors).T
    more, less = (np.stack([loss.step(np.fmin(np.fmax(v, low), high)) for v in at + end]) for end in (away, -away))
    return torch.from_numpy(0.5 * (more - less))


def expected_amplitudes(
    bend: np.ndarray,
    value: Callable[[np.ndarray], float],
    at: np.ndarray,
    which: list[int],
    bounds: list[tuple[float, float | None]],
) -> np.ndarray:
    """½ ln <A²> of some hyperparameters, and the others as they are.

    Args:
        bend: (H, H) the Hessian of -ln p.
        value: -ln p alone, of a place (H,).
        at: (H,) where it is smallest.
        which: numbers of the ln A.
        bounds: of all.

    Example:
        >>> def loss(v):  # ln A is normal, with a standard deviation of a half: <A²> = exp(2 · ¼)
        ...     return 2.0 * float(v @ v)
        >>> found = expected_amplitudes(4.0 * np.eye(2), loss, np.zeros(2), [0], [(-9.0, 9.0), (-9.0, None)])
        >>> [round(float(value), 2) for value in found]
        [0.25, 0.0]
    """
    covariance, here = _inverse(bend), value(at)
    found = at.copy()
    for i in which:
        sigma = math.sqrt(covariance[i, i])
        low, high = bounds[i]
        wanted = sigma * (_PLACES[1::2] if sigma < _SURE else _PLACES)
        places = np.array([t for t in wanted if low <= at[i] + t <= (math.inf if high is None else high)])
        along = covariance[:, i] / covariance[i, i]
        losses = np.array([value(at + place * along) if place else here for place in places])
        share = np.exp(losses.min() - losses)
        found[i] += 0.5 * math.log(float(share @ np.exp(2.0 * places)) / float(share.sum()))
    return found


def _inverse(bend: np.ndarray) -> np.ndarray:
    """The inverse of the Hessian; a direction without upward curvature gets the largest variance that is allowed."""
    values, vectors = np.linalg.eigh(bend)
    return np.asarray((vectors / np.maximum(values, _WIDEST**-2)) @ vectors.T)
