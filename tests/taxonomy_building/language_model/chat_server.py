"""A server on this machine that speaks the OpenAI chat completions protocol, for tests."""

from __future__ import annotations

import contextlib
import json
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Groups = dict[str, list[str]]


@dataclass(frozen=True)
class Response:
    """A response to one request.

    Attributes:
        text: message of the model; None to send `body` unchanged.
        body: body of the response.
        status: HTTP status.
        headers: additional headers.
        delay_s: time before the status line, seconds.
        trickle_s: time between the bytes of the body, seconds.
        dropped: close the connection before the status line, or after half of the body if there
            is a text.
        finish: reason why the model stopped.
        refusal: refusal of the model.
    """

    text: str | None = None
    body: str = ""
    status: int = 200
    headers: Mapping[str, str] = field(default_factory=dict)
    delay_s: float = 0.0
    trickle_s: float = 0.0
    dropped: bool = False
    finish: str = "stop"
    refusal: str | None = None


# From the body of a request to the response.
Behaviour = Callable[[dict[str, Any]], Response]


class ChatServer:
    """Serves one behaviour after the other on a free port; the last one continues.

    Attributes:
        behaviours: of the first request, the second, ...
        requests: bodies of all requests.
        headers: of the last request, with names in lower case.
    """

    def __init__(self, *behaviours: Behaviour) -> None:
        self.behaviours: list[Behaviour] = list(behaviours)
        self.requests: list[dict[str, Any]] = []
        self.headers: Mapping[str, str] = {}
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self._server.daemon_threads = True

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_address[1]}/v1"

    @contextlib.contextmanager
    def serving(self) -> Iterator[ChatServer]:
        """Serve within this context."""
        thread = threading.Thread(target=self._server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield self
        finally:
            self._server.shutdown()
            self._server.server_close()
            thread.join()

    def _respond(self, request: dict[str, Any]) -> Response:
        self.requests.append(request)
        place = min(len(self.requests), len(self.behaviours)) - 1
        return self.behaviours[place](request)

    def _handler(server: ChatServer) -> type[BaseHTTPRequestHandler]:  # noqa: N805
        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                server.headers = {n.lower(): v for n, v in self.headers.items()}
                if self.path != "/v1/chat/completions":
                    self.send_error(404)
                    return
                length = int(self.headers["Content-Length"])
                response = server._respond(json.loads(self.rfile.read(length)))
                time.sleep(response.delay_s)
                if response.dropped and response.text is None:
                    return
                with contextlib.suppress(OSError):  # the client timed out
                    self._send(response)

            def _send(self, response: Response) -> None:
                body = (response.body if response.text is None else _completion(response)).encode()
                self.send_response(response.status)
                for name, value in response.headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                if response.trickle_s:
                    for byte in body:
                        self.wfile.write(bytes([byte]))
                        time.sleep(response.trickle_s)
                else:
                    self.wfile.write(body[: len(body) // 2] if response.dropped else body)

            def log_message(self, *_: object) -> None:
                pass

        return Handler


def _completion(response: Response) -> str:
    message = {"role": "assistant", "content": response.text, "refusal": response.refusal}
    choice = {"index": 0, "message": message, "finish_reason": response.finish}
    return json.dumps({"id": "1", "object": "chat.completion", "choices": [choice]})


def fails(status: int, message: str = "try later", **headers: str) -> Behaviour:
    """An error, in the form of OpenAI."""
    body = json.dumps({"error": {"message": message, "type": "error", "code": None}})
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return lambda _: Response(body=body, status=status, headers=named)


def items_of(request: dict[str, Any]) -> list[str]:
    """Return the items that a request lists; empty if it lists clusters."""
    lines = request["messages"][1]["content"].splitlines()
    listed = (re.fullmatch(r"\d+\. (\".*\")", line) for line in lines)
    return [json.loads(found[1]) for found in listed if found]


def clusters_of(request: dict[str, Any]) -> list[list[str]]:
    """Return the clusters that a request lists, with the items that are shown."""
    lines = request["messages"][1]["content"].splitlines()
    listed = (re.fullmatch(r"\d+\. (\[.*\])( and \d+ more)?", line) for line in lines)
    return [json.loads(found[1]) for found in listed if found]


def as_text(groups: Mapping[str, list[str]]) -> str:
    """Return groups in the requested form."""
    listed = [{"name": name, "items": items} for name, items in groups.items()]
    return json.dumps({"groups": listed})
