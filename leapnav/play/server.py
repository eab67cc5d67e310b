"""The server of `leapnav play`: three files and a few questions, for one user on one machine."""

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

from leapnav.envs.scenario import Scenario
from leapnav.experts.policy import NoOptimumError
from leapnav.play.answers import Answers, banked

LONGEST = 1_000_000  # bytes of a question
FILES = {
    "/": ("page.html", "text/html"),
    "/page.css": ("page.css", "text/css"),
    "/page.js": ("page.js", "text/javascript"),
}
# Nothing but what is served here: no script, font or picture from elsewhere, and no page around this one.
POLICY = {
    "Content-Security-Policy": "default-src 'self'; img-src data:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
LOCAL = ("127.0.0.1", "localhost", "[::1]")
Endpoint = Callable[[Request], Awaitable[Response]]


def create_app(answers: Answers, scenario: Scenario, host: str = "127.0.0.1") -> Starlette:
    """The application.

    Args:
        answers: what solves.
        scenario: that the page shows first.
        host: where it listens; a request that names another host is refused, so that no page from elsewhere can ask by
            giving this machine a name of its own.

    """

    async def first(request: Request) -> Response:
        return JSONResponse({"scenario": scenario.to_dict(), "policies": answers.policies})

    async def bank(request: Request) -> Response:
        index = request.query_params.get("index", "0")
        try:
            if not re.fullmatch(r"-?[0-9]{1,9}", index):
                raise ValueError(f"index: expected a number, got {index[:20]!r}")
            found = banked(request.query_params.get("family", ""), int(index))
        except ValueError as error:
            return _refused(error)
        return JSONResponse({"scenario": found.to_dict()})

    def check(question: dict[str, Any]) -> dict[str, Any]:
        return {"scenario": _scenario(question).to_dict()}

    def follow(question: dict[str, Any]) -> dict[str, Any]:
        before = question.get("before")
        if before is not None and not isinstance(before, str):
            raise ValueError(f"before: expected text, got {before!r}")
        return answers.follow(_scenario(question), before)

    questions: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
        "/check": check,
        "/follow": follow,
        "/search": lambda question: answers.search(_scenario(question)),
        "/sweeps": lambda question: answers.sweeps(_scenario(question)),
        "/drive": lambda question: answers.drive(_scenario(question), str(question.get("policy"))),
    }
    any_host = host in ("0.0.0.0", "::")
    allowed = ["*"] if any_host else [host, *LOCAL]
    return Starlette(
        routes=[
            *(Route(path, _file(*file)) for path, file in FILES.items()),
            Route("/first", first),
            Route("/bank", bank),
            *(Route(path, _question(answer), methods=["POST"]) for path, answer in questions.items()),
        ],
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=allowed)],
    )


def _file(name: str, kind: str) -> Endpoint:
    content = files("leapnav.play").joinpath(name).read_bytes()

    async def endpoint(request: Request) -> Response:
        return Response(content, media_type=kind, headers=POLICY)

    return endpoint


def _question(answer: Callable[[dict[str, Any]], dict[str, Any]]) -> Endpoint:
    """An endpoint that reads a JSON object and answers with one; what is wrong with it is told in one line."""

    async def endpoint(request: Request) -> Response:
        # A form of another page could send text, but no JSON without being asked first.
        if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
            return JSONResponse({"error": "expected application/json"}, 415)
        body = b""
        try:
            async for part in request.stream():
                body += part
                if len(body) > LONGEST:
                    return JSONResponse({"error": f"expected at most {LONGEST} bytes"}, 413)
        except ClientDisconnect:
            return Response(status_code=400)
        try:
            try:
                question = json.loads(body)
            except (ValueError, RecursionError):
                raise ValueError("the question is not JSON") from None
            if not isinstance(question, dict):
                raise ValueError("expected a JSON object")
            return JSONResponse(await run_in_threadpool(answer, question))
        except (ValueError, OSError, RecursionError, NoOptimumError) as error:
            return _refused(error)

    return endpoint


def _refused(error: Exception) -> Response:
    line = str(error).splitlines()[0] if str(error) else type(error).__name__
    return JSONResponse({"error": line.encode("utf-8", "replace").decode()}, 400)  # no halves of surrogate pairs


def _scenario(question: dict[str, Any]) -> Scenario:
    scenario = Scenario.from_dict(question.get("scenario"))
    if not scenario.name.isprintable():
        raise ValueError(f"Scenario: name: expected printable characters, got {ascii(scenario.name)[:80]}")
    return scenario
