"""All submaps of a map: the active one in memory, the others paged by the store."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import Balance
from toolkit.base.keyframe import Keyframe
from toolkit.io.arrays import arrays_below
from toolkit.slam.submaps.allocation import Allocation, AllocationVerdict
from toolkit.slam.submaps.options import BoundaryOptions
from toolkit.slam.submaps.paged import PagedSubmap
from toolkit.slam.submaps.store import SubmapStore
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.gaussians.cloud import GaussianCloud


class Atlas:
    """Owns the submaps and their anchors.

    Args:
        first: the first submap, empty. New ones are on its device.
        allocation: decides when the next submap starts; None keeps a single submap.
        store: stores inactive submaps; in memory by default.
        boundary: options of the transition between submaps.

    Attributes:
        saved: number of submaps loaded from an earlier run, which come first. They are neither
            optimised nor moved.
        unreadable: numbers of the submaps whose file was lost or damaged.
        boundary: options of the transition between submaps.
        active: number of the active submap; without one, of the last one that was.
        visited: number of keyframes that the active submap had when it was entered.
        device: of the active submap's Gaussians.
    """

    def __init__(
        self,
        first: Submap,
        allocation: Allocation | None = None,
        store: SubmapStore | None = None,
        boundary: BoundaryOptions | None = None,
    ) -> None:
        self.verdicts: list[AllocationVerdict] = []
        self.unreadable: list[int] = []
        self.saved = self.active = self.visited = 0
        self.boundary = boundary or BoundaryOptions()
        self.device = first.device
        self._allocation = allocation
        self._store = store or SubmapStore()
        self._submaps = [PagedSubmap.of(first, self._store)]
        self._none = GaussianCloud.empty(first.gaussians.features.shape[1])
        self._checkpoints: list[dict[str, int]] = []

    def __len__(self) -> int:
        return len(self._submaps)

    @property
    def has_active_submap(self) -> bool:
        """Whether a submap is active.

        None is until the camera is relocalised in a loaded map, and at the end of a run.
        """
        return bool(self._submaps) and self._submaps[self.active].active is not None

    @property
    def current(self) -> Submap:
        """The active submap, on the device that optimises it.

        Raises:
            RuntimeError: there is none.
        """
        submap = self._submaps[self.active].active if self._submaps else None
        if submap is None:
            raise RuntimeError("no submap is active")
        return submap

    @property
    def keyframes(self) -> list[Keyframe]:
        """The keyframes of the active submap, in order; none without an active submap."""
        return self.current.keyframes if self.has_active_submap else []

    @property
    def gaussians(self) -> GaussianCloud:
        """The Gaussians of the active submap; none without an active submap."""
        return self.current.gaussians if self.has_active_submap else self._none

    def load_map(self, submaps: Iterable[Submap]) -> None:
        """Load the submaps of an earlier run, before the first frame.

        No submap is active until `start` starts one.

        Args:
            submaps: numbered from 0, at least one; their keyframes have negative indices.
        """
        self._submaps = []
        for submap in submaps:
            self._submaps.append(PagedSubmap.of(submap, self._store))
            self._submaps[-1].page_out()
        self.saved = len(self._submaps)
        self.active = self.saved - 1

    def T_world_submap(self, number: int) -> NDArray[np.float64]:
        """[4, 4] pose of an anchor."""
        return self._submaps[number].T_world_submap

    def move(self, number: int, T_world_submap: NDArray[np.float64]) -> None:
        """Set the pose [4, 4] of an anchor; the submap's content does not change."""
        self._submaps[number].T_world_submap = T_world_submap.copy()

    def keyframe_poses(self, number: int) -> dict[int, NDArray[np.float64]]:
        """T_submap_camera of a submap's keyframes by frame index, in order."""
        return self._submaps[number].keyframe_poses

    def keyframe_balances(self, number: int) -> dict[int, Balance]:
        """White balance of a submap's keyframes by frame index, in order."""
        return self._submaps[number].keyframe_balances

    def descriptors(self, number: int) -> NDArray[np.float32]:
        """Descriptors [K, D] of a submap's keyframes so far."""
        return self._submaps[number].descriptors

    def describe(self, descriptor: NDArray[np.float32]) -> None:
        """Append the descriptor [D] of the active submap's newest keyframe."""
        active = self._submaps[self.active]
        rows = active.descriptors.reshape(-1, len(descriptor))
        active.descriptors = np.concatenate([rows, descriptor[None]]).astype(np.float32)

    def submap(self, number: int) -> Submap:
        """A submap on the CPU; the active one is shared if it is there.

        Raises:
            ToolkitError: the submap is stored on disk and cannot be read.
        """
        return self._submaps[number].content

    def put(self, submap: Submap) -> None:
        """Replace the stored content of a submap."""
        self._submaps[submap.number].put(submap)

    def has_enough(self, keyframes: list[Keyframe]) -> bool:
        """Whether a submap should only get keyframes of what it does not show yet."""
        return self._allocation is not None and self._allocation.has_enough(keyframes)

    def is_full(self, submap: Submap) -> bool:
        """Whether a submap has reached a limit of its size."""
        if self._allocation is None:
            return False
        return bool(self._allocation.limit(submap.keyframes, len(submap.gaussians)))

    @property
    def established_keyframes(self) -> list[Keyframe]:
        """The keyframes of the active submap without the newest, which see most of any view."""
        keyframes = self.keyframes
        return keyframes if self._allocation is None else self._allocation.established(keyframes)

    def judge(self) -> AllocationVerdict | None:
        """Decide whether the newest keyframe starts a submap; None without allocation."""
        if self._allocation is None:
            return None
        verdict = self._allocation.judge(self.active, self.keyframes, len(self.gaussians))
        self.verdicts.append(verdict)
        return verdict

    def start(self, submap: Submap) -> None:
        """Make a new submap the active one, and store the one before."""
        if self.has_active_submap:
            self.store_active()
        self._submaps.append(PagedSubmap.of(submap, self._store))
        self.active, self.visited = submap.number, 0

    def enter(self, number: int) -> None:
        """Make a stored submap of this run the active one again, and store the one before.

        Raises:
            ToolkitError: it cannot be read; nothing has changed.
        """
        self._submaps[number].page_in(self.device)
        self.store_active()
        self.active, self.visited = number, len(self._submaps[number].keyframe_poses)
        self._store.prune(*self._checkpoints)  # each visit may store another version

    def store_active(self) -> None:
        """Move the active submap to the store; afterwards no submap is active."""
        self._submaps[self.active].page_out()

    @property
    def stored_versions(self) -> dict[str, int]:
        """Versions of the stored submaps by number; see `SubmapStore.state`."""
        return self._store.state()

    def readable(self) -> list[int]:
        """Numbers of the submaps whose content can be read."""
        return [number for number in range(len(self)) if number not in self.unreadable]

    def forget_checkpoints(self) -> None:
        """Remove all files but those of the current state: no checkpoint is needed any more."""
        self._checkpoints = []
        self._store.prune()

    def compress(self) -> None:
        """Compress the stored submaps, which will not change any more."""
        self._store.compress()

    def checkpointed(self) -> None:
        """Remove the files that neither of the two newest checkpoints needs.

        Call this after a checkpoint of the current state was written.
        """
        self._checkpoints = [*self._checkpoints, self._store.state()][-2:]
        self._store.prune(*self._checkpoints)

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues identically."""
        arrays: dict[str, NDArray] = {}
        arrays["anchors"] = np.array([submap.T_world_submap for submap in self._submaps])
        values: dict[str, Any] = {"store": self.stored_versions, "saved": self.saved}
        values["visited"] = self.visited
        values["verdicts"] = [verdict.values() for verdict in self.verdicts]
        for submap in self._submaps:
            arrays[f"descriptors/{submap.number}"] = submap.descriptors
            if submap.active is None:
                arrays |= _stored_state(submap)
        if self.has_active_submap:
            content, values["active"] = self.current.state()
            arrays |= self._submaps[self.active].stored_state()
            # Copies: the next optimisation step changes the Gaussians in place.
            arrays |= {f"active/{name}": _copied(name, array) for name, array in content.items()}
        return arrays, values

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`; a warning is logged for each submap that cannot be read."""
        self._submaps = [
            _restored(PagedSubmap(n, np.array(T), arrays[f"descriptors/{n}"], self._store), arrays)
            for n, T in enumerate(arrays["anchors"])
        ]
        self.active, self.visited = len(self._submaps) - 1, int(values["visited"])
        if "active" in values:
            content = arrays_below(arrays, "active/")
            submap = Submap.from_state(content, values["active"], self.device)
            self.active = submap.number
            self._submaps[self.active].active = submap
            self._submaps[self.active].restore_stored(arrays)
        self.saved = int(values["saved"])
        self.verdicts = [AllocationVerdict.from_values(row) for row in values["verdicts"]]
        self.unreadable = self._store.restore(values["store"])
        if self.has_active_submap and self.active in self.unreadable:
            # Only its stored version is lost, and is written again.
            self.unreadable.remove(self.active)
            self._submaps[self.active].stored_poses = {}
        self._checkpoints = [dict(values["store"])]


def _copied(name: str, array: NDArray) -> NDArray:
    """A copy of an array of a submap's state; the images of keyframes never change."""
    return array if name.startswith("keyframes/") else array.copy()


def _stored_state(submap: PagedSubmap) -> dict[str, NDArray]:
    """Poses and white balance of a stored submap's keyframes."""
    number, poses = submap.number, submap.keyframe_poses
    balances = list(submap.keyframe_balances.values())
    return {
        f"indices/{number}": np.array(list(poses), np.int64),
        f"poses/{number}": np.array(list(poses.values())).reshape(-1, 4, 4),
        f"balances/{number}": np.array(balances).reshape(-1, 3),
    }


def _restored(submap: PagedSubmap, arrays: dict[str, NDArray]) -> PagedSubmap:
    """The same with its `_stored_state`, if it is stored."""
    number = submap.number
    if f"indices/{number}" in arrays:
        indices = arrays[f"indices/{number}"].tolist()
        poses, balances = arrays[f"poses/{number}"], arrays[f"balances/{number}"].tolist()
        submap.stored_poses = {i: np.array(T) for i, T in zip(indices, poses, strict=True)}
        submap.stored_balances = {
            i: (red, green, blue) for i, (red, green, blue) in zip(indices, balances, strict=True)
        }
    return submap
