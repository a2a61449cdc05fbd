"""Snapshots of a run in progress: the part of its state that viewers show.

    live/watched   touched by viewers while they follow the run
    live/snapshot  the newest snapshot, in the layout of a checkpoint

A run that nobody watches writes nothing.
"""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.keyframe import Keyframe
from toolkit.io.arrays import write_array_tree
from toolkit.io.images import small_image
from toolkit.runs.checkpoints import CHECKPOINT_FORMAT
from toolkit.runs.folder import RunFolder
from toolkit.runs.observers import ObservedRun
from toolkit.scene.growing.listener import SceneListener
from toolkit.slam.result import FrameResult, SlamResult
from toolkit.slam.system import Slam
from toolkit.splatting.gaussians.cloud import PARAMETERS

_log = logging.getLogger(__name__)

_EVERY_S = 2.0
# Interval at which a run looks whether a viewer watches it, and how long that remains valid.
_LOOK_EVERY_S, _WATCHED_S = 0.5, 10.0
# Maximum share of the time of a run that is spent on snapshots.
_MAX_SHARE = 0.02
# Maximum width of the keyframes' images, pixels.
_IMAGE_WIDTH = 240


def watch(folder: RunFolder) -> None:
    """Ask a run for snapshots during the next seconds; without write access, do nothing."""
    try:
        if folder.config.is_file():
            folder.live.mkdir(exist_ok=True)
            folder.watched.touch()
    except OSError as error:
        _log.debug("The run is not asked for snapshots: %s", error)


def unwatch(folder: RunFolder) -> None:
    """Stop asking for snapshots, and remove what the run has left."""
    shutil.rmtree(folder.live, ignore_errors=True)


class SnapshotWriter:
    """Writes a snapshot every few seconds while a viewer watches the run; see ProgressObserver.

    The thread of the run only copies the arrays; a background thread writes them.

    Args:
        clock: returns seconds, for tests.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._run: ObservedRun | None = None
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="snapshots")
        self._pending: Future[None] | None = None
        self._images: dict[int, NDArray[np.uint8]] = {}
        self._touched_ns = 0
        self._watched_until_s = self._look_at_s = self._write_at_s = -np.inf

    def started(self, run: ObservedRun) -> None:
        """Remove the snapshot of an interrupted process; see `ProgressObserver`."""
        self._run = run
        shutil.rmtree(run.folder.snapshot, ignore_errors=True)

    def frame_processed(self, frame: Frame, result: FrameResult) -> None:
        """Write a snapshot if one is due; see `ProgressObserver`.

        Raises:
            RunFolderError: the snapshot before could not be written.
        """
        run, now_s = self._run, self._clock()
        assert run is not None
        if not self._is_watched(run.folder, now_s) or now_s < self._write_at_s:
            return
        if self._pending is not None:
            if not self._pending.done():
                return
            self._pending.result()
        arrays, values = self._state(run.slam)
        taken_s = self._clock() - now_s
        self._write_at_s = now_s + max(_EVERY_S, taken_s / _MAX_SHARE)
        metadata = {
            # Unique across processes, so that viewers notice that a run was resumed.
            "serial": time.time_ns(),
            "next_frame": frame.index + 1,
            "format": CHECKPOINT_FORMAT,
            "values": values,
        }
        self._pending = self._executor.submit(
            write_array_tree, run.folder.snapshot, arrays, metadata
        )

    def finished(self, result: SlamResult) -> None:
        """Nothing: viewers show the finished map as soon as it is written."""

    def close(self) -> None:
        """Remove the snapshot; see `ProgressObserver`."""
        self._executor.shutdown()
        if self._run is not None:
            shutil.rmtree(self._run.folder.live, ignore_errors=True)

    def _is_watched(self, folder: RunFolder, now_s: float) -> bool:
        """Whether a viewer has touched its file lately.

        Only changes of the file's time count, because its clock may be that of another machine.
        """
        if now_s >= self._look_at_s:
            self._look_at_s = now_s + _LOOK_EVERY_S
            try:
                touched_ns = folder.watched.stat().st_mtime_ns
            except OSError:
                touched_ns = 0
            if touched_ns not in (0, self._touched_ns):
                self._watched_until_s = now_s + _WATCHED_S
            self._touched_ns = touched_ns
        return now_s < self._watched_until_s

    def _state(self, slam: Slam) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Copies of what is shown, named as in checkpoints."""
        atlas, path = slam.atlas, slam.camera_path
        gaussians, metres = slam.unit.cloud_in_metres(atlas.gaussians), slam.unit.pose_in_metres
        arrays: dict[str, NDArray] = {
            f"atlas/active/gaussians/{name}": getattr(gaussians, name).cpu().numpy().copy()
            for name in PARAMETERS
        }
        decoder = slam.mapper.semantics.state()
        arrays |= {f"mapper/semantics/{name}": np.array(a) for name, a in decoder.items()}
        self._images = {k.index: self._image(k) for k in atlas.keyframes}
        for place, keyframe in enumerate(atlas.keyframes):
            name = f"atlas/active/keyframes/{place}"
            arrays[f"{name}/T_map_camera"] = metres(keyframe.T_map_camera).copy()
            arrays[f"{name}/rgb"] = self._images[keyframe.index]
        anchors = [metres(atlas.T_world_submap(n)) for n in range(len(atlas))]
        arrays["atlas/anchors"] = np.array(anchors)
        versions = atlas.stored_versions
        for number in map(int, versions):
            poses = atlas.keyframe_poses(number)
            arrays[f"atlas/indices/{number}"] = np.array(list(poses), np.int64)
            stored = np.array(list(poses.values())).reshape(-1, 4, 4)
            arrays[f"atlas/poses/{number}"] = metres(stored)
        arrays["path/T_keyframe_camera"] = metres(path.T_keyframe_camera)
        rows, doubts = zip(path.indices, path.keyframes, strict=True), path.doubtful_frames
        stored_and_active: dict[str, Any] = {"store": versions}
        if atlas.has_active_submap:
            keyframes = [{"index": k.index, "camera": asdict(k.camera)} for k in atlas.keyframes]
            stored_and_active["active"] = {"number": atlas.active, "keyframes": keyframes}
        values: dict[str, Any] = {
            "up_side": slam.up_side,
            "atlas": stored_and_active,
            "path": {
                "tracked": [
                    {"index": i, "keyframe": k, "doubt": doubts.get(i, "")} for i, k in rows
                ],
                "lost_frames": list(path.lost_frames.items()),
            },
        }
        scene = slam.listener(SceneListener.name)
        if isinstance(scene, SceneListener):
            own, shown = scene.snapshot()
            arrays |= {f"scene/shown/{name}": array for name, array in own.items()}
            values["scene"] = {"shown": shown}
        return arrays, values

    def _image(self, keyframe: Keyframe) -> NDArray[np.uint8]:
        """Image [3, h, w] of a keyframe, which is reduced only once."""
        image = self._images.get(keyframe.index)
        if image is None:
            rgb = keyframe.rgb.cpu().numpy()
            image = np.ascontiguousarray(small_image(rgb, _IMAGE_WIDTH).transpose(2, 0, 1))
        return image
