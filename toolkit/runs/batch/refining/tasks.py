"""The tasks of the refinement: each reads what it needs from storage, and returns little."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.frustum import Frustum
from toolkit.base.pose_graph.noise import path_between
from toolkit.io import storage
from toolkit.runs.batch.refining.stored_map import StoredMap
from toolkit.runs.building import refinement_describer
from toolkit.semantics.features.factory import build_differentiable_describer
from toolkit.slam.loops.closing.visibility import Visibility
from toolkit.slam.loops.registration.factory import build_fine, needs_describer
from toolkit.slam.loops.registration.result import RegistrationResult, register_pair
from toolkit.slam.loops.registration.views import ViewRenderer
from toolkit.slam.loops.verification import VerificationLimits, rejection_reason
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.rendering import map_device

Array = NDArray[np.float64]
Item = TypeVar("Item")
Value = TypeVar("Value")


class Tasks(Protocol):
    """Calls a function for many items, in this process or on a cluster."""

    def map(self, function: Callable[[Item], Value], items: Sequence[Item]) -> list[Value]:
        """Return the results in the order of the items."""
        ...


class InThisProcess:
    """Calls the function for one item after the other."""

    def map(self, function: Callable[[Item], Value], items: Sequence[Item]) -> list[Value]:
        """See Tasks."""
        return [function(item) for item in items]


@dataclass(frozen=True)
class Work:
    """What all tasks share; small.

    Attributes:
        source: the map that is refined.
        out: place of the refined run.
        threads: number of threads of every task; results depend on it by rounding.
        iterations: optimisation steps per keyframe.
    """

    source: StoredMap
    out: str
    threads: int
    iterations: int

    @property
    def scratch(self) -> str:
        """Place of intermediate results, removed at the end."""
        return storage.join(self.out, "scratch")


@dataclass(frozen=True)
class SubmapTask:
    """A task on one submap.

    Attributes:
        number: of the submap.
        others: submaps that may overlap with it.
    """

    work: Work
    number: int
    others: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Extent:
    """Where a submap is.

    Attributes:
        low, high: corners [3] of the box around the observed points, in the world.
        path_m, path_rad: length and total rotation of the path of its keyframes.
        keyframes: number of keyframes.
    """

    low: Array
    high: Array
    path_m: float
    path_rad: float
    keyframes: int


def measure_extent(task: SubmapTask) -> Extent:
    """Measure where a submap is, and store which points its keyframes observe."""
    torch.set_num_threads(task.work.threads)
    submap = task.work.source.submap(task.number)
    seen = Visibility.of(submap)
    arrays: dict[str, NDArray] = {}
    cameras = []
    for index, (volume, points) in enumerate(zip(seen.volumes, seen.points, strict=True)):
        arrays |= {f"{index}/T": volume.T_world_camera, f"{index}/points": points}
        cameras.append({"camera": vars(volume.camera), "far_m": volume.far_m})
    storage.write_tree(_visibility(task.work, task.number), arrays, {"views": cameras})
    points = np.concatenate([*seen.points, submap.T_world_submap[None, :3, 3]])
    poses = [keyframe.T_map_camera for keyframe in submap.keyframes]
    path_m, path_rad = path_between(poses) if len(poses) > 1 else (0.0, 0.0)
    return Extent(points.min(0), points.max(0), path_m, path_rad, len(submap.keyframes))


def measure_overlaps(task: SubmapTask) -> dict[int, float]:
    """Measure the overlap of a submap's views with those of other submaps (0-1), by number."""
    torch.set_num_threads(task.work.threads)
    own = _read_visibility(task.work, task.number)
    return {other: own.overlap(_read_visibility(task.work, other)) for other in task.others}


@dataclass(frozen=True)
class PairTask:
    """Registration of two submaps from their current poses."""

    work: Work
    first: int
    second: int


@dataclass(frozen=True, eq=False)
class PairResult:
    """Registration of two submaps.

    Attributes:
        reason: why it was rejected; empty if it was accepted.
    """

    first: int
    second: int
    result: RegistrationResult
    reason: str


def register_submap_pair(task: PairTask) -> PairResult:
    """Register two submaps by rendering, from their current poses, and verify the result."""
    work, source = task.work, task.work.source
    torch.set_num_threads(work.threads)
    loops, registration = source.settings.loops, source.settings.registration
    renderer = ViewRenderer(source.settings.backend, source.semantics())
    describer = None
    if needs_describer(registration):
        describer = build_differentiable_describer(loops.features)
    registrar = build_fine(registration, renderer, describer)
    first, second = source.submap(task.first), source.submap(task.second)
    T_first_second = se3.inverse(first.T_world_submap) @ second.T_world_submap
    result = register_pair(registrar, first, second, T_first_second)
    reason = rejection_reason(result, VerificationLimits() if loops.verify else None)
    return PairResult(task.first, task.second, result, reason)


def refine_submap(task: SubmapTask) -> int:
    """Optimise a submap over its keyframes, and store it; return its number of Gaussians.

    That of a splat file is only stored: its keyframes are renderings.
    """
    work, settings = task.work, task.work.source.settings
    torch.set_num_threads(work.threads)
    submap = work.source.submap(task.number)
    if settings.map is None or submap.keyframes[0].index >= 0:
        submap = _refined(work, submap)
    submap.optimiser.release()
    arrays, values = work.source.unit.submap_in_metres(submap).state()
    storage.write_tree(refined_place(work.out, task.number), arrays, values)
    return len(submap.gaussians)


def _refined(work: Work, submap: Submap) -> Submap:
    settings = work.source.settings
    # Poses of keyframes stay, since those of the other frames refer to them.
    options = replace(
        settings.mapping,
        centred=False,
        final_iterations=work.iterations,
        final_poses=False,
        bundle_adjustment=False,
    )
    mapper = Mapper(
        options,
        # One generator per submap, so that the order of the tasks does not matter.
        np.random.default_rng((settings.seed, submap.number)),
        settings.backend,
        None,
        work.source.semantics(),
        map_device(settings.device, settings.backend),
        describer=refinement_describer(settings),
    )
    submap = submap.to(mapper.device)
    mapper.refine(submap)
    return submap.to("cpu")


def refined_place(out: str, number: int) -> str:
    """Return the place of a refined submap, as `SubmapStore` names it."""
    return storage.join(out, "submaps", f"{number:04d}_0")


def _visibility(work: Work, number: int) -> str:
    return storage.join(work.scratch, f"visibility{number:04d}")


def _read_visibility(work: Work, number: int) -> Visibility:
    tree = storage.read_tree(_visibility(work, number))
    views: list[dict[str, Any]] = tree.metadata["views"]
    volumes = [
        Frustum(Camera(**view["camera"]), tree.arrays[f"{index}/T"], far_m=view["far_m"])
        for index, view in enumerate(views)
    ]
    return Visibility(volumes, [tree.arrays[f"{index}/points"] for index in range(len(views))])
