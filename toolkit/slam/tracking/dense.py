"""The default tracker: dense Gauss-Newton alignment to the rendered map.

The map is rendered at the pose of the frame's features or, without them, at the predicted one, at
no more than the resolution that a pose needs, and the frame is aligned to that view from coarse to
fine. The map is rendered again only if the estimated pose is far from the rendered view. If the
frame then fits badly, alignment is repeated from the predicted pose, matches and rotations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.exposure import IDENTITY, Exposure
from toolkit.base.frame import Frame, NullRecorder, Recorder
from toolkit.base.geometry import se3
from toolkit.base.stages import Stage
from toolkit.io.arrays import arrays_below
from toolkit.slam.tracking.evidence import is_clear, unexpected_reason
from toolkit.slam.tracking.feature_pose import FeaturePose
from toolkit.slam.tracking.health import has_depth, relaxed_scales
from toolkit.slam.tracking.judgement import judged
from toolkit.slam.tracking.landmarks import Landmarks
from toolkit.slam.tracking.moving import MovingTracker
from toolkit.slam.tracking.options import DenseOptions
from toolkit.slam.tracking.plausibility import is_reached, unless_implausible
from toolkit.slam.tracking.prepared import PreparedFrames
from toolkit.slam.tracking.proposals import Proposals
from toolkit.slam.tracking.reach import (
    REPEATS,
    Reach,
    by_evidence,
    doubted,
    likeliest,
    unless_contradicted,
)
from toolkit.slam.tracking.repetition import repeats_beyond, repetitions
from toolkit.slam.tracking.result import Health, TrackingResult
from toolkit.slam.tracking.rotation_search import rotated_starts, wide_camera
from toolkit.slam.tracking.views import MapRenderer, RenderedView, Task
from toolkit.splatting.alignment.backend import align, linearise
from toolkit.splatting.alignment.data import (
    INITIAL_SCALES,
    Alignment,
    FrameLevel,
    GaussNewtonOptions,
    LevelProblem,
    ResidualScales,
)
from toolkit.splatting.alignment.exposure import estimate_exposure
from toolkit.splatting.alignment.health import HealthLimits
from toolkit.splatting.gaussians.cloud import GaussianCloud

# Maximum number of renderings of the map per frame, and pose change (`Task.size`) that triggers a
# new one. At 0.05, recordings take up to a fifth less time online and are as accurate, but images
# of a noisy ring of 160x120 pixels lose 2 dB before the refinement.
_RENDERS, _RERENDER_DISTANCE = 3, 0.02
# Maximum depth difference of corresponding pixels at the finest level, as a fraction of depth. It
# doubles with every coarser level.
_MAX_DISTANCE = 0.05
# Maximum number of iterations per pyramid level.
_ITERATIONS = 12

# Distance from the predicted pose (`Task.distance`) up to which alignment hardly ever converges to
# a wrong pose, and distance up to which two results are the same.
_EXPECTED, _SAME = 0.015, 0.004
# Fraction of a frame that the map must cover to end a doubt, and number of such frames after an
# ambiguous one: where nothing is determined, single frames seem to determine something by chance.
_SURE_COVERED, _PROOFS = 0.25, 2
# Number of pyramid levels aligned from poses that are accurate to a few pixels.
_FINE_LEVELS = 2

# First level of the search over rotations: half the resolution, as that of its view of the map.
_SEARCH_LEVEL = 1


class DenseTracker(MovingTracker):
    """Tracks frames against a map of Gaussians by second-order optimisation.

    Args:
        levels: number of image pyramid levels. The coarsest image should keep 30 pixels per side.
    """

    centred = gains = placed = True

    def __init__(
        self,
        options: DenseOptions | None = None,
        limits: HealthLimits | None = None,
        backend_name: str = "auto",
        recorder: Recorder | None = None,
        levels: int = 4,
    ) -> None:
        super().__init__(limits)
        self.options, self._levels = options or DenseOptions(), levels
        self._prepared = PreparedFrames(levels, self.options.max_width)
        self._recorder = recorder or NullRecorder()
        self._renderer = MapRenderer(backend_name, self._recorder)
        self._landmarks = Landmarks()
        self._newest: FrameLevel | None = None
        self._scales = INITIAL_SCALES
        self._exposure = IDENTITY
        self._ambiguous, self._proofs = False, 0

    def prepare(self, frame: Frame, device: torch.device) -> None:
        """Compute a frame's pyramid on a GPU while earlier frames are tracked.

        Does nothing on a CPU, where tracking needs all cores: runs took 3 % longer.
        """
        if device.type != "cpu":
            self._prepared.prepare(frame, device)

    def state(self) -> dict[str, NDArray]:
        """Arrays from which `restore` continues identically."""
        scales = [self._scales.intensity, self._scales.depth_m]
        exposure = [self._exposure.gain, self._exposure.bias]
        own = {"scales": np.array(scales), "exposure": np.array(exposure)}
        own |= {"ambiguous": np.array(self._ambiguous), "proofs": np.array(self._proofs)}
        features = {f"features/{name}": a for name, a in self._landmarks.state().items()}
        return super().state() | own | features

    def restore(self, state: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        super().restore(state)
        self._scales = ResidualScales(*(float(s) for s in state["scales"]))
        self._exposure = Exposure(*(float(value) for value in state["exposure"]))
        self._ambiguous, self._proofs = bool(state["ambiguous"]), int(state["proofs"])
        self._landmarks.restore(arrays_below(state, "features/"))

    def first_pose(self, frame: Frame) -> NDArray[np.float64] | None:
        """The identity, because the map's frame is that of the first camera; None if unusable."""
        T_map_camera = super().first_pose(frame)
        if T_map_camera is not None:
            level = self._prepared.of(frame, torch.device("cpu")).levels[0]
            self._landmarks = Landmarks(level, T_map_camera)
        return T_map_camera

    def change_frame(self, T_new_old: NDArray[np.float64]) -> None:
        """Change the coordinate frame of the map."""
        super().change_frame(T_new_old)
        self._landmarks.change_frame(T_new_old)

    def correct(self, T_new_old: NDArray[np.float64]) -> None:
        """Correct the poses since the last correction, which were wrong by a motion [4, 4]."""
        super().correct(T_new_old)
        self._landmarks.correct(T_new_old)

    def continue_from(self, timestamp_s: float, T_map_camera: NDArray[np.float64]) -> None:
        """Continue from a pose [4, 4], without a velocity."""
        super().continue_from(timestamp_s, T_map_camera)
        self._ambiguous, self._proofs = False, 0
        self._landmarks = Landmarks(self._newest, T_map_camera)

    def track(
        self, frame: Frame, gaussians: GaussianCloud, proposals: Proposals | None = None
    ) -> TrackingResult:
        """Track a frame and update the motion model, unless its pose is unknown."""
        starts = [self.motion.predict(frame.timestamp_s)]
        last = self.motion.last()
        if last is not None:
            starts.append(last)
        self._newest = self._prepared.of(frame, gaussians.means.device).levels[0]
        with self._recorder.timed(Stage.TRACKING_FEATURES):
            features = self._landmarks.locate(self._newest, starts)
        reach = self.motion.reach(frame.timestamp_s)
        result = self.locate(
            frame, gaussians, *starts, proposals=proposals, features=features, reach=reach
        )
        followed = features is not None
        result = unless_implausible(result, self.motion, frame.timestamp_s, reach, followed)
        proofs = self._proofs_after(result, reach)
        if result.health is Health.GOOD and proofs > 0:
            result = doubted(result, "after doubtful frames, this one alone is not enough evidence")
            result = replace(result, ambiguous=self._ambiguous)
        good = result.health is Health.GOOD
        two_motions = features is not None and features.motions is not None
        if good or (result.ambiguous and not (result.lost or two_motions)):
            # In other directions than the ambiguous one, the velocity is known.
            self.motion.update(frame.timestamp_s, result.T_map_camera, reliable=good)
        else:
            self.motion.forget_velocity()
        if good:
            self._scales = ResidualScales(result.intensity_residual, result.depth_residual_m)
            self._exposure = result.exposure
        elif not result.ambiguous and has_depth(frame):
            self._scales = relaxed_scales(self._scales)
        self._ambiguous, self._proofs = result.ambiguous, proofs
        if result.lost:
            self._landmarks.undo()
        else:
            with self._recorder.timed(Stage.TRACKING_FEATURES):
                self._landmarks.extend(self._newest, result.T_map_camera, certain=good)
        return result

    def _proofs_after(self, result: TrackingResult, reach: Reach | None) -> int:
        """Number of clear frames after this one that end the doubt; 0 without one."""
        if result.health is not Health.GOOD:
            return _PROOFS if result.ambiguous else max(1, self._proofs)
        # In a periodic view, the motion since an ambiguous frame may be one by a period.
        possible = not self._ambiguous or is_reached(result, reach)
        clear = possible and is_clear(result.similarity, _SURE_COVERED)
        return max(self._proofs - int(clear), 0)

    def locate(
        self,
        frame: Frame,
        gaussians: GaussianCloud,
        *starts: NDArray[np.float64],
        proposals: Proposals | None = None,
        search: bool = True,
        features: FeaturePose | None = None,
        reach: Reach | None = None,
    ) -> TrackingResult:
        """Locate a frame near one of several initial poses; the tracker's state does not change.

        Args:
            starts: initial poses T_map_camera [4, 4]. The map is rendered at the first one.
                Alignment starts at the one with the lowest cost on the coarsest level.
            proposals: further initial poses, which are asked for if the result is not clear.
            search: look for other initial poses at all.
            features: the pose of the frame's features, at which alignment starts instead, and with
                which its result is combined.
            reach: where the camera may be. A pattern that repeats is found outside of it, too.
        """
        prepared = self._prepared.of(frame, gaussians.means.device)
        task = Task(prepared, gaussians, features, self._ambiguous)
        results, start, expected = [], starts[0], starts[0]
        if features is not None:
            # Features are accurate to a pixel or two, and at coarse levels thin joints are lost.
            start = expected = features.T_map_camera
            view = self._render(task, start)
            results.append(self._align(task, view, start, _FINE_LEVELS))
        if features is None or not self._suffices(results[0], reach):
            view = self._render(task, starts[0])
            start = self._best_start(task, view, starts)
            results.append(self._align(task, view, start))
        likely = max(results, key=by_evidence)
        unclear = has_depth(frame) and not self._is_expected(task, likely, expected)
        # No other start makes an ambiguous view unambiguous.
        if search and unclear and not likely.ambiguous:
            further = self._further_starts(task, start, results, proposals)
            for T_map_camera, levels in further:
                nearby = self._render(task, T_map_camera)
                found = self._align(task, nearby, T_map_camera, levels)
                results.append(unless_contradicted(task, found, reach))
        likely = max(results, key=by_evidence)
        if reach is not None and likely.health is Health.GOOD:
            for T_map_camera in repetitions(task, view, likely.T_map_camera, reach):
                view = self._render(task, T_map_camera)
                results.append(self._align(task, view, T_map_camera, _FINE_LEVELS))
        best = likeliest(task, results, reach)
        if reach is not None and task.after_ambiguous and best.health is Health.GOOD:
            view = self._render(task, best.T_map_camera)
            if repeats_beyond(task, view, best.T_map_camera, reach):
                best = replace(doubted(best, REPEATS), ambiguous=True)
        if has_depth(frame) and not self._is_expected(task, best, expected):
            best = doubted(best, unexpected_reason(best.similarity))
        return replace(
            best,
            renders=sum(result.renders for result in results),
            iterations=sum(result.iterations for result in results),
        )

    @staticmethod
    def _suffices(result: TrackingResult, reach: Reach | None) -> bool:
        """Whether an alignment from the features' pose needs none from the predicted one."""
        return is_reached(result, reach) and (result.ambiguous or result.health is Health.GOOD)

    def _is_expected(
        self, task: Task, result: TrackingResult, T_expected: NDArray[np.float64]
    ) -> bool:
        """Whether a result needs no search: its evidence is clear, or it is where it should be.

        A pose that agrees with the features or, without them, with the prediction has evidence of
        its own, unless it is doubtful.
        """
        if _is_clear(result):
            return True
        distance = task.distance(T_expected, result.T_map_camera)
        return result.health is Health.GOOD and distance < _EXPECTED

    def _further_starts(
        self,
        task: Task,
        start: NDArray[np.float64],
        results: list[TrackingResult],
        proposals: Proposals | None,
    ) -> Iterator[tuple[NDArray[np.float64], int]]:
        """Initial poses T_map_camera [4, 4] with the levels to align, until a result is certain.

        It is if its evidence is clear, or if another initial pose has led to the likely pose again.

        Args:
            start: the first initial pose.
            results: those so far; the caller extends them.
        """
        likely = max(results, key=by_evidence)
        proposed = () if proposals is None else proposals(task.frame)
        searches = chain(
            ((T_map_camera, _FINE_LEVELS) for T_map_camera in proposed),
            self._rotated_starts(task, start),
        )
        for search in searches:
            yield search
            again = task.distance(likely.T_map_camera, results[-1].T_map_camera) < _SAME
            if any(_is_clear(result) for result in results) or (again and not likely.lost):
                return

    def _render(self, task: Task, T_map_view: NDArray[np.float64]) -> RenderedView:
        camera, levels = task.camera, self._levels
        return self._renderer.view(task.gaussians, camera, T_map_view, levels)

    def _best_start(
        self, task: Task, view: RenderedView, starts: tuple[NDArray[np.float64], ...]
    ) -> NDArray[np.float64]:
        """The initial pose with the lowest cost against a view."""
        if len(starts) == 1:
            return starts[0]
        T_view_map = se3.inverse(view.T_map_view)
        model, frame = view.levels[-1], task.levels[-1]
        gate = _MAX_DISTANCE * 2 ** (self._levels - 1)
        costs = [
            linearise(
                LevelProblem(model, frame, T_view_map @ T, self._scales, self._exposure, gate)
            ).cost
            for T in starts
        ]
        return starts[int(np.argmin(costs))]

    def _rotated_starts(
        self, task: Task, start: NDArray[np.float64]
    ) -> Iterator[tuple[NDArray[np.float64], int]]:
        """Initial poses T_map_camera [4, 4] by rotations in all directions, and their levels."""
        levels = task.levels[_SEARCH_LEVEL:]
        if not levels:
            return
        camera = wide_camera(task.camera)
        view = self._renderer.view(task.gaussians, camera, start, len(levels))
        options = replace(
            self._alignment_options,
            max_distance=_MAX_DISTANCE * 2**_SEARCH_LEVEL,
        )
        with self._recorder.timed(Stage.TRACKING_SEARCH):
            found = rotated_starts(view.levels, levels, np.eye(4), self._exposure, options)
        yield from ((view.T_map_view @ T, _FINE_LEVELS) for T in found)

    def _align(
        self, task: Task, view: RenderedView, start: NDArray[np.float64], levels: int | None = None
    ) -> TrackingResult:
        """Align a frame from an initial pose.

        Args:
            view: a view of the map near the initial pose. The map is rendered again if the
                estimate moves too far from it.
            levels: number of the finest pyramid levels to align; all by default.
        """
        T_view_camera = se3.inverse(view.T_map_view) @ start
        alignment = Alignment(T_view_camera, self._scales, self._exposure)
        renders, levels, options = 1, levels or len(view.levels), self._alignment_options
        while True:
            with self._recorder.timed(Stage.TRACKING_ALIGN):
                alignment = align(view.levels[:levels], task.levels[:levels], alignment, options)
            near = task.size(alignment.T_view_camera) <= _RERENDER_DISTANCE
            if (near and alignment.converged) or renders == _RENDERS:
                return self._result(task, view, alignment, renders)
            view = self._render(task, view.T_map_view @ alignment.T_view_camera)
            alignment = replace(alignment, T_view_camera=np.eye(4))
            # Further views of the same frame are aligned at the finest level only.
            renders, levels = renders + 1, 1

    @property
    def _alignment_options(self) -> GaussNewtonOptions:
        return GaussNewtonOptions(
            iterations=_ITERATIONS,
            max_distance=_MAX_DISTANCE,
            photometric_weight=1.0,
            exposure=self._exposure,
        )

    def _estimated_exposure(self, task: Task, view: RenderedView, alignment: Alignment) -> Exposure:
        """Exposure of the frame that is stored with a keyframe."""
        if alignment.last is None:
            return alignment.exposure
        levels = list(zip(view.levels, task.levels, strict=True))
        pose, scales = alignment.T_view_camera, alignment.scales
        return estimate_exposure(levels, pose, scales, alignment.exposure, _MAX_DISTANCE)

    def _result(
        self, task: Task, view: RenderedView, alignment: Alignment, renders: int
    ) -> TrackingResult:
        judgement = judged(self.limits, task, view, alignment, _MAX_DISTANCE, self._recorder)
        return TrackingResult(
            T_map_camera=judgement.pose.T_map_camera,
            converged=alignment.converged,
            iterations=alignment.iterations,
            renders=renders,
            intensity_residual=alignment.scales.intensity,
            depth_residual_m=alignment.scales.depth_m,
            visible_fraction=judgement.visible,
            information=judgement.information,
            covariance=judgement.pose.covariance,
            health=judgement.health,
            reason=judgement.reason,
            ambiguous=judgement.ambiguous,
            exposure=self._estimated_exposure(task, view, alignment),
            similarity=judgement.similarity,
            T_by_features=None if task.features is None else task.features.T_map_camera,
        )


def _is_clear(result: TrackingResult) -> bool:
    """Whether no other pose needs to be considered."""
    return not result.lost and is_clear(result.similarity)
