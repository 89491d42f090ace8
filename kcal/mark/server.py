"""The marking page's routes, which check what they are given and ask the `Desk`."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Annotated, Any

import numpy as np
import pydantic
from numpy.typing import NDArray
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from kcal.corners.match import enlarge
from kcal.mark.items import ACTION, Coordinate, Number, Side
from kcal.mark.marking_service import Desk, Json
from kcal.web.serving import json_body, local_app, page_files

_NAMED = pydantic.TypeAdapter(dict[str, Any])
Level = Annotated[int, pydantic.Field(ge=0, le=20)]
Key = Annotated[str, pydantic.Field(min_length=8, max_length=64)]


def marking_app(desk: Desk, token: str, hosts: tuple[str, ...]) -> Starlette:
    """Make the application; requests are checked by the types of the handlers' parameters.

    Args:
        desk: what it serves.
        token: that requests for data must carry in the header `X-Kcal-Token`.
        hosts: values of the header `Host` that are answered, for example `127.0.0.1:8347`.
    """

    def asked(answer: Callable[..., Any]) -> Callable[[Request], Awaitable[Response]]:
        checked = pydantic.validate_call(answer)

        async def endpoint(request: Request) -> Response:
            given = await json_body(request) if request.method == "POST" else dict(request.query_params)
            named = _NAMED.validate_python(given)
            found = await run_in_threadpool(lambda: checked(**named))
            return found if isinstance(found, Response) else JSONResponse(found)

        return endpoint

    def tile(
        side: Side, frame: Number, level: Level, x: Number, y: Number,
        low: Coordinate | None = None, high: Coordinate | None = None,
    ) -> Response:  # fmt: skip
        """A tile; `low` and `high` stretch deep images."""
        span = None if low is None or high is None else (low, high)
        return pixels(desk.pictures.pyramid(side, frame).tile(level, x, y, span))

    def pixels(levels: NDArray[np.uint8], **more: int) -> Response:
        """Levels of 8 bits, (H, W) or (H, W, 3), row by row."""
        height, width, *channels = levels.shape
        told = {"width": width, "height": height, "channels": channels[0] if channels else 1, **more}
        headers = {f"X-{name.capitalize()}": str(value) for name, value in told.items()}
        return Response(levels.tobytes(), media_type="application/octet-stream", headers=headers)

    def enlarged(side: Side, frame: Number, u: Coordinate, v: Coordinate) -> Response:
        import torch

        pyramid = desk.pictures.pyramid(side, frame)
        image = pyramid.level(0)
        height, width = image.shape[:2]
        column, row = min(max(round(u), 0), width - 1), min(max(round(v), 0), height - 1)
        top, left = max(row - 32, 0), max(column - 32, 0)
        crop = torch.from_numpy(image[top : row + 33, left : column + 33].astype("float64"))
        middle = torch.tensor([float(column - left), float(row - top)])
        views = [enlarge(plane, middle, half=24) for plane in torch.atleast_3d(crop).unbind(-1)]
        low, high = pyramid.span if image.dtype.itemsize > 1 else (0.0, 255.0)
        levels = (torch.stack([view.patch for view in views], -1) - low) * (255.0 / (high - low))
        patch = levels.clamp(0, 255).round().to(torch.uint8).numpy().squeeze(-1 if len(views) == 1 else ())
        return pixels(patch, left=left + views[0].left, top=top + views[0].top, factor=views[0].factor)

    def act(key: Key, action: dict[str, Any]) -> Json:
        return desk.act(ACTION.validate_python(action), key)

    def curve(side: Side, frame: Number, u: Coordinate, v: Coordinate) -> Json:
        return desk.curve(side, u, v)

    answers: dict[str, dict[str, Callable[..., Any]]] = {
        "GET": {"about": desk.about, "state": desk.state, "map": desk.map, "tile": tile, "enlarged": enlarged},
        "POST": {
            "act": act, "snap": desk.snapped, "curve": curve, "proposal": desk.proposal, "position": desk.position,
            "again": desk.again,
        },
    }  # fmt: skip
    routes = [
        Route(f"/api/{name}", asked(answer), methods=[method])
        for method, named in answers.items() for name, answer in named.items()
    ]  # fmt: skip
    return local_app(routes, marking_files(), token, hosts)


def marking_files() -> dict[str, tuple[bytes, str]]:
    """The page's own files, and those of maps."""
    return page_files(("kcal.mark", "page"), ("kcal.report", "leaflet"), ("kcal.web", "map"))
