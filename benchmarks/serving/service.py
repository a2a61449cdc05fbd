"""Latency of the service under load on this machine.

python -m benchmarks.serving.service
"""

from __future__ import annotations

import http.client
import json
import os
import random
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
_POSE = '"translation_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]'
# Endpoint: weight, path, body of a POST.
_ENDPOINTS: dict[str, tuple[int, str, str]] = {
    "run": (10, "/run", ""),
    "poses": (10, "/poses?count=100", ""),
    "metrics": (5, "/metrics", ""),
    "query": (15, "/query?name=chair", ""),
    "objects": (5, "/objects", ""),
    "keyframe, colour, 320x240": (15, "/keyframes/{keyframe}.png", ""),
    "keyframe, classes, 320x240": (10, "/keyframes/{keyframe}.png?what=classes", ""),
    "render, colour, 640x480": (20, "/render", f'{{{_POSE}, "width": 640, "height": 480}}'),
    "render, depth, 320x240": (10, "/render", f'{{{_POSE}, "what": "depth"}}'),
}
_COLUMNS = ("endpoint", "requests", "median ms", "p90 ms", "p95 ms", "p99 ms", "max ms", "failed")
_TIMEOUT_S = 120.0


@dataclass(frozen=True)
class Options:
    """Load of the service."""

    requests: int = 1000
    """Number of requests of all clients."""
    clients: int = 16
    """Number of clients."""
    frames: int = 60
    """Frames of the run."""
    seed: int = 0
    """Seed of the order of the requests."""
    out: Path = RESULTS
    """Folder of the results file."""


@dataclass(frozen=True)
class _Request:
    """A request for an endpoint; a POST if it has a body."""

    endpoint: str
    path: str
    body: str = ""


@dataclass(frozen=True)
class _Answer:
    """Status, latency and body of a request; status 0 if the connection ended."""

    endpoint: str
    status: int
    latency_ms: float
    body: bytes = b""


def main() -> int:
    """Measure; exit with 1 if a request failed."""
    options = tyro.cli(Options)
    measured = ("toolkit/tools/serving", "toolkit/splatting/rendering")
    header = current_header([options.seed], measured)
    service, url = start_semsplat_server("serve", str(_run(options.frames)), "--port", "0")
    port = int(url.rpartition(":")[2])
    try:
        keyframes = json.loads(_ask(port, _Request("", "/keyframes?count=1")).body)["total"]
        first_ms = _ask(port, _Request("objects", "/objects")).latency_ms
        requests = _requests(options, int(keyframes))
        begin = time.perf_counter()
        answers = _load(port, requests[: options.requests // 5], options.clients)
        memory_mb = [_memory_mb(service.pid)]
        answers += _load(port, requests[options.requests // 5 :], options.clients)
        elapsed_s = time.perf_counter() - begin
        memory_mb.append(_memory_mb(service.pid))
    finally:
        service.terminate()
        _, errors = service.communicate()
    note = (
        f"{options.requests} requests of {options.clients} clients in {elapsed_s:.1f} s: "
        f"{options.requests / elapsed_s:.0f} per second. Objects, first request: {first_ms:.0f} "
        f"ms. Memory of the service: {memory_mb[0]:.0f} MB after a fifth of the requests, "
        f"{memory_mb[1]:.0f} MB after all."
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


def _memory_mb(process: int) -> float:
    """Resident memory of a process; NaN where the system does not tell."""
    state = Path(f"/proc/{process}/statm")
    pages = int(state.read_text("utf-8").split()[1]) if state.exists() else float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _requests(options: Options, keyframes: int) -> list[_Request]:
    generator = random.Random(options.seed)
    weights = [weight for weight, *_ in _ENDPOINTS.values()]
    requests = []
    for name in generator.choices(list(_ENDPOINTS), weights, k=options.requests):
        _, path, body = _ENDPOINTS[name]
        requests.append(_Request(name, path.format(keyframe=generator.randrange(keyframes)), body))
    return requests


def _load(port: int, requests: Sequence[_Request], clients: int) -> list[_Answer]:
    """Send requests from several clients, each with a connection of its own."""
    connections = threading.local()

    def ask(request: _Request) -> _Answer:
        if not hasattr(connections, "own"):
            connections.own = http.client.HTTPConnection("127.0.0.1", port, timeout=_TIMEOUT_S)
        return _ask(port, request, connections.own)

    with ThreadPoolExecutor(clients) as pool:
        return list(pool.map(ask, requests))


def _ask(
    port: int, request: _Request, connection: http.client.HTTPConnection | None = None
) -> _Answer:
    connection = connection or http.client.HTTPConnection("127.0.0.1", port, timeout=_TIMEOUT_S)
    method, headers = (
        ("POST", {"content-type": "application/json"}) if request.body else ("GET", {})
    )
    begin = time.perf_counter()
    status, body = 0, b""
    try:
        connection.request(method, request.path, request.body or None, headers)
        response = connection.getresponse()
        status, body = response.status, response.read()
    except (OSError, http.client.HTTPException):
        connection.close()
    return _Answer(request.endpoint, status, 1e3 * (time.perf_counter() - begin), body)


def _latencies(answers: Sequence[_Answer], note: str) -> Table:
    rows = []
    for name in [*_ENDPOINTS, "all"]:
        chosen = [a for a in answers if name in (a.endpoint, "all")]
        if chosen:
            values = np.percentile([a.latency_ms for a in chosen], (50, 90, 95, 99, 100))
            failed = sum(a.status != 200 for a in chosen)
            rows.append((name, str(len(chosen)), *(f"{v:.1f}" for v in values), str(failed)))
    return Table(_COLUMNS, tuple(rows), note=note)


if __name__ == "__main__":
    sys.exit(main())
