"""The service: its answers, and a clear status for every bad request."""

from __future__ import annotations

import json
import random
import shutil
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fastapi.testclient import TestClient
from malformed_requests import malformed_requests

from toolkit.base.geometry import se3
from toolkit.io.trajectories import read_tum
from toolkit.runs.maps.finished import load_run
from toolkit.splatting.rendering import backend, render_surface
from toolkit.tools.cli.main import main
from toolkit.tools.serving.admission import Computations
from toolkit.tools.serving.application import build_application
from toolkit.tools.serving.options import ServiceLimits
from toolkit.tools.serving.served_run import NotAvailableError, ServedRun

BASE = "http://127.0.0.1"
IDENTITY = {"translation_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}
Connect = Callable[..., TestClient]


@pytest.fixture(scope="module")
def served(tiny_run: Path) -> ServedRun:
    return ServedRun(tiny_run, max_pixels=100_000)


@pytest.fixture(scope="module")
def connect(served: ServedRun) -> Iterator[Connect]:
    computations = []

    def connect(
        limits: ServiceLimits | None = None, base: str = BASE, local: bool = True
    ) -> TestClient:
        limits = limits or ServiceLimits()
        computations.append(Computations(limits.max_waiting))
        application = build_application(served, limits, computations[-1], local)
        return TestClient(application, base_url=base, raise_server_exceptions=False)

    yield connect
    for item in computations:
        item.close()


@pytest.fixture(scope="module")
def client(connect: Connect) -> TestClient:
    return connect()


def decoded(png: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    return image if image.ndim == 2 else image[..., ::-1]


def detail(response: Any, status: int) -> str:
    """The message of an error, which must be one line of JSON."""
    assert response.status_code == status, response.text
    (key,) = response.json()
    text = response.json()[key]
    assert key == "detail" and text and "\n" not in text and "Traceback" not in text
    return text


def test_poses_are_those_of_the_trajectory_file(client: TestClient, tiny_run: Path):
    truth = read_tum(tiny_run / "trajectory.txt")
    answer = client.get("/poses", params={"first": 1, "count": 2}).json()
    assert answer["total"] == len(truth) and answer["first"] == 1
    for pose, T, time_s in zip(
        answer["poses"], truth.T_world_camera[1:3], truth.timestamps_s[1:3], strict=True
    ):
        assert pose["timestamp_s"] == pytest.approx(time_s, abs=1e-6)
        np.testing.assert_allclose(pose["translation_m"], T[:3, 3], atol=1e-7)
        R = se3.rotation_from_quaternion_xyzw(np.array(pose["quaternion_xyzw"]))
        np.testing.assert_allclose(R, T[:3, :3], atol=1e-7)
    numbers = [pose["keyframe"] for pose in client.get("/keyframes").json()["poses"]]
    assert numbers == list(range(len(load_run(tiny_run).keyframes)))


def test_a_render_shows_the_map_from_the_given_pose(client: TestClient, tiny_run: Path):
    run = load_run(tiny_run)
    T_map_camera = run.tracked[2].T_map_camera @ se3.exp(np.array([0.05, 0, 0, 0, 0.03, 0]))
    view = render_surface(
        backend(run.settings.backend), run.gaussians, run.camera, se3.inverse(T_map_camera)
    )
    matrix = {"T_map_camera": T_map_camera.tolist()}
    parts = {
        "translation_m": T_map_camera[:3, 3].tolist(),
        "quaternion_xyzw": (2.0 * se3.quaternion_xyzw(T_map_camera[:3, :3])).tolist(),
    }
    colour = decoded(client.post("/render", json=matrix).content)
    expected = np.rint(255.0 * view.output.colour.clamp(0, 1).numpy())
    assert np.abs(colour - expected).max() <= 1
    same = decoded(client.post("/render", json=parts).content)
    assert np.abs(colour.astype(int) - same).max() <= 1
    depth = decoded(client.post("/render", json={**matrix, "what": "depth"}).content)
    assert depth.dtype == np.uint16
    np.testing.assert_allclose(depth / 1000.0, view.depth_m.numpy(), atol=2e-3)


def test_renders_repeat_and_have_the_requested_size(client: TestClient):
    first, second = (client.get("/keyframes/0.png", params={"what": "classes"}) for _ in range(2))
    assert first.headers["content-type"] == "image/png"
    assert first.content == second.content
    words = {"width": 40, "height": 24, "horizontal_fov_deg": 90}
    assert decoded(client.post("/render", json={**words, **IDENTITY}).content).shape == (24, 40, 3)


def test_classes_have_the_colours_of_their_level(client: TestClient):
    classes = client.get("/classes").json()
    for level in (0, len(classes["levels"]) - 1):
        image = decoded(
            client.get("/keyframes/0.png", params={"what": "classes", "level": level}).content
        )
        known = {
            tuple(c["rgb"])
            for c in classes["colours"]
            if c["level"] == level or (c["is_class"] and c["level"] < level)
        }
        shown = {tuple(colour) for colour in image.reshape(-1, 3).tolist()}
        assert shown <= known | {(0, 0, 0)} and len(shown & known) >= 2


def test_queries_and_objects_agree_with_the_programs(client: TestClient, tiny_run, tmp_path):
    tree = client.get("/classes").json()["tree"]
    node = tree[0]
    while node["children"]:
        node = node["children"][0]
    answer = client.get("/query", params={"name": node["name"], "min_gaussians": 5}).json()
    assert answer["path"][-1] == node["name"] and answer["gaussians"] == node["gaussians"]
    plural = {"name": f"big {node['name']}s", "min_gaussians": 5}
    meant = client.get("/query", params=plural).json()
    assert meant["explanation"].endswith(f"searched for '{node['name']}'")
    assert meant["gaussians"] == node["gaussians"]
    words = ["export", str(tiny_run), "--format", "scene-graph", "--to", str(tmp_path / "s.json")]
    status = main(words)
    response = client.get("/objects")
    if status == 0:
        assert response.json() == json.loads((tmp_path / "s.json").read_text())
    else:
        assert "floor" in detail(response, 404)


def test_the_page_and_openapi_describe_every_path_without_a_network(client: TestClient):
    page = client.get("/").text
    openapi = client.get("/openapi.json").json()
    assert set(openapi["paths"]) >= {"/poses", "/render", "/query", "/objects", "/metrics"}
    assert all(path in page for path in openapi["paths"])
    assert "<script" not in page and "src=" not in page and "https://" not in page
    assert client.get("/docs").status_code == 404
    assert client.get("/metrics").json()["frames"]["total"] == 6
    assert client.get("/run").json()["camera"]["width"] == 64


@pytest.mark.parametrize(
    ("body", "status", "message"),
    [
        ({}, 422, "give one of keyframe"),
        ({"keyframe": 0, **IDENTITY}, 422, "give one of keyframe"),
        ({"keyframe": 99}, 404, "there is no keyframe 99"),
        ({"keyframe": 0, "width": 4000, "height": 4000}, 422, "the limit of this service"),
        ({"keyframe": 0, "width": 8, "height": 8000}, 422, "too large"),
        ({"keyframe": 0, "width": 40}, 422, "width and height"),
        ({"keyframe": 0, "what": "classes", "level": 60}, 404, "no level 60"),
        ({"keyframe": 0, "level": 0}, 422, "classes only"),
        ({"keyframe": 0, "extra": 1}, 422, "extra"),
        ({"keyframe": True}, 422, "keyframe"),
        ({**IDENTITY, "quaternion_xyzw": [0, 0, 0, 0]}, 422, "nearly zero"),
        ({"T_map_camera": [[1, 1, 0, 0]] * 4}, 422, "not a rigid motion"),
        ({"T_map_camera": [[1, 0], [0, 1]]}, 422, "T_map_camera"),
    ],
)
def test_wrong_views_are_rejected_with_the_reason(client: TestClient, body, status, message):
    assert message in detail(client.post("/render", json=body), status)


@pytest.mark.parametrize(
    "content",
    [
        b'{"translation_m": [NaN, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}',
        b'{"translation_m": [0, 0, Infinity], "quaternion_xyzw": [0, 0, 0, 1]}',
        b'{"translation_m": [0, 0, 1e400], "quaternion_xyzw": [0, 0, 0, 1]}',
        b'{"keyframe": ' + b"9" * 5000 + b"}",
        b"[" * 10_000,
        b'{"keyframe": 0',
        b"\xff\xfe\x00",
        b"",
        b"null",
    ],
)
def test_numbers_that_are_none_and_broken_json_are_rejected(client: TestClient, content):
    response = client.post("/render", content=content, headers={"content-type": "application/json"})
    assert response.status_code in (400, 422)
    detail(response, response.status_code)


def test_paths_outside_the_service_and_wrong_methods_are_rejected(client: TestClient):
    for path in ("/../config.yaml", "/%2e%2e/config.yaml", "/keyframes/..%2f0.png", "/map.ply"):
        assert client.get(path).status_code in (404, 422)
    for method in ("DELETE", "PUT", "PATCH", "POST", "TRACE"):
        detail(client.request(method, "/poses"), 405)
    detail(client.get("/keyframes/0.png", params={"width": 40}), 422)
    assert "GET /classes" in detail(client.get("/query", params={"name": "no such class"}), 404)
    detail(client.get("/poses", params={"count": 10**9}), 422)


def test_other_host_names_are_rejected_unless_other_machines_can_connect(connect: Connect):
    assert "Host" in detail(connect(base="http://rebound.example").get("/run"), 400)
    for base in ("http://localhost:8000", "http://[::1]:8000", "http://127.0.0.2"):
        assert connect(base=base).get("/run").status_code == 200
    remote = connect(base="http://map.example", local=False)
    assert remote.get("/run").headers["x-content-type-options"] == "nosniff"


def test_large_bodies_are_rejected_before_they_are_read(connect: Connect):
    client = connect(ServiceLimits(max_body_bytes=1000))
    detail(client.post("/render", content=b" " * 2000), 413)

    def parts() -> Iterator[bytes]:  # without a Content-Length
        for _ in range(100):
            yield b" " * 500

    detail(client.post("/render", content=parts()), 411)


def test_more_computations_than_may_wait_are_rejected_and_the_others_answered(
    connect: Connect, served: ServedRun, monkeypatch
):
    begun, finish = threading.Event(), threading.Event()

    def slow_objects() -> dict[str, Any]:
        begun.set()
        assert finish.wait(10)
        return {"nodes": []}

    monkeypatch.setattr(served, "objects", slow_objects)
    client = connect(ServiceLimits(max_waiting=1))
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(client.get, "/objects")
        assert begun.wait(10)
        response = client.get("/keyframes/0.png")
        detail(response, 503)
        assert response.headers["retry-after"] == "1"
        assert client.get("/run").status_code == 200
        finish.set()
        assert waiting.result(10).json() == {"nodes": []}
    assert client.get("/keyframes/0.png").status_code == 200


def test_an_error_of_the_program_is_answered_and_the_service_goes_on(
    connect: Connect, served: ServedRun, monkeypatch
):
    client = connect()
    monkeypatch.setattr(served, "description", lambda: 1 / 0)
    assert "internal error" in detail(client.get("/run"), 500)
    assert client.get("/poses").status_code == 200


def test_random_malformed_requests_get_a_client_error(client: TestClient):
    for request in malformed_requests(100, random.Random(7)):
        response = client.request(
            request.method, request.path, content=request.body, headers=dict(request.headers)
        )
        assert 400 <= response.status_code < 500, request
        detail(response, response.status_code)


def test_a_run_without_semantics_or_metrics_still_serves_views(tiny_run: Path, tmp_path: Path):
    bare = tmp_path / "bare"
    shutil.copytree(tiny_run, bare)
    (bare / "metrics.json").write_text("{")
    served = ServedRun(bare, 10_000)
    with pytest.raises(NotAvailableError, match="semsplat evaluate"):
        served.metrics()
    assert served.poses(0, 10)["total"] == 6
    client = TestClient(build_application(served, ServiceLimits(), Computations(1)), base_url=BASE)
    assert client.get("/keyframes/0.png").status_code == 200
