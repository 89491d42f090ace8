"""Which distortion terms a lens model has, and the public names and order of its coefficients."""

from __future__ import annotations

import dataclasses

from kcal.errors import InputError

# OpenCV's order. A name keeps its meaning in every model; what a model lacks is left out.
_OPENCV = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
# Orders above OpenCV's, named as in Eq. 10 of the paper and continued alike: numerator, denominator.
_RADIAL = {
    **{f"k{i}": ("numerator", i) for i in (1, 2, 3)},
    **{f"k{i + 3}": ("denominator", i) for i in (1, 2, 3)},
    **{f"k{i}": ("numerator", j) for i, j in ((7, 4), (8, 5), (11, 6), (13, 7))},
    **{f"k{i}": ("denominator", j) for i, j in ((9, 4), (10, 5), (12, 6), (14, 7))},
}
_PRISM = {
    "s1": (0, 1),
    "s2": (0, 2),
    "s3": (1, 1),
    "s4": (1, 2),
    "s5": (0, 3),
    "s6": (1, 3),
    "s7": (0, 4),
    "s8": (1, 4),
}
_ORDER = (*_OPENCV, "k7", "k8", "k9", "k10", "s5", "s6", "k11", "k12", "k13", "k14", "s7", "s8")


@dataclasses.dataclass(frozen=True, kw_only=True)
class LensModel:
    """The orders of each distortion term (Eq. 4 and Eq. 10 of the paper).

    Args:
        numerator: highest power of r² in the radial numerator, 0 to 7.
        denominator: highest power of r² in the radial denominator, 0 to 7.
        tangential: whether p1, p2 are present.
        prism: highest power of r² in the thin-prism terms, 0 to 4, for x and y each.
        tilt: whether the tilted-sensor angles are present.
        fisheye: whether the numerator's series acts on the angle from the axis instead of its tangent
            (Kannala-Brandt): r_D = θ (1 + k1 θ² + k2 θ⁴ + ...). It has no other terms, and its coefficients are
            called k1, k2, k3, ... in this order, as in `cv2.fisheye`.

    Attributes:
        names: coefficient names in storage order: OpenCV's 14 first, higher orders after them.
        numerator_index: where the numerator's coefficients of r², r⁴, ... are stored.
        denominator_index: likewise for the denominator.
        prism_index: likewise for the prism terms, for x and for y.
        without_tilt: the same model without its tilt; None if it has none.
        untilted_index: where the coefficients of `untilted` are stored.

    Example:
        >>> LensModel(numerator=3, tangential=True).names
        ('k1', 'k2', 'p1', 'p2', 'k3')
        >>> LensModel.named("opencv14").size
        14
    """

    numerator: int = 0
    denominator: int = 0
    tangential: bool = False
    prism: int = 0
    tilt: bool = False
    fisheye: bool = False

    # What follows from the orders. Ordinary attributes, because compilers trace no lazily computed ones.
    names: tuple[str, ...] = dataclasses.field(init=False, repr=False, compare=False)
    numerator_index: tuple[int, ...] = dataclasses.field(init=False, repr=False, compare=False)
    denominator_index: tuple[int, ...] = dataclasses.field(init=False, repr=False, compare=False)
    prism_index: tuple[tuple[int, ...], tuple[int, ...]] = dataclasses.field(init=False, repr=False, compare=False)
    without_tilt: LensModel | None = dataclasses.field(init=False, repr=False, compare=False)
    untilted_index: tuple[int, ...] = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name, limit in (("numerator", 7), ("denominator", 7), ("prism", 4)):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= limit:
                raise InputError(f"lens model: {name} must be a whole number from 0 to {limit}, got {value!r}")
        if self.fisheye and (self.denominator or self.tangential or self.prism or self.tilt):
            raise InputError("lens model: a fisheye has a numerator only")
        names = self._names()
        radial = {term: self._radial_names(term) for term in ("numerator", "denominator")}
        prism = {order: names.index(name) for name, order in _PRISM.items() if name in names}
        rest = dataclasses.replace(self, tilt=False) if self.tilt else None
        derived = {
            "names": names,
            "numerator_index": tuple(names.index(name) for name in radial["numerator"]),
            "denominator_index": tuple(names.index(name) for name in radial["denominator"]),
            "prism_index": tuple(tuple(prism[k, j] for j in range(1, self.prism + 1)) for k in (0, 1)),
            "without_tilt": rest,
            "untilted_index": tuple(names.index(name) for name in (rest.names if rest else names)),
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    def _names(self) -> tuple[str, ...]:
        if self.fisheye:
            return tuple(f"k{order}" for order in range(1, self.numerator + 1))
        present = {name for name, (term, order) in _RADIAL.items() if order <= getattr(self, term)}
        present |= {name for name, (_, order) in _PRISM.items() if order <= self.prism}
        present |= {"p1", "p2"} if self.tangential else set()
        present |= {"tau_x", "tau_y"} if self.tilt else set()
        return tuple(name for name in _ORDER if name in present)

    def _radial_names(self, term: str) -> tuple[str, ...]:
        place = {order: name for name, (kind, order) in _RADIAL.items() if kind == term}
        orders = range(1, getattr(self, term) + 1)
        return tuple(f"k{order}" if self.fisheye else place[order] for order in orders)

    @classmethod
    def named(cls, name: str | LensModel) -> LensModel:
        """The model behind a preset name such as `"opencv5"` (or the model itself).

        Raises:
            InputError: an unknown name; the message lists the known ones.
        """
        if isinstance(name, LensModel):
            return name
        if name not in PRESETS:
            raise InputError(f"unknown lens model {name!r}; choose one of {', '.join(PRESETS)}")
        return PRESETS[name]

    @property
    def size(self) -> int:
        """How many coefficients the model has."""
        return len(self.names)

    @property
    def radial(self) -> bool:
        """Whether the lens is symmetric about its axis, so that whatever limits it is a circle."""
        return not (self.tangential or self.prism or self.tilt)

    @property
    def untilted(self) -> LensModel:
        """The same model without the tilt."""
        return self if self.without_tilt is None else self.without_tilt

    def contains(self, other: LensModel) -> bool:
        """Whether every lens of `other` is also a lens of this model."""
        return self.fisheye == other.fisheye and set(other.names) <= set(self.names)

    def __str__(self) -> str:
        kind = "fisheye " if self.fisheye else ""
        return next((name for name, model in PRESETS.items() if model == self), f"{kind}({', '.join(self.names)})")


PRESETS: dict[str, LensModel] = {
    "pinhole": LensModel(),
    "opencv4": LensModel(numerator=2, tangential=True),
    "opencv5": LensModel(numerator=3, tangential=True),
    "opencv8": LensModel(numerator=3, denominator=3, tangential=True),
    "opencv12": LensModel(numerator=3, denominator=3, tangential=True, prism=2),
    "opencv14": LensModel(numerator=3, denominator=3, tangential=True, prism=2, tilt=True),
    "ext16": LensModel(numerator=4, denominator=4, tangential=True, prism=2, tilt=True),
    "ext18": LensModel(numerator=5, denominator=5, tangential=True, prism=2, tilt=True),
    "ext20": LensModel(numerator=5, denominator=5, tangential=True, prism=3, tilt=True),
    "ext20b": LensModel(numerator=6, denominator=6, tangential=True, prism=2, tilt=True),
    "ext22": LensModel(numerator=6, denominator=6, tangential=True, prism=3, tilt=True),
    "ext24": LensModel(numerator=7, denominator=7, tangential=True, prism=3, tilt=True),
    "fisheye4": LensModel(numerator=4, fisheye=True),
}
