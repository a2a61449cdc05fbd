"""Merge the maps of two finished runs, with labels if both use the same taxonomy and code."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.io.splat_labels import INSTANCE, SplatLabels
from toolkit.runs.maps.finished import FinishedRun
from toolkit.runs.maps.map_files import splat_labels
from toolkit.runs.maps.saved_objects import load_objects
from toolkit.scene.instances.result import InstanceMap
from toolkit.scene.instances.saved import SavedObjects, joined
from toolkit.semantics.factory import build_code
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.mapping.semantic_mapping import SemanticMapping, build_semantic_mapping
from toolkit.slam.refinement.fusion import FusedMap, fuse_submaps
from toolkit.slam.submaps.store import SavedSubmaps
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.gaussians.cloud import GaussianCloud


@dataclass(frozen=True)
class MergedMap:
    """Two maps in the frame of the first.

    Attributes:
        gaussians: N Gaussians.
        submap: [N] int32 submap of each Gaussian; numbers of the second map follow those of the
            first.
        labels: labels of the Gaussians; None if the labels of the runs cannot be merged.
        taxonomy: taxonomy of the labels, or None.
        instances: objects of both maps, joined where they overlap; None if neither has any.
    """

    gaussians: GaussianCloud
    submap: Tensor
    labels: SplatLabels | None
    taxonomy: Taxonomy | None
    instances: InstanceMap | None = None

    def columns(self) -> dict[str, NDArray]:
        """Return the additional columns of the map's file."""
        columns = {} if self.labels is None else self.labels.columns()
        if self.instances is not None:
            ids = [self.instances.ids[n] for n in sorted(self.instances.ids)]
            columns |= {INSTANCE: np.concatenate(ids)}
        return columns | {"submap": self.submap.numpy()}


def label_conflict(a: FinishedRun, b: FinishedRun) -> str:
    """Return why the labels of two runs cannot be merged, or an empty string if they can."""
    if a.taxonomy is None or b.taxonomy is None:
        paths = [str(run.folder.path) for run in (a, b) if run.taxonomy is None]
        return f"no labels in {' and '.join(paths)}"
    if a.taxonomy.digest != b.taxonomy.digest:
        return f"the taxonomies {a.folder.taxonomy} and {b.folder.taxonomy} differ"
    if a.settings.semantics.code != b.settings.semantics.code:
        return "the runs differ in semantics.code"
    return ""


def shared_semantics(a: FinishedRun, b: FinishedRun) -> SemanticMapping | None:
    """Return a decoder for the features of both maps, for the classes observed in either run.

    It decodes along the paths of the code, because a trained network is only valid for the map of
    its own run. None if the labels of the runs cannot be compared.
    """
    if label_conflict(a, b) or a.taxonomy is None:
        return None
    settings = a.settings.semantics
    network = replace(settings.network, use=False)
    settings = replace(settings, reader="path", network=network)
    semantics = build_semantic_mapping(settings, build_code(settings.code, a.taxonomy), 0)
    observed = a.semantics.state()["observed"] | b.semantics.state()["observed"]
    semantics.restore({"observed": observed})
    return semantics


def merge(
    a: FinishedRun,
    b: FinishedRun,
    submaps_a: SavedSubmaps,
    submaps_b: SavedSubmaps,
    T_a_b: NDArray[np.float64],
) -> MergedMap:
    """Merge both maps in A's frame, without duplicated surfaces.

    Raises:
        ToolkitError: a submap cannot be read.
    """
    labelled = not label_conflict(a, b)
    first_b = max(submaps_a) + 1

    def load(number: int) -> Submap:
        if number < first_b:
            submap = submaps_a[number]
        else:
            submap = submaps_b[number - first_b]
            submap = replace(submap, number=number, T_world_submap=T_a_b @ submap.T_world_submap)
        return submap if labelled else _without_features(submap)

    numbers = [*sorted(submaps_a), *(first_b + number for number in sorted(submaps_b))]
    fused = fuse_submaps(numbers, load)
    instances = _instances((a, b), fused, first_b, T_a_b)
    if not labelled:
        return MergedMap(fused.gaussians, fused.submap, None, None, instances)
    labels = _labels((a, b), fused.gaussians, (fused.submap >= first_b).numpy())
    return MergedMap(fused.gaussians, fused.submap, labels, a.taxonomy, instances)


def _instances(
    runs: tuple[FinishedRun, FinishedRun], fused: FusedMap, first_b: int, T_a_b: NDArray[np.float64]
) -> InstanceMap | None:
    """The objects of both maps; objects that overlap are one."""
    a, b = (load_objects(run.folder) for run in runs)
    if b is not None:
        b = replace(b, submap=b.submap + np.int32(first_b))
    if a is None and b is None:
        return None
    none = np.zeros(0, np.int32)
    empty = SavedObjects([], np.zeros((0, 3)), none, none)
    objects = joined(a or empty, b or empty, T_a_b)
    parts = zip(fused.numbers, fused.parts(), strict=True)
    return objects.carried({n: objects.of(n, p.means.double().numpy()) for n, p in parts})


def _without_features(submap: Submap) -> Submap:
    """Return a submap without features, which are only valid for one code."""
    cloud = submap.gaussians
    return replace(
        submap, gaussians=replace(cloud, features=cloud.features.new_zeros(len(cloud), 0))
    )


def _labels(
    runs: tuple[FinishedRun, FinishedRun], gaussians: GaussianCloud, from_b: NDArray[np.bool_]
) -> SplatLabels:
    """Decode the labels of each Gaussian with the decoder of its run."""
    parts = []
    for run, mask in zip(runs, (~from_b, from_b), strict=True):
        features = gaussians.features.index_select(0, torch.from_numpy(mask.nonzero()[0]))
        decoding = run.semantics.decode_gaussians(features)
        parts.append(splat_labels(decoding, run.settings.semantics.min_confidence))
    # The Gaussians of A precede those of B, as do the submaps.
    label, levels, confidence = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("label", "levels", "confidence")
    )
    return SplatLabels(label, levels, confidence)
