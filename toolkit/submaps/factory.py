"""The atlas from settings."""

from __future__ import annotations

from pathlib import Path

from toolkit.mapping.mapper import Mapper
from toolkit.settings.submaps import SubmapSettings
from toolkit.submaps.allocation import Allocation, AllocationOptions
from toolkit.submaps.atlas import Atlas, BoundaryOptions
from toolkit.submaps.store import SubmapStore


def build_atlas(
    settings: SubmapSettings, mapper: Mapper, classes: int, folder: Path | None = None
) -> Atlas:
    """The atlas that the settings describe.

    Args:
        classes: of the taxonomy, 0 for a map without labels.
        folder: where submaps rest; None keeps them in memory.
    """
    allocation = None
    if settings.use:
        options = AllocationOptions(**settings.allocation.model_dump())
        allocation = Allocation(options, classes)
    store = SubmapStore(folder, settings.memory_mb)
    boundary = BoundaryOptions(**settings.boundary.model_dump())
    return Atlas(mapper, allocation, store, boundary)
