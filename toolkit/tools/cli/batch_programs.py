"""Arguments of the jobs that execute many runs or many tasks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from toolkit.base.options import PositiveFloat, PositiveInt
from toolkit.runs.batch.options import RayOptions


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


@dataclass(frozen=True)
class RefineOptions:
    """Refine the map of a finished run: register overlapping submaps and optimise every submap."""

    run: Positional[str]
    """Run folder: a path, or a URL of shared storage (s3://, gs://)."""
    out: str
    """Run folder to write, new or empty: a path or a URL."""
    iterations: PositiveInt | None = None
    """Optimisation steps per keyframe. By default, as at the end of the run."""
    threads: PositiveInt = 1
    """Number of threads of every task. Results are only reproducible with the same number."""
    cluster: bool = False
    """Execute the tasks on a Ray cluster. By default, one after the other; results are the same."""
    memory_gb: PositiveFloat = 2.0
    """Memory in GB that the scheduler reserves for each task."""
    ray: RayOptions = RayOptions()

    @property
    def use_ray(self) -> bool:
        """Whether the tasks are executed on a cluster."""
        return self.cluster or self.ray != RayOptions()
