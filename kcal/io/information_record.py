"""What a calibration says of a camera, as a block inside kcal's files."""

from __future__ import annotations

import math

import pydantic
import torch

from kcal.io.record import Packed
from kcal.lens.information import CameraInformation
from kcal.native_file import Record


class InformationRecord(Record):
    """A `CameraInformation` by the names of the parameters; whatever is not named is held.

    The unknowns are groups of parameters that are equal, then the amplitudes of the board's modes. The likelihood of
    the data near the estimate is exp(-½ ‖R (x - estimate) + r‖²), the prior exp(-½ Σ ((x - mean) / sigma)²).

    Args:
        unknowns: for each of the camera's unknowns the names of the parameters that it is.
        board: amplitudes of the board's modes at the estimate, meters.
        triangle: upper triangle of R, row by row, each row followed by its element of r.
        mean: of the prior.
        sigma: of the prior; None where nothing was assumed.
        others: what other cameras say of the board's unknowns, as `triangle`; None: nothing.
    """

    unknowns: tuple[tuple[str, ...], ...]
    board: tuple[float, ...]
    triangle: Packed
    mean: tuple[float, ...]
    sigma: tuple[pydantic.PositiveFloat | None, ...]
    others: Packed | None = None

    @pydantic.model_validator(mode="after")
    def _fits(self) -> InformationRecord:
        count = len(self.unknowns) + len(self.board)
        names = [name for group in self.unknowns for name in group]
        if len(set(names)) != len(names) or not all(self.unknowns):
            raise ValueError("information: a name occurs twice, or an unknown has none")
        if (len(self.mean), len(self.sigma), self.triangle.shape) != (count, count, (count * (count + 3) // 2,)):
            raise ValueError(f"information: mean, sigma and triangle must be those of {count} unknowns")
        if self.others is not None and self.others.shape != (len(self.board) * (len(self.board) + 3) // 2,):
            raise ValueError(f"information: others must be about the {len(self.board)} unknowns of the board")
        return self

    @classmethod
    def of(cls, known: CameraInformation, names: tuple[str, ...]) -> InformationRecord:
        """In the form in which it is stored; `names` are those of the camera's parameters."""
        groups: list[list[str]] = [[] for _ in range(known.lens_size)]
        for name, slot in zip(names, known.slots, strict=True):
            if slot >= 0:
                groups[slot].append(name)
        others = None if known.others is None else Packed.of(_above(known.told.compressed().rows))
        return cls(
            unknowns=tuple(map(tuple, groups)),
            board=tuple(known.estimate[known.lens_size :].tolist()),
            triangle=Packed.of(_above(known.triangle())),
            mean=tuple(known.mean.tolist()),
            sigma=tuple(value if math.isfinite(value) else None for value in known.sigma.tolist()),
            others=others,
        )

    def information(self, values: dict[str, float]) -> CameraInformation:
        """What is known of a camera with these values of its parameters, by name, in their order."""
        slots = {name: slot for slot, group in enumerate(self.unknowns) for name in group}
        lens, count = [values[group[0]] for group in self.unknowns], len(self.mean)
        rows = _triangle_of(self.triangle.tensor(), count)
        return CameraInformation(
            slots=tuple(slots.get(name, -1) for name in values),
            estimate=torch.tensor([*lens, *self.board], dtype=torch.float64),
            rows=rows[:, :-1],
            residuals=rows[:, -1],
            mean=torch.tensor(self.mean, dtype=torch.float64),
            sigma=torch.tensor([math.inf if value is None else value for value in self.sigma], dtype=torch.float64),
            others=None if self.others is None else _triangle_of(self.others.tensor(), len(self.board)),
        )


def _above(rows: torch.Tensor) -> torch.Tensor:
    """Elements of rows (C, C + 1) from the diagonal on."""
    row, column = torch.triu_indices(*rows.shape)
    return rows[row, column]


def _triangle_of(elements: torch.Tensor, count: int) -> torch.Tensor:
    """(C, C + 1) rows with these elements."""
    rows = torch.zeros(count, count + 1, dtype=torch.float64)
    row, column = torch.triu_indices(count, count + 1)
    rows[row, column] = elements
    return rows
