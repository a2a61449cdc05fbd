"""Latency of the service under load on this machine.

python -m benchmarks.serving.service
"""

from __future__ import annotations

import http.client
import json
import os
import random
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from benchmarks.shared.programs import semsplat, start_semsplat_server
from benchmarks.shared.recordings import sequence_arguments
from benchmarks.shared.results_file import RESULTS, Results, current_header
from benchmarks.shared.runner import WORK, publish
from benchmarks.shared.tables import Table

DESCRIPTION = """\
`semsplat serve` in a process of its own, with a run over frames of the synthetic room at 320x240.
Clients are threads of the benchmark with one connection each; each sends its next request when
the last one has been answered. The order of the requests is random. Renders are computed one after
another, so that the latency of a render contains that of the renders before it. The first query
for objects, which computes them, is sent before the measurement and stands below the table."""

# Endpoint: weight, path, body of a POST.
_ENDPOINTS: dict[str, tuple[int, str, bytes]] = {
    "run": (10, "/run", b""),
    "poses": (10, "/poses?count=100", b""),
    "metrics": (5, "/metrics", b""),
    "query": (15, "/query?name=chair", b""),
    "objects": (5, "/objects", b""),
    "keyframe, colour, 320x240": (15, "/keyframes/{keyframe}.png", b""),
    "keyframe, classes, 320x240": (10, "/keyframes/{keyframe}.png?what=classes", b""),
    "render, colour, 640x480": (
        20,
        "/render",
        b'{"translation_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1],'
        b' "width": 640, "height": 480}',
    ),
    "render, depth, 320x240": (
        10,
        "/render",
        b'{"translation_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1], "what": "depth"}',
    ),
}
_TIMEOUT_S = 120.0


@dataclass(frozen=True)
class Options:
    """Load of the service."""

    requests: int = 1000
    """Number of well-formed requests of all clients."""
    clients: int = 16
    """Number of clients."""
    frames: int = 60
    """Frames of the run."""
    seed: int = 0
    """Seed of the order of the requests."""
    run: Path | None = None
    """A finished run with labels to serve instead."""
    out: Path = RESULTS
    """Folder of the results file."""


@dataclass(frozen=True)
class _Request:
    """A request for an endpoint; a POST if it has a body."""

    endpoint: str
    path: str
    body: bytes = b""


@dataclass(frozen=True)
class _Answer:
    """Status and latency of a request; status 0 if the connection ended."""

    endpoint: str
    status: int
    latency_ms: float


def main() -> int:
    """Measure; exit with 1 if a request failed."""
    options = tyro.cli(Options)
    header = current_header(
        [options.seed], ("toolkit/tools/serving", "toolkit/splatting/rendering")
    )
    generator = random.Random(options.seed)
    service, port = _started(options.run or _run(options.frames))
    try:
        keyframes = _keyframes(port)
        first_ms = _ask(_connection(port), _Request("objects", "/objects")).latency_ms
        begin = time.perf_counter()
        requests = _requests(options.requests, keyframes, generator)
        answers = _load(port, requests[: options.requests // 5], options.clients)
        memory_mb = [_memory_mb(service)]
        answers += _load(port, requests[options.requests // 5 :], options.clients)
        elapsed_s = time.perf_counter() - begin
        memory_mb.append(_memory_mb(service))
    finally:
        service.terminate()
        _, errors = service.communicate()
    rate = options.requests / elapsed_s
    note = (
        f"{options.requests} requests of {options.clients} clients in {elapsed_s:.1f} s: "
        f"{rate:.0f} per second. Objects, first request: {first_ms:.0f} ms. Memory of the service: "
        f"{memory_mb[0]:.0f} MB after a fifth of the requests, {memory_mb[1]:.0f} MB after all."
    )
    tables = (_latencies(answers, note),)
    publish(Results("serving", "Service", DESCRIPTION, header, tables), options.out)
    served = all(answer.status == 200 for answer in answers)
    return 0 if served and "Traceback" not in errors else 1


def _run(frames: int) -> Path:
    """Return the folder of a run over the synthetic room, made when it is first needed."""
    out = WORK / f"serving-{frames}"
    if not (out / "report.html").is_file():
        arguments = [*sequence_arguments("room"), "--max-frames", str(frames)]
        semsplat("run", *arguments, "--out", str(out))
    return out


def _started(run: Path) -> tuple[subprocess.Popen[str], int]:
    service, url = start_semsplat_server("serve", str(run), "--port", "0")
    return service, int(url.rpartition(":")[2])


def _memory_mb(service: subprocess.Popen[str]) -> float:
    """Resident memory of the service; NaN where the system does not tell."""
    state = Path(f"/proc/{service.pid}/statm")
    pages = int(state.read_text("utf-8").split()[1]) if state.exists() else float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _connection(port: int) -> http.client.HTTPConnection:
    return http.client.HTTPConnection("127.0.0.1", port, timeout=_TIMEOUT_S)


def _keyframes(port: int) -> int:
    connection = _connection(port)
    connection.request("GET", "/keyframes?count=1")
    return int(json.loads(connection.getresponse().read())["total"])


def _requests(count: int, keyframes: int, generator: random.Random) -> list[_Request]:
    weights = [weight for weight, _, _ in _ENDPOINTS.values()]
    requests = []
    for name in generator.choices(list(_ENDPOINTS), weights, k=count):
        _, path, body = _ENDPOINTS[name]
        path = path.format(keyframe=generator.randrange(keyframes))
        requests.append(_Request(name, path, body))
    return requests


def _load(port: int, requests: Sequence[_Request], clients: int) -> list[_Answer]:
    """Send requests from several clients, each with a connection of its own."""
    connections = threading.local()

    def ask(request: _Request) -> _Answer:
        if not hasattr(connections, "own"):
            connections.own = _connection(port)
        return _ask(connections.own, request)

    with ThreadPoolExecutor(clients) as pool:
        return list(pool.map(ask, requests))


def _ask(connection: http.client.HTTPConnection, request: _Request) -> _Answer:
    method = "POST" if request.body else "GET"
    headers = {"content-type": "application/json"} if request.body else {}
    begin = time.perf_counter()
    try:
        connection.request(method, request.path, request.body or None, headers)
        response = connection.getresponse()
        response.read()
        status = response.status
    except (OSError, http.client.HTTPException):
        connection.close()
        status = 0
    return _Answer(request.endpoint, status, 1e3 * (time.perf_counter() - begin))


def _latencies(answers: Sequence[_Answer], note: str) -> Table:
    rows = []
    for name in [*_ENDPOINTS, "all"]:
        chosen = [a for a in answers if name in (a.endpoint, "all")]
        if not chosen:
            continue
        values = np.percentile([a.latency_ms for a in chosen], (50, 90, 95, 99, 100))
        failed = sum(a.status != 200 for a in chosen)
        rows.append((name, str(len(chosen)), *(f"{v:.1f}" for v in values), str(failed)))
    columns = (
        *("endpoint", "requests", "median ms", "p90 ms", "p95 ms", "p99 ms", "max ms", "failed"),
    )
    return Table(columns, tuple(rows), note=note)


if __name__ == "__main__":
    sys.exit(main())
