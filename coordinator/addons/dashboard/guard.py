"""Access control of the page: it is only looked at, by a token if there is one."""

import hashlib
import hmac
from html import escape

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import Scope

from dreamfleet.coordinator.addons.dashboard.assets import FOLDER
from dreamfleet.coordinator.addons.web.guard import Guard, constant_time_equal

COOKIE = "dreamfleet"
# Only this server's own scripts run. plotly sets styles on its elements, which is harmless.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "cache-control": "no-store",
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "x-frame-options": "DENY",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}
LOGIN_PAGE = (FOLDER / "login.html").read_text(encoding="utf-8")


class PageGuard(Guard):
    """Passes on GET requests, with the token if there is one: in a header, or as a cookie, which a page asks for."""

    headers = HEADERS

    def refuse(self, status: int, _kind: str, text: str) -> Response:
        """The reason as a line of text."""
        return PlainTextResponse(f"{text}\n", status)

    def is_link(self, scope: Scope, headers: Headers) -> bool:
        """Another site's page may link to ours, and to nothing else."""
        return bool(scope["path"] == "/") and headers.get("sec-fetch-mode") == "navigate"

    def check(self, scope: Scope, headers: Headers) -> Response | None:
        """Refuse what is no GET or lacks the token; who gives it in the address gets a cookie."""
        if scope["method"] not in ("GET", "HEAD"):
            return PlainTextResponse("this page is only looked at: GET\n", 405, {"allow": "GET, HEAD"})
        if not self.tokens:
            return None
        (token,) = self.tokens
        given, cookie = Request(scope).query_params.get("token"), Request(scope).cookies.get(COOKIE, "")
        if given is not None and constant_time_equal(given, token):
            answer = RedirectResponse("/", 303)  # without the token, which an address bar would show
            answer.set_cookie(COOKIE, cookie_value(token), httponly=True, samesite="lax", path="/")
            return answer
        if self.bears_token(headers) or constant_time_equal(cookie, cookie_value(token)):
            return None
        text = "This is not the token." if given is not None else "Who looks at these runs must know their token."
        challenge = {"www-authenticate": 'Bearer realm="dreamfleet"'}
        return HTMLResponse(LOGIN_PAGE.replace("$text", escape(text)), 401, challenge)


def cookie_value(token: str) -> str:
    """The cookie of an authorised browser: proves knowledge of the token without holding it."""
    return hmac.new(token.encode(errors="replace"), b"dreamfleet dashboard", hashlib.sha256).hexdigest()
