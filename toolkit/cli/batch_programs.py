"""Arguments of the jobs that execute many runs or many tasks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from toolkit.cluster.options import RayOptions


@dataclass(frozen=True)
class RunManyOptions:
    """Execute the runs of a plan (sequences x settings x seeds), and write a table and a report."""

    plan: Positional[Path]
    """Plan (.yaml, docs/guides/many-runs.md)."""
    dry_run: bool = False
    """List the runs, their folders and what exists of them, and stop."""
    cluster: bool = False
    """Execute the runs on a Ray cluster. By default, one after the other."""
    ray: RayOptions = RayOptions()

    @property
    def use_ray(self) -> bool:
        """Whether the runs are executed on a cluster."""
        return self.cluster or self.ray != RayOptions()
