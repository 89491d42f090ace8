"""What is marked: items with a name, a kind and a mark in either image; and the actions that change them.

State is a value: `applied(state, action)` returns the next one, so that undoing is going back to an earlier value.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Annotated, Literal

import pydantic

from kcal.errors import InputError
from kcal.mark.shapes import REACH

Kind = Literal["landmark", "feature", "target"]
Side = Literal["left", "right"]
# What pages ask for: a pixel of a frame, and numbers of frames and tiles.
Coordinate = Annotated[float, pydantic.Field(allow_inf_nan=False, ge=-1e6, le=1e6)]
Number = Annotated[int, pydantic.Field(ge=0, le=10_000_000)]
_Finite = Annotated[float, pydantic.Field(allow_inf_nan=False)]
_Name = Annotated[str, pydantic.StringConstraints(strip_whitespace=True, min_length=1, max_length=60)]


SIDES: tuple[Side, Side] = ("left", "right")


def other_side(side: Side) -> Side:
    """The other image."""
    return "right" if side == "left" else "left"


class _Strict(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class Mark(_Strict):
    """A pixel with its covariance.

    Args:
        u: column, integer at a pixel's center.
        v: row.
        cov: variance of u, covariance, variance of v, px².
        how: what it was set by: "hand", a shape that was found there, or "match".
        frame: name of the pair of images in which it was set.
    """

    u: _Finite
    v: _Finite
    cov: tuple[_Finite, _Finite, _Finite]
    how: Literal["hand", "corner", "cross", "blob", "end", "edges", "match", "again", "file"] = "hand"
    frame: str = ""

    @pydantic.model_validator(mode="after")
    def _is_covariance(self) -> Mark:
        uu, uv, vv = self.cov
        if not (uu > 0 and uu * vv - uv * uv > 0):
            raise ValueError("the covariance is not positive definite")
        return self

    @property
    def sigma(self) -> float:
        """The larger standard deviation along an axis, px."""
        return math.sqrt(max(self.cov[0], self.cov[2]))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Item:
    """An item and its marks.

    Args:
        kind: "landmark" (surveyed), "feature" (it does not move) or "target" (to be located).
        left: its mark in the left image.
        right: its mark in the right image.
        cross: whether the right mark was matched to the left one or the reverse: "left" or "right" is the side it was
            matched from, so that both marks share that side's error.
    """

    kind: Kind
    left: Mark | None = None
    right: Mark | None = None
    cross: Side | None = None

    def mark(self, side: Side) -> Mark | None:
        """The mark of one side."""
        return self.left if side == "left" else self.right


class Place(_Strict):
    """Surveyed coordinates: latitude, longitude, height or east, north, up, with sigmas in meters."""

    at: tuple[_Finite, _Finite, _Finite]
    sigma: Annotated[float, pydantic.Field(gt=0, allow_inf_nan=False)]
    sigma_up: Annotated[float, pydantic.Field(gt=0, allow_inf_nan=False)] | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class MarkingState:
    """All items by name, in the order in which they were added, and the survey."""

    items: Mapping[str, Item] = dataclasses.field(default_factory=dict)
    survey: Mapping[str, Place] = dataclasses.field(default_factory=dict)


class _OfItem(_Strict):
    name: _Name


class Add(_OfItem):
    """Add an item without marks."""

    do: Literal["add"]
    kind: Kind


class Put(_OfItem):
    """Set a mark.

    Args:
        name: of the item.
        side: of the image.
        mark: as it was clicked, dragged, matched or found.
        matched: it was matched to the other side's mark and shares its error.
        zoom: screen pixels per pixel of the image when it was clicked or dragged. A click is known to one screen pixel
            at best.
    """

    do: Literal["put"]
    side: Side
    mark: Mark
    matched: bool = False
    zoom: Annotated[float, pydantic.Field(gt=0, le=1e4)] | None = None


class Take(_OfItem):
    """Remove a mark."""

    do: Literal["take"]
    side: Side


class Drop(_OfItem):
    """Remove an item with its marks; surveyed places stay."""

    do: Literal["drop"]


class Rename(_OfItem):
    """Give an item another name or kind."""

    do: Literal["rename"]
    to: _Name
    kind: Kind


class SurveyPlace(_OfItem):
    """Type in where a landmark is."""

    do: Literal["survey"]
    place: Place


class Places(_Strict):
    """Take over files of surveyed places and of targets' names. It is no work of the operator's: nothing to undo."""

    do: Literal["places"]
    places: dict[str, Place]
    targets: tuple[_Name, ...] = ()


class Load(_Strict):
    """Take over the marks of files that were changed outside, in place of all marks of that kind."""

    do: Literal["load"]
    items: dict[str, tuple[Kind, Mark | None, Mark | None]]
    kinds: tuple[Kind, ...]


class Step(_Strict):
    """Undo or redo one action."""

    do: Literal["undo", "redo"]


Change = Add | Put | Take | Drop | Rename | SurveyPlace | Places | Load
Action = Annotated[Change | Step, pydantic.Field(discriminator="do")]
ACTION: pydantic.TypeAdapter[Change | Step] = pydantic.TypeAdapter(Action)


def applied(state: MarkingState, action: Change) -> MarkingState:
    """The state after an action.

    Raises:
        InputError: a name that does not exist or exists already, or marks of a moving item at two moments.

    Example:
        >>> mark = Mark(u=10.5, v=20.0, cov=(0.01, 0.0, 0.01), frame="1")
        >>> state = applied(MarkingState(), Add(do="add", name="mast", kind="target"))
        >>> applied(state, Put(do="put", name="mast", side="left", mark=mark)).items["mast"].left.u
        10.5
    """
    items, survey = dict(state.items), dict(state.survey)
    if isinstance(action, Load):
        items = {name: item for name, item in items.items() if item.kind not in action.kinds}
        items |= {name: Item(kind=kind, left=left, right=right) for name, (kind, left, right) in action.items.items()}
    elif isinstance(action, Places | SurveyPlace):
        places = typed_places(action)
        survey |= places
        for name in places:
            items.setdefault(name, Item(kind="landmark"))
        for name in action.targets if isinstance(action, Places) else ():
            items.setdefault(name, Item(kind="target"))
    elif isinstance(action, Add):
        if action.name in items:
            raise InputError(f"the name {action.name!r} is used already; names must differ")
        if not action.name.isprintable():
            raise InputError("a name is one line of printable characters")
        items[action.name] = Item(kind=action.kind)
    elif action.name not in items:
        raise InputError(f"nothing is named {action.name!r}")
    elif isinstance(action, Put):
        items[action.name] = _with_mark(action, items[action.name])
    elif isinstance(action, Take):
        items[action.name] = _item_with(_unmatched(items[action.name]), action.side, None)
    elif isinstance(action, Drop):
        del items[action.name]
    else:
        if action.to != action.name and action.to in items:
            raise InputError(f"the name {action.to!r} is used already; names must differ")
        items[action.name] = dataclasses.replace(items[action.name], kind=action.kind)
        items = {action.to if name == action.name else name: value for name, value in items.items()}
        survey = {action.to if name == action.name else name: value for name, value in survey.items()}
    return MarkingState(items=items, survey=survey)


def typed_places(action: Change | Step) -> dict[str, Place]:
    """The surveyed places that an action states; empty for all other actions."""
    if isinstance(action, SurveyPlace):
        return {action.name: action.place}
    return action.places if isinstance(action, Places) else {}


def _with_mark(action: Put, item: Item) -> Item:
    far = item.mark(other_side(action.side))
    if item.kind == "target" and far is not None and far.frame != action.mark.frame:
        raise InputError(
            f"{action.name} is marked in the pair {far.frame}: marks of a target must be of one moment; remove that "
            "mark, or add another target"
        )
    if action.matched and far is None:
        raise InputError(f"{action.name} has no mark in the other image to be matched with")
    cross = other_side(action.side) if action.matched else None
    return dataclasses.replace(_item_with(_unmatched(item), action.side, _known_to(action)), cross=cross)


def _known_to(action: Put) -> Mark:
    """The mark with the sigma that its zoom allows: from afar, a shape within reach may be another item."""
    least = 0.0 if action.zoom is None else 1.0 / action.zoom
    exact = action.mark.how != "hand" and 2.0 * least <= REACH
    if exact or action.mark.sigma >= least:
        return action.mark
    return action.mark.model_copy(update={"cov": (least**2, 0.0, least**2)})


def _item_with(item: Item, side: Side, mark: Mark | None) -> Item:
    return dataclasses.replace(item, left=mark) if side == "left" else dataclasses.replace(item, right=mark)


def _unmatched(item: Item) -> Item:
    """The item with marks that stand alone: a matched one has the other's error besides its own."""
    if item.cross is None or item.left is None or item.right is None:
        return item
    total = tuple(a + b for a, b in zip(item.left.cov, item.right.cov, strict=True))
    side = other_side(item.cross)
    mark = item.mark(side)
    assert mark is not None
    return dataclasses.replace(_item_with(item, side, mark.model_copy(update={"cov": total})), cross=None)
