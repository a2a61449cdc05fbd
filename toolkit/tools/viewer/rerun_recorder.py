"""Records the progress of a run to an .rrd file of Rerun."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DependencyError, SettingsError
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.runs.observers import ObservedRun
from toolkit.slam.result import FrameResult, SlamResult
from toolkit.splatting.gaussians.cloud import GaussianCloud

# The map is recorded at every _MAP_EVERY-th keyframe, with at most _MAX_GAUSSIANS of each submap,
# because viewers keep all of a recording in memory.
_MAP_EVERY = 10
_MAX_GAUSSIANS = 50_000
_MAX_PATH_POINTS = 1000
_JPEG_QUALITY = 85
_DEPTH_SCALE = 1000.0


class RerunRecorder:
    """Records frames, depth, poses, the map, loops and times on the timelines `frame` and `time`.

    Entities: `world/camera` with `colour` and `depth`; `world/path`; `world/submaps/N`, replaced
    by `world/map` when the map is finished; `world/loops`; `times/STAGE_ms`; `counts/...`;
    `events`.

    Args:
        path: new file with the suffix .rrd.

    Raises:
        DependencyError: rerun-sdk is missing.
        SettingsError: the file exists, or has another suffix or no folder.
    """

    def __init__(self, path: Path) -> None:
        try:
            import rerun
        except ImportError as error:
            raise DependencyError(
                "--record needs rerun-sdk: pip install 'semsplat[recording]'"
            ) from error
        if path.suffix != ".rrd":
            raise SettingsError(f"--record {path} must have the suffix .rrd")
        if path.exists():
            raise SettingsError(f"--record {path} already exists; remove it or choose another name")
        if not path.parent.is_dir():
            raise SettingsError(f"--record {path}: {path.parent} is not a folder; create it first")
        self._rr, self._path = rerun, path
        self._stream: Any = None
        self._run: ObservedRun | None = None
        self._positions: list[NDArray[np.float64]] = []
        self._counted: dict[str, int] = {}
        self._keyframes = self._loops = 0
        self._submap = -1

    def started(self, run: ObservedRun) -> None:
        """Open the file; see `ProgressObserver`."""
        rr, camera = self._rr, run.camera
        self._run = run
        self._stream = rr.RecordingStream("semsplat", recording_id=None)
        self._stream.save(self._path)
        self._log("world", rr.ViewCoordinates.RDF, static=True)
        self._log("world/camera", _pinhole(rr, camera), static=True)
        self._log("name", rr.TextDocument(run.name), static=True)

    def frame_processed(self, frame: Frame, result: FrameResult) -> None:
        """Record a frame; see `ProgressObserver`."""
        self._stream.set_time("frame", sequence=frame.index)
        self._stream.set_time("time", duration=frame.timestamp_s)
        self._record_times()
        if result.dropped:
            self._event(f"Frame {frame.index} was dropped.")
            return
        self._log("counts/lost", self._rr.Scalars(float(result.lost)))
        self._log("counts/doubtful", self._rr.Scalars(float(result.doubtful)))
        self._record_images(frame)
        if result.T_world_camera is None:
            reason = result.tracking.reason if result.tracking else "no map exists yet"
            self._event(f"Frame {frame.index} is lost: {reason}.")
            return
        if result.doubtful:
            self._event(f"Frame {frame.index} is doubtful: {result.reason}.")
        self._record_pose(result.T_world_camera)
        if result.keyframe:
            self._record_keyframe(frame)

    def finished(self, result: SlamResult) -> None:
        """Record the final map and trajectory; see `ProgressObserver`."""
        rr = self._rr
        self._record_times()
        self._log("world/submaps", rr.Clear(recursive=True))
        parts = list(result.map.parts())
        share = _MAX_GAUSSIANS * max(1, len(result.submaps)) // max(1, len(parts))
        for number, part in enumerate(parts):
            self._log(f"world/map/{number}", _points(rr, part, share))
        self._record_path(result.trajectory.positions_m)
        self._record_loops()

    def close(self) -> None:
        """Complete the file; see `ProgressObserver`."""
        if self._stream is not None:
            self._stream.flush()
            self._stream.disconnect()
            self._stream = None

    def _record_images(self, frame: Frame) -> None:
        rr = self._rr
        colour = cv2.cvtColor((frame.rgb * 255.0).round().astype(np.uint8), cv2.COLOR_RGB2BGR)
        jpeg = _encoded(".jpg", colour, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        self._log("world/camera/colour", rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        values = np.clip(frame.depth_m * _DEPTH_SCALE, 0, 65535).round().astype(np.uint16)
        png = _encoded(".png", values, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        depth = rr.EncodedDepthImage(png, media_type="image/png", meter=_DEPTH_SCALE)
        self._log("world/camera/depth", depth)

    def _record_pose(self, T_world_camera: NDArray[np.float64]) -> None:
        self._log("world/camera", _transform(self._rr, T_world_camera))
        self._positions.append(T_world_camera[:3, 3])

    def _record_keyframe(self, frame: Frame) -> None:
        """Record what changes at keyframes: path, map, submaps and loops."""
        run = self._run
        assert run is not None
        rr, atlas, slam = self._rr, run.slam.atlas, run.slam
        self._keyframes += 1
        self._record_path(np.array(self._positions))
        self._log("counts/keyframes", rr.Scalars(self._keyframes))
        self._log("counts/gaussians", rr.Scalars(len(slam.atlas.gaussians)))
        new_submap = atlas.active != self._submap
        if new_submap:
            self._submap = atlas.active
            what = "entered again" if atlas.visited else "started"
            self._event(f"Submap {atlas.active} {what} at frame {frame.index}.")
        if new_submap or self._keyframes % _MAP_EVERY == 0:
            points = _points(rr, slam.atlas.gaussians, _MAX_GAUSSIANS)
            self._log(f"world/submaps/{atlas.active}", points)
            for number in range(len(atlas)):
                pose = _transform(rr, atlas.T_world_submap(number))
                self._log(f"world/submaps/{number}", pose)
        if len(slam.loops) != self._loops:
            self._record_loops()

    def _record_path(self, positions_m: NDArray[np.float64]) -> None:
        every = max(1, -(-len(positions_m) // _MAX_PATH_POINTS))
        self._log("world/path", self._rr.LineStrips3D([positions_m[::every]]))

    def _record_loops(self) -> None:
        """Record the loops as lines between the anchors of their submaps."""
        assert self._run is not None
        atlas, loops = self._run.slam.atlas, self._run.slam.loops
        new = loops[self._loops :]
        self._loops = len(loops)
        anchors_m = [atlas.T_world_submap(number)[:3, 3] for number in range(len(atlas))]
        lines = [[anchors_m[edge.first], anchors_m[edge.second]] for edge in loops]
        self._log("world/loops", self._rr.LineStrips3D(lines))
        self._log("counts/loops", self._rr.Scalars(len(loops)))
        for edge in new:
            self._event(f"Loop between submaps {edge.first} and {edge.second}.")

    def _record_times(self) -> None:
        """Record the time of each stage since the last call."""
        assert self._run is not None
        for stage, durations_ms in self._run.recorder.durations_ms.items():
            new = durations_ms[self._counted.get(stage, 0) :]
            self._counted[stage] = len(durations_ms)
            if new:
                name = f"times/{stage.replace(' ', '_')}_ms"
                self._log(name, self._rr.Scalars(sum(new)))

    def _event(self, text: str) -> None:
        self._log("events", self._rr.TextLog(text))

    def _log(self, entity: str, archetype: Any, static: bool = False) -> None:
        self._stream.log(entity, archetype, static=static)


def _pinhole(rr: Any, camera: Camera) -> Any:
    return rr.Pinhole(
        focal_length=[camera.fx, camera.fy],
        # Rerun's pixel centres are at half pixels, ours at integers.
        principal_point=[camera.cx + 0.5, camera.cy + 0.5],
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
    )


def _transform(rr: Any, T_parent_child: NDArray[np.float64]) -> Any:
    return rr.Transform3D(translation=T_parent_child[:3, 3], mat3x3=T_parent_child[:3, :3])


def _points(rr: Any, gaussians: GaussianCloud, most: int) -> Any:
    """Gaussians as points of their colour and standard deviation; every n-th one if there are more
    than `most`."""
    every = max(1, -(-len(gaussians) // max(1, most)))
    means, log_radii, logits, colours = (
        tensor.detach().cpu()[::every].numpy()
        for tensor in (
            gaussians.means,
            gaussians.log_radii,
            gaussians.opacity_logits,
            gaussians.colours,
        )
    )
    opaque = logits > 0.0  # the others are hardly visible and would hide surfaces as points
    rgb = np.clip(255.0 * colours[opaque], 0, 255).astype(np.uint8)
    return rr.Points3D(means[opaque], colors=rgb, radii=np.exp(log_radii[opaque]))


def _encoded(suffix: str, image: NDArray, parameters: list[int]) -> bytes:
    done, content = cv2.imencode(suffix, image, parameters)
    if not done:
        raise ValueError(f"OpenCV cannot encode {suffix}")
    return content.tobytes()
