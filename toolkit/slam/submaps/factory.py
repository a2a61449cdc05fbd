"""Build the atlas from the options of submaps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from toolkit.semantics.labeller import Labeller
from toolkit.slam.submaps.allocation import Allocation
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.options import AllocationOptions, SubmapOptions
from toolkit.slam.submaps.store import SubmapStore
from toolkit.slam.submaps.submap import Submap


def build_atlas(
    options: SubmapOptions,
    first: Submap,
    labeller: Labeller | None,
    folder: Path | None = None,
) -> Atlas:
    """Build the atlas described by the options.

    Args:
        first: the first submap, empty.
        labeller: segments frames; None for a map without labels.
        folder: where inactive submaps are stored; None keeps them in memory.
    """
    allocation = None
    if options.use:
        classes = len(labeller.taxonomy) if labeller else 0
        allocation = Allocation(allocation_options(options.allocation, labeller), classes)
    store = SubmapStore(folder, options.memory_mb)
    return Atlas(first, allocation, store, options.boundary)


def allocation_options(options: AllocationOptions, labeller: Labeller | None) -> AllocationOptions:
    """Options with the segmenter's default of `min_divergence` if it is not set."""
    if labeller is None or options.min_divergence is not None:
        return options
    return replace(options, min_divergence=labeller.segmenter.place_divergence)
