"""Which terms a lens model has, and the names and order of its coefficients."""

from __future__ import annotations

import dataclasses

from torch import Tensor, nn

from kcal.errors import InputError
from kcal.lens.field_modes import NetworkModes
from kcal.lens.hybrid_terms import HybridForm

# The term and the order of every coefficient, in storage order: OpenCV's 14 first, so that its models are prefixes,
# then the higher orders of Eq. 10 of the paper and their continuation. A name means the same in every model.
_COEFFICIENTS = {
    "k1": ("numerator", 1), "k2": ("numerator", 2), "p1": ("tangential", 1), "p2": ("tangential", 1),
    "k3": ("numerator", 3), "k4": ("denominator", 1), "k5": ("denominator", 2), "k6": ("denominator", 3),
    "s1": ("prism_x", 1), "s2": ("prism_x", 2), "s3": ("prism_y", 1), "s4": ("prism_y", 2),
    "tau_x": ("tilt", 1), "tau_y": ("tilt", 1),
    "k7": ("numerator", 4), "k8": ("numerator", 5), "k9": ("denominator", 4), "k10": ("denominator", 5),
    "s5": ("prism_x", 3), "s6": ("prism_y", 3),
    "k11": ("numerator", 6), "k12": ("denominator", 6), "k13": ("numerator", 7), "k14": ("denominator", 7),
    "s7": ("prism_x", 4), "s8": ("prism_y", 4),
}  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class LensModel:
    """A lens model: the order of each distortion term (Eq. 4 and Eq. 10 of the paper).

    Most models have a name: `LensModel.named("opencv5")`. Functions that take a model also take its name.

    Args:
        numerator: highest power of r² in the radial numerator, 0 to 7.
        denominator: highest power of r² in the radial denominator, 0 to 7.
        tangential: whether the tangential terms p1, p2 are present.
        prism: highest power of r² in the thin-prism terms, 0 to 4, the same for x and y.
        tilt: whether the angles τx, τy of a tilted sensor are present.
        fisheye: whether the numerator's series acts on the angle θ from the axis instead of its tangent
            (Kannala-Brandt): r_D = θ (1 + k1 θ² + k2 θ⁴ + ...). A fisheye has no other terms, and its coefficients are
            called k1, k2, k3, ... in this order, as in `cv2.fisheye`.
        hybrid: the constants of a hybrid lens (base projection, field and entrance pupil; `kcal.lens.hybrid_terms`),
            which has no other terms.

    Attributes:
        names: names of the coefficients in storage order: OpenCV's 14 first, then higher orders.
        numerator_index: indices of the numerator's coefficients of r², r⁴, ...
        denominator_index: indices of the denominator's coefficients of r², r⁴, ...
        prism_index: indices of the prism coefficients of r², r⁴, ..., for x and for y.
        without_tilt: the same model without its tilt; None if it has none.
        untilted_index: indices of the coefficients of `untilted`.

    Raises:
        InputError: an order out of range, or a fisheye or hybrid lens with other terms.

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
    hybrid: HybridForm | None = None

    # Computed once: compilers cannot trace lazily computed attributes.
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
            raise InputError("lens model: a fisheye has a numerator only; leave out the other terms")
        others = (self.numerator, self.denominator, self.tangential, self.prism, self.tilt, self.fisheye)
        if self.hybrid and any(others):
            raise InputError("lens model: a hybrid lens has terms of its own; leave out the others")
        highest = {
            "numerator": self.numerator, "denominator": self.denominator, "tangential": self.tangential,
            "prism_x": self.prism, "prism_y": self.prism, "tilt": self.tilt,
        }  # fmt: skip
        table = {f"k{i}": ("numerator", i) for i in range(1, 8)} if self.fisheye else _COEFFICIENTS
        terms = {name: term for name, (term, order) in table.items() if order <= highest[term]}

        def index(*chosen: str) -> tuple[int, ...]:
            return tuple(i for i, term in enumerate(terms.values()) if term in chosen)

        derived = {
            "names": self.hybrid.names if self.hybrid else tuple(terms),
            "numerator_index": index("numerator"),
            "denominator_index": index("denominator"),
            "prism_index": (index("prism_x"), index("prism_y")),
            "without_tilt": dataclasses.replace(self, tilt=False) if self.tilt else None,
            "untilted_index": index(*(term for term in highest if term != "tilt")),
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    @classmethod
    def named(cls, name: str | LensModel) -> LensModel:
        """Return the model with a preset name such as `"opencv5"`; a model is returned as it is.

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
        """Number of coefficients."""
        return len(self.names)

    @property
    def radial(self) -> bool:
        """Whether the lens is symmetric about its axis."""
        return not (self.tangential or self.prism or self.tilt or self.hybrid)

    @property
    def wide(self) -> bool:
        """Whether points beside the camera and behind it have a place on the lens's plane."""
        return self.fisheye or self.hybrid is not None

    @property
    def network(self) -> nn.Module | None:
        """The module inside the field of a hybrid lens, if that is a network (`kcal.lens.field_modes`)."""
        modes = self.hybrid and self.hybrid.modes
        return modes.trunk if isinstance(modes, NetworkModes) else None

    @property
    def weights(self) -> tuple[Tensor, ...]:
        """Weights of that network, by which derivatives may be asked for besides those by coefficients."""
        return () if self.network is None else tuple(self.network.parameters())

    @property
    def untilted(self) -> LensModel:
        """The same model without its tilt."""
        return self if self.without_tilt is None else self.without_tilt

    def contains(self, other: LensModel) -> bool:
        """Whether every lens of `other` is also a lens of this model."""
        return self.fisheye == other.fisheye and self.hybrid == other.hybrid and set(other.names) <= set(self.names)

    def __str__(self) -> str:
        if self.hybrid:
            return "hybrid" if self.network is None else "network"
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


def larger_model(count: int) -> str:
    """Which model to choose for that many coefficients of OpenCV, in words.

    Example:
        >>> larger_model(8)
        'choose model="opencv8"'
    """
    fit = [name for name, model in PRESETS.items() if name.startswith("opencv") and model.size >= count]
    return f'choose model="{fit[0]}"' if fit else "choose a model with more"
