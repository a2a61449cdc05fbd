"""Latency of the service under load on this machine, and its answers to malformed requests.

python -m benchmarks.serving
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
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from benchmarks.malformed_requests import HttpRequest, malformed_requests
from benchmarks.programs import semsplat, start_semsplat_server
from benchmarks.recordings import sequence_arguments
from benchmarks.report import WORK, publish
from benchmarks.results_file import RESULTS, Results, current_header
from benchmarks.tables import Table

DESCRIPTION = """\
`semsplat serve` in a process of its own, with a run over frames of the synthetic room at 320x240.
Clients are threads of the benchmark with one connection each; each sends its next request when
the last one has been answered. The order of the requests is random. Renders are computed one after
another, so that the latency of a render contains that of the renders before it. The first query
for objects, which computes them, is sent before the measurement and stands below the table.

Malformed requests: paths outside the service, wrong methods, broken JSON, numbers that are none,
matrices that are no rotation, wrong sizes, large bodies, wrong parameters."""

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
    malformed: int = 100
    """Number of malformed requests."""
    frames: int = 60
    """Frames of the run."""
    seed: int = 0
    """Seed of the order of the requests and of the malformed ones."""
    run: Path | None = None
    """A finished run with labels to serve instead."""
    out: Path = RESULTS
    """Folder of the results file."""


@dataclass(frozen=True)
class _Answer:
    """Status and latency of a request; status 0 if the connection ended."""

    endpoint: str
    status: int
    latency_ms: float


def main() -> int:
    """Measure; exit with 1 if the service crashed or answered with a server's error."""
    options = tyro.cli(Options)
    header = current_header(
        [options.seed], ("toolkit/tools/serving", "toolkit/splatting/rendering")
    )
    generator = random.Random(options.seed)
    service, port = _started(options.run or _run(options.frames))
    try:
        keyframes = _keyframes(port)
        first_ms = _ask(_connection(port), "objects", HttpRequest("GET", "/objects")).latency_ms
        begin = time.perf_counter()
        requests = _well_formed(options.requests, keyframes, generator)
        answers = _load(port, requests[: options.requests // 5], options.clients)
        memory_mb = [_memory_mb(service)]
        answers += _load(port, requests[options.requests // 5 :], options.clients)
        elapsed_s = time.perf_counter() - begin
        malformed = [
            _ask(_connection(port), "malformed", request)
            for request in malformed_requests(options.malformed, generator)
        ]
        memory_mb.append(_memory_mb(service))
        alive = (
            service.poll() is None
            and _ask(_connection(port), "run", HttpRequest("GET", "/run")).status == 200
        )
    finally:
        service.terminate()
        _, errors = service.communicate()
    rate = options.requests / elapsed_s
    note = (
        f"{options.requests} requests of {options.clients} clients in {elapsed_s:.1f} s: "
        f"{rate:.0f} per second. Objects, first request: {first_ms:.0f} ms. Memory of the service: "
        f"{memory_mb[0]:.0f} MB after a fifth of the requests, {memory_mb[1]:.0f} MB after all."
    )
    tracebacks = errors.count("Traceback")
    tables = (_latencies(answers, note), _statuses(malformed, alive, tracebacks))
    publish(Results("serving", "Service", DESCRIPTION, header, tables), options.out)
    served = all(answer.status == 200 for answer in answers)
    rejected = all(400 <= answer.status < 500 for answer in malformed)
    return 0 if served and rejected and alive and not tracebacks else 1


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


def _well_formed(
    count: int, keyframes: int, generator: random.Random
) -> list[tuple[str, HttpRequest]]:
    weights = [weight for weight, _, _ in _ENDPOINTS.values()]
    requests = []
    for name in generator.choices(list(_ENDPOINTS), weights, k=count):
        _, path, body = _ENDPOINTS[name]
        path = path.format(keyframe=generator.randrange(keyframes))
        headers = {"content-type": "application/json"} if body else {}
        requests.append((name, HttpRequest("POST" if body else "GET", path, body, headers)))
    return requests


def _load(port: int, requests: Sequence[tuple[str, HttpRequest]], clients: int) -> list[_Answer]:
    """Send requests from several clients, each with a connection of its own."""
    connections = threading.local()

    def ask(request: tuple[str, HttpRequest]) -> _Answer:
        if not hasattr(connections, "own"):
            connections.own = _connection(port)
        return _ask(connections.own, *request)

    with ThreadPoolExecutor(clients) as pool:
        return list(pool.map(ask, requests))


def _ask(connection: http.client.HTTPConnection, endpoint: str, request: HttpRequest) -> _Answer:
    begin = time.perf_counter()
    try:
        connection.request(request.method, request.path, request.body or None, request.headers)
        response = connection.getresponse()
        response.read()
        status = response.status
    except (OSError, http.client.HTTPException):
        connection.close()
        status = 0
    return _Answer(endpoint, status, 1e3 * (time.perf_counter() - begin))


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
        "endpoint",
        "requests",
        "median ms",
        "p90 ms",
        "p95 ms",
        "p99 ms",
        "max ms",
        "failed",
    )
    return Table(columns, tuple(rows), note=note)


def _statuses(answers: Sequence[_Answer], alive: bool, tracebacks: int) -> Table:
    counts = Counter(answer.status for answer in answers)
    rows = [(str(status or "no answer"), str(count)) for status, count in sorted(counts.items())]
    state = "answers" if alive else "**does not answer**"
    note = f"Afterwards, the service {state}; tracebacks in its log: {tracebacks}."
    return Table(("status", "requests"), tuple(rows), "Malformed requests", note)


if __name__ == "__main__":
    sys.exit(main())
