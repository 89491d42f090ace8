"""The marking page's routes, which check what they are given and ask the `Desk`."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Annotated, Any

import pydantic
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from kcal.corners.point import enlarge
from kcal.mark.items import ACTION, Mark, Side
from kcal.mark.marking_service import Desk
from kcal.web.serving import json_body, local_app, page_files

_Coordinate = Annotated[float, pydantic.Field(allow_inf_nan=False, ge=-1e6, le=1e6)]
_Number = Annotated[int, pydantic.Field(ge=0, le=10_000_000)]


class _Query(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid")


class At(_Query):
    """A pixel of a frame."""

    side: Side
    frame: _Number
    u: _Coordinate
    v: _Coordinate


class From(At):
    """A mark that is to be matched, and what it was set by."""

    how: Annotated[str, pydantic.Field(max_length=20)] = "hand"


class Pair(_Query):
    """Two marks that are being dragged."""

    left: Mark
    right: Mark
    matched: Side | None = None


class Again(_Query):
    """A thing of the reference."""

    name: str
    side: Side
    frame: _Number
    reach: Annotated[int, pydantic.Field(ge=5, le=200)] = 40


class Do(_Query):
    """An action with its key."""

    key: Annotated[str, pydantic.Field(min_length=8, max_length=64)]
    action: dict[str, Any]


class Tile(_Query):
    """A tile; `low` and `high` stretch deep images."""

    side: Side
    frame: _Number
    level: Annotated[int, pydantic.Field(ge=0, le=20)]
    x: _Number
    y: _Number
    low: _Coordinate | None = None
    high: _Coordinate | None = None


def marking_app(desk: Desk, token: str, hosts: tuple[str, ...]) -> Starlette:
    """The application.

    Args:
        desk: what it serves.
        token: that requests for data must carry in the header `X-Kcal-Token`.
        hosts: values of the header `Host` that are answered, for example `127.0.0.1:8347`.
    """

    def asked(
        model: type[pydantic.BaseModel], answer: Callable[[Any], Any]
    ) -> Callable[[Request], Awaitable[Response]]:
        async def endpoint(request: Request) -> Response:
            given = await json_body(request) if request.method == "POST" else dict(request.query_params)
            query = model.model_validate(given)
            found = await run_in_threadpool(answer, query)
            return found if isinstance(found, Response) else JSONResponse(found)

        return endpoint

    def tile(query: Tile) -> Response:
        span = None if query.low is None or query.high is None else (query.low, query.high)
        part = desk.pictures.pyramid(query.side, query.frame).tile(query.level, query.x, query.y, span)
        return Response(part.tobytes(), media_type="application/octet-stream",
                        headers={"X-Width": str(part.shape[1]), "X-Height": str(part.shape[0])})  # fmt: skip

    def enlarged(query: At) -> Response:
        import torch

        image = desk.pictures.image(query.side, query.frame)
        height, width = image.shape
        u, v = min(max(round(query.u), 0), width - 1), min(max(round(query.v), 0), height - 1)
        top, left = max(v - 32, 0), max(u - 32, 0)
        crop = torch.from_numpy(image[top : v + 33, left : u + 33].astype("float64"))
        view = enlarge(crop, torch.tensor([float(u - left), float(v - top)]), half=24)
        low, high = desk.pictures.pyramid(query.side, query.frame).span if image.dtype.itemsize > 1 else (0.0, 255.0)
        patch = ((view.patch - low) * (255.0 / (high - low))).clamp(0, 255).round().to(torch.uint8).numpy()
        where = {"X-Left": str(left + view.left), "X-Top": str(top + view.top), "X-Factor": str(view.factor)}
        size = {"X-Width": str(patch.shape[1]), "X-Height": str(patch.shape[0])}
        return Response(patch.tobytes(), media_type="application/octet-stream", headers={**size, **where})

    data: dict[str, tuple[type[pydantic.BaseModel], Callable[[Any], Any], str]] = {
        "about": (_Query, lambda _: desk.about(), "GET"),
        "state": (_Query, lambda _: desk.state(), "GET"),
        "map": (_Query, lambda _: desk.map(), "GET"),
        "tile": (Tile, tile, "GET"),
        "enlarged": (At, enlarged, "GET"),
        "act": (Do, lambda query: desk.act(ACTION.validate_python(query.action), query.key), "POST"),
        "snap": (At, lambda query: desk.snapped(query.side, query.frame, query.u, query.v), "POST"),
        "curve": (At, lambda query: desk.curve(query.side, query.u, query.v), "POST"),
        "proposal": (From, lambda query: desk.proposal(query.side, query.frame, query.u, query.v, query.how), "POST"),
        "position": (Pair, lambda query: desk.position(query.left, query.right, query.matched), "POST"),
        "again": (Again, lambda query: desk.again(query.name, query.side, query.frame, query.reach), "POST"),
    }
    routes = [
        Route(f"/api/{name}", asked(model, answer), methods=[method]) for name, (model, answer, method) in data.items()
    ]
    return local_app(routes, marking_files(), token, hosts)


def marking_files() -> dict[str, tuple[bytes, str]]:
    """The page's own files, and those of maps."""
    return page_files(("kcal.mark", "page"), ("kcal.report", "leaflet"), ("kcal.web", "map"))
