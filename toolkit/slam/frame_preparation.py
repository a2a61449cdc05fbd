"""Preparation of frames: rectified, denoised, labelled, and with the depth of their priors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame, Recorder, without_pixels
from toolkit.base.stages import Stage
from toolkit.depth.depth_priors.correction import RenderedDepth
from toolkit.semantics.labeller import IgnoredPixels, Labeller
from toolkit.slam.camera_path import CameraPath
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.tracking.depth_filter import DepthFilter
from toolkit.slam.tracking.moving import MovingTracker
from toolkit.slam.tracking.rolling_shutter import rectified

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FrameSources:
    """What frames are prepared with.

    Attributes:
        labeller: segments frames; None for a map without semantics.
        denoise: filter the depth of each frame according to its noise.
        ignored: finds what is neither tracked against nor mapped without labels; with labels, the
            labeller finds it.
        watches_carrier: find what moves with the camera in the first frames; False if it is ignored
            in the frames already.
    """

    labeller: Labeller | None = None
    denoise: bool = True
    ignored: IgnoredPixels | None = None
    watches_carrier: bool = False


class FramePreparation:
    """Prepares frames before they are tracked, before they may be mapped, and as keyframes.

    Attributes:
        sources: what frames are prepared with.
        labeller: segments frames; None for a map without semantics.
        correction: aligns depth priors with the map; None if depth is measured.
    """

    def __init__(
        self,
        sources: FrameSources,
        front_end: FrontEnd,
        mapper: Mapper,
        atlas: Atlas,
        path: CameraPath,
        recorder: Recorder,
    ) -> None:
        self._mapper, self._atlas, self._path = mapper, atlas, path
        self._recorder = recorder
        self.sources, self.labeller = sources, sources.labeller
        self.correction = front_end.correction
        self._start_velocity = front_end.start_velocity
        tracker = front_end.tracker
        # Predicts the poses at which priors are aligned before frames are tracked with them.
        self._predicting: MovingTracker | None = None
        if front_end.tracks_priors:
            assert isinstance(tracker, MovingTracker), "a trajectory needs no depth"
            self._predicting = tracker
        self._filter = DepthFilter() if sources.denoise else None
        labeller, tracks_labels = sources.labeller, tracker.wants_labels
        # All frames are labelled before they are tracked, not only keyframes.
        self._labels_first = labeller is not None and (labeller.every_frame or tracks_labels)

    def ahead(self, frame: Frame) -> Frame:
        """A later frame after the work that depends on no other frame; from any thread."""
        return frame if self._filter is None else self._filter.prepare(frame)

    def before_tracking(self, frame: Frame) -> Frame:
        """The next frame as it is tracked: rectified by the camera's last motion, and denoised."""
        if frame.readout_s > 0.0:
            with self._recorder.timed(Stage.RECTIFICATION):
                frame = rectified(frame, self._last_velocity(frame))
        frame = self._denoised(frame)
        if self._labels_first:
            frame = self._segmented(frame, None)
        frame = self._without_ignored(frame)
        if self.correction is None:
            return frame
        if self._atlas.keyframes:
            if self._predicting is None:
                return frame
            predicted = self._predicting.motion.predict(frame.timestamp_s)
            return self._with_prior(frame, predicted, final=False)
        # The first map follows from the prior alone.
        with self._recorder.timed(Stage.DEPTH_PRIOR):
            started = self.correction.start(frame)
        return _still_ignored(self._denoised(started, measured=False))

    def for_mapping(self, frame: Frame, T_map_camera: Array) -> Frame:
        """A tracked frame as it may be mapped: with the depth of its prior, aligned with the map.

        Args:
            T_map_camera: [4, 4] pose of the frame.
        """
        atlas, mapper = self._atlas, self._mapper
        if self.correction is None or not atlas.keyframes:
            return frame
        if not mapper.wants_view(atlas.keyframes, frame.index, T_map_camera, atlas.visited):
            return frame
        return self._with_prior(frame, T_map_camera)

    def _with_prior(self, frame: Frame, T_map_camera: Array, final: bool = True) -> Frame:
        """A frame with the depth of its prior, aligned with the map at a pose (H-15, H-16)."""
        assert self.correction is not None
        with self._recorder.timed(Stage.DEPTH_PRIOR):
            view = self._mapper.render(self._atlas.gaussians, frame.camera, T_map_camera)
            corrected = self.correction.correct(frame, RenderedDepth.of(view), final)
        return _still_ignored(self._denoised(corrected, measured=False))

    def as_keyframe(self, observed: Frame, frame: Frame, T_map_camera: Array) -> Frame:
        """A frame that becomes a keyframe: rectified by its own velocity, and labelled.

        The velocity of the frames before it differs from its own by the tremor of a hand.

        Args:
            observed: the frame as it was recorded.
            frame: the same after `for_mapping`.
        """
        velocity = None
        if observed.readout_s > 0.0:
            velocity = self._path.velocity(self._atlas, observed, T_map_camera)
        if velocity is not None:
            with self._recorder.timed(Stage.RECTIFICATION):
                again = rectified(observed, velocity)
            images = self._without_ignored(self._denoised(again))
            if self.labeller is not None and self.labeller.every_frame:
                return self._segmented(images, T_map_camera)  # what is ignored has no depth
            frame = replace(images, labels=frame.labels if self._labels_first else images.labels)
        return self.labelled(frame, T_map_camera)

    def labelled(self, frame: Frame, T_map_camera: Array | None = None) -> Frame:
        """A frame that is mapped, with labels if the map has semantics."""
        if self.labeller is None or self._labels_first:
            return frame
        return self._segmented(frame, T_map_camera)

    def _last_velocity(self, frame: Frame) -> Array | None:
        velocity = self._path.velocity(self._atlas, frame)
        if velocity is None and len(self._path.indices) < 2 and not self._path.lost_frames:
            return self._start_velocity
        return velocity

    def _without_ignored(self, frame: Frame) -> Frame:
        """A frame without depth where a run without labels ignores something."""
        if self.sources.ignored is None:
            return frame
        nothing = np.zeros(frame.depth_m.shape, bool)
        with self._recorder.timed(Stage.LABELLING):
            return without_pixels(frame, self.sources.ignored.pixels(frame, nothing))

    def _denoised(self, frame: Frame, measured: bool = True) -> Frame:
        if self._filter is None:
            return frame
        with self._recorder.timed(Stage.DENOISING):
            return self._filter.of(frame, measured)

    def _segmented(self, frame: Frame, T_map_camera: Array | None) -> Frame:
        assert self.labeller is not None
        # Segmenters use the world frame, which does not depend on submaps.
        T_world_map = self._atlas.T_world_submap(self._atlas.active)
        T_world_camera = None if T_map_camera is None else T_world_map @ T_map_camera
        with self._recorder.timed(Stage.LABELLING):
            return self.labeller.label(frame, T_world_camera)

    def state(self) -> dict[str, NDArray]:
        """Arrays from which `restore` continues identically."""
        return {} if self.labeller is None else self.labeller.segmenter.state()

    def restore(self, state: Mapping[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        if self.labeller is not None:
            self.labeller.segmenter.restore(dict(state))


def _still_ignored(frame: Frame) -> Frame:
    """A frame without the depth that a prior has given to what is ignored."""
    return frame if frame.ignored is None else without_pixels(frame, frame.ignored)
