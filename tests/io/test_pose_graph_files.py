"""Pose-graph files: round trips, both formats and malformed lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pose_graph_files import PoseGraphArrays, read_pose_graph

from toolkit.base.errors import DatasetError, FormatError
from toolkit.base.geometry import se3
from toolkit.io.covariances import read_covariances, write_covariances

TRIANGLE = " ".join(str(k) for k in range(1, 22))


def write_g2o(path: Path, graph: PoseGraphArrays) -> None:
    lines = [
        f"VERTEX_SE3:QUAT {node} {numbers(pose_values(T))}"
        for node, T in zip(graph.nodes, graph.T_world_node, strict=True)
    ]
    lines += [f"FIX {node}" for node in graph.fixed]
    upper = np.triu_indices(6)
    for (first, second), T, information in zip(
        graph.edges, graph.T_first_second, graph.information, strict=True
    ):
        values = [*pose_values(T), *information[upper]]
        lines.append(f"EDGE_SE3:QUAT {first} {second} {numbers(values)}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def pose_values(T: np.ndarray) -> list[float]:
    return [*T[:3, 3], *se3.quaternion_xyzw(T[:3, :3])]


def numbers(values: list[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def random_graph(seed: int) -> PoseGraphArrays:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 6, 6))
    return PoseGraphArrays(
        nodes=np.arange(5),
        T_world_node=np.stack([se3.exp(rng.normal(size=6)) for _ in range(5)]),
        edges=np.array([(k, k + 1) for k in range(4)] + [(4, 0), (1, 3)]),
        T_first_second=np.stack([se3.exp(rng.normal(size=6)) for _ in range(6)]),
        information=A @ A.transpose(0, 2, 1) + np.eye(6),
        fixed=np.array([2]),
    )


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_g2o_round_trip(tmp_path_factory, seed: int) -> None:
    path = tmp_path_factory.mktemp("g2o") / "graph.g2o"
    written = random_graph(seed)
    write_g2o(path, written)
    read = read_pose_graph(path)
    for name in ("nodes", "edges", "fixed"):
        assert np.array_equal(getattr(read, name), getattr(written, name))
    np.testing.assert_allclose(read.T_world_node, written.T_world_node, atol=1e-15)
    np.testing.assert_allclose(read.T_first_second, written.T_first_second, atol=1e-15)
    upper = np.triu_indices(6)
    assert np.array_equal(read.information[:, *upper], written.information[:, *upper])
    assert np.array_equal(read.T_world_node[:, :3, 3], written.T_world_node[:, :3, 3])


def test_quaternions_are_xyzw_and_information_has_translation_first(tmp_path) -> None:
    path = tmp_path / "graph.g2o"
    half = np.sqrt(0.5)
    path.write_text(f"EDGE_SE3:QUAT 3 7 1 2 3 {half} 0 0 {half} {TRIANGLE}\nFIX 3\n")
    graph = read_pose_graph(path)
    assert graph.edges.tolist() == [[3, 7]]
    assert graph.fixed.tolist() == [3]
    assert len(graph.nodes) == 0
    assert graph.T_world_node.shape == (0, 4, 4)
    T = graph.T_first_second[0]
    np.testing.assert_allclose(T[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(se3.log(T)[3:], [np.pi / 2, 0, 0], atol=1e-12)
    information = graph.information[0]
    assert information[0].tolist() == [1, 2, 3, 4, 5, 6]
    assert np.diag(information).tolist() == [1, 7, 12, 16, 19, 21]
    assert np.array_equal(information, information.T)


def test_toro_angles_are_about_fixed_axes(tmp_path) -> None:
    path = tmp_path / "graph.txt"
    path.write_text(f"VERTEX3 0 1 2 3 0.1 0.2 0.3\nEDGE3 0 1 4 5 6 0.1 0.2 0.3 {TRIANGLE}\n")
    graph = read_pose_graph(path)
    turn = [se3.exp_so3(a * axis) for a, axis in zip((0.1, 0.2, 0.3), np.eye(3), strict=True)]
    expected = turn[2] @ turn[1] @ turn[0]
    np.testing.assert_allclose(graph.T_first_second[0, :3, :3], expected, atol=1e-15)
    np.testing.assert_allclose(graph.T_world_node[0, :3, :3], expected, atol=1e-15)
    np.testing.assert_allclose(graph.T_first_second[0, :3, 3], [4, 5, 6])


def test_g2o_and_toro_files_of_one_graph_agree(real_data) -> None:
    folder = real_data("pose_graphs")
    quaternions = read_pose_graph(folder / "sphere2500.g2o")
    angles = read_pose_graph(folder / "sphere2500.txt")
    by_ends = [np.lexsort(graph.edges.T) for graph in (quaternions, angles)]
    assert np.array_equal(quaternions.edges[by_ends[0]], angles.edges[by_ends[1]])
    np.testing.assert_allclose(
        quaternions.T_first_second[by_ends[0]], angles.T_first_second[by_ends[1]], atol=1e-5
    )


GOOD = f"EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1 {TRIANGLE}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "contains no edges"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n", "contains no edges"),
        (GOOD + "VERTEX_SE2 0 0 0 0\n", "line 2: 'VERTEX_SE2' is not a tag of a 3D pose graph"),
        (
            GOOD + "VERTEX_SE3:QUAT 0 0 0 0 0 0 1\n",
            "line 2: VERTEX_SE3:QUAT needs 8 numbers, got 7",
        ),
        (GOOD + "VERTEX_SE3:QUAT x 0 0 0 0 0 0 1\n", "line 2: .*'x'.*; fix the line"),
        (GOOD + "VERTEX_SE3:QUAT 0 0 0 nan 0 0 0 1\n", "line 2: values must be finite"),
        (GOOD + "VERTEX_SE3:QUAT -1 0 0 0 0 0 0 1\n", "line 2: .*must not be negative"),
        (GOOD + "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 2\n", "line 2: the quaternion"),
        (GOOD + 2 * "VERTEX_SE3:QUAT 4 0 0 0 0 0 0 1\n", "line 3: node 4 is defined twice"),
        (GOOD.replace(" 21", ""), "line 1: EDGE_SE3:QUAT needs 30 numbers, got 29"),
    ],
)
def test_malformed_files_raise(tmp_path, text: str, message: str) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(text)
    with pytest.raises(FormatError, match=message) as raised:
        read_pose_graph(path)
    assert str(path) in str(raised.value)


def test_missing_file_raises(tmp_path) -> None:
    with pytest.raises(DatasetError, match="cannot read"):
        read_pose_graph(tmp_path / "none.g2o")


def test_covariances_round_trip(tmp_path) -> None:
    path = tmp_path / "covariances.txt"
    A = np.random.default_rng(0).normal(size=(4, 6, 6))
    covariances = A @ A.transpose(0, 2, 1)
    covariances[0] = 0.0
    times = np.array([0.0, 0.1, 0.25, 1.5e9])
    write_covariances(path, times, covariances)
    first = path.read_bytes()
    write_covariances(path, times, covariances)
    assert path.read_bytes() == first
    header = [line for line in path.read_text().splitlines() if line.startswith("#")]
    assert header[-1].split()[:4] == ["#", "timestamp_s", "tx_tx", "tx_ty"]
    assert len(header[-1].split()) == 23
    assert all(len(line) <= 200 for line in header)
    read_times, read = read_covariances(path)
    np.testing.assert_allclose(read_times, times)
    np.testing.assert_allclose(read, covariances, rtol=1e-8, atol=1e-12)


def test_invalid_covariances_raise(tmp_path) -> None:
    path = tmp_path / "covariances.txt"
    with pytest.raises(ValueError, match=r"shape \[2, 6, 6\], got \[3, 6, 6\]"):
        write_covariances(path, np.zeros(2), np.zeros((3, 6, 6)))
    path.write_text("0.0 1 2 3\n")
    with pytest.raises(FormatError, match="line 1: expected a timestamp and 21"):
        read_covariances(path)
