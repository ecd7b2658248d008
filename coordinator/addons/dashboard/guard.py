"""Access control in front of every response, and the security headers of each."""

from __future__ import annotations

import hashlib
import hmac
import re
from collections.abc import Mapping
from html import escape
from http.cookies import CookieError, SimpleCookie

from starlette.datastructures import Headers, MutableHeaders, QueryParams
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

COOKIE = "dreamfleet"
# Only this server's own scripts run. plotly sets styles on its elements, which is harmless.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "x-frame-options": "DENY",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}
_OWN_HOST = re.compile(r"(localhost|127\.\d+\.\d+\.\d+|\[::1\])(:\d+)?", re.IGNORECASE)
LOGIN_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>dreamfleet: token</title><style>body{{font:16px/1.5 system-ui,sans-serif;margin:15vh auto;max-width:26rem;
padding:0 1rem;color-scheme:light dark}}input,button{{font:inherit;padding:.4rem .6rem}}</style>
<h1>dreamfleet</h1><p>{text}</p><form method="get" action="/"><label>Token
<input name="token" type="password" autocomplete="current-password" required autofocus></label>
<button>Look</button></form></html>"""


class Guard:
    """Passes on GET requests to one of our own host names, with the token if there is one; refuses all others."""

    def __init__(self, app: ASGIApp, token: str | None, *, is_loopback: bool) -> None:
        self._app = app
        self._token = token
        self._is_loopback = is_loopback

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return  # a websocket: no response

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
                headers.setdefault("cache-control", "no-store")
            await send(message)

        answer = self._refusal(scope) or self._app
        await answer(scope, receive, with_headers)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        if scope["method"] not in ("GET", "HEAD"):
            return PlainTextResponse("this page is only looked at: GET\n", 405, {"allow": "GET, HEAD"})
        if self._is_loopback and not is_own_host(headers.get("host", "")):
            # Otherwise a page whose host name resolves to this address could read ours (DNS rebinding).
            return PlainTextResponse("ask for this page as http://127.0.0.1, with its port\n", 421)
        if is_foreign(headers, scope["path"]):
            return PlainTextResponse("another site's page asks for this: open it by its own address\n", 403)
        if self._token is None:
            return None
        given = QueryParams(scope["query_string"]).get("token")
        if given is not None and constant_time_equal(given, self._token):
            answer = RedirectResponse("/", 303)  # without the token, which an address bar would show
            answer.set_cookie(COOKIE, cookie_value(self._token), httponly=True, samesite="lax", path="/")
            return answer
        if self._is_authorised(headers):
            return None
        text = "This is not the token." if given is not None else "Who looks at these runs must know their token."
        challenge = {"www-authenticate": 'Bearer realm="dreamfleet"'}
        return HTMLResponse(LOGIN_PAGE.format(text=escape(text)), 401, challenge)

    def _is_authorised(self, headers: Mapping[str, str]) -> bool:
        assert self._token is not None
        kind, _, credentials = headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer":
            # Headers are decoded as Latin-1, but clients send tokens with other letters in UTF-8.
            given = credentials.strip()
            as_utf8 = given.encode("latin-1", "replace").decode(errors="replace")
            return any([constant_time_equal(given, self._token), constant_time_equal(as_utf8, self._token)])
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
        except CookieError:
            return False
        return cookie is not None and constant_time_equal(cookie.value, cookie_value(self._token))


def is_own_host(host: str) -> bool:
    """Whether a Host header is a loopback name, which no other site's page can send."""
    return bool(_OWN_HOST.fullmatch(host))


def is_foreign(headers: Mapping[str, str], path: str) -> bool:
    """Whether another site's page caused this request; such a page may only link to ours.

    Browsers say so in Sec-Fetch headers (https://www.w3.org/TR/fetch-metadata/); other clients send none.
    """
    if headers.get("sec-fetch-site", "none") in ("same-origin", "none"):
        return False
    return path != "/" or headers.get("sec-fetch-mode") != "navigate"


def constant_time_equal(given: str, wanted: str) -> bool:
    """Compare two texts in a time that does not depend on where they differ."""
    return hmac.compare_digest(*(hashlib.sha256(each.encode(errors="replace")).digest() for each in (given, wanted)))


def cookie_value(token: str) -> str:
    """The cookie of an authorised browser: proves knowledge of the token without holding it."""
    return hmac.new(token.encode(errors="replace"), b"dreamfleet dashboard", hashlib.sha256).hexdigest()
