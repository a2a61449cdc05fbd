"""Follow a run in progress."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from toolkit.base.errors import ToolkitError
from toolkit.io.images import small_image
from toolkit.runs.progress import MapPart, ProgressReader, RunProgress
from toolkit.runs.snapshots import unwatch
from toolkit.tools.viewer.keyframes import spread
from toolkit.tools.viewer.options import ShownContent
from toolkit.tools.viewer.reading import loops_between, read_scene, vertical
from toolkit.tools.viewer.scene import (
    ShownKeyframe,
    ShownSplats,
    ShownTree,
    ViewerScene,
    path_states,
)
from toolkit.tools.viewer.server import MapServer
from toolkit.tools.viewer.shown_objects import graph_objects
from toolkit.tools.viewer.streaming import ServedMap

_log = logging.getLogger(__name__)

_POLL_S = 1.0
# Share of the time in which a run is read and shown, so that the run itself is not slowed down.
_BUSY_SHARE = 0.3
_FINISHED = "The run is finished."


class LiveRun:
    """The scene of a run in progress, and of the finished run in the end.

    Args:
        path: the run folder.
        content: what is shown.

    Raises:
        RunFolderError: the folder contains no run.
    """

    def __init__(self, path: Path, content: ShownContent) -> None:
        self._reader = ProgressReader(path)
        self._path, self._content = path, content
        self.finished = False

    def poll(self) -> ViewerScene | None:
        """Return the scene if there is a new one since the last call; all of a finished run.

        Raises:
            ToolkitError: the folder was written by another version, or is damaged.
        """
        if self.finished:
            return None
        if self._reader.finished:
            scene = read_scene(self._path, self._content, whole=True)
            self.finished = True
            unwatch(self._reader.folder)
            return scene
        progress = self._reader.read()
        return None if progress is None else self._scene(progress)

    def _scene(self, progress: RunProgress) -> ViewerScene:
        parts = [_splats(part, progress) for part in progress.parts if len(part.gaussians)]
        poses = progress.T_world_camera
        splats = _concatenated(parts)
        wanted = set(spread([k.index for k in progress.keyframes], self._content.images))
        keyframes = tuple(
            ShownKeyframe(
                k.index,
                k.T_world_camera,
                k.submap,
                small_image(k.rgb, self._content.image_width)
                if k.rgb is not None and k.index in wanted
                else None,
            )
            for k in progress.keyframes
        )
        return ViewerScene(
            title=f"{self._path.resolve().name}, frame {progress.next_frame}",
            splats=splats.thinned(self._content.max_gaussians, poses[:, :3, 3]),
            total=len(splats),
            up=vertical(poses, progress.up_side),
            tree=None if progress.taxonomy is None else ShownTree.from_taxonomy(progress.taxonomy),
            path=poses,
            path_states=path_states(progress.indices, progress.doubtful, progress.lost),
            keyframes=keyframes,
            camera=progress.camera,
            loops=loops_between(
                self._reader.folder.loops,
                {i: T[:3, 3] for i, T in zip(progress.indices, poses, strict=True)},
            ),
            objects=()
            if progress.graph is None
            else graph_objects(progress.graph, progress.voxels_m),
        )


def follow(
    run: LiveRun,
    server: MapServer,
    served: Callable[[ViewerScene], ServedMap],
    wait: Callable[[float], object],
) -> None:
    """Serve a run in progress until it is finished.

    Args:
        run: the run.
        server: shows each state in place of the one before.
        served: prepares a state for the server.
        wait: called with the seconds between two looks at the run.

    Raises:
        ToolkitError: the first state cannot be read. Later ones are only reported, because the run
            may be stopped and started anew while it is followed.
    """
    logged = ""
    while not run.finished:
        begin_s = time.monotonic()
        scene, news = None, ""
        try:
            scene = run.poll()
        except ToolkitError as error:
            if not server.state.version:
                raise
            news = f"The run cannot be read at the moment: {error}"
        if scene is not None and len(scene.splats):
            server.show(served(scene), _FINISHED if run.finished else "", run.finished)
            news = f"Show {scene.title}: {scene}."
        elif news or not server.state.version:
            news = news or "Waiting for the first frames of the run."
            server.report(news)
        if news and news != logged:
            _log.info(news)
            logged = news
        if not run.finished:
            busy_s = time.monotonic() - begin_s
            wait(max(_POLL_S, busy_s * (1.0 / _BUSY_SHARE - 1.0)))
    _log.info(_FINISHED)


def _splats(part: MapPart, progress: RunProgress) -> ShownSplats:
    gaussians, T = part.gaussians, part.T_world_submap
    labels = None if progress.decode is None else progress.decode(gaussians)
    means_m = gaussians.means.numpy() @ T[:3, :3].T + T[:3, 3]
    return ShownSplats(
        means_m=means_m.astype(np.float32),
        sigmas_m=gaussians.radii_m.numpy(),
        opacities=gaussians.opacities.numpy(),
        rgb=np.rint(255.0 * gaussians.colours.clamp(0.0, 1.0).numpy()).astype(np.uint8),
        levels=None if labels is None else labels.levels,
        confidence=None if labels is None else labels.confidence,
        submap=np.full(len(gaussians), part.number, np.int32),
    )


def _concatenated(parts: list[ShownSplats]) -> ShownSplats:
    if not parts:
        none = np.zeros(0, np.float32)
        return ShownSplats(np.zeros((0, 3), np.float32), none, none, np.zeros((0, 3), np.uint8))
    names = parts[0].columns()
    return ShownSplats(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})
