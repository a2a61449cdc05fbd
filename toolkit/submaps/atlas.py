"""All submaps and their anchors: the mapper works on the active one, the others are stored."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.exposure import NEUTRAL, Balance
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.keyframe import Keyframe
from toolkit.mapping.gaussian_map import MapContent
from toolkit.mapping.mapper import Mapper
from toolkit.rendering import SurfaceView
from toolkit.submaps.allocation import Allocation, AllocationVerdict
from toolkit.submaps.options import BoundaryOptions
from toolkit.submaps.store import SubmapStore
from toolkit.submaps.submap import Submap

# Maximum distance of a visible Gaussian behind the rendered surface, as a fraction of depth.
_MAX_BEHIND = 0.05
_NO_INDICES = torch.zeros(0, dtype=torch.int64)


class Atlas:
    """Owns the anchors and provides access to the submaps.

    Args:
        mapper: holds and optimises the active submap.
        allocation: decides when the next submap starts; None keeps a single submap.
        store: stores inactive submaps; in memory by default.
        boundary: options of the transition between submaps.

    Attributes:
        saved: number of submaps loaded from an earlier run, which come first. They are neither
            optimised nor moved.
        unreadable: numbers of the submaps whose file was lost or damaged.
    """

    def __init__(
        self,
        mapper: Mapper,
        allocation: Allocation | None = None,
        store: SubmapStore | None = None,
        boundary: BoundaryOptions | None = None,
    ) -> None:
        self.mapper = mapper
        self.verdicts: list[AllocationVerdict] = []
        self.unreadable: list[int] = []
        self.saved = 0
        self._allocation = allocation
        self._store = store or SubmapStore()
        self._boundary = boundary or BoundaryOptions()
        self._anchors = [np.eye(4)]
        # Poses of the keyframes of each stored submap by frame index: small and used often.
        self._keyframes: list[dict[int, NDArray[np.float64]]] = []
        self._balances: list[dict[int, Balance]] = []
        self._checkpoints: list[dict[str, int]] = []
        self._descriptors: list[NDArray[np.float32]] = [np.zeros((0, 0), np.float32)]

    @property
    def active(self) -> int:
        """Number of the active submap, the newest one."""
        return len(self._anchors) - 1

    def __len__(self) -> int:
        return len(self._anchors)

    @property
    def has_active_submap(self) -> bool:
        """Whether a submap is active; False until the camera is relocalised in a loaded map."""
        return self._in_mapper(self.active)

    def load_map(self, submaps: Iterable[Submap]) -> None:
        """Load the submaps of an earlier run, before the first frame.

        No submap is active until `start_at` starts one.

        Args:
            submaps: numbered from 0, at least one; their keyframes have negative indices.
        """
        self._anchors, self._descriptors = [], []
        for submap in submaps:
            self._anchors.append(submap.T_world_submap)
            self._descriptors.append(submap.descriptors)
            self._keyframes.append({k.index: k.T_map_camera for k in submap.keyframes})
            self._balances.append(_balances(submap.keyframes))
            self._store.put(submap)
        self.saved = len(self._anchors)

    def T_world_submap(self, number: int) -> NDArray[np.float64]:
        """[4, 4] pose of an anchor."""
        return self._anchors[number]

    def move(self, number: int, T_world_submap: NDArray[np.float64]) -> None:
        """Set the pose [4, 4] of an anchor; the submap's content does not change."""
        self._anchors[number] = T_world_submap.copy()

    def keyframe_poses(self, number: int) -> dict[int, NDArray[np.float64]]:
        """T_submap_camera of a submap's keyframes by frame index, in order."""
        if self._in_mapper(number):
            return {k.index: k.T_map_camera for k in self.mapper.keyframes}
        return self._keyframes[number]

    def keyframe_balances(self, number: int) -> dict[int, Balance]:
        """White balance of a submap's keyframes by frame index, in order."""
        return (
            _balances(self.mapper.keyframes) if self._in_mapper(number) else self._balances[number]
        )

    def _in_mapper(self, number: int) -> bool:
        """Whether a submap is the active one; after `store_active` there is none."""
        return number == len(self._keyframes)

    def descriptors(self, number: int) -> NDArray[np.float32]:
        """Descriptors [K, D] of a submap's keyframes so far."""
        return self._descriptors[number]

    def describe(self, descriptor: NDArray[np.float32]) -> None:
        """Append the descriptor [D] of the active submap's newest keyframe."""
        rows = self._descriptors[-1].reshape(-1, len(descriptor))
        self._descriptors[-1] = np.concatenate([rows, descriptor[None]]).astype(np.float32)

    def submap(self, number: int) -> Submap:
        """A submap; the active one shares the mapper's arrays.

        Raises:
            ToolkitError: the submap is stored on disk and cannot be read.
        """
        if self._in_mapper(number):
            content = self.mapper.content
            return Submap(
                number,
                self._anchors[number],
                content.gaussians,
                content.keyframes,
                content.seeded_by,
                self._descriptors[number],
                content.steps,
            )
        submap = self._store.get(number)
        submap.T_world_submap = self._anchors[number]
        return submap

    def put(self, submap: Submap) -> None:
        """Replace the content of a submap."""
        number = submap.number
        self._anchors[number] = submap.T_world_submap
        self._descriptors[number] = submap.descriptors
        if self._in_mapper(number):
            self.mapper.replace_content(submap.content)
            return
        self._keyframes[number] = {k.index: k.T_map_camera for k in submap.keyframes}
        self._balances[number] = _balances(submap.keyframes)
        self._store.put(submap)

    def judge(self) -> AllocationVerdict | None:
        """Decide whether the newest keyframe starts a submap; None without allocation."""
        if self._allocation is None:
            return None
        mapper = self.mapper
        verdict = self._allocation.judge(self.active, mapper.keyframes, len(mapper.gaussians))
        self.verdicts.append(verdict)
        return verdict

    def start_next(self) -> NDArray[np.float64]:
        """Start the next submap at the newest keyframe, which then belongs to both submaps.

        Returns:
            T_new_old [4, 4], from the frame of the old submap to that of the new one.
        """
        self.mapper.optimise_window(self._boundary.steps, self._boundary.bundle_adjustment)
        old, last = self.submap(self.active), self.mapper.keyframes[-1]
        anchor = replace(last, T_map_camera=np.eye(4), pose_moments=None)
        self._start(anchor, old, last.T_map_camera)
        return se3.inverse(last.T_map_camera)

    def start_at(
        self,
        anchor: Keyframe,
        number: int,
        T_submap_camera: NDArray[np.float64],
        inherit: bool = True,
    ) -> None:
        """Start a submap at a keyframe that was located in an existing submap.

        Args:
            anchor: the first keyframe, at the identity.
            number: the existing submap's number.
            T_submap_camera: pose [4, 4] of the keyframe in the existing submap.
            inherit: False if the pose is uncertain, so that no Gaussians are copied.
        """
        source = self.submap(number)
        if not inherit:
            empty = source.gaussians.select(_NO_INDICES)
            source = replace(source, gaussians=empty, steps=_NO_INDICES.int())
        else:
            located = replace(anchor, T_map_camera=T_submap_camera)
            self.mapper.exposures.estimate(located, source.keyframes)
            anchor = replace(located, T_map_camera=anchor.T_map_camera)
        self._start(anchor, source, T_submap_camera)

    def _start(
        self, anchor: Keyframe, source: Submap, T_source_camera: NDArray[np.float64]
    ) -> None:
        """Start a submap at a keyframe that has a pose in an existing submap."""
        old = self.submap(self.active)
        content = self._inherited(anchor, source, T_source_camera)
        if self.has_active_submap:
            self.store_active()
        self._anchors.append(source.T_world_submap @ T_source_camera)
        self._descriptors.append(self._boundary_row(old, anchor.index))
        self.mapper.replace_content(content)
        self.mapper.add_keyframe(anchor)

    @staticmethod
    def _boundary_row(old: Submap, index: int) -> NDArray[np.float32]:
        """Descriptor [1, D] of the keyframe that two submaps share; [0, D] if there is none."""
        shared = bool(old.keyframes) and old.keyframes[-1].index == index
        return old.descriptors[-1:].copy() if shared else old.descriptors[:0].copy()

    def store_active(self) -> None:
        """Move the active submap to the store; afterwards no submap is active."""
        active = self.submap(self.active)
        self._keyframes.append({k.index: k.T_map_camera for k in active.keyframes})
        self._balances.append(_balances(active.keyframes))
        self._store.put(active)

    @property
    def stored_versions(self) -> dict[str, int]:
        """Versions of the stored submaps by number; see `SubmapStore.state`."""
        return self._store.state()

    def readable(self) -> list[int]:
        """Numbers of the submaps whose content can be read."""
        return [number for number in range(len(self)) if number not in self.unreadable]

    def _inherited(
        self, anchor: Keyframe, source: Submap, T_source_camera: NDArray[np.float64]
    ) -> MapContent:
        """Copies of the Gaussians that the first keyframe sees, in the new submap's frame."""
        cloud, T_camera_source = source.gaussians, se3.inverse(T_source_camera)
        index = _NO_INDICES
        if self._boundary.inherit:
            view = self.mapper.render(cloud, anchor.camera, T_source_camera)
            index = visible_gaussians(view, cloud, anchor.camera, T_camera_source)
        copies = cloud.select(index).transformed(T_camera_source)
        copies = replace(copies, centred_colours=self.mapper.options.centred)
        seeded_by = torch.full((len(index),), anchor.index, dtype=torch.int32)
        return MapContent(copies, [], seeded_by, source.steps.index_select(0, index))

    def checkpointed(self) -> None:
        """Remove the files that neither of the two newest checkpoints needs.

        Call this after a checkpoint of the current state was written.
        """
        self._checkpoints = [*self._checkpoints, self._store.state()][-2:]
        self._store.prune(*self._checkpoints)

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values; the active submap's content is the mapper's state."""
        arrays: dict[str, NDArray] = {"anchors": np.array(self._anchors)}
        for number, descriptors in enumerate(self._descriptors):
            arrays[f"descriptors/{number}"] = descriptors
        for number, poses in enumerate(self._keyframes):
            arrays[f"indices/{number}"] = np.array(list(poses), np.int64)
            arrays[f"poses/{number}"] = np.array(list(poses.values())).reshape(-1, 4, 4)
            balances = list(self._balances[number].values())
            arrays[f"balances/{number}"] = np.array(balances).reshape(-1, 3)
        verdicts = [verdict.values() for verdict in self.verdicts]
        values = {"store": self.stored_versions, "verdicts": verdicts, "saved": self.saved}
        return arrays, values

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`; a warning is logged for each submap that cannot be read."""
        self._anchors = [np.array(T) for T in arrays["anchors"]]
        count = len(self._anchors)
        self._descriptors = [np.array(arrays[f"descriptors/{n}"]) for n in range(count)]
        self._keyframes = [
            {
                int(index): np.array(T)
                for index, T in zip(arrays[f"indices/{n}"], arrays[f"poses/{n}"], strict=True)
            }
            for n in range(count)
            if f"indices/{n}" in arrays
        ]
        self._balances = [_restored(poses, arrays, n) for n, poses in enumerate(self._keyframes)]
        self.saved = int(values["saved"])
        self.verdicts = [AllocationVerdict.from_values(row) for row in values["verdicts"]]
        self.unreadable = self._store.restore(values["store"])
        self._checkpoints = [dict(values["store"])]


def _balances(keyframes: Iterable[Keyframe]) -> dict[int, Balance]:
    return {keyframe.index: keyframe.exposure.balance for keyframe in keyframes}


def _restored(
    indices: Iterable[int], arrays: dict[str, NDArray], number: int
) -> dict[int, Balance]:
    """White balance of a submap's keyframes; neutral in checkpoints of older versions."""
    rows = arrays.get(f"balances/{number}")
    if rows is None:
        return dict.fromkeys(indices, NEUTRAL)
    values = [(float(r), float(g), float(b)) for r, g, b in rows]
    return dict(zip(indices, values, strict=True))


def visible_gaussians(
    view: SurfaceView, cloud: GaussianCloud, camera: Camera, T_camera_map: NDArray[np.float64]
) -> Tensor:
    """Indices [V] of the Gaussians on the surface visible in a rendered view of the map."""
    points = cloud.transformed(T_camera_map).means.double().numpy()
    height, width = view.depth_m.shape
    ahead = points[:, 2] > 0
    uv = camera.project(np.where(ahead[:, None], points, [0.0, 0.0, 1.0]))
    column, row = np.rint(uv).astype(np.int64).T
    inside = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    depth_m = view.depth_m.numpy()[row[inside], column[inside]]
    inside[inside] = points[inside, 2] <= (1.0 + _MAX_BEHIND) * depth_m
    return torch.from_numpy(inside.nonzero()[0])
