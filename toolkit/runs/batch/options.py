"""Options of Ray clusters."""

from __future__ import annotations

from dataclasses import dataclass

from toolkit.base.options import PositiveInt


@dataclass(frozen=True)
class RayOptions:
    """The Ray cluster that executes tasks; requires `pip install 'semsplat[cluster]'`."""

    address: str | None = None
    """Address of an existing cluster (HOST:PORT, or auto), whose nodes have semsplat and see the
    same files. By default, a cluster is started on this machine, which only this machine can
    reach."""
    cpus: PositiveInt | None = None
    """Number of cores of a cluster on this machine. By default, all of them."""
    object_store_mb: PositiveInt = 100
    """Size of the object store of a cluster on this machine, in MB."""
