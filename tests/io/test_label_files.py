"""Labels beside splat files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from toolkit.io.label_files import label_file_of, write_label_file
from toolkit.io.splat_labels import SplatLabels
from toolkit.io.splats import export_splats, read_splats

SUFFIXES = (".splat", ".spz", ".sog", ".compressed.ply")
TAXONOMY = {"classes": ["chair", "table"], "tree": {"seating": {"chair": {}}, "table": {}}}


@pytest.fixture
def labels(cloud) -> SplatLabels:
    rng, count = np.random.default_rng(0), len(cloud)
    return SplatLabels(
        label=rng.integers(0, 3, count).astype(np.int32),
        levels=rng.integers(-1, 4, (count, 3)).astype(np.int32),
        confidence=rng.uniform(0, 1, count).astype(np.float32),
    )


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_labels_follow_the_order_of_the_file(tmp_path, cloud, labels, suffix):
    path = tmp_path / f"map{suffix}"
    export_splats(path, cloud, labels.columns(), taxonomy=TAXONOMY)
    read = read_splats(path)
    distances = np.linalg.norm(read.means[:, None] - cloud.means.numpy(), axis=2)
    order = distances.argmin(axis=1)
    assert sorted(order) == list(range(len(cloud)))
    for name in ("label", "levels", "confidence"):
        np.testing.assert_array_equal(getattr(read.labels, name), getattr(labels, name)[order])
    assert read.taxonomy == TAXONOMY


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".ply", ".glb"])
def test_the_class_tree_is_read_from_every_format(tmp_path, cloud, labels, suffix):
    """And is not left beside a later map without classes."""
    path = tmp_path / f"map{suffix}"
    export_splats(path, cloud, labels.columns(), taxonomy=TAXONOMY)
    assert read_splats(path).taxonomy == TAXONOMY
    export_splats(path, cloud)
    assert read_splats(path).taxonomy is None
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_objects_follow_the_order_of_the_file(tmp_path, cloud, labels):
    numbers = np.arange(len(cloud), dtype=np.int32)
    path = tmp_path / "map.sog"
    export_splats(path, cloud, replace(labels, instances=numbers).columns(), taxonomy=TAXONOMY)
    read = read_splats(path)
    distances = np.linalg.norm(read.means[:, None] - cloud.means.numpy(), axis=2)
    assert read.labels is not None
    np.testing.assert_array_equal(read.labels.instances, distances.argmin(axis=1))


def test_objects_of_a_map_without_labels_are_kept(tmp_path, cloud):
    numbers = np.arange(len(cloud), dtype=np.int32)
    path = tmp_path / "map.sog"
    export_splats(path, cloud, {"instance": numbers})
    read = read_splats(path)
    distances = np.linalg.norm(read.means[:, None] - cloud.means.numpy(), axis=2)
    assert read.labels is None
    np.testing.assert_array_equal(read.extra["instance"], distances.argmin(axis=1))
    np.savez(label_file_of(path), splats_sha256=np.array(""))
    assert "instance" not in read_splats(path).extra


def test_the_file_contains_names_and_is_reproducible(tmp_path, cloud, labels):
    path = tmp_path / "map.sog"
    export_splats(path, cloud, labels.columns(), taxonomy=TAXONOMY)
    content = label_file_of(path).read_bytes()
    with np.load(label_file_of(path)) as arrays:
        names = arrays["class_names"][arrays["label"]]
        assert set(names) == {"void", "chair", "table"}
        assert (names == "table").sum() == (labels.label == 2).sum()
    export_splats(path, cloud, labels.columns(), taxonomy=TAXONOMY)
    assert label_file_of(path).read_bytes() == content


def test_a_map_without_labels_removes_those_of_an_earlier_one(tmp_path, cloud, labels):
    path = tmp_path / "map.spz"
    export_splats(path, cloud, labels.columns())
    export_splats(path, cloud)
    assert not label_file_of(path).exists()
    assert read_splats(path).labels is None


def test_labels_of_another_file_are_ignored_with_one_line(tmp_path, cloud, labels, caplog):
    path, other = tmp_path / "map.spz", tmp_path / "other.spz"
    export_splats(path, cloud, labels.columns())
    export_splats(other, cloud.select(torch.arange(20)))
    label_file_of(path).rename(label_file_of(other))
    read = read_splats(other)
    assert read.labels is None and len(read) == 20
    assert "labels of 50 splats, but other.spz contains 20; export the map again" in caplog.text


def test_labels_of_a_changed_file_are_ignored(tmp_path, cloud, labels, caplog):
    path = tmp_path / "map.splat"
    export_splats(path, cloud, labels.columns())
    content = path.read_bytes()
    path.write_bytes(content[32:] + content[:32])
    assert read_splats(path).labels is None
    assert "map.splat was changed after it was exported" in caplog.text


@pytest.mark.parametrize("length", [0, 100, -1])
def test_damaged_labels_are_ignored(tmp_path, cloud, labels, caplog, length):
    path = tmp_path / "map.splat"
    export_splats(path, cloud, labels.columns())
    label_file_of(path).write_bytes(label_file_of(path).read_bytes()[:length])
    read = read_splats(path)
    assert read.labels is None and len(read) == len(cloud)
    assert "map.splat.labels.npz cannot be read and is ignored" in caplog.text


def test_splats_that_are_left_out_lose_their_labels(tmp_path, cloud, labels, caplog):
    path = tmp_path / "map.splat"
    export_splats(path, cloud)
    content = bytearray(path.read_bytes())
    content[32 * 3 : 32 * 3 + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(content)
    write_label_file(path, labels.columns(), None, None)
    read = read_splats(path)
    assert "1 of 50 splats are not finite" in caplog.text
    assert len(read.labels) == len(read) == 49
    np.testing.assert_array_equal(read.labels.confidence, np.delete(labels.confidence, 3))
