"""Builds submaps: densify with each keyframe, and optimise over a window of keyframes."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.frame import Frame, NullRecorder, Recorder
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.base.stages import Stage
from toolkit.io.arrays import arrays_below
from toolkit.semantics.features.builtin import BuiltinEncoder
from toolkit.semantics.features.sources import ViewDescriber
from toolkit.slam.mapping.consensus import LabelAgreement, label_consensus
from toolkit.slam.mapping.deferred import DeferredSteps
from toolkit.slam.mapping.densification import Densification
from toolkit.slam.mapping.depth_fusion import fuse_depth
from toolkit.slam.mapping.effort import Effort
from toolkit.slam.mapping.final_optimisation import refine
from toolkit.slam.mapping.free_space import (
    FreeSpace,
    contradicted_by_all,
    evidence_of_all,
    is_measured,
)
from toolkit.slam.mapping.hidden_gaussians import hidden
from toolkit.slam.mapping.hole_filling import fill_all_holes
from toolkit.slam.mapping.keyframe_exposures import KeyframeExposures
from toolkit.slam.mapping.keyframes import KeyframeChoice, choose_window, wants_view
from toolkit.slam.mapping.merging import to_ellipsoids
from toolkit.slam.mapping.moving_objects import hide_moving_objects
from toolkit.slam.mapping.optimisation import KeyframeImages, MapOptimisation, Objective
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.mapping.view_features import FeatureLoss, ViewFeatures
from toolkit.slam.submaps.submap import Submap
from toolkit.slam.tracking.health import has_depth
from toolkit.splatting.gaussians.cloud import PIXEL_FILTER, GaussianCloud, LowPass
from toolkit.splatting.rendering import RenderOptions, SurfaceView, backend, render_surface
from toolkit.splatting.rendering.backend import GaussianGradients

_log = logging.getLogger(__name__)

# Maximum number of optimisation iterations on a keyframe that is not explained yet.
_MAX_ITERATIONS = 12
# Maximum number of keyframes optimised together, minimum overlap of the others with the newest one,
# and fraction of the iterations spent on the newest one.
_WINDOW, _MIN_OVERLAP, _NEWEST_SHARE = 8, 0.15, 0.4


@dataclass(frozen=True)
class MappingResult:
    """Result of adding a keyframe.

    Attributes:
        seeded: number of Gaussians added.
        loss: loss of the images at the last optimisation step, nan if there was none or steps are
            deferred.
        steps: number of optimisation steps, 0 if they are deferred.
    """

    seeded: int
    loss: float
    steps: int = 0


class Mapper:
    """Extends, optimises and refines the submap that it is given.

    Args:
        generator: chooses keyframes, and pixels if only a random fraction of them is seeded.
        semantics: semantics of the map; none by default.
        device: device that stores and optimises submaps, "cpu" or "cuda".
        describer: computes the features of views that the final refinement compares; of the colour
            images by default.
        gains: whether the exposures of keyframes are estimated, not only their white balance.

    Attributes:
        exposures: estimates those of keyframes.
        densification: adds and removes Gaussians.
        deferred: steps that wait for `take_deferred_step`; None if they are taken at once.
        label_agreement: of the keyframes of all refined submaps.
    """

    def __init__(  # noqa: PLR0913 - everything that the parts of mapping share
        self,
        options: MapperOptions | None = None,
        generator: np.random.Generator | None = None,
        backend_name: str = "auto",
        recorder: Recorder | None = None,
        semantics: SemanticMapping | None = None,
        device: str = "cpu",
        gains: bool = True,
        describer: ViewDescriber | None = None,
    ) -> None:
        self.options = options or MapperOptions()
        self.semantics = semantics or SemanticMapping()
        self.device = torch.device(device)
        self._keyframe_choice: KeyframeChoice = self.options.keyframes
        self.deferred: DeferredSteps | None = None
        self.label_agreement = LabelAgreement()
        self.exposures = KeyframeExposures(self.options.white_balance, gains)
        self._generator = generator or np.random.default_rng(0)
        self._backend = backend(backend_name)
        self._recorder = recorder or NullRecorder()
        self._observations = KeyframeImages(self.device)
        self._free_space = FreeSpace()
        feature_loss = None
        if self.options.final_feature > 0:
            features = ViewFeatures(describer or ViewDescriber(BuiltinEncoder()), self.semantics)
            feature_loss = FeatureLoss(features, self.options.final_feature)
        self.densification = Densification(self.options, self.semantics, self._generator)
        self._optimisation = MapOptimisation(
            self.options,
            self.semantics,
            self._backend,
            self._observations,
            self._recorder,
            feature_loss,
        )

    def first_submap(self) -> Submap:
        """The first submap of a map, empty."""
        return Submap.empty(0, self.semantics.channels, self.device, self.options.centred)

    def wants(
        self,
        keyframes: Sequence[Keyframe],
        frame: Frame,
        T_map_camera: NDArray[np.float64],
        visited: int = 0,
    ) -> bool:
        """Whether a tracked frame should become the next keyframe of a submap."""
        if not keyframes:
            return True
        return has_depth(frame) and self.wants_view(keyframes, frame.index, T_map_camera, visited)

    def wants_view(
        self,
        keyframes: Sequence[Keyframe],
        index: int,
        T_map_camera: NDArray[np.float64],
        visited: int = 0,
    ) -> bool:
        """Whether the view of a frame with depth should become a keyframe; see `is_revisit`."""
        choice, revisit = self._keyframe_choice, self.options.keyframes.revisit
        return wants_view(choice, keyframes, index, T_map_camera, revisit, visited)

    def add_keyframe(self, submap: Submap, keyframe: Keyframe) -> MappingResult:
        """Extend and optimise a submap with a keyframe.

        Args:
            keyframe: at its pose in the submap's frame. Its class ids refer to the map's taxonomy;
                a map without semantics removes them.
        """
        if self.semantics.channels == 0:
            keyframe.class_ids = None
        with self._recorder.timed(Stage.EXPOSURE):
            self.exposures.estimate(keyframe, submap.keyframes)
        submap.keyframes.append(keyframe)
        self.semantics.observe(keyframe.class_ids)
        observed = self._observations.of(keyframe)
        if self.options.fuse_depth:
            with self._recorder.timed(Stage.DEPTH_FUSION):
                fuse_depth(submap, observed.measured_m)
        others = submap.keyframes[:-1]
        free_space = self.options.free_space and others and is_measured(submap.keyframes)
        if free_space:
            with self._recorder.timed(Stage.FREE_SPACE):
                mask = self._free_space.contradicted(submap.gaussians.means, keyframe, others)
                _remove(submap, mask)
        with self._recorder.timed(Stage.SEEDING):
            view, options = self.view(submap, keyframe), self.options
            if options.moving_objects:
                hide_moving_objects(keyframe, view, others, options.min_silhouette)
            observed = self._observations.of(keyframe)
            empty = partial(self._free_space.seen_through, others=others) if free_space else None
            seeded = self.densification.seed(submap, keyframe, view, observed, empty)
        all_new = seeded == len(submap.gaussians)
        steps = options.first_iterations if all_new else options.iterations
        if self.deferred is None:
            effort = Effort(steps, steps if all_new else max(_MAX_ITERATIONS, steps))
            loss = self._optimise(submap, effort)
        else:
            effort, loss = Effort(0, 0), float("nan")
            self.deferred.add(keyframe, steps)
        self.densification.prune(submap)
        return MappingResult(seeded, loss, effort.taken)

    def defer_steps(self, keyframes: KeyframeChoice) -> DeferredSteps:
        """Defer the steps of keyframes until `take_deferred_step`.

        Args:
            keyframes: decides which tracked frames become keyframes from now on.
        """
        self._keyframe_choice, self.deferred = keyframes, DeferredSteps()
        return self.deferred

    def skip_deferred_steps(self) -> None:
        """Skip the deferred steps: another submap becomes active, or this one was moved."""
        if self.deferred is not None:
            self.deferred.clear()

    def take_deferred_step(self, submap: Submap) -> None:
        """Take one of the deferred steps of the active submap, if there are any."""
        due = None if self.deferred is None else self.deferred.next()
        if self.deferred is None or due is None:
            return
        if not due.window:
            position = next(i for i, k in enumerate(submap.keyframes) if k is due.keyframe)
            due.window = self._window(submap.keyframes[: position + 1])
        objective = Objective(self.options.bundle_adjustment)
        self.step(submap, self._pick(due.window), (due.taken, due.total), objective)
        self.deferred.take(due)

    def optimise_window(self, submap: Submap, steps: int, poses: bool = False) -> None:
        """Optimise the window of a submap's newest keyframe (G: at a boundary between submaps).

        If steps are deferred, these are skipped.

        Args:
            steps: number of optimisation steps.
            poses: optimise the poses of keyframes too, except the first keyframe's.
        """
        if self.deferred is not None:
            self.deferred.skip(steps)
            return
        self._optimise(submap, Effort(steps, steps), poses)
        self.densification.prune(submap)

    def optimise_moved(self, submap: Submap, indices: Iterable[int], iterations: int) -> None:
        """Optimise a submap over keyframes that were moved, each equally often, at fixed poses.

        The moments of the optimiser and deferred steps, which are of the map before, are dropped.

        Args:
            indices: frame indices of the keyframes; others are ignored.
            iterations: number of optimisation steps on each keyframe.
        """
        submap.optimiser.release()
        self.skip_deferred_steps()
        wanted = set(indices)
        chosen = [keyframe for keyframe in submap.keyframes if keyframe.index in wanted]
        if not chosen or iterations == 0:
            return
        objective = Objective()
        for done in range(iterations):
            for number, index in enumerate(self._generator.permutation(len(chosen))):
                progress = (done * len(chosen) + number, iterations * len(chosen))
                self.step(submap, chosen[index], progress, objective)
        self.densification.prune(submap)

    def step(
        self, submap: Submap, keyframe: Keyframe, progress: tuple[int, int], objective: Objective
    ) -> float:
        """Take one optimisation step on one keyframe; see `MapOptimisation.step`."""
        return self._optimisation.step(submap, keyframe, progress, objective)

    def gradients(
        self, gaussians: GaussianCloud, keyframe: Keyframe, progress: tuple[int, int]
    ) -> tuple[float, GaussianGradients]:
        """Loss of the final refinement on a keyframe; see `MapOptimisation.gradients`."""
        loss, gradients, _ = self._optimisation.gradients(
            gaussians, keyframe, progress, complete=True
        )
        return loss, gradients

    def refine(
        self,
        submap: Submap,
        T_map_cameras: NDArray[np.float64] | None = None,
        steps: Iterator[int] | None = None,
        low_pass: LowPass = PIXEL_FILTER,
    ) -> None:
        """Refine a submap over all its keyframes, at the end of a run; see `final_optimisation.py`.

        Args:
            T_map_cameras: [P, 4, 4] poses of all frames, in front of which space is cleared; only
                those of the keyframes if absent.
            steps: is advanced once per optimisation step, for a progress bar.
            low_pass: of new ellipsoids.
        """
        if T_map_cameras is None:
            T_map_cameras = np.array([k.T_map_camera for k in submap.keyframes])
        with self._recorder.timed(Stage.EXPOSURE):
            self.exposures.adjust(submap.keyframes)
        if self.semantics.channels and self.options.consensus.use:
            with self._recorder.timed(Stage.MAP_CONSENSUS):
                consensus = label_consensus(
                    submap.gaussians,
                    submap.keyframes,
                    self.semantics,
                    partial(self.render, features=True),
                    self.options.consensus.rounds,
                )
            submap.gaussians = consensus.gaussians
            self.label_agreement += consensus.agreement
            submap.optimiser.reset("features")
        self._clear_free_space(submap, T_map_cameras)
        if self.options.fill_holes:
            with self._recorder.timed(Stage.HOLE_FILLING):
                fill_all_holes(submap, self.view, self.densification)
        # Without optimisation, merged ellipsoids would be worse than the spheres.
        merge = self.options.final_shape == "ellipsoids" and self.options.final_iterations > 0
        merge &= submap.gaussians.ellipsoids is None
        if merge:
            classes = self.semantics.classes_of(submap.gaussians.features)
            to_ellipsoids(submap, classes, low_pass)
        refine(submap, self._optimisation, self.options, self._generator, steps, merge)
        support = self._clear_free_space(submap, T_map_cameras)
        if self.options.final_iterations:
            _remove(submap, hidden(submap.gaussians, submap.keyframes, self._backend, support))
        self.densification.prune(submap)

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues identically."""
        arrays = {f"semantics/{name}": a for name, a in self.semantics.state().items()}
        return arrays, {"generator": self._generator.bit_generator.state}

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        self.semantics.restore(arrays_below(arrays, "semantics/"))
        self._generator.bit_generator.state = values["generator"]

    def view(self, submap: Submap, keyframe: Keyframe) -> SurfaceView:
        """Render a submap from a keyframe."""
        return self.render(submap.gaussians, keyframe.camera, keyframe.T_map_camera)

    def render(
        self,
        gaussians: GaussianCloud,
        camera: Camera,
        T_map_camera: NDArray[np.float64],
        features: bool = False,
    ) -> SurfaceView:
        """Render Gaussians from a camera at a pose [4, 4], on request with their features."""
        options = RenderOptions(features=features)
        T_camera_map = se3.inverse(T_map_camera)
        return render_surface(self._backend, gaussians, camera, T_camera_map, options)

    def _clear_free_space(
        self, submap: Submap, T_map_cameras: NDArray[np.float64]
    ) -> Tensor | None:
        """Remove Gaussians from space that all keyframes together measured as empty.

        Args:
            T_map_cameras: [P, 4, 4] poses of frames.

        Returns:
            The number [N] of the keyframes that measured a surface at each remaining Gaussian;
            None if free space is not searched.
        """
        gaussians, keyframes = submap.gaussians, submap.keyframes
        if not self.options.free_space or not is_measured(keyframes):
            return None
        with self._recorder.timed(Stage.FREE_SPACE):
            evidence = evidence_of_all(gaussians, keyframes)
            mask = contradicted_by_all(gaussians, evidence, keyframes[0].camera, T_map_cameras)
        _remove(submap, mask)
        if mask.any():
            _log.info("Removed %d Gaussians from empty space.", int(mask.sum()))
        return evidence.support[~mask]

    def _optimise(self, submap: Submap, effort: Effort, poses: bool = False) -> float:
        """Optimise over the window of the newest keyframe; return the loss of the last step."""
        window = self._window(submap.keyframes)
        adjust_poses = poses or self.options.bundle_adjustment
        objective = Objective(adjust_poses)
        loss = float("nan")
        while effort.wanted:
            keyframe = window[0] if effort.measures else self._pick(window)
            # The weights of semantics follow the minimum, which slow sequences take.
            progress = (effort.taken, max(effort.minimum, effort.taken + 1))
            loss = self.step(submap, keyframe, progress, objective)
            effort.took(loss if keyframe is window[0] else None)
        return loss

    def _window(self, keyframes: list[Keyframe]) -> list[Keyframe]:
        """Keyframes to optimise together with the newest of some keyframes, which comes first."""
        return choose_window(keyframes, _WINDOW, _MIN_OVERLAP, self._generator)

    def _pick(self, window: list[Keyframe]) -> Keyframe:
        if len(window) == 1 or self._generator.random() < _NEWEST_SHARE:
            return window[0]
        return window[1 + int(self._generator.integers(len(window) - 1))]


def _remove(submap: Submap, mask: Tensor) -> None:
    """Remove the Gaussians in a mask [N]."""
    if mask.any():
        submap.remove(mask)
