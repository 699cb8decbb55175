"""HTTP for the page in the browser, bytes to bytes: who may ask, and what is answered. The sockets are the gateway's.

Only GET and HEAD of a few files and of one stream. A request must name this machine as its Host: a page of somebody else,
whose name has been pointed at this address (DNS rebinding), names itself there. One of a foreign Origin is refused as well.
"""

from __future__ import annotations

import ipaddress
import re
import socket
from http import HTTPStatus
from http.client import HTTPException, parse_headers
from io import BytesIO
from pathlib import Path
from typing import Final, NamedTuple

_PAGE: Final = Path(__file__).with_name("page")
_FILES: Final = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/uplot/uPlot.min.css": ("uplot/uPlot.min.css", "text/css; charset=utf-8"),
    "/uplot/uPlot.iife.min.js": ("uplot/uPlot.iife.min.js", "text/javascript; charset=utf-8"),
    "/uplot/LICENSE": ("uplot/LICENSE", "text/plain; charset=utf-8"),
}
STREAM: Final = "/events"
_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_ALWAYS: Final = {
    "Cache-Control": "no-cache",
    "Connection": "close",
    "Content-Security-Policy": _POLICY,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
_END: Final = b"\r\n\r\n"
_PROTOCOL: Final = "sec-websocket-protocol"


class Request(NamedTuple):
    """Head of a request: method, path without query, and its headers, each value of a name in order."""

    method: str
    path: str
    headers: dict[str, list[str]]

    @property
    def protocols(self) -> list[str]:
        """Return the websocket subprotocols that it offers; none where it asks for no websocket."""
        asks = self.method == "GET" and "websocket" in map(str.lower, self.headers.get("upgrade", []))
        values = self.headers.get(_PROTOCOL, []) if asks else []
        return [each.strip() for value in values for each in value.split(",")]


def request_of(head: bytes) -> Request:
    """Return the request of a head that ends with an empty line. Raises ValueError for what is no HTTP/1 request."""
    line, _, rest = head.partition(b"\r\n")
    found = re.fullmatch(rb"([A-Z]+) (/[^ ?#]*)[^ ]* HTTP/1\.[01]", line)
    if found is None:
        raise ValueError(f"found {line[:80]!r}, expected a request of HTTP/1")
    try:
        fields = parse_headers(BytesIO(rest))
    except HTTPException as error:
        raise ValueError(str(error)) from None
    headers: dict[str, list[str]] = {}
    for name, value in fields.items():
        headers.setdefault(name.lower(), []).append(value)
    return Request(found[1].decode(), found[2].decode("latin-1"), headers)


def local_names(host: str) -> frozenset[str]:
    """Return the names by which a request may address a server that listens at `host`; any IP address may."""
    name = socket.gethostname().lower()
    return frozenset(("localhost", host.lower(), name, f"{name}.local"))


def obstacle(request: Request, names: frozenset[str]) -> str:
    """Return why a request is refused, by its Host and Origin; "" where it may pass.

    A websocket may have any Origin: viewers in a browser are pages of their own.
    """
    hosts, origins = request.headers.get("host", []), request.headers.get("origin", [])
    if len(hosts) != 1 or not _is_local(hosts[0], names):
        return (
            f"Host {', '.join(hosts)[:80]!r} is not a name of this machine; use its IP address or localhost"
        )
    if origins and not request.protocols and origins != [f"http://{hosts[0]}"]:
        return f"Origin {', '.join(origins)[:80]!r} is not this page"
    return ""


def _is_local(host: str, names: frozenset[str]) -> bool:
    found = re.fullmatch(r"(?:\[([0-9a-fA-F:.]+)\]|([\w.-]+))(?::\d{1,5})?", host)
    if found is None:
        return False
    name = found[1] or found[2]
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return name.lower() in names
    return True


def answer(request: Request, names: frozenset[str]) -> bytes | None:
    """Return the whole answer to a request without a websocket; None for the stream, which goes on behind `STREAM_HEAD`."""
    whole = _answer_to_get(request, names)
    if request.method != "HEAD":
        return whole
    return STREAM_HEAD if whole is None else whole[: whole.index(_END) + len(_END)]


def _answer_to_get(request: Request, names: frozenset[str]) -> bytes | None:
    if why := obstacle(request, names):
        return text_answer(HTTPStatus.FORBIDDEN, why)
    if request.method not in ("GET", "HEAD"):
        return text_answer(HTTPStatus.METHOD_NOT_ALLOWED, "read-only: GET and HEAD", {"Allow": "GET, HEAD"})
    if request.path == STREAM:
        return None
    if request.path not in _FILES:
        return text_answer(HTTPStatus.NOT_FOUND, f"nothing at {request.path[:80]!r}")
    name, kind = _FILES[request.path]
    body = (_PAGE / name).read_bytes()
    return _head(HTTPStatus.OK, {"Content-Type": kind, "Content-Length": str(len(body))}) + body


def text_answer(status: HTTPStatus, text: str, headers: dict[str, str] | None = None) -> bytes:
    """Return an answer with one line of text."""
    body = f"{text}\n".encode()
    kind = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
    return _head(status, kind | (headers or {})) + body


def _head(status: HTTPStatus, headers: dict[str, str]) -> bytes:
    lines = (f"HTTP/1.1 {status.value} {status.phrase}", *map(": ".join, (headers | _ALWAYS).items()))
    return "\r\n".join((*lines, "", "")).encode("latin-1")


STREAM_HEAD: Final = _head(HTTPStatus.OK, {"Content-Type": "text/event-stream"})
