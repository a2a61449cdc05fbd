"""A submap of the atlas, whose content is in memory while it is active and stored afterwards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.exposure import Balance
from toolkit.slam.submaps.store import SubmapStore
from toolkit.slam.submaps.submap import Submap

Array = NDArray[np.float64]


@dataclass
class PagedSubmap:
    """Pages the content of a submap; anchor, descriptors and keyframe poses stay in memory.

    Those are small and used at every frame.

    Attributes:
        number: of the submap.
        T_world_submap: [4, 4] pose of the anchor.
        descriptors: [K, D] of the keyframes so far.
        store: of the contents of all inactive submaps.
        active: the content; None once it is stored.
        stored_poses: T_submap_camera [4, 4] of stored keyframes by frame index, in order.
        stored_balances: white balance of stored keyframes by frame index, in order.
        stored_gaussians, stored_views: their numbers when the submap became active again.
    """

    number: int
    T_world_submap: Array
    descriptors: NDArray[np.float32]
    store: SubmapStore
    active: Submap | None = None
    stored_poses: dict[int, Array] = field(default_factory=dict)
    stored_balances: dict[int, Balance] = field(default_factory=dict)
    stored_gaussians: int = 0
    stored_views: int = 0

    @classmethod
    def of(cls, submap: Submap, store: SubmapStore) -> PagedSubmap:
        """A submap that becomes active."""
        return cls(submap.number, submap.T_world_submap, submap.descriptors, store, submap)

    @property
    def keyframe_poses(self) -> dict[int, Array]:
        """T_submap_camera [4, 4] of the keyframes by frame index, in order."""
        return self.stored_poses if self.active is None else _poses(self.active)

    @property
    def keyframe_balances(self) -> dict[int, Balance]:
        """White balance of the keyframes by frame index, in order."""
        return self.stored_balances if self.active is None else _balances(self.active)

    @property
    def content(self) -> Submap:
        """The submap on the CPU; shared if it is active there.

        Raises:
            ToolkitError: it is stored on disk and cannot be read.
        """
        submap = self.store.get(self.number) if self.active is None else self.active
        submap.T_world_submap, submap.descriptors = self.T_world_submap, self.descriptors
        return submap.to("cpu")

    def page_in(self, device: torch.device) -> None:
        """Make the stored content active again, with the Gaussians on a device.

        Raises:
            ToolkitError: it is stored on disk and cannot be read.
        """
        submap = self.store.take(self.number)
        submap.T_world_submap, submap.descriptors = self.T_world_submap, self.descriptors
        self.stored_gaussians, self.stored_views = len(submap.gaussians), len(submap.views)
        self.active = submap.to(device)

    def page_out(self) -> None:
        """Store the active content, without the moments of its optimiser.

        Nothing is written if it did not change since it was made active again.
        """
        submap = self.content
        if self._is_stored(submap):
            self.stored_balances = _balances(submap)  # not restored with the active submap
            self.store.give_back(submap)
            self.active = None
        else:
            self.put(submap)

    def stored_state(self) -> dict[str, NDArray]:
        """Arrays that describe the stored version of an active submap, for `restore_stored`."""
        return {
            "stored/indices": np.array(list(self.stored_poses), np.int64),
            "stored/poses": np.array(list(self.stored_poses.values())).reshape(-1, 4, 4),
            "stored/gaussians": np.array(self.stored_gaussians),
            "stored/views": np.array(self.stored_views),
        }

    def restore_stored(self, arrays: Mapping[str, NDArray]) -> None:
        """Restore the `stored_state` of an active submap."""
        indices, poses = arrays["stored/indices"].tolist(), arrays["stored/poses"]
        self.stored_poses = {i: np.array(T) for i, T in zip(indices, poses, strict=True)}
        self.stored_gaussians = int(arrays["stored/gaussians"])
        self.stored_views = int(arrays["stored/views"])

    def _is_stored(self, submap: Submap) -> bool:
        """Whether the stored version has the same keyframes, poses and Gaussians.

        Without steps of the optimiser, Gaussians change only where keyframes are added or moved.
        """
        poses = _poses(submap)
        return (
            list(poses) == list(self.stored_poses)
            and all(np.array_equal(T, self.stored_poses[index]) for index, T in poses.items())
            and len(submap.gaussians) == self.stored_gaussians
            and len(submap.views) == self.stored_views
            and (self.active is None or not self.active.optimiser.is_active)
        )

    def put(self, submap: Submap) -> None:
        """Store another content of the submap, which is not active afterwards."""
        submap.optimiser.release()
        self.T_world_submap, self.descriptors = submap.T_world_submap, submap.descriptors
        poses = {index: T.copy() for index, T in _poses(submap).items()}
        self.stored_poses, self.stored_balances = poses, _balances(submap)
        self.store.put(submap)
        self.active = None


def _poses(submap: Submap) -> dict[int, Array]:
    return {keyframe.index: keyframe.T_map_camera for keyframe in submap.keyframes}


def _balances(submap: Submap) -> dict[int, Balance]:
    return {keyframe.index: keyframe.exposure.balance for keyframe in submap.keyframes}
