"""A chat-completions endpoint on this machine that misbehaves as real ones do."""

from __future__ import annotations

import contextlib
import json
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Groups = dict[str, list[str]]
KEY = "sk-a-very-secret-key"


@dataclass(frozen=True)
class Response:
    """What the server sends: `text` as the model's message, or `body` as it is."""

    text: str | None = None
    body: str = ""
    status: int = 200
    headers: Mapping[str, str] = field(default_factory=dict)
    delay_s: float = 0.0
    trickle_s: float = 0.0  # between the bytes of the body
    dropped: bool = False  # before a status, or after half of the body where there is one
    finish: str = "stop"
    refusal: str | None = None


# From a request's body to the response.
Behaviour = Callable[[dict[str, Any]], Response]


class FakeEndpoint:
    """Serves one behaviour after the other; the last one goes on.

    Attributes:
        requests: the bodies of all requests. headers: of the last one.
    """

    def __init__(self) -> None:
        self.behaviours: list[Behaviour] = [honest]
        self.requests: list[dict[str, Any]] = []
        self.headers: Mapping[str, str] = {}
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self._server.daemon_threads = True

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_address[1]}/v1"

    def serve(self) -> None:
        self._server.serve_forever(poll_interval=0.01)

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def _respond(self, request: dict[str, Any]) -> Response:
        self.requests.append(request)
        place = min(len(self.requests), len(self.behaviours)) - 1
        return self.behaviours[place](request)

    def _handler(fake: FakeEndpoint) -> type[BaseHTTPRequestHandler]:  # noqa: N805
        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                fake.headers = {n.lower(): v for n, v in self.headers.items()}
                if self.path != "/v1/chat/completions":
                    self.send_error(404)
                    return
                length = int(self.headers["Content-Length"])
                response = fake._respond(json.loads(self.rfile.read(length)))
                time.sleep(response.delay_s)
                if response.dropped and response.text is None:
                    return
                with contextlib.suppress(OSError):  # whoever asked did not wait
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


def items_of(request: dict[str, Any]) -> list[str]:
    """The items, or of clusters their numbers, that a request lists."""
    lines = request["messages"][1]["content"].splitlines()
    listed = (re.fullmatch(r"\d+\. (\".*\")", line) for line in lines)
    return [json.loads(found[1]) for found in listed if found]


def right_groups(request: dict[str, Any]) -> Groups:
    """A sensible answer: by the names that are given, or by the length of the name."""
    content = request["messages"][1]["content"]
    given = re.search(r"no other names for groups than (\[.*\])\.", content)
    names = json.loads(given[1]) if given else ["short things", "long things"]
    groups: Groups = {name: [] for name in names}
    for item in items_of(request):
        groups[names[len(item) % len(names)]].append(item)
    return groups


def as_text(groups: Groups) -> str:
    listed = [{"name": name, "items": items} for name, items in groups.items()]
    return json.dumps({"groups": listed})


def honest(request: dict[str, Any]) -> Response:
    """Sorts, or names clusters, as it was asked to."""
    content = request["messages"][1]["content"]
    if "\nGroups:\n" in f"\n{content}":
        count = len(re.findall(r"^\d+\. \[", content, re.MULTILINE))
        named = [{"number": n, "name": f"shape {'abcdefgh'[n - 1]}"} for n in range(1, count + 1)]
        return Response(json.dumps({"groups": named}))
    return Response(as_text(right_groups(request)))


def changed(change: Callable[[Groups], Groups]) -> Behaviour:
    """An honest answer with something done to its groups."""

    def behave(request: dict[str, Any]) -> Response:
        return Response(as_text(change(right_groups(request))))

    return behave


def says(text: str) -> Behaviour:
    """The same words, whatever the question."""
    return lambda request: Response(text)


def fails(status: int, message: str = "try later", **headers: str) -> Behaviour:
    """An error, in the form that OpenAI gives it."""
    body = json.dumps({"error": {"message": message, "type": "error", "code": None}})
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return lambda request: Response(body=body, status=status, headers=named)


def knows_no(*parameters: str) -> Behaviour:
    """Refuses requests that hold a parameter."""

    def behave(request: dict[str, Any]) -> Response:
        for parameter in parameters:
            name, _, value = parameter.partition("=")
            sent = request.get(name)
            if sent is not None and (not value or sent.get("type") == value):
                return fails(400, f"Unsupported parameter: '{name}'")(request)
        return honest(request)

    return behave
