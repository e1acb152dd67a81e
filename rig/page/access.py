"""Who may ask for what: tokens, hosts, origins, and the headers of every answer. Rules only.

A page of another site, open in the same browser, can send requests to this computer. So every
request has to carry the token in a header, which such a page can neither know nor send; the Host
has to be this computer's own, so that a foreign name that resolves to it is refused; and where the
browser states an Origin it has to be this server's own.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Right = Literal["watch", "stop"]
HOSTS = frozenset({"127.0.0.1", "localhost", "[::1]"})
"""Host names under which the server may be addressed; the port may be that of a tunnel."""

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Headers of every answer: no foreign content, no framing, nothing kept by a proxy."""


class AccessRefusedError(Exception):
    """Raised for a request that is refused: the status and a reason."""

    def __init__(self, status: int, reason: str):
        super().__init__(reason)
        self.status, self.reason = status, reason


@dataclass(frozen=True)
class Access:
    """The tokens of one server."""

    read_only: bool = False
    """True if no one may stop anything, whatever the token."""
    watch_token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    stop_token: str = field(default_factory=lambda: secrets.token_urlsafe(24))

    def right(self, authorization: str) -> Right | None:
        """Return what the value of an Authorization header allows, None for nothing."""
        kind, _, token = authorization.partition(" ")
        if kind != "Bearer":
            return None
        given = token.encode("utf-8", "replace")
        if not self.read_only and secrets.compare_digest(given, self.stop_token.encode()):
            return "stop"
        if secrets.compare_digest(given, self.watch_token.encode()):
            return "watch"
        return None

    def check(self, method: str, path: str, headers: Mapping[str, str]) -> Right | None:
        """Return the right of a request; None for the page itself, which holds no data.

        `headers` has lower-case names. Raises AccessRefusedError.
        """
        host = headers.get("host", "")
        if host_name(host) not in HOSTS:
            raise AccessRefusedError(403, "this server is addressed as 127.0.0.1 or localhost only")
        origin = headers.get("origin")
        if origin is not None and origin != f"http://{host}":
            raise AccessRefusedError(403, "the request comes from another site")
        # The page itself may be opened from a link elsewhere: it shows nothing without the token.
        foreign = headers.get("sec-fetch-site", "none") not in ("none", "same-origin")
        if foreign and path.startswith("/api/"):
            raise AccessRefusedError(403, "the request comes from another site")
        if not path.startswith("/api/"):
            if method not in ("GET", "HEAD"):
                raise AccessRefusedError(405, "the page is only read")
            return None
        right = self.right(headers.get("authorization", ""))
        if right is None:
            raise AccessRefusedError(401, "the token is missing or wrong; use the printed address")
        return right


def host_name(host: str) -> str:
    """Return the name of a Host header, without its port."""
    name, colon, port = host.rpartition(":")
    return name if colon and port.isdigit() else host
