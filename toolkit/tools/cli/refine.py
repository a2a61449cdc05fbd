"""`semsplat refine`: refine the map of a finished run, here or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from toolkit.io.atomic import cannot_write
from toolkit.io.storage import is_url
from toolkit.runs.batch.refining.pipeline import refine_map
from toolkit.runs.batch.refining.tasks import InThisProcess, Tasks
from toolkit.runs.lock import locked
from toolkit.runs.new_folder import repeatable
from toolkit.tools.cli.batch_programs import RefineOptions

Item = TypeVar("Item")
Value = TypeVar("Value")


def main(options: RefineOptions) -> int:
    """Refine a run.

    Raises:
        ToolkitError: there is no finished run, its map cannot be refined, or there is no cluster.
    """
    source, out = _absolute(options.run), _absolute(options.out)
    with _tasks(options) as tasks, _held(out):
        refined = refine_map(source, out, tasks, options.threads, options.iterations)
    moved = f"submaps moved by up to {100.0 * refined.largest_m:.2f} cm"
    if not refined.largest_m:
        moved = "they agree with the poses of the run, which stay"
    print(
        f"{refined.submaps} submaps refined; {refined.pairs} pairs registered, {refined.verified} "
        f"verified: {moved}"
    )
    print(f"wrote {refined.gaussians} Gaussians to {out}; metrics: semsplat evaluate {out}")
    return 0


@contextmanager
def _held(out: str) -> Iterator[None]:
    """Hold the output folder, if it is one of this machine; an empty one is not left behind."""
    if is_url(out):
        yield
        return
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error
    try:
        with repeatable(), locked(folder):
            yield
    finally:
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


@contextmanager
def _tasks(options: RefineOptions) -> Iterator[Tasks]:
    if not options.use_ray:
        yield InThisProcess()
        return
    from toolkit.runs.batch.ray_cluster import RayCluster, TaskResources, ray_cluster

    class _OnRay:
        def __init__(self, cluster: RayCluster) -> None:
            self._cluster = cluster
            self._resources = TaskResources(options.threads, options.memory_gb)

        def map(self, function: Callable[[Item], Value], items: Sequence[Item]) -> list[Value]:
            return self._cluster.map(function, items, self._resources)

    with ray_cluster(options.ray) as cluster:
        yield _OnRay(cluster)


def _absolute(place: str) -> str:
    """Return a place that is valid in the working directory of every worker."""
    return place if is_url(place) else str(Path(place).absolute())
