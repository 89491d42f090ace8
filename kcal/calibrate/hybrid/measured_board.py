"""What is known of a board, as Gaussians over its modes: as printed, and as cameras measured it, with its file."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import pydantic
import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import KNOWN, BoardModes, board_modes, undetermined_modes
from kcal.calibrate.hybrid.evidence import Amplitudes, maximize_evidence, view_data
from kcal.calibrate.hybrid.families import BOARD, Hyperprior, PriorFamilies, typical_hyperprior
from kcal.corners.board import Board
from kcal.errors import InputError
from kcal.gaussian import Gaussian, numbered, stacked
from kcal.lens.information import BOARD_SLOT, CameraInformation
from kcal.native_file import NativeFile
from kcal.solve.schur import Products
from kcal.texts import brief, measured_text, number_text

# What is known of a board, as Gaussians over the amplitudes of its modes: as printed, and what cameras tell of it.
#
# Near its solution the data of one camera are a Gaussian of lens and board. With the lens integrated out, a message
# about the board remains. Messages of several cameras and a prior are stacked; together they give mean, covariance,
# evidence.


def off_by(points: Tensor, corners: Tensor | None) -> Tensor:
    """Points (N, 3) that are displaced in the board's plane (N, 2), or not."""
    return points if corners is None else points + torch.nn.functional.pad(corners, (0, 1))


class BoardPrior(NamedTuple):
    """What is known of a board before a camera is calibrated.

    Attributes:
        own: as it was printed, or as it was measured.
        told: what other cameras say of a printed one; None: it was measured.
        corners: (N, 2) meters by which corners are off their places beside the modes, as others found; None: they tell
            nothing of it.
    """

    own: Gaussian
    told: Gaussian | None = None
    corners: Tensor | None = None

    @property
    def whole(self) -> Gaussian:
        """Both together."""
        return self.own if self.told is None else self.own + self.told

    def applied(self, points: Tensor, modes: BoardModes) -> tuple[Tensor, BoardModes]:
        """Change variables: the mean board, and modes whose amplitudes have unit variance and no hyperparameter.

        Args:
            points: (N, 3) the board as ordered, meters.
            modes: of that board.
        """
        mean, half = self.whole.mean_and_half()
        shapes = torch.einsum("ab,bkn->akn", half, modes.shapes)
        unit = torch.ones_like(modes.unit)
        known = BoardModes(shapes, unit, torch.full_like(modes.family, KNOWN))
        return off_by(points + torch.einsum("b,bkn->nk", mean, modes.shapes), self.corners), known

    def in_units(self, amplitudes: Tensor) -> Tensor:
        """(B,) the variables of `applied`, from the amplitudes (B,) of the board's own modes."""
        mean, half = self.whole.mean_and_half()
        return torch.linalg.solve_triangular(half, (amplitudes - mean)[None], upper=False, left=False)[0]

    def in_modes(self, known: CameraInformation, amplitudes: Tensor, wider: float) -> CameraInformation:
        """Convert what is known from the variables of `applied` to the board's own modes, with what others told apart.

        Args:
            known: with these variables as the board's unknowns.
            amplitudes: (B,) of the modes at the estimate.
            wider: by which variances of `known` are larger than the posterior's.
        """
        if self.told is None:
            # Modes of a board that was measured are not its own: what is said of the camera, whatever the board is.
            return known.without_board()
        lens = known.lens_size
        by_modes = known.rows[:, lens:] @ self.whole.compressed().rows[:, :-1]
        mean, half = self.own.mean_and_half()
        return dataclasses.replace(
            known,
            estimate=torch.cat([known.estimate[:lens], amplitudes]),
            rows=torch.cat([known.rows[:, :lens], by_modes], 1),
            mean=torch.cat([known.mean[:lens], mean]),
            sigma=torch.cat([known.sigma[:lens], half.diagonal() * math.sqrt(wider)]),
            others=self.told.placed(known.board, amplitudes).rows / math.sqrt(wider),
        )


def evidence(prior: Gaussian, messages: Sequence[Gaussian]) -> float:
    """Logarithm of the prior's integral over the messages' likelihoods."""
    return stacked([prior, *messages]).log_integral() - prior.log_integral()


def printed_prior(modes: BoardModes, amplitudes: Tensor) -> Gaussian:
    """The prior of a printed board, from the ln amplitudes (4,) of its families of modes."""
    sigma = modes.unit * torch.exp(amplitudes[modes.family])
    return Gaussian.independent(numbered(BOARD_SLOT, len(sigma)), torch.zeros_like(sigma), sigma)


def printed_board(modes: BoardModes, messages: Sequence[Gaussian]) -> tuple[Gaussian, float]:
    """The prior of a printed board whose amplitudes maximize the evidence of all messages, and its logarithm.

    Args:
        modes: of the board.
        messages: of the cameras that saw it.
    """
    typical, unit = typical_hyperprior(), modes.unit
    prior = Hyperprior(typical.mean[BOARD:], typical.sd[BOARD:])
    zero, none = torch.zeros_like(unit), torch.full_like(modes.family, -1)
    families = PriorFamilies(zero, unit.log(), modes.family, none, zero)
    rows = stacked(messages).placed(numbered(BOARD_SLOT, len(unit)), zero).rows.T[None]
    data = view_data(Products.of_rows(rows, 0), zero, zero.new_zeros(1, 0), 0.0)
    # Messages are in standard deviations already.
    found = maximize_evidence(data, families, Amplitudes(prior.mean, 1.0), prior, known_noise=True)
    return printed_prior(modes, found.h), -found.loss


# A board as cameras measured it, with its covariance, and its file.


class Measured(NamedTuple):
    """A value and its standard deviation."""

    value: float
    sigma: float


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredBoard:
    """How a printed board differs from the one that was ordered.

    Convention: the frame is the ordered board's (`Board`). Size, place and tilt of a board cannot be measured by
    cameras: what differs is bending, stretch, shear and print errors.

    Args:
        name: of the board.
        board: as it was ordered.
        amplitudes: (B,) of the modes of `board_modes`, meters.
        half: (B, B) upper part of their covariance: halfᵀ half.
        log_evidence: nats by which the data prefer a printed board over one that is exactly as ordered.
        observations: names of the observations that it was measured from.
        corners: (N, 2) meters by which single corners are off their places beside the modes; None: no evidence of it.

    Raises:
        InputError: shapes or values that do not fit the board.
    """

    name: str
    board: Board
    amplitudes: Tensor
    half: Tensor
    log_evidence: float
    observations: tuple[str, ...] = ()
    corners: Tensor | None = None

    def __post_init__(self) -> None:
        corners = self.corners
        if corners is not None and not (corners.shape == (self.board.corners, 2) and bool(corners.isfinite().all())):
            raise InputError(
                f"measured board: finite displacements of {self.board.corners} corners are needed, x and y"
            )
        size = len(board_modes(self.board.points).unit)
        if self.amplitudes.shape != (size,) or self.half.shape != (size, size):
            raise InputError(f"measured board: {size} amplitudes and a root of {size} x {size} are needed")
        if not bool(self.amplitudes.isfinite().all() & self.half.isfinite().all()):
            raise InputError("measured board: amplitudes and their covariance must be finite")

    def prior_for(self, points: Tensor) -> BoardPrior:
        """The prior of the amplitudes, for a camera that saw a board with these corners as ordered, (N, 3) meters.

        Raises:
            InputError: they are not this board's.
        """
        if not torch.equal(points, self.board.points):
            raise InputError(f"the measured board {self.name!r} is {self.board}; the observations show another board")
        rows, info = torch.linalg.inv_ex(self.half)
        if int(info):
            raise InputError(f"the measured board {self.name!r}: its covariance is singular")
        weight = torch.nn.functional.pad(rows.T, (0, 1))
        own = Gaussian(numbered(BOARD_SLOT, len(self.amplitudes)), self.amplitudes, weight)
        return BoardPrior(own, corners=self.corners)

    @property
    def points(self) -> Tensor:
        """(N, 3) the corners as they are, meters."""
        shapes = board_modes(self.board.points).shapes
        return off_by(self.board.points + torch.einsum("b,bkn->nk", self.amplitudes, shapes), self.corners)

    @property
    def bending(self) -> Measured:
        """Height of the corner farthest from the best plane, meters."""
        heights = self._fitted()[1][:, 2]
        at = int((self.amplitudes @ heights).abs().argmax())
        value, sigma = self._measured(heights[:, at])
        return Measured(abs(value), sigma)

    @property
    def stretch(self) -> Measured:
        """Width over height, relative to the ordered board, less one."""
        return self._measured(2.0 * self._fitted()[0][:, -2])

    @property
    def shear(self) -> Measured:
        """Cosine of the angle between rows and columns."""
        return self._measured(2.0 * self._fitted()[0][:, -1])

    @property
    def corner_error(self) -> float:
        """RMS distance, in the plane, of single corners from where the modes have them, meters."""
        return 0.0 if self.corners is None else float(self.corners.square().sum(1).mean().sqrt())

    @property
    def print_error(self) -> Measured:
        """RMS distance of the corners, in the plane, from the best stretched and sheared board, meters."""
        rows = self._fitted()[1][:, :2].flatten(1) / math.sqrt(self.board.corners)
        rms = float((self.amplitudes @ rows).norm())
        noise = self.half @ rows
        slope = noise @ (self.amplitudes @ rows) / max(rms, 1e-12)
        # An RMS no larger than its own noise has no slope to speak of.
        return Measured(rms, float(slope.norm() if rms > float(noise.norm()) else noise.norm()))

    def displacements(self, places: Tensor | None = None) -> Tensor:
        """(M, 3) how far places of the board lie from where they were ordered, at the best shift, turn and scale.

        Args:
            places: (M, 3) of the ordered board, meters, z = 0, between the corners; the corners themselves if not
                given, with what displaces single ones.
        """
        coefficients, rest = self._fitted(places)
        points = self.board.points if places is None else places
        x, y = (points[:, :2] - self.board.points[:, :2].mean(0)).unbind(-1)
        stretch, shear = (self.amplitudes @ coefficients[:, -2:]).tolist()
        plane = torch.stack([stretch * x + shear * y, shear * x - stretch * y, torch.zeros_like(x)])
        smooth = (torch.einsum("b,bkn->kn", self.amplitudes, rest) + plane).T
        return off_by(smooth, self.corners if places is None else None)

    def _measured(self, row: Tensor) -> Measured:
        return Measured(float(self.amplitudes @ row), float((self.half @ row).norm()))

    def _fitted(self, places: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """For each mode: what shifts, turns, scale, stretch and shear fit of it (B, 9), and the rest (B, 3, M)."""
        corners = self.board.points
        points = corners if places is None else torch.cat([corners, places])
        x, y = (points[:, :2] - corners[:, :2].mean(0)).unbind(-1)
        zero = torch.zeros_like(x)
        affine = torch.stack([torch.stack([x, -y, zero]), torch.stack([y, x, zero])])
        basis = torch.cat([undetermined_modes(points), affine])
        shapes, count = board_modes(points).shapes, len(corners)
        fitted = torch.linalg.lstsq(basis[..., :count].flatten(1).T, shapes[..., :count].flatten(1).T).solution.T
        rest = shapes - torch.einsum("bg,gkn->bkn", fitted, basis)
        return fitted, rest if places is None else rest[..., count:]

    __repr__ = brief


def board_text(board: MeasuredBoard) -> list[str]:
    """Bending, stretch, shear and print error with their standard deviations, one line each."""

    def text(found: Measured, scale: float, unit: str) -> str:
        return measured_text(scale * found.value, scale * found.sigma, unit)

    single = f"single corners {number_text(1e3 * board.corner_error)} mm RMS, beside all this"
    return [
        f"bending {text(board.bending, 1e3, 'mm')} (height over the best plane, at most)",
        f"stretch {text(board.stretch, 100.0, '%')} (width over height)",
        f"shear {text(board.shear, 100.0, '%')}",
        f"print error {text(board.print_error, 1e3, 'mm')} RMS, beyond stretch and shear",
        *([single] if board.corner_error else []),
    ]


class BoardFile(NativeFile):
    """A measured board (file kind `board`, version 1).

    Args:
        name: of the board.
        board: as it was ordered.
        amplitudes: of the modes of bending and print, meters; see `kcal.calibrate.hybrid.board_modes`.
        half: rows of a matrix whose transpose times itself is their covariance.
        log_evidence: nats by which the data prefer this board over the ordered one.
        observations: names of the observations that it was measured from.
        corners: meters in x and y by which each corner is off its place beside the modes; absent from the file where
            that is not known.
    """

    KIND: ClassVar[str] = "board"
    VERSION: ClassVar[int] = 1
    _LATER: ClassVar[Mapping[str, Any]] = {"corners": None}

    name: str
    board: Board
    amplitudes: tuple[float, ...]
    half: tuple[tuple[float, ...], ...]
    log_evidence: float
    observations: tuple[str, ...] = ()
    corners: tuple[tuple[float, float], ...] | None = None

    @pydantic.model_validator(mode="after")
    def _fits(self) -> BoardFile:
        if any(len(row) != len(self.amplitudes) for row in self.half):
            raise ValueError("the root of the covariance must have as many columns as there are amplitudes")
        self.measured()
        return self

    def measured(self) -> MeasuredBoard:
        """The board, equal to the stored one to the last bit."""
        stored = {"amplitudes": self.amplitudes, "half": self.half, "corners": self.corners}
        tensors = {n: None if own is None else torch.tensor(own, dtype=torch.float64) for n, own in stored.items()}
        return MeasuredBoard(**dict(self) | tensors)


def save_measured_board(board: MeasuredBoard, path: str | Path) -> Path:
    """Write a measured board to a JSON file, losslessly and atomically.

    Raises:
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> size = 28
        >>> half = 1e-5 * torch.eye(size, dtype=torch.float64)
        >>> plate = Board(columns=9, rows=6, square=0.025)
        >>> flat = MeasuredBoard(name="A", board=plate, amplitudes=0 * half[0], half=half, log_evidence=0.0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = save_measured_board(flat, Path(folder, "a.board.json"))
        ...     bool((load_measured_board(path).points == plate.points).all())
        True
    """
    return BoardFile(**vars(board)).save(path)


def load_measured_board(path: str | Path) -> MeasuredBoard:
    """Read a measured board.

    Raises:
        FileError: missing, another kind of file, or content that is wrong.

    Example:
        >>> load_measured_board("no-such-file.json")
        Traceback (most recent call last):
        kcal.errors.FileError: no-such-file.json: cannot read: No such file or directory
    """
    return BoardFile.load(path).measured()
