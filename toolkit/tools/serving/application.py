"""The application: its paths, and the status of each error."""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable, Iterable
from typing import Annotated, Any

from fastapi import FastAPI, Path, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, Response
from fastapi.routing import APIRoute
from pydantic import ValidationError
from starlette.datastructures import Headers

from toolkit.base.errors import FormatError, SettingsError, ToolkitError
from toolkit.base.version import __version__
from toolkit.io.addresses import is_local
from toolkit.tools.serving.admission import Computations, OverloadedError
from toolkit.tools.serving.listing import Listed, listing_page
from toolkit.tools.serving.options import ServiceLimits
from toolkit.tools.serving.requests import (
    PageParameters,
    QueryParameters,
    RenderRequest,
    ViewParameters,
)
from toolkit.tools.serving.served_run import NotAvailableError, ServedRun

KeyframeNumber = Annotated[int, Path(ge=0, le=10**9)]
_PNG: dict[int | str, dict[str, Any]] = {200: {"content": {"image/png": {}}}}


# The pages of the service load nothing, and no other page may embed them.
_HEADERS = {
    "cache-control": "no-store",
    "content-security-policy": "default-src 'none'; style-src 'unsafe-inline'; "
    "frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
}


def build_application(
    run: ServedRun, limits: ServiceLimits, computations: Computations, local: bool = True
) -> FastAPI:
    """Return the ASGI application that serves a run.

    Args:
        computations: computes renders and queries; to be closed by the caller.
        local: only clients on this machine can connect.
    """
    # FastAPI's documentation pages load scripts from a CDN; the page at / replaces them.
    app = FastAPI(
        title="semsplat",
        version=__version__,
        description="Poses, rendered views, queries and objects of a finished run.",
        docs_url=None,
        redoc_url=None,
    )
    _add_values(app, run, computations)
    _add_pictures(app, run, computations)

    @app.get("/", response_class=HTMLResponse, include_in_schema=False)
    async def listing() -> str:
        return listing_page(run.name, run.length_names, _listed(app.routes))

    _add_checks(app, limits, local)
    _add_errors(app)
    return app


def _add_values(app: FastAPI, run: ServedRun, computations: Computations) -> None:
    """Add the paths that return JSON."""

    @app.get("/run")
    async def describe_run() -> dict[str, Any]:
        """Sizes, camera, unit of length (`metric`) and levels of the class tree."""
        return run.description()

    @app.get("/poses")
    async def poses(page: Annotated[PageParameters, Query()]) -> dict[str, Any]:
        """Poses T_map_camera of the tracked frames."""
        return run.poses(page.first, page.count)

    @app.get("/keyframes")
    async def keyframes(page: Annotated[PageParameters, Query()]) -> dict[str, Any]:
        """Poses T_map_camera of the keyframes."""
        return run.poses(page.first, page.count, keyframes=True)

    @app.get("/metrics")
    async def metrics() -> dict[str, Any]:
        """The metrics of the run."""
        return run.metrics()

    @app.get("/classes")
    async def classes() -> dict[str, Any]:
        """The class tree with numbers of Gaussians, and the colours of rendered classes."""
        return await computations.run("queries", run.classes)

    @app.get("/query")
    async def query(parameters: Annotated[QueryParameters, Query()]) -> dict[str, Any]:
        """Objects of a class or group, with positions and sizes."""
        return await computations.run("queries", lambda: run.answer(parameters))

    @app.get("/objects")
    async def objects() -> dict[str, Any]:
        """All objects and their relations (on, in, next to), in NetworkX's node-link format."""
        return await computations.run("queries", run.objects)


def _add_pictures(app: FastAPI, run: ServedRun, computations: Computations) -> None:
    """Add the paths that return images."""

    async def rendered(request: RenderRequest) -> Response:
        png = await computations.run("renders", lambda: run.png(request))
        return Response(png, media_type="image/png")

    @app.post("/render", response_class=Response, responses=_PNG)
    async def render(request: RenderRequest) -> Response:
        """A view from any pose as PNG: colour, classes, or depth (16 bits, 1/1000 of the unit)."""
        return await rendered(request)

    @app.get("/keyframes/{number}.png", response_class=Response, responses=_PNG)
    async def render_keyframe(
        number: KeyframeNumber, view: Annotated[ViewParameters, Query()]
    ) -> Response:
        """The view of a keyframe as PNG."""
        return await rendered(RenderRequest(keyframe=number, **view.model_dump()))


def _listed(routes: Iterable[Any]) -> list[Listed]:
    """Return the documented paths."""
    return [
        Listed(method, route.path, route.description.splitlines()[0])
        for route in routes
        if isinstance(route, APIRoute) and route.include_in_schema
        for method in sorted(route.methods or ())
    ]


def _add_checks(app: FastAPI, limits: ServiceLimits, local: bool) -> None:
    """Check the host and the size of the body of every request."""

    def rejected(headers: Headers) -> JSONResponse | None:
        # A web page could read the answers through a name that it has pointed at this machine (DNS
        # rebinding).
        host = re.sub(r":\d+$", "", headers.get("host", "")).strip("[]").lower()
        if local and not is_local(host):
            return _error(400, "the header Host must be localhost or 127.0.0.1")
        if "transfer-encoding" in headers:
            return _error(411, "a body needs the header Content-Length")
        if int(headers.get("content-length", "0")) > limits.max_body_bytes:
            return _error(413, f"the body is larger than {limits.max_body_bytes} bytes")
        return None

    @app.middleware("http")
    async def check(
        request: Request, call_next: Callable[[Request], Awaitable[Response]]
    ) -> Response:
        response = rejected(request.headers) or await call_next(request)
        response.headers.update(_HEADERS)
        return response


def _error(status: int, detail: str, headers: dict[str, str] | None = None) -> JSONResponse:
    return JSONResponse({"detail": detail}, status, headers)


def _add_errors(app: FastAPI) -> None:
    """Answer errors with a status and one line."""

    def handler(status: int) -> Callable[[Request, Any], JSONResponse]:
        return lambda _, error: _error(status, " ".join(str(error).split()))

    app.add_exception_handler(NotAvailableError, handler(404))
    app.add_exception_handler(FormatError, handler(404))  # a query for an unknown class
    app.add_exception_handler(SettingsError, handler(422))
    app.add_exception_handler(ToolkitError, handler(501))  # a library is missing on this machine
    # The server writes the error to its log.
    app.add_exception_handler(
        Exception, lambda *_: _error(500, "internal error; see the server's log")
    )

    @app.exception_handler(RequestValidationError)
    async def invalid(_: Request, error: RequestValidationError) -> JSONResponse:
        # Without the value: it may be NaN, which is not JSON, or long.
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        return _error(422, f"{place}: {first['msg']}")

    @app.exception_handler(ValidationError)
    async def invalid_view(_: Request, error: ValidationError) -> JSONResponse:
        return _error(422, error.errors()[0]["msg"])

    @app.exception_handler(OverloadedError)
    async def overloaded(*_: Any) -> JSONResponse:
        return _error(503, "too many renders and queries wait; try again", {"retry-after": "1"})
