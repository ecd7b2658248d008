"""The dashboard's routes, which docs/how-to/dashboard.md lists. All are GET and change nothing."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import aclosing
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp

from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.printable import printable
from dreamfleet.coordinator.addons.dashboard import stored_runs
from dreamfleet.coordinator.addons.dashboard.assets import Assets
from dreamfleet.coordinator.addons.dashboard.compared_runs import compare_runs
from dreamfleet.coordinator.addons.dashboard.config import DashboardConfig
from dreamfleet.coordinator.addons.dashboard.feed import Feed
from dreamfleet.coordinator.addons.dashboard.guard import PageGuard
from dreamfleet.coordinator.addons.dashboard.view_processes import ViewProcesses, ViewTarget
from dreamfleet.coordinator.addons.metrics.prometheus import CONTENT_TYPE, exposition
from dreamfleet.coordinator.addons.web.documents import event, json_response

EVENTS = "text/event-stream"
FULL = "too many pages are open: close some\n"
FOR_EVER = "private, max-age=31536000, immutable"


def make_app(feed: Feed, views: ViewProcesses, runs_dir: Path, config: DashboardConfig) -> ASGIApp:
    """The page behind its guard; `ModuleNotFoundError` if a package of the extra is missing."""
    handlers = _Handlers(feed, views, runs_dir, Assets())
    routes = [
        Route("/", handlers.index), Route("/files/{digest}/{name}", handlers.file), Route("/live", handlers.live),
        Route("/view", handlers.view), Route("/metrics", handlers.metrics),
        Route("/runs", handlers.runs), Route("/runs/{name}", handlers.run),
        Route("/hosts/{name}", handlers.hosts), Route("/compare/{one}/{other}", handlers.compare),
    ]  # fmt: skip
    tokens = () if config.token is None else (config.token,)
    app = Starlette(routes=routes, exception_handlers={DreamfleetError: _not_found})  # of what a path names
    return PageGuard(app, tokens, is_loopback=config.is_loopback)


class _Handlers:
    """The request handlers. Those without `async` read disks, so they run in a thread."""

    def __init__(self, feed: Feed, views: ViewProcesses, runs_dir: Path, files: Assets) -> None:
        self._feed, self._views, self._runs_dir, self._files = feed, views, runs_dir, files
        self._listing: asyncio.Task[list[dict[str, Any]]] | None = None

    def index(self, _request: Request) -> Response:
        return HTMLResponse(self._files.index)

    def file(self, request: Request) -> Response:
        found = self._files.find(request.path_params["digest"], request.path_params["name"])
        if found is None:
            return PlainTextResponse("there is no such file; load the page anew\n", 404)
        headers = {"cache-control": FOR_EVER, "vary": "accept-encoding"}
        if "gzip" in request.headers.get("accept-encoding", ""):
            return Response(found.gzipped, 200, {**headers, "content-encoding": "gzip"}, found.media_type)
        return Response(found.data, 200, headers, found.media_type)

    async def live(self, request: Request) -> Response:
        if self._feed.is_full:
            return PlainTextResponse(FULL, 503)
        return _stream(request, self._events(request.query_params.get("run")))

    async def view(self, request: Request) -> Response:
        if self._views.is_full:
            return PlainTextResponse(FULL, 503)
        try:
            target = ViewTarget.of(request.query_params)
        except UsageError as error:
            return PlainTextResponse(f"{printable(str(error))}\n", 400)
        return _stream(request, self._views.events(target))

    async def metrics(self, _request: Request) -> Response:
        """Prometheus metrics of all live runs; a scrape counts as a viewer of one snapshot."""
        async with aclosing(self._feed.snapshots()) as snapshots:
            async for snapshot in snapshots:
                return Response(exposition(*snapshot.statuses), media_type=CONTENT_TYPE)
        return PlainTextResponse("this page is about to leave\n", 503)

    async def runs(self, _request: Request) -> Response:
        """List the stored runs; concurrent requests share one read, since thousands of journals take seconds."""
        if self._listing is None or self._listing.done():
            self._listing = asyncio.create_task(asyncio.to_thread(stored_runs.list_runs, self._runs_dir))
        rows = await asyncio.shield(self._listing)
        return json_response({"runs": rows, "folder": printable(str(self._runs_dir))})

    def run(self, request: Request) -> Response:
        return json_response(stored_runs.describe_run(self._runs_dir, request.path_params["name"]))

    def hosts(self, request: Request) -> Response:
        return json_response(stored_runs.describe_hosts(self._runs_dir, request.path_params["name"]))

    def compare(self, request: Request) -> Response:
        return json_response(compare_runs(self._runs_dir, request.path_params["one"], request.path_params["other"]))

    async def _events(self, run: str | None) -> AsyncIterator[bytes]:
        """A frame for each snapshot, and the curves whenever they changed."""
        yield event("hello", {"digest": self._files.digest, "views": self._views.is_enabled})
        curves = b""
        async for snapshot in self._feed.snapshots():
            shown = snapshot.find(run)
            if shown is None:
                yield snapshot.absent_event
                continue
            yield shown.page_state
            if shown.curves != curves:
                yield (curves := shown.curves)


def _stream(request: Request, events: AsyncIterator[bytes]) -> Response:
    """An endless stream of events; for HEAD only its headers."""
    return Response(media_type=EVENTS) if request.method == "HEAD" else StreamingResponse(events, media_type=EVENTS)


async def _not_found(_request: Request, error: Exception) -> Response:
    return json_response({"error": printable(str(error))}, 404)
