"""ASGI middleware that every request passes: host, rate, token, size of the body, errors.

Answers are JSON objects with the key `detail`, like those of FastAPI.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import json
import logging
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from toolkit.serving.admission import RateLimit
from toolkit.serving.options import ServiceLimits

_log = logging.getLogger(__name__)

Message = MutableMapping[str, Any]
Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

# The pages of the service load nothing, and no other page may embed them.
_HEADERS = (
    (b"cache-control", b"no-store"),
    (b"content-security-policy", b"default-src 'none'; style-src 'unsafe-inline'"),
    (b"x-content-type-options", b"nosniff"),
)


def is_local(host: str) -> bool:
    """Return whether only this machine can reach an address. Other names are not looked up."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class _RejectedError(Exception):
    """The request is answered without the application."""

    def __init__(self, status: int, detail: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status, self.detail, self.headers = status, detail, headers or {}


class Protection:
    """Admits requests to an ASGI application.

    Args:
        application: the application.
        limits: limits of size, rate and time.
        token: required in the header `Authorization: Bearer TOKEN`; None admits everybody who uses
            a name of this machine. Names that others have pointed at it are rejected then, because
            a web page could otherwise read the answers through such a name (DNS rebinding).
    """

    def __init__(self, application: Application, limits: ServiceLimits, token: str | None) -> None:
        self._application, self._limits = application, limits
        self._token = None if token is None else token.encode()
        self._rate = RateLimit(limits.requests_per_s, limits.burst)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] != "http":
            return
        started = False

        async def sending(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                message = {**message, "headers": [*message.get("headers", ()), *_HEADERS]}
            await send(message)

        try:
            headers = dict(scope["headers"])
            self._check(scope, headers)
            body = await self._body(receive, headers)
            await self._application(scope, _replayed(body, receive), sending)
        except _RejectedError as error:
            await _answer(sending, error)
        except Exception as error:  # noqa: BLE001 - the service goes on
            # An error in this program: the client learns nothing about it, the log does.
            _log.error("Cannot answer %s %r: %r.", scope["method"], scope["path"], error)
            _log.debug("Traceback of the error:", exc_info=True)
            if not started:
                await _answer(sending, _RejectedError(500, "internal error; see the server's log"))

    def _check(self, scope: Scope, headers: dict[bytes, bytes]) -> None:
        """Check client, host and token, before the body is received."""
        client = scope.get("client")
        wait_s = self._rate.wait_s(client[0] if client else "")
        if wait_s:
            raise _RejectedError(
                429,
                f"too many requests; the limit is {self._limits.requests_per_s:g} per second",
                {"retry-after": str(wait_s)},
            )
        if self._token is None:
            host = headers.get(b"host", b"").decode("latin-1").lower()
            if not is_local(_without_port(host).strip("[]")):
                raise _RejectedError(400, "the header Host must be localhost or 127.0.0.1")
        elif not self._authorised(headers.get(b"authorization", b"")):
            raise _RejectedError(
                401,
                "a token is required: Authorization: Bearer TOKEN",
                {"www-authenticate": "Bearer"},
            )

    def _authorised(self, header: bytes) -> bool:
        assert self._token is not None
        scheme, _, given = header.partition(b" ")
        # Compared in constant time, so that response times do not reveal a part of the token.
        same = hmac.compare_digest(given.strip(), self._token)
        return same and scheme.lower() == b"bearer"

    async def _body(self, receive: Receive, headers: dict[bytes, bytes]) -> bytes:
        """Receive the body within its limits of size and time."""
        limit = self._limits.max_body_bytes
        too_large = _RejectedError(413, f"the body is larger than {limit} bytes")
        length = headers.get(b"content-length", b"0")
        if length.isdigit() and (len(length) > 18 or int(length) > limit):
            raise too_large
        body = bytearray()
        try:
            async with asyncio.timeout(self._limits.body_timeout_s):
                while True:
                    message = await receive()
                    if message["type"] == "http.disconnect":
                        raise _RejectedError(400, "the client disconnected")
                    body += message.get("body", b"")
                    if len(body) > limit:
                        raise too_large
                    if not message.get("more_body", False):
                        return bytes(body)
        except TimeoutError:
            raise _RejectedError(408, "the body was not received in time") from None


def _without_port(host: str) -> str:
    """Return the name of a Host header, which may end in a port."""
    name, colon, port = host.rpartition(":")
    return name if colon and port.isdigit() else host


def _replayed(body: bytes, receive: Receive) -> Receive:
    """Return a `receive` that delivers a body, and then what follows it."""
    pending = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Message:
        return pending.pop() if pending else await receive()

    return replay


async def _answer(send: Send, error: _RejectedError) -> None:
    body = json.dumps({"detail": error.detail}).encode()
    headers = {
        "content-type": "application/json",
        "content-length": str(len(body)),
        **({"connection": "close"} if error.status in (408, 413) else {}),
        **error.headers,
    }
    encoded = [(name.encode(), value.encode("latin-1")) for name, value in headers.items()]
    await send({"type": "http.response.start", "status": error.status, "headers": encoded})
    await send({"type": "http.response.body", "body": body})
