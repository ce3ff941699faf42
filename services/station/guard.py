"""Who may see the page: host names, the token, the origin of a WebSocket, and the headers of every answer. Pure.

On the loopback address the Host header is checked, so that a web site that has its own name resolve to 127.0.0.1
(DNS rebinding) gets nothing; on every address the origin of a WebSocket must be the page's own.
"""

from __future__ import annotations

import hmac
from collections.abc import Mapping
from http.cookies import CookieError, SimpleCookie
from urllib.parse import urlsplit

COOKIE = "treedock_station"
_LOCAL_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})

HEADERS: Mapping[str, str] = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
    "cache-control": "no-store",
}


class Guard:
    """Judges requests by their headers. ``token`` empty: none is asked for."""

    def __init__(self, token: str, *, local: bool) -> None:
        self._token = token
        self._local = local

    def host_refusal(self, host: str) -> str:
        """Return why the Host header is not ours, empty when it is."""
        if not self._local or host_name(host) in _LOCAL_NAMES:
            return ""
        return "this page is served to this machine alone, under 127.0.0.1 or localhost"

    def origin_refusal(self, origin: str | None, host: str) -> str:
        """Return why a WebSocket's origin is not our page."""
        if origin is None:
            return "no Origin header: only the station's own page may connect"
        return "" if origin and urlsplit(origin).netloc == host else "the request comes from another site"

    def knows(self, token: str | None) -> bool:
        """Return whether ``token`` is the right one (compared in constant time), or none is asked for."""
        return not self._token or hmac.compare_digest((token or "").encode(), self._token.encode())

    def admits(self, cookie_header: str | None) -> bool:
        """Return whether the cookies hold the token."""
        return self.knows(cookie_of(cookie_header)) if self._token else True


def host_name(host: str) -> str:
    """Return the name of a Host header without its port."""
    return urlsplit(f"//{host}").hostname or "" if "@" not in host else ""


def cookie_of(header: str | None) -> str | None:
    """Return the station's cookie from a Cookie header."""
    try:
        found = SimpleCookie(header or "").get(COOKIE)
    except CookieError:
        return None
    return None if found is None else found.value
