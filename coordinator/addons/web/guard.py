"""Access control in front of every response of a web server."""

import hashlib
import hmac
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dreamfleet.common.transport.network import names_loopback


class Guard(ABC):
    """Passes on what no page of another site asks for and what `check` allows; refuses the rest.

    Each response gets those of the `headers` that it lacks.
    """

    headers: ClassVar[Mapping[str, str]]

    def __init__(self, app: ASGIApp, tokens: Sequence[str], *, is_loopback: bool) -> None:
        self.tokens = tokens
        self._app, self._is_loopback = app, is_loopback

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request; a websocket gets no response."""
        if scope["type"] != "http":
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in self.headers.items():
                    headers.setdefault(name, value)
            await send(message)

        await (self._refusal(scope, Headers(scope=scope)) or self._app)(scope, receive, with_headers)

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:  # bridge/openapi.py describes both
        if self._is_loopback and not names_loopback(headers.get("host", "")):
            return self.refuse(421, "misdirected", "ask for this address as http://127.0.0.1, with its port")
        # Browsers send Sec-Fetch headers (https://www.w3.org/TR/fetch-metadata/); other clients send none.
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none") and not self.is_link(scope, headers):
            return self.refuse(403, "forbidden", "another site's page asks for this: open it by its own address")
        return self.check(scope, headers)

    @abstractmethod
    def refuse(self, status: int, kind: str, text: str) -> Response:
        """The response that refuses a request."""

    @abstractmethod
    def check(self, scope: Scope, headers: Headers) -> Response | None:
        """What answers a request instead of the application; `None`: it is passed on."""

    def is_link(self, _scope: Scope, _headers: Headers) -> bool:
        """Whether another site's page may cause this request."""
        return False

    def bears_token(self, headers: Headers) -> bool:
        """Whether a request bears one of the tokens; they are compared in constant time, so all of them."""
        kind, _, given = headers.get("authorization", "").partition(" ")
        # Headers are decoded as Latin-1, but clients send tokens with other letters in UTF-8.
        texts = given.strip(), given.strip().encode("latin-1", "replace").decode(errors="replace")
        matches = [constant_time_equal(text, token) for text in texts for token in self.tokens]
        return kind.lower() == "bearer" and any(matches)


def constant_time_equal(given: str, wanted: str) -> bool:
    """Compare two texts in a time that does not depend on where they differ."""
    return hmac.compare_digest(*(hashlib.sha256(each.encode(errors="replace")).digest() for each in (given, wanted)))
