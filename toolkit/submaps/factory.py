"""Build the atlas from the options of submaps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from toolkit.mapping.mapper import Mapper
from toolkit.semantics.labeller import Labeller
from toolkit.submaps.allocation import Allocation
from toolkit.submaps.atlas import Atlas
from toolkit.submaps.options import AllocationOptions, SubmapOptions
from toolkit.submaps.store import SubmapStore


def build_atlas(
    options: SubmapOptions,
    mapper: Mapper,
    labeller: Labeller | None,
    folder: Path | None = None,
) -> Atlas:
    """Build the atlas described by the options.

    Args:
        labeller: segments frames; None for a map without labels.
        folder: where inactive submaps are stored; None keeps them in memory.
    """
    allocation = None
    if options.use:
        classes = len(labeller.taxonomy) if labeller else 0
        allocation = Allocation(allocation_options(options.allocation, labeller), classes)
    store = SubmapStore(folder, options.memory_mb)
    return Atlas(mapper, allocation, store, options.boundary)


def allocation_options(options: AllocationOptions, labeller: Labeller | None) -> AllocationOptions:
    """Options with the segmenter's default of `min_divergence` if it is not set."""
    if labeller is None or options.min_divergence is not None:
        return options
    return replace(options, min_divergence=labeller.segmenter.place_divergence)
