"""State of a run in progress, from its newest checkpoint."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.errors import FormatError, RunFolderError
from toolkit.gaussians.cloud import PARAMETERS, GaussianCloud
from toolkit.geometry.camera import Camera
from toolkit.io.arrays import arrays_below, read_array_tree
from toolkit.io.splats import SplatLabels
from toolkit.mapping.factory import build_semantic_mapping
from toolkit.runs.folder import CHECKPOINT_FORMAT, RunFolder
from toolkit.runs.results import splat_labels
from toolkit.runs.settings import load_settings
from toolkit.semantics.factory import build_code
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.submaps.store import SubmapStore

# Arrays of a checkpoint that describe the map and the cameras; the rest is much larger.
_WANTED = re.compile(
    r"mapper/(gaussians/.*|semantics/.*|keyframes/\d+/(T_map_camera|rgb))"
    r"|atlas/(anchors|indices/\d+|poses/\d+)|path/T_keyframe_camera"
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
        rgb: [3, H, W] uint8; None for keyframes of earlier submaps.
    """

    index: int
    submap: int
    T_world_camera: NDArray[np.float64]
    rgb: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class RunProgress:
    """State of a run at a checkpoint.

    Attributes:
        serial: number of the checkpoint.
        next_frame: number of frames that were processed.
        parts: submaps that can be read.
        keyframes: keyframes in order.
        indices: [M] frame indices of the tracked frames.
        T_world_camera: [M, 4, 4] their poses.
        camera: intrinsics; None before the first keyframe.
        taxonomy: of the labels, or None.
        decode: labels of Gaussians from their features; None without labels.
    """

    serial: int
    next_frame: int
    parts: list[MapPart]
    keyframes: list[ProgressKeyframe]
    indices: list[int]
    T_world_camera: NDArray[np.float64]
    camera: Camera | None
    taxonomy: Taxonomy | None
    decode: Callable[[GaussianCloud], SplatLabels] | None


class ProgressReader:
    """Reads the state of a run whenever it has saved a checkpoint.

    Args:
        path: the run folder.

    Raises:
        RunFolderError: the folder contains no run.
    """

    def __init__(self, path: Path) -> None:
        self.folder = RunFolder.open(path)
        self._settings = load_settings(self.folder.config)
        self._serial = -1

    @property
    def finished(self) -> bool:
        """Whether the run has written its results."""
        return self.folder.map.is_file() and self.folder.frames.is_file()

    def read(self) -> RunProgress | None:
        """Read the newest checkpoint, None if there is none since the last call.

        A checkpoint that is replaced while it is read counts as none.

        Raises:
            RunFolderError: another version of semsplat has saved it in another format.
        """
        saved = self.folder.saved_checkpoints()
        if not saved or saved[0][1] <= self._serial:
            return None
        slot, serial = saved[0]
        try:
            tree = read_array_tree(slot, lambda name: _WANTED.fullmatch(name) is not None)
        except (FormatError, RunFolderError):
            return None
        found = tree.metadata.get("format", 0)
        if found != CHECKPOINT_FORMAT:
            raise RunFolderError(
                f"{slot} has checkpoint format {found}, this version of semsplat reads format "
                f"{CHECKPOINT_FORMAT}; use the version that started the run"
            )
        try:
            progress = self._progress(serial, tree.arrays, tree.metadata)
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise RunFolderError(f"{slot} is damaged ({error!r}); start a new run") from error
        self._serial = serial
        return progress

    def _progress(
        self, serial: int, arrays: dict[str, NDArray], metadata: dict[str, Any]
    ) -> RunProgress:
        values = metadata["values"]
        atlas = arrays_below(arrays, "atlas/")
        anchors = [np.array(T) for T in atlas["anchors"]]
        keyframes = _keyframes(arrays, values["mapper"]["keyframes"], atlas, anchors)
        poses = {k.index: k.T_world_camera for k in keyframes}
        tracked = values["path"]["tracked"]
        relative = arrays["path/T_keyframe_camera"]
        known = [i for i, row in enumerate(tracked) if row["keyframe"] in poses]
        path = [poses[tracked[i]["keyframe"]] @ relative[i] for i in known]
        first = next(iter(values["mapper"]["keyframes"]), None)
        taxonomy, decode = self._decoder(arrays_below(arrays, "mapper/semantics/"))
        return RunProgress(
            serial=serial,
            next_frame=int(metadata["next_frame"]),
            parts=self._parts(arrays, anchors, values["atlas"]["store"]),
            keyframes=keyframes,
            indices=[int(tracked[i]["index"]) for i in known],
            T_world_camera=np.array(path).reshape(-1, 4, 4),
            camera=None if first is None else Camera(**first["camera"]),
            taxonomy=taxonomy,
            decode=decode,
        )

    def _parts(
        self, arrays: dict[str, NDArray], anchors: list[NDArray], versions: dict[str, int]
    ) -> list[MapPart]:
        """Return the active submap, and the earlier ones from their files."""
        active = len(anchors) - 1
        store = SubmapStore(self.folder.submaps, self._settings.submaps.memory_mb)
        earlier = {number: v for number, v in versions.items() if int(number) != active}
        lost = store.restore(earlier)
        parts = [
            MapPart(number, anchors[number], store.get(number).gaussians)
            for number in sorted(map(int, earlier))
            if number not in lost
        ]
        tensors = (
            torch.from_numpy(np.array(arrays[f"mapper/gaussians/{name}"])) for name in PARAMETERS
        )
        return [*parts, MapPart(active, anchors[active], GaussianCloud(*tensors))]

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


def _keyframes(
    arrays: dict[str, NDArray],
    values: list[dict[str, Any]],
    atlas: dict[str, NDArray],
    anchors: list[NDArray],
) -> list[ProgressKeyframe]:
    """Return the keyframes of earlier submaps, and those of the active one with images."""
    active = len(anchors) - 1
    found = []
    for number, anchor in enumerate(anchors[:-1]):
        indices = atlas.get(f"indices/{number}", np.zeros(0, np.int64))
        poses = atlas.get(f"poses/{number}", np.zeros((0, 4, 4)))
        found += [
            ProgressKeyframe(int(index), number, anchor @ T)
            for index, T in zip(indices, poses, strict=True)
        ]
    for place, row in enumerate(values):
        T_map_camera = arrays[f"mapper/keyframes/{place}/T_map_camera"]
        rgb = arrays[f"mapper/keyframes/{place}/rgb"]
        found.append(
            ProgressKeyframe(int(row["index"]), active, anchors[active] @ T_map_camera, rgb)
        )
    return found
