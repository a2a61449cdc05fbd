"""Two finished runs as one map, with labels where both mean the same by them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.io.splats import SplatLabels
from toolkit.mapping.factory import build_semantic_mapping
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.refinement.fusion import fuse_submaps
from toolkit.runs.finished import FinishedRun
from toolkit.runs.results import splat_labels
from toolkit.semantics.factory import build_code
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.submaps.saved import SavedSubmaps
from toolkit.submaps.submap import Submap


@dataclass(frozen=True)
class MergedMap:
    """Two maps in the frame of the first.

    Attributes:
        gaussians: N Gaussians.
        submap: [N] int32, where each came from; the second map's numbers follow the first's.
        labels: of the Gaussians, and taxonomy: their tree; None where the runs share none.
    """

    gaussians: GaussianCloud
    submap: Tensor
    labels: SplatLabels | None
    taxonomy: Taxonomy | None

    def columns(self) -> dict[str, NDArray]:
        """What lies beside the Gaussians in a file."""
        columns = {} if self.labels is None else self.labels.columns()
        return columns | {"submap": self.submap.numpy()}


def not_one_tree(a: FinishedRun, b: FinishedRun) -> str:
    """Why the labels of two runs cannot stand in one map, in plain words; empty if they can."""
    if a.taxonomy is None or b.taxonomy is None:
        bare = [run.folder.path for run in (a, b) if run.taxonomy is None]
        return f"{' and '.join(map(str, bare))} has none"
    if a.taxonomy.digest != b.taxonomy.digest:
        return f"{a.folder.taxonomy} and {b.folder.taxonomy} are different trees"
    if a.settings.semantics.code != b.settings.semantics.code:
        return "the runs differ in semantics.code"
    return ""


def shared_reading(a: FinishedRun, b: FinishedRun) -> SemanticMapping | None:
    """What reads the features of both maps, for classes that either was told of.

    It reads along the code's paths: a trained network knows the map of its own run alone.
    None where their labels cannot be compared.
    """
    if not_one_tree(a, b) or a.taxonomy is None:
        return None
    settings = a.settings.semantics
    network = replace(settings.network, use=False)
    settings = replace(settings, reader="path", network=network)
    semantics = build_semantic_mapping(settings, build_code(settings.code, a.taxonomy), 0)
    told = a.semantics.state()["told"] | b.semantics.state()["told"]
    semantics.restore({"told": told})
    return semantics


def merge(
    a: FinishedRun,
    b: FinishedRun,
    submaps_a: SavedSubmaps,
    submaps_b: SavedSubmaps,
    T_a_b: NDArray[np.float64],
) -> MergedMap:
    """Both maps in A's frame; what both show is told once, at A's exposure.

    Raises:
        ToolkitError: a submap cannot be read.
    """
    labelled = not not_one_tree(a, b)
    begin_b = max(submaps_a) + 1

    def submap(number: int) -> Submap:
        if number < begin_b:
            found = submaps_a[number]
        else:
            found = submaps_b[number - begin_b]
            found = replace(found, number=number, T_world_submap=T_a_b @ found.T_world_submap)
        return found if labelled else _bare(found)

    numbers = [*sorted(submaps_a), *(begin_b + number for number in sorted(submaps_b))]
    fused = fuse_submaps(numbers, submap)
    if not labelled:
        return MergedMap(fused.gaussians, fused.submap, None, None)
    labels = _labels((a, b), fused.gaussians, (fused.submap >= begin_b).numpy())
    return MergedMap(fused.gaussians, fused.submap, labels, a.taxonomy)


def _bare(submap: Submap) -> Submap:
    """Without features, which another code cannot read."""
    cloud = submap.gaussians
    return replace(submap, gaussians=replace(cloud, features=torch.zeros(len(cloud), 0)))


def _labels(
    runs: tuple[FinishedRun, FinishedRun], gaussians: GaussianCloud, of_b: NDArray[np.bool_]
) -> SplatLabels:
    """Each Gaussian's labels, as the run that it comes from reads them."""
    parts = []
    for run, mine in zip(runs, (~of_b, of_b), strict=True):
        features = gaussians.features.index_select(0, torch.from_numpy(mine.nonzero()[0]))
        decoding = run.semantics.decode_gaussians(features)
        parts.append(splat_labels(decoding, run.settings.semantics.min_confidence))
    # A's submaps come before B's, so their Gaussians do.
    label, levels, confidence = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("label", "levels", "confidence")
    )
    return SplatLabels(label, levels, confidence)
