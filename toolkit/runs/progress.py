"""State of a run in progress, from its newest snapshot or checkpoint."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.image_sides import ImageSide
from toolkit.io.arrays import arrays_below, read_array_tree
from toolkit.io.guarded.documents import read_json
from toolkit.io.splat_labels import SplatLabels
from toolkit.runs.checkpoints import CHECKPOINT_FORMAT
from toolkit.runs.folder import RunFolder
from toolkit.runs.maps.map_files import splat_labels
from toolkit.runs.settings import load_stored_settings
from toolkit.runs.snapshots import watch
from toolkit.scene.growing.listener import read_snapshot
from toolkit.semantics.factory import build_code
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.mapping.semantic_mapping import build_semantic_mapping
from toolkit.slam.submaps.store import SubmapStore
from toolkit.splatting.gaussians.cloud import PARAMETERS, GaussianCloud

# Arrays of a checkpoint that describe the map and the cameras; the rest is much larger.
_WANTED = re.compile(
    r"atlas/(anchors|indices/\d+|poses/\d+)|mapper/semantics/.*|path/T_keyframe_camera|scene/shown/.*"
    r"|atlas/active/(gaussians/.*|keyframes/\d+/(T_map_camera|rgb))"
)


@dataclass(frozen=True)
class MapPart:
    """The Gaussians of a submap.

    Attributes:
        number: of the submap.
        T_world_submap: [4, 4] pose of its anchor.
        gaussians: in its frame.
    """

    number: int
    T_world_submap: NDArray[np.float64]
    gaussians: GaussianCloud


@dataclass(frozen=True)
class ProgressKeyframe:
    """A keyframe of a run in progress.

    Attributes:
        index: frame index.
        submap: number of its submap.
        T_world_camera: [4, 4] float64.
        rgb: [3, H, W] uint8, in snapshots reduced; None for keyframes of stored submaps.
    """

    index: int
    submap: int
    T_world_camera: NDArray[np.float64]
    rgb: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class RunProgress:
    """State of a run in progress.

    Attributes:
        next_frame: number of frames that were processed.
        parts: submaps that can be read.
        keyframes: keyframes in order.
        indices: [M] frame indices of the tracked frames.
        up_side: the side of the images that is up.
        T_world_camera: [M, 4, 4] their poses. Those of parts of the map that were not joined so
            far have arbitrary poses relative to each other.
        camera: intrinsics; None before the first keyframe.
        taxonomy: of the labels, or None.
        decode: labels of Gaussians from their features; None without labels.
        doubtful: indices of the tracked frames whose poses may be wrong.
        lost: indices of the frames without a pose.
        graph: the scene graph so far in node-link format; None without one.
        voxels_m: by the number of an object of the graph, [V, 3] mean point of each of its voxels.
    """

    next_frame: int
    parts: list[MapPart]
    keyframes: list[ProgressKeyframe]
    indices: list[int]
    up_side: ImageSide
    T_world_camera: NDArray[np.float64]
    camera: Camera | None
    taxonomy: Taxonomy | None
    decode: Callable[[GaussianCloud], SplatLabels] | None
    doubtful: frozenset[int] = frozenset()
    lost: frozenset[int] = frozenset()
    graph: dict[str, Any] | None = None
    voxels_m: Mapping[int, NDArray[np.float32]] = field(default_factory=dict)


class ProgressReader:
    """Reads the state of a run whenever it has written a snapshot or saved a checkpoint.

    Runs write snapshots while `read` is called.

    Args:
        path: the run folder.

    Raises:
        RunFolderError: the folder contains no run.
    """

    def __init__(self, path: Path) -> None:
        self.folder = RunFolder.open(path)
        self._settings = load_stored_settings(self.folder.config)[0]
        self._next_frame = -1
        self._serials: dict[Path, int] = {}
        # Gaussians of the stored submaps by number and version.
        self._clouds: dict[tuple[int, int], GaussianCloud] = {}

    @property
    def finished(self) -> bool:
        """Whether the run has written its results."""
        return self.folder.map.is_file() and self.folder.frames.is_file()

    def read(self) -> RunProgress | None:
        """Read the newest state, None if there is none since the last call.

        What is replaced while it is read counts as none.

        Raises:
            RunFolderError: another version of semsplat has saved it in another format.
        """
        watch(self.folder)
        slot = self._newest()
        serial = None if slot is None else read_serial(slot)
        if slot is None or serial is None or serial == self._serials.get(slot):
            return None
        try:
            tree = read_array_tree(slot, lambda name: _WANTED.fullmatch(name) is not None)
        except (FormatError, RunFolderError):
            return None
        if tree.metadata.get("serial") != serial or read_serial(slot) != serial:
            return None
        found = tree.metadata.get("format")
        if found != CHECKPOINT_FORMAT:
            raise RunFolderError(
                f"{slot} has checkpoint format {found}, this version of semsplat reads format "
                f"{CHECKPOINT_FORMAT}; use the version that started the run"
            )
        try:
            progress = self._progress(tree.arrays, tree.metadata)
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise RunFolderError(f"{slot} is damaged ({error!r}); start a new run") from error
        self._serials[slot] = serial
        if slot != self.folder.snapshot and progress.next_frame <= self._next_frame:
            return None  # older than the snapshot that was removed
        self._next_frame = progress.next_frame
        return progress

    def _newest(self) -> Path | None:
        """Folder of the snapshot, otherwise of the newest checkpoint."""
        if self.folder.snapshot.is_dir():
            return self.folder.snapshot
        return next((path for path, _ in self.folder.checkpoints.saved()), None)

    def _progress(self, arrays: dict[str, NDArray], metadata: dict[str, Any]) -> RunProgress:
        values = metadata["values"]
        atlas = arrays_below(arrays, "atlas/")
        anchors = [np.array(T) for T in atlas["anchors"]]
        active = values["atlas"].get("active")
        rows = [] if active is None else active["keyframes"]
        number = None if active is None else int(active["number"])
        keyframes = _keyframes(number, rows, atlas, anchors)
        poses = {k.index: k.T_world_camera for k in keyframes}
        tracked = values["path"]["tracked"]
        relative = arrays["path/T_keyframe_camera"]
        known = [i for i, row in enumerate(tracked) if row["keyframe"] in poses]
        path = [poses[tracked[i]["keyframe"]] @ relative[i] for i in known]
        first = next(iter(rows), None)
        taxonomy, decode = self._decoder(arrays_below(arrays, "mapper/semantics/"))
        scene = None
        if taxonomy is not None and "scene" in values:
            scene = read_snapshot(arrays_below(arrays, "scene/"), values["scene"])
        return RunProgress(
            next_frame=int(metadata["next_frame"]),
            parts=self._parts(arrays, anchors, values["atlas"]["store"], number),
            keyframes=keyframes,
            indices=[int(tracked[i]["index"]) for i in known],
            up_side=values.get("up_side", "top"),
            T_world_camera=np.array(path).reshape(-1, 4, 4),
            camera=None if first is None else Camera(**first["camera"]),
            taxonomy=taxonomy,
            decode=decode,
            doubtful=frozenset(int(row["index"]) for row in tracked if row["doubt"]),
            lost=frozenset(int(index) for index, _ in values["path"]["lost_frames"]),
            graph=None if taxonomy is None or scene is None else scene.content(taxonomy),
            voxels_m={} if scene is None else scene.points_m,
        )

    def _parts(
        self,
        arrays: dict[str, NDArray],
        anchors: list[NDArray],
        versions: dict[str, int],
        active: int | None,
    ) -> list[MapPart]:
        """Return the stored submaps, and the active one if there is one."""
        stored = {int(n): int(v) for n, v in versions.items() if int(n) != active}
        clouds = self._stored(stored)
        if active is not None:
            content = arrays_below(arrays, "atlas/active/gaussians/")
            tensors = (torch.from_numpy(np.array(content[name])) for name in PARAMETERS)
            clouds[active] = GaussianCloud(*tensors)
        return [MapPart(number, anchors[number], clouds[number]) for number in sorted(clouds)]

    def _stored(self, versions: dict[int, int]) -> dict[int, GaussianCloud]:
        """Return the Gaussians of stored submaps by number; only new versions are read."""
        new = {n: version for n, version in versions.items() if (n, version) not in self._clouds}
        store = SubmapStore(self.folder.submaps, self._settings.submaps.memory_mb)
        lost = store.restore({str(n): version for n, version in new.items()})
        for number in sorted(set(new) - set(lost)):
            self._clouds[number, new[number]] = store.get(number).gaussians
        kept = {n: key for n in sorted(versions) if (key := (n, versions[n])) in self._clouds}
        self._clouds = {key: self._clouds[key] for key in kept.values()}
        return {n: self._clouds[key] for n, key in kept.items()}

    def _decoder(
        self, state: dict[str, NDArray]
    ) -> tuple[Taxonomy | None, Callable[[GaussianCloud], SplatLabels] | None]:
        if not self.folder.taxonomy.is_file() or not state:
            return None, None
        taxonomy = Taxonomy.load(self.folder.taxonomy)
        options = self._settings.semantics
        code = build_code(options.code, taxonomy)
        semantics = build_semantic_mapping(options, code, self._settings.seed)
        semantics.restore(state)

        def decode(gaussians: GaussianCloud) -> SplatLabels:
            decoding = semantics.decode_gaussians(gaussians.features)
            return splat_labels(decoding, options.min_confidence)

        return taxonomy, decode


def read_serial(slot: Path) -> int | None:
    """Read the serial number of a snapshot or checkpoint; None while it is being replaced."""
    try:
        return int(read_json(slot / "metadata.json")["serial"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _keyframes(
    active: int | None,
    rows: list[dict[str, Any]],
    atlas: dict[str, NDArray],
    anchors: list[NDArray],
) -> list[ProgressKeyframe]:
    """Return the keyframes of stored submaps, and those of the active one with images."""
    found = []
    for number, anchor in enumerate(anchors):
        if number == active:
            continue  # poses of a snapshot may include its stored ones
        indices = atlas.get(f"indices/{number}", np.zeros(0, np.int64))
        poses = atlas.get(f"poses/{number}", np.zeros((0, 4, 4)))
        found += [
            ProgressKeyframe(int(index), number, anchor @ T)
            for index, T in zip(indices, poses, strict=True)
        ]
    for place, row in enumerate(rows):
        assert active is not None
        T_map_camera = atlas[f"active/keyframes/{place}/T_map_camera"]
        rgb = atlas[f"active/keyframes/{place}/rgb"]
        found.append(
            ProgressKeyframe(int(row["index"]), active, anchors[active] @ T_map_camera, rgb)
        )
    return found
