"""The web server of `leapnav play`: the page, and requests in JSON, for one user on one machine."""

from __future__ import annotations

import json
import re
from collections.abc import Awaitable, Callable
from importlib.resources import files
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from leapnav.envs.robots.base import MODELS
from leapnav.envs.scenarios.families import FAMILIES
from leapnav.envs.scenarios.faults import check_headings
from leapnav.envs.scenarios.obstacle import Obstacle
from leapnav.envs.scenarios.scenario import Scenario
from leapnav.envs.utils import colors
from leapnav.experts.acting.policy import NoOptimumError
from leapnav.play.solving import PlaySolver, bank_scenario

MAX_REQUEST_SIZE = 1_000_000  # bytes
SCRIPTS = (
    "state.js",
    "shapes.js",
    "canvas.js",
    "plots.js",
    "lessons.js",
    "drawing.js",
    "editing.js",
    "link.js",
    "driving.js",
    "page.js",
)
FILES = {
    "/": ("page.html", "text/html"),
    "/page.css": ("page.css", "text/css"),
    **{f"/{name}": (name, "text/javascript") for name in SCRIPTS},
}
# The page loads only what this server delivers, and cannot be embedded in another page.
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src data:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
LOCAL_HOSTS = ("127.0.0.1", "localhost", "[::1]")
# The colours of the page, by name; see `leapnav.envs.utils.colors`.
COLORS = {
    "start": colors.START,
    "goal": colors.GOAL,
    "optimum": colors.OPTIMUM,
    "policy": colors.POLICY,
    "failure": colors.FAILURE,
    "alternatives": colors.ALTERNATIVES,
    "sweep": colors.SWEEP,
    "obstacle": colors.OBSTACLE,
    "edge": colors.EDGE,
    "wall": colors.WALL,
    "curves": colors.CURVES,
}
Endpoint = Callable[[Request], Awaitable[Response]]
Handler = Callable[[dict[str, Any]], dict[str, Any]]


def robots() -> dict[str, dict[str, Any]]:
    """Return, for each robot model, a robot with the defaults, its labels, and the weights of the cost that it uses."""
    described = {}
    for name, model in MODELS.items():
        fields = model().model_dump(mode="json", exclude_none=True)
        names = (*model.state_names, *model.control_names)
        units = (*model.state_units, *model.control_units)
        labels = [f"{label.replace('_', ' ')} ({unit})" for label, unit in zip(names, units, strict=True)]
        n = len(model.state_names)
        described[name] = {
            "fields": fields,
            "states": labels[:n],
            "controls": labels[n:],
            "weights": list(model.cost_fields),
        }
    return described


def create_app(solver: PlaySolver, scenario: Scenario, host: str = "127.0.0.1") -> Starlette:
    """Return the web application.

    Args:
        solver: solves the scenarios of the page.
        scenario: the initial scenario.
        host: address of the server. Requests that name another host are refused, so that no page elsewhere can send
            requests through a host name that resolves to this machine.

    """

    async def initial(request: Request) -> Response:
        return JSONResponse(
            {
                "scenario": scenario.to_dict(),
                "families": list(FAMILIES),
                "policies": solver.policies,
                "colors": COLORS,
                "robots": robots(),
            }
        )

    async def bank(request: Request) -> Response:
        index = request.query_params.get("index", "0")
        try:
            if not re.fullmatch(r"-?[0-9]{1,9}", index):
                raise ValueError(f"index: expected an integer, got {index[:20]!r}")
            found = bank_scenario(request.query_params.get("family", ""), int(index))
        except ValueError as error:
            return _error_response(error)
        return JSONResponse({"scenario": found.to_dict()})

    def check(content: dict[str, Any]) -> dict[str, Any]:
        scenario = _scenario(content)
        check_headings(scenario.name, scenario.start, scenario.goal)  # the content of a file or a link
        return {"scenario": scenario.to_dict()}

    def parts(content: dict[str, Any]) -> dict[str, Any]:
        obstacle = Obstacle.model_validate(content.get("obstacle"))
        return {"parts": [{part.kind: part.model_dump()} for part in obstacle.shape.parts()]}

    def follow(content: dict[str, Any]) -> dict[str, Any]:
        previous = content.get("previous")
        if previous is not None and not isinstance(previous, str):
            raise ValueError(f"previous: expected a string, got {previous!r}")
        return solver.follow(_scenario(content), previous)

    handlers: dict[str, Handler] = {
        "/check": check,
        "/parts": parts,
        "/follow": follow,
        "/search": lambda content: solver.search(_scenario(content)),
        "/sweeps": lambda content: solver.sweeps(_scenario(content)),
        "/drive": lambda content: solver.drive(_scenario(content), str(content.get("policy"))),
        "/driving/start": lambda content: solver.start_driving(_scenario(content)),
        "/driving/step": lambda content: solver.driving(content.get("id")).step(content.get("commands")),
        "/driving/finish": lambda content: solver.driving(content.get("id")).finish(),
        "/lesson": lambda content: solver.lesson(str(content.get("lesson"))),
    }
    is_public = host in ("0.0.0.0", "::")
    allowed = ["*"] if is_public else [host, *LOCAL_HOSTS]
    return Starlette(
        routes=[
            *(Route(path, _file_endpoint(*file)) for path, file in FILES.items()),
            Route("/initial", initial),
            Route("/bank", bank),
            *(Route(path, _json_endpoint(handler), methods=["POST"]) for path, handler in handlers.items()),
        ],
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=allowed)],
    )


def _file_endpoint(name: str, media_type: str) -> Endpoint:
    content = files("leapnav.play").joinpath(name).read_bytes()

    async def endpoint(request: Request) -> Response:
        return Response(content, media_type=media_type, headers=HEADERS)

    return endpoint


def _json_endpoint(handler: Handler) -> Endpoint:
    """Return an endpoint that reads a JSON object and responds with one; errors are reported in one line."""

    async def endpoint(request: Request) -> Response:
        # A form on another page can send text, but JSON only after a preflight request, which is refused here.
        if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
            return JSONResponse({"error": "expected application/json"}, 415)
        body = b""
        try:
            async for part in request.stream():
                body += part
                if len(body) > MAX_REQUEST_SIZE:
                    return JSONResponse({"error": f"expected at most {MAX_REQUEST_SIZE} bytes"}, 413)
        except ClientDisconnect:
            return Response(status_code=400)
        try:
            try:
                content = json.loads(body)
            except (ValueError, RecursionError):
                raise ValueError("the request is not valid JSON") from None
            if not isinstance(content, dict):
                raise ValueError("expected a JSON object")
            return JSONResponse(await run_in_threadpool(handler, content))
        except (ValueError, OSError, RecursionError, NoOptimumError) as error:
            return _error_response(error)

    return endpoint


def _error_response(error: Exception) -> Response:
    line = str(error).splitlines()[0] if str(error) else type(error).__name__
    # A message may quote half of a surrogate pair, which cannot be encoded.
    return JSONResponse({"error": line.encode("utf-8", "replace").decode()}, 400)


def _scenario(content: dict[str, Any]) -> Scenario:
    scenario = Scenario.from_dict(content.get("scenario"))
    if not scenario.name.isprintable():
        raise ValueError(f"Scenario: name: expected printable characters, got {ascii(scenario.name)[:80]}")
    return scenario
