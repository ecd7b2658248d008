"""The bridge's routes: each request becomes queries to a coordinator over Zenoh."""

import asyncio
import base64
import json
import secrets
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import asdict
from functools import partial
from time import monotonic
from typing import Any

import numpy as np
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from dreamfleet.common.addons.batches.batch_client import BatchClient, is_final
from dreamfleet.common.addons.batches.remote_scorer import scored_candidates
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError, DreamfleetError, UsageError
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.printable import printable, truncate
from dreamfleet.common.protocol.batches import MAX_CANDIDATES, BatchError, BatchReply, pack_batch
from dreamfleet.common.protocol.keys import check_run_name
from dreamfleet.common.runs.seeds import remark_on_seeds
from dreamfleet.coordinator.addons.bridge.changes import Changes
from dreamfleet.coordinator.addons.bridge.openapi import document
from dreamfleet.coordinator.addons.web.documents import event, json_response
from dreamfleet.coordinator.addons.web.guard import Guard

MAX_BODY = 64 << 20  # bytes of a request
MAX_TEXT = 16 << 20  # bytes of one whose vectors are numbers as text; openapi.py says it too
MANY = 1 << 16  # commas of such a one: in float32, only seeds are many
MOST_DISCARDED = 1 << 30  # bytes of a request that is too long, which are read all the same
MAX_BODIES = 4 * MAX_BODY  # bytes of all requests that are being read
BODY_TIMEOUT = 10.0  # seconds in which `LEAST` bytes of a request's body arrive, or its end
LEAST = 1 << 16
MOST_STREAMS = 256
STREAM_THREADS = 4  # in which all streams read their batches, so that others find one
KEEP_ALIVE = 10.0  # seconds between two signs of life in a stream of events
RUN_WAIT = 600.0  # seconds for which a stream waits for a coordinator that does not answer
OPEN_PATHS = ("/v1/health",)  # need no token
POLL = 0.5  # seconds between two looks at a batch of which no event arrives
# `openapi.py` says what each means.
STATUS = {"malformed": 400, "too large": 413, "conflict": 409, "unknown": 404, "busy": 503, "not external": 409}
Handler = Callable[[Request], Awaitable[Response]]


def make_app(client: Client, changes: Changes, tokens: Sequence[str], *, is_loopback: bool) -> ASGIApp:
    """The routes behind their guard."""
    handlers = _Handlers(client, changes, document(needs_token=bool(tokens)))
    batch = "/v1/runs/{run}/batches/{id}"
    routes = [
        _route("/v1/health", GET=handlers.health), _route("/openapi.json", GET=handlers.openapi),
        _route("/v1/runs", GET=handlers.runs),
        _route("/v1/runs/{run}/batches", GET=handlers.list_batches, POST=handlers.submit),
        _route(batch, GET=handlers.read, DELETE=handlers.cancel), _route(f"{batch}/events", GET=handlers.events),
    ]  # fmt: skip
    ours: dict[Any, Any] = {DreamfleetError: _refused, ClientDisconnect: _disconnected}
    app = Starlette(routes=routes, exception_handlers={**ours, HTTPException: _http_error, Exception: _bug})
    return BridgeGuard(app, tokens, is_loopback=is_loopback)


class BridgeGuard(Guard):
    """Refuses in JSON."""

    headers = {"cache-control": "no-store", "x-content-type-options": "nosniff"}  # noqa: RUF012 - a constant

    def refuse(self, status: int, kind: str, text: str) -> Response:
        """An error as the routes give it."""
        return _error(status, kind, text)

    def check(self, scope: Scope, headers: Headers) -> Response | None:
        """Refuse a request without a token."""
        if not self.tokens or scope["path"] in OPEN_PATHS or self.bears_token(headers):
            return None
        refusal = self.refuse(401, "unauthorised", "give one of the bridge's tokens: Authorization: Bearer TOKEN")
        refusal.headers["www-authenticate"] = 'Bearer realm="dreamfleet"'
        return refusal


class _Handlers:
    """The request handlers; what waits for Zenoh runs in threads."""

    def __init__(self, client: Client, changes: Changes, description: dict[str, Any]) -> None:
        self._client, self._batches = client, BatchClient(client)
        self._changes, self._description = changes, description
        self._seen: set[str] = set()  # runs whose coordinators have answered: theirs may be resumed
        self.streams = 0  # that are open
        self._stream_threads = ThreadPoolExecutor(STREAM_THREADS)
        self._held = 0  # bytes of the bodies that are being read

    async def health(self, _request: Request) -> Response:
        return json_response({"status": "ok", "version": package_version("dreamfleet")})

    async def openapi(self, _request: Request) -> Response:
        return json_response(self._description)

    async def runs(self, _request: Request) -> Response:
        return json_response({"runs": await run_in_threadpool(self._list_runs)})

    async def submit(self, request: Request) -> Response:
        run = _run_name(request)
        if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
            return _error(415, "malformed", "send JSON: Content-Type: application/json")
        async with self._body(request) as body:
            reply, remark = await self._ask(run, lambda: self._submit(run, body))
        headers = {"location": f"/v1/runs/{run}/batches/{reply.id}"}
        return json_response(_describe(reply) | {"remark": remark}, 201 if reply.is_new else 200, headers)

    async def list_batches(self, request: Request) -> Response:
        run = _run_name(request)
        found = await self._ask(run, lambda: self._batches.list_batches(run))
        return json_response({"batches": [asdict(each) for each in found]})

    async def read(self, request: Request) -> Response:
        run, batch = _run_name(request), request.path_params["id"]
        pages = await self._ask(run, lambda: self._read_all(run, batch))
        return json_response(_describe(pages[0]) | _scores(pages))

    async def cancel(self, request: Request) -> Response:
        run, batch = _run_name(request), request.path_params["id"]
        return json_response(_describe(await self._ask(run, lambda: self._batches.cancel(run, batch))))

    async def events(self, request: Request) -> Response:
        run, batch = _run_name(request), request.path_params["id"]
        first = await self._ask(run, lambda: self._batches.read(run, batch))
        if self.streams >= MOST_STREAMS:
            raise BatchError("busy", "too many streams are open: close some, or ask for the batch itself")
        self.streams += 1  # here, as no request comes between: the stream itself begins later
        return _Stream(self._stream(run, first), self)

    def _list_runs(self) -> list[dict[str, Any]]:
        rows = []
        for name in self._client.runs():
            try:
                status = self._client.status(name)
            except DreamfleetError:
                continue  # it has left, or is of another version
            settings = status.settings
            rows.append({"run": name, "state": status.state, "why": status.why, "task": settings.task.task,
                         "external": settings.is_external, "size": settings.controller.size,
                         "episodes": settings.episodes, "slots": status.slots})  # fmt: skip
        return rows

    def _submit(self, run: str, body: bytes) -> tuple[BatchReply, str]:
        given = _parse(body)
        batch_id, seeds = given.get("id", secrets.token_hex(8)), given.get("seeds", [])
        episodes = _whole(given.get("episodes", 0))
        if not isinstance(batch_id, str):
            raise BatchError("malformed", "id must be a text")
        if not isinstance(seeds, list):
            raise BatchError("malformed", "seeds must be a list of whole numbers")
        seeds = list(map(_whole, seeds))
        if not isinstance(episodes, int) or isinstance(episodes, bool):
            raise BatchError("malformed", "episodes must be a whole number")
        vectors = _read_vectors(given.get("vectors"))
        header, packed = pack_batch(batch_id, vectors, seeds if "seeds" in given else None, episodes)
        return self._batches.submit(run, header, packed), remark_on_seeds(seeds)

    def _read_all(self, run: str, batch: str) -> list[BatchReply]:
        pages = [self._batches.read(run, batch)]
        while (seen := pages[-1].offset + len(pages[-1].fitness)) < pages[-1].population and pages[-1].fitness:
            pages.append(self._batches.read(run, batch, seen))
        return pages

    @asynccontextmanager
    async def _body(self, request: Request) -> AsyncIterator[bytes]:
        """Read a request's body; an error if it is too long, stops arriving, or too many are being read."""
        size, chunks, stream, now = 0, [], request.stream(), asyncio.get_running_loop().time
        due, wanted = now() + BODY_TIMEOUT, LEAST
        try:
            while True:
                try:
                    async with asyncio.timeout_at(due):
                        chunk = await anext(stream, None)
                except TimeoutError:
                    raise HTTPException(408, f"fewer than {LEAST:,} bytes came within {BODY_TIMEOUT:g} s") from None
                if chunk is None:
                    break
                size += len(chunk)
                if size >= wanted:
                    due, wanted = now() + BODY_TIMEOUT, size + LEAST
                if size <= MAX_BODY and self._held + len(chunk) <= MAX_BODIES:
                    self._held += len(chunk)
                    chunks.append(chunk)
                elif size > MOST_DISCARDED:
                    break
            if size > MAX_BODY:  # it was read to its end, else its sender would not read the answer
                raise BatchError("too large", f"a request has at most {MAX_BODY:,} bytes: split the batch")
            if sum(map(len, chunks)) < size:
                raise BatchError("busy", "too many large batches are being sent at once: send it again later")
            yield b"".join(chunks)
        finally:
            self._held -= sum(map(len, chunks))

    def _read_page(self, run: str, batch: str, offset: int, sent: set[int]) -> tuple[BatchReply, bytes]:
        """A page of a batch, and the events of its candidates that are done, but for those `sent`, which gets them."""
        page = self._batches.read(run, batch, offset)
        new = [each for each in scored_candidates(page) if each.index not in sent]
        sent.update(each.index for each in new)
        return page, b"".join(event("candidate", vars(each)) for each in new)

    async def _ask(self, run: str, ask: Callable[[], Any], threads: Executor | None = None) -> Any:
        try:
            in_thread = asyncio.get_running_loop().run_in_executor(threads, ask) if threads else run_in_threadpool(ask)
            found = await in_thread
        except ConnectionFailedError as error:
            if run in self._seen:
                raise BatchError("busy", f"{error}; ask again with the same id") from error
            raise BatchError("unknown", str(error)) from error
        self._seen.add(run)
        self._changes.subscribe(run)
        return found

    async def _stream(self, run: str, first: BatchReply) -> AsyncIterator[bytes]:
        """An event for each candidate that is done, once; then one that says how the batch ended.

        Between two pages other requests have their turn, and a client that left ends its stream.
        """
        sent: set[int] = set()
        begin = 0  # all candidates before it are sent
        lost_since, spoke_at = None, monotonic()
        with self._changes.following(run, first.id) as changed:
            while not self._changes.closed:
                state, offset = None, begin
                try:
                    while state is None or offset < state.population:
                        read = partial(self._read_page, run, first.id, offset, sent)
                        page, events = await self._ask(run, read, self._stream_threads)
                        state, offset = state or page, offset + (len(page.fitness) or page.population)
                        if events:
                            yield events
                except BatchError as error:
                    lost_since = monotonic() if lost_since is None else lost_since
                    if error.refusal != "busy" or monotonic() - lost_since > RUN_WAIT:
                        yield event("error", {"error": error.refusal, "text": str(error)})
                        return
                else:
                    lost_since = None
                    if is_final(state):  # before its pages were read
                        yield event("end", _describe(state))
                        return
                while begin in sent:
                    begin += 1
                if monotonic() - spoke_at > KEEP_ALIVE:
                    spoke_at = monotonic()
                    yield b": the batch is being scored\n\n"
                await changed(POLL)


class _Stream(StreamingResponse):
    """Server-sent events; an open stream less once they have ended, even if none was sent."""

    media_type = "text/event-stream"

    def __init__(self, events: AsyncIterator[bytes], handlers: _Handlers) -> None:
        super().__init__(events)
        self._handlers = handlers

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the events until they end or the client leaves."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._handlers.streams -= 1


def _parse(body: bytes) -> dict[str, Any]:
    def refuse(name: str) -> Any:
        raise BatchError("malformed", f"{name} is not a number in JSON")

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict[str, Any]()
        for name, value in pairs:
            if name in found:  # which one counts depends on the reader
                raise BatchError("malformed", f"{truncate(name, 60)!r} is given twice")
            found[name] = value
        return found

    if body.count(b"[") > MAX_CANDIDATES + 2 or (len(body) > MAX_TEXT and body.count(b",") > MANY):
        raise BatchError(  # parsing it would stop all others for seconds
            "too large",
            f"a batch has at most {MAX_CANDIDATES:,} vectors, {MAX_TEXT >> 20} MiB as text: "
            "split it into smaller batches, or send float32",
        )
    try:
        found = json.loads(str(body, "utf-8"), parse_constant=refuse, object_pairs_hook=once)
    except (ValueError, RecursionError) as error:
        raise BatchError("malformed", f"the body is not JSON: {truncate(str(error), 200)}") from error
    if not isinstance(found, dict):
        raise BatchError("malformed", "the body must be a JSON object with vectors")
    if unknown := found.keys() - {"id", "vectors", "seeds", "episodes"}:
        raise BatchError("malformed", f"unknown field {truncate(min(unknown), 60)!r}: id, vectors, seeds, episodes")
    if found.keys() >= {"seeds", "episodes"}:
        raise BatchError("malformed", "give seeds, or a number of episodes, not both")
    return found


def _read_vectors(given: object) -> object:
    """Rows of numbers as they are; of `{"float32": BASE64, "size": N}` an array `(n, N)`."""
    if isinstance(given, list):
        if not all(isinstance(row, list) and {int, float}.issuperset(map(type, row)) for row in given):
            raise BatchError("malformed", "vectors must be rows of numbers: no texts, true, false or null")
        return given
    if not (isinstance(given, dict) and given.keys() == {"float32", "size"}):
        forms = 'a list of rows of numbers, all of one length, or {"float32": BASE64, "size": N}'
        raise BatchError("malformed", f"vectors must be {forms}")
    try:
        if type(size := _whole(given["size"])) is not int:
            raise TypeError("size is no whole number")
        numbers = np.frombuffer(base64.b64decode(given["float32"], validate=True), dtype="<f4")
        return numbers.reshape(-1, size)
    except (ValueError, TypeError) as error:
        raise BatchError("malformed", "float32 must be base64 of rows of `size` little-endian numbers") from error


def _whole(value: Any) -> Any:
    """A number such as 3.0 as 3: JSON has one kind of number. Others as they are."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _run_name(request: Request) -> str:
    return check_run_name(request.path_params["run"])


def _describe(reply: BatchReply) -> dict[str, Any]:
    names = ("id", "run", "state", "population", "size", "episodes", "done", "generation", "run_state", "run_why")
    return {name: getattr(reply, name) for name in names}


def _scores(pages: Sequence[BatchReply]) -> dict[str, Any]:
    fitness = [each for page in pages for each in page.fitness]
    return {"fitness": fitness, "errors": {str(each.candidate): each.error for page in pages for each in page.errors}}


def _route(path: str, **handlers: Handler) -> Route:
    """One route with a handler for each method: another one's answer is 405, with all these in `Allow`."""

    async def handle(request: Request) -> Response:
        return await handlers["GET" if request.method == "HEAD" else request.method](request)

    return Route(path, handle, methods=[*handlers])


async def _refused(_request: Request, error: Exception) -> Response:
    if isinstance(error, BatchError):
        headers = {"retry-after": "1"} if error.refusal == "busy" else {}
        return _error(STATUS[error.refusal], error.refusal, str(error), headers)
    status, kind = (400, "malformed") if isinstance(error, UsageError) else (502, "failed")
    return _error(status, kind, str(error))


async def _disconnected(_request: Request, _error: Exception) -> Response:
    return Response(status_code=400)


async def _http_error(_request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    kind = "unknown" if error.status_code == 404 else "malformed"
    return _error(error.status_code, kind, error.detail, error.headers)


async def _bug(_request: Request, _cause: Exception) -> Response:
    return _error(500, "failed", "this is a bug of dreamfleet; the bridge's log says more")


def _error(status: int, kind: str, text: str, headers: Mapping[str, str] | None = None) -> Response:
    return json_response({"error": kind, "text": printable(text)}, status, headers)
