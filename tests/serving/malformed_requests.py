"""Random malformed HTTP requests for the service; every one of them is a client's error."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from dataclasses import dataclass, field

_JSON = {"content-type": "application/json"}
_IDENTITY = {"translation_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}
_PATHS = ("/run", "/poses", "/keyframes", "/metrics", "/classes", "/query", "/objects")
_OUTSIDE = ("/etc/passwd", "/../../etc/passwd", "/%2e%2e/%2e%2e/config.yaml", "/..%5cmap.ply")


@dataclass(frozen=True)
class HttpRequest:
    """A request: method, path with parameters, body and headers."""

    method: str
    path: str
    body: bytes = b""
    headers: dict[str, str] = field(default_factory=dict)


def malformed_requests(count: int, generator: random.Random) -> list[HttpRequest]:
    """Return random requests, all kinds equally often."""
    return [_KINDS[number % len(_KINDS)](generator) for number in range(count)]


def _outside(generator: random.Random) -> HttpRequest:
    ups = "/.." * generator.randint(1, 9)
    return HttpRequest("GET", generator.choice([*_OUTSIDE, f"/keyframes{ups}/config.yaml"]))


def _wrong_method(generator: random.Random) -> HttpRequest:
    method = generator.choice(["DELETE", "PUT", "PATCH", "OPTIONS", "TRACE", "NONSENSE"])
    return HttpRequest(method, generator.choice(_PATHS))


def _not_json(generator: random.Random) -> HttpRequest:
    body = generator.choice(
        [
            generator.randbytes(generator.randint(1, 4000)),
            b"[" * generator.randint(1, 15_000),
            b'{"keyframe": ' + b"9" * generator.randint(20, 9_000) + b"}",
            b'{"keyframe": 0' + b" " * generator.randint(0, 50),
            b"\x00",
        ]
    )
    return HttpRequest("POST", "/render", body, _JSON)


def _not_a_pose(generator: random.Random) -> HttpRequest:
    bad = generator.choice(["NaN", "Infinity", "-Infinity", "1e999", '"0"x', "null", "[]", "1e12"])
    position = generator.randrange(3)
    numbers = ", ".join(bad if i == position else "0" for i in range(3))
    text = f'{{"translation_m": [{numbers}], "quaternion_xyzw": [0, 0, 0, 1]}}'
    return HttpRequest("POST", "/render", text.encode(), _JSON)


def _not_a_rotation(generator: random.Random) -> HttpRequest:
    rows = [[generator.uniform(-9, 9) for _ in range(4)] for _ in range(4)]
    body = generator.choice(
        [
            {"T_map_camera": rows},
            {"T_map_camera": rows[: generator.randint(0, 3)]},
            {**_IDENTITY, "quaternion_xyzw": [0, 0, 0, 0]},
        ]
    )
    return HttpRequest("POST", "/render", json.dumps(body).encode(), _JSON)


def _wrong_size(generator: random.Random) -> HttpRequest:
    size = generator.choice([0, -1, 10**5, 10**18, 8192])
    body = {**_IDENTITY, "width": size, "height": size}
    return HttpRequest("POST", "/render", json.dumps(body).encode(), _JSON)


def _too_large(generator: random.Random) -> HttpRequest:
    return HttpRequest("POST", "/render", b" " * generator.randint(20_000, 200_000), _JSON)


def _wrong_parameter(generator: random.Random) -> HttpRequest:
    return HttpRequest(
        "GET",
        generator.choice(
            [
                f"/keyframes/{'9' * generator.randint(7, 60)}.png",
                "/keyframes/-1.png",
                "/keyframes/%00.png",
                "/keyframes/0.png?what=everything",
                "/keyframes/0.png?width=nan&height=nan",
                "/poses?first=-1",
                f"/poses?count={'9' * generator.randint(6, 5000)}",
                "/query",
                f"/query?name={'x' * generator.randint(1, 5000)}",
                "/query?name=%F0%9F%92%A5&link_m=inf",
                f"/{'a' * generator.randint(1, 10_000)}",
            ]
        ),
    )


_KINDS: tuple[Callable[[random.Random], HttpRequest], ...] = (
    _outside,
    _wrong_method,
    _not_json,
    _not_a_pose,
    _not_a_rotation,
    _wrong_size,
    _too_large,
    _wrong_parameter,
)
