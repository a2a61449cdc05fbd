"""The atlas from settings."""

from __future__ import annotations

from pathlib import Path

from toolkit.mapping.mapper import Mapper
from toolkit.semantics.labeller import Labeller
from toolkit.settings.submaps import AllocationSettings, SubmapSettings
from toolkit.submaps.allocation import Allocation, AllocationOptions
from toolkit.submaps.atlas import Atlas, BoundaryOptions
from toolkit.submaps.store import SubmapStore


def build_atlas(
    settings: SubmapSettings,
    mapper: Mapper,
    labeller: Labeller | None,
    folder: Path | None = None,
) -> Atlas:
    """The atlas that the settings describe.

    Args:
        labeller: None for a map without labels.
        folder: where submaps rest; None keeps them in memory.
    """
    allocation = None
    if settings.use:
        classes = len(labeller.taxonomy) if labeller else 0
        allocation = Allocation(allocation_options(settings.allocation, labeller), classes)
    store = SubmapStore(folder, settings.memory_mb)
    boundary = BoundaryOptions(**settings.boundary.model_dump())
    return Atlas(mapper, allocation, store, boundary)


def allocation_options(
    settings: AllocationSettings, labeller: Labeller | None
) -> AllocationOptions:
    """When submaps begin, by the classes of whoever labels the frames."""
    values = settings.model_dump()
    if labeller is not None and settings.min_divergence is None:
        values["min_divergence"] = labeller.segmenter.place_divergence
    return AllocationOptions(**{name: v for name, v in values.items() if v is not None})
