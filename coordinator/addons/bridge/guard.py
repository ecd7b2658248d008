"""Access control in front of every response of the bridge."""

from __future__ import annotations

from collections.abc import Sequence

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dreamfleet.coordinator.addons.dashboard.guard import constant_time_equal, is_own_host

OPEN_PATHS = ("/v1/health",)  # need no token
HEADERS = {"cache-control": "no-store", "x-content-type-options": "nosniff"}


class BridgeGuard:
    """Passes requests on that have one of the `tokens`, if there are any, and that no web page of others caused."""

    def __init__(self, app: ASGIApp, tokens: Sequence[str], *, is_loopback: bool) -> None:
        self._app = app
        self._tokens = tokens
        self._is_loopback = is_loopback

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await (self._refusal(scope) or self._app)(scope, receive, with_headers)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        if self._is_loopback and not is_own_host(headers.get("host", "")):
            # Otherwise a page whose host name resolves to this address could submit here (DNS rebinding).
            return _refuse(421, "misdirected", "ask for this address as http://127.0.0.1, with its port")
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            return _refuse(403, "forbidden", "another site's page asks for this")
        if self._tokens and scope["path"] not in OPEN_PATHS and not self._is_authorised(headers):
            refusal = _refuse(401, "unauthorised", "give one of the bridge's tokens: Authorization: Bearer TOKEN")
            refusal.headers["www-authenticate"] = 'Bearer realm="dreamfleet"'
            return refusal
        return None

    def _is_authorised(self, headers: Headers) -> bool:
        kind, _, given = headers.get("authorization", "").partition(" ")
        matches = [constant_time_equal(given.strip(), each) for each in self._tokens]  # all of them: in constant time
        return kind.lower() == "bearer" and any(matches)


def _refuse(status: int, kind: str, text: str) -> Response:
    return JSONResponse({"error": kind, "text": text}, status)
