"""Incremental writing of maps."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toolkit.base.errors import RunFolderError
from toolkit.io.splat_parts import write_splat_parts
from toolkit.io.splats import write_splat_ply
from toolkit.splatting.gaussians.cloud import GaussianCloud


def cloud(count, seed):
    generator = torch.Generator().manual_seed(seed)
    return GaussianCloud.from_values(
        torch.randn(count, 3, generator=generator),
        torch.rand(count, generator=generator) + 0.01,
        torch.rand(count, generator=generator) * 0.9 + 0.05,
        torch.rand(count, 3, generator=generator),
    )


def columns(count, number):
    return {
        "label": np.full(count, number, np.int32),
        "confidence": np.linspace(0, 1, count, dtype=np.float32),
    }


def test_parts_are_byte_identical_to_the_whole_map(tmp_path):
    counts = (7, 0, 1, 300)
    parts = [(cloud(n, seed=n), columns(n, n)) for n in counts]
    write_splat_parts(tmp_path / "parts.ply", parts)
    whole = GaussianCloud.concatenate([part for part, _ in parts])
    together = {k: np.concatenate([c[k] for _, c in parts]) for k in ("label", "confidence")}
    write_splat_ply(tmp_path / "whole.ply", whole, together)
    assert (tmp_path / "parts.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["parts.ply", "whole.ply"]


def test_map_without_gaussians_raises(tmp_path):
    with pytest.raises(RunFolderError, match=r"map\.ply: the map contains no Gaussians"):
        write_splat_parts(tmp_path / "map.ply", [(cloud(0, 0), {})])
    assert list(tmp_path.iterdir()) == []


def test_parts_with_different_columns_raise(tmp_path):
    with pytest.raises(ValueError, match="same columns"):
        write_splat_parts(tmp_path / "map.ply", [(cloud(2, 0), {}), (cloud(2, 1), columns(2, 1))])


def test_error_names_the_path_that_cannot_be_written(tmp_path):
    with pytest.raises(RunFolderError, match="nowhere"):
        write_splat_parts(tmp_path / "nowhere" / "map.ply", [(cloud(2, 0), {})])
