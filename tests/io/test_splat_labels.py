"""Splat labels: round trips, and files without labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from toolkit.base.errors import FormatError
from toolkit.io.splat_labels import SplatLabels, instances_in
from toolkit.io.splats import read_splats, write_splat_ply
from toolkit.splatting.gaussians.cloud import GaussianCloud

N = 40


@pytest.fixture
def cloud() -> GaussianCloud:
    g = torch.Generator().manual_seed(0)
    return GaussianCloud.from_values(
        means=torch.randn(N, 3, generator=g),
        radii_m=torch.full((N,), 0.02),
        opacities=torch.full((N,), 0.9),
        colours=torch.rand(N, 3, generator=g),
    )


@pytest.fixture
def labels() -> SplatLabels:
    generator = np.random.default_rng(0)
    return SplatLabels(
        label=generator.integers(0, 550, N).astype(np.int32),
        levels=generator.integers(-1, 700, (N, 12)).astype(np.int32),
        confidence=generator.uniform(0, 1, N).astype(np.float32),
    )


def test_objects_are_stored_beside_labels(tmp_path, cloud, labels):
    assert labels.instances is None
    assert "instance" not in labels.columns()
    numbered = replace(labels, instances=np.arange(N, dtype=np.int32))
    write_splat_ply(tmp_path / "map.ply", cloud, numbered.columns())
    read = read_splats(tmp_path / "map.ply").labels
    assert read is not None
    np.testing.assert_array_equal(read.select(np.array([3, 1])).instances, [3, 1])


def test_a_column_of_another_tool_is_no_object():
    assert instances_in({"instance": np.linspace(0.0, 1.0, N)}) is None


def test_as_many_objects_as_splats(labels):
    with pytest.raises(ValueError, match="instances must have shape"):
        replace(labels, instances=np.zeros(N + 1, np.int32))


def test_labels_round_trip_is_exact(tmp_path, cloud, labels):
    # Twelve levels, so that lexicographic order (l10 before l2) would fail.
    write_splat_ply(tmp_path / "map.ply", cloud, labels.columns())
    read = read_splats(tmp_path / "map.ply").labels
    assert read is not None
    for name in ("label", "levels", "confidence"):
        np.testing.assert_array_equal(getattr(read, name), getattr(labels, name))
        assert getattr(read, name).dtype == getattr(labels, name).dtype


def test_labels_do_not_change_the_properties_for_viewers(tmp_path, cloud, labels):
    write_splat_ply(tmp_path / "with.ply", cloud, labels.columns())
    write_splat_ply(tmp_path / "without.ply", cloud)
    headers = [
        (tmp_path / name).read_bytes().partition(b"end_header")[0].decode().splitlines()
        for name in ("with.ply", "without.ply")
    ]
    # Viewers find properties by name and support the scalar types of PLY 1.0.
    with_labels, without = (
        {tuple(line.split()[1:]) for line in header if line.startswith("property")}
        for header in headers
    )
    assert without < with_labels
    assert all(kind == "float" for kind, _ in without)
    own = {("int", "label"), *(("int", f"label_l{i}") for i in range(12)), ("float", "confidence")}
    assert with_labels - without == own
    one, other = (read_splats(tmp_path / name) for name in ("with.ply", "without.ply"))
    np.testing.assert_array_equal(one.means, other.means)
    np.testing.assert_array_equal(one.log_radii, other.log_radii)


@pytest.mark.parametrize(
    "columns",
    [
        {},
        {"label": np.arange(N)},
        {"label": np.arange(N), "confidence": np.ones(N)},
        {"label": np.linspace(0, 1, N), "label_l0": np.arange(N), "confidence": np.ones(N)},
    ],
)
def test_label_columns_of_other_tools_are_ignored(tmp_path, cloud, columns):
    write_splat_ply(tmp_path / "other.ply", cloud, columns)
    read = read_splats(tmp_path / "other.ply")
    assert len(read) == N
    assert read.labels is None


def test_missing_level_raises(tmp_path, cloud, labels):
    columns = labels.columns()
    del columns["label_l3"]
    write_splat_ply(tmp_path / "map.ply", cloud, columns)
    with pytest.raises(FormatError, match="label_l3"):
        _ = read_splats(tmp_path / "map.ply").labels


def test_select_applies_to_all_columns(labels):
    index = np.array([3, 1, 1])
    kept = labels.select(index)
    np.testing.assert_array_equal(kept.levels, labels.levels[index])
    np.testing.assert_array_equal(kept.label, labels.label[index])
    np.testing.assert_array_equal(kept.confidence, labels.confidence[index])
    assert len(labels.select(labels.label > 300)) == (labels.label > 300).sum()


@pytest.mark.parametrize(
    ("label", "levels", "confidence"),
    [((3,), (2, 4), (3,)), ((3,), (3, 0), (3,)), ((3,), (3,), (3,)), ((3,), (3, 4), (2,))],
)
def test_mismatched_shapes_raise(label, levels, confidence):
    with pytest.raises(ValueError, match="must"):
        SplatLabels(
            np.zeros(label, np.int32), np.zeros(levels, np.int32), np.zeros(confidence, np.float32)
        )
