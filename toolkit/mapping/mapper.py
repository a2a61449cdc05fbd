"""Builds the map: densify it with each keyframe, and optimise it over a window of keyframes."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.frame import Frame, NullRecorder, Recorder
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.io.arrays import arrays_below
from toolkit.keyframe import Keyframe
from toolkit.mapping.consensus import label_consensus
from toolkit.mapping.deferred import DeferredSteps
from toolkit.mapping.densification import Densification
from toolkit.mapping.depth_fusion import fuse_depth
from toolkit.mapping.depth_views import DepthView
from toolkit.mapping.effort import Effort
from toolkit.mapping.free_space import Evidence, FreeSpace, hides_view, is_measured
from toolkit.mapping.gaussian_map import GaussianMap, MapContent
from toolkit.mapping.hole_filling import fill_holes
from toolkit.mapping.keyframe_exposures import KeyframeExposures
from toolkit.mapping.keyframes import KeyframeChoice, choose_window
from toolkit.mapping.moving_objects import hide_moving_objects
from toolkit.mapping.observations import KeyframeImages
from toolkit.mapping.optimisation import MapOptimisation, Objective
from toolkit.mapping.options import MapperOptions
from toolkit.mapping.refinement import refine
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.rendering import RenderOptions, SurfaceView, backend, render_surface
from toolkit.stages import Stage
from toolkit.tracking.health import has_depth

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class MappingResult:
    """Result of adding a keyframe.

    Attributes:
        seeded, pruned: number of Gaussians added and removed.
        loss: loss of the images at the last optimisation step, nan if there was none or steps are
            deferred.
        steps: number of optimisation steps, 0 if they are deferred.
    """

    seeded: int
    pruned: int
    loss: float
    steps: int = 0


class Mapper:
    """Extends, optimises and refines one map.

    Args:
        generator: chooses keyframes, and pixels if only a random fraction of them is seeded.
        semantics: semantics of the map; none by default.
        device: device that stores and optimises the map, "cpu" or "cuda".
        gains: whether the exposures of keyframes are estimated, not only their white balance.

    Attributes:
        exposures: estimates those of keyframes.
        keyframe_choice: decides which tracked frames become keyframes.
        deferred: steps that wait for `take_deferred_step`; None if they are taken at once.
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
    ) -> None:
        self.options = options or MapperOptions()
        self.semantics = semantics or SemanticMapping()
        self.device = torch.device(device)
        rates = self.options.rates
        rates = replace(rates, features=rates.features * self.semantics.unit)
        self.map = GaussianMap(rates, self.semantics.channels, self.device, self.options.centred)
        self.keyframe_choice: KeyframeChoice = self.options.keyframes
        self.deferred: DeferredSteps | None = None
        self.exposures = KeyframeExposures(self.options.white_balance, gains)
        self._generator = generator or np.random.default_rng(0)
        self._backend = backend(backend_name)
        self._recorder = recorder or NullRecorder()
        self._observations = KeyframeImages(self.device)
        self._free_space = FreeSpace(self.options.free_space)
        self._densification = Densification(self.options, self.semantics, self._generator)
        self._optimisation = MapOptimisation(
            self.options, self.semantics, self._backend, self._observations, self._recorder
        )

    @property
    def gaussians(self) -> GaussianCloud:
        """The Gaussians of the map, on its device."""
        return self.map.gaussians

    @property
    def keyframes(self) -> list[Keyframe]:
        """The keyframes of the map, in order."""
        return self.map.keyframes

    def wants(self, frame: Frame, T_map_camera: NDArray[np.float64]) -> bool:
        """Whether a tracked frame should become a keyframe."""
        if not self.keyframes:
            return True
        return has_depth(frame) and self.wants_view(frame.index, T_map_camera)

    def wants_view(self, index: int, T_map_camera: NDArray[np.float64]) -> bool:
        """Whether the view of a frame should become a keyframe, if the frame has depth."""
        if not self.keyframes:
            return True
        last = self.keyframes[-1]
        return self.keyframe_choice.wants(index - last.index, last.fraction_seen_by(T_map_camera))

    def add_keyframe(self, keyframe: Keyframe) -> MappingResult:
        """Extend and optimise the map with a keyframe.

        Args:
            keyframe: at its pose in the map's frame. Its class ids refer to the map's taxonomy;
                a map without semantics removes them.
        """
        if self.semantics.channels == 0:
            keyframe.class_ids = None
        with self._recorder.timed(Stage.EXPOSURE):
            self.exposures.estimate(keyframe, self.keyframes)
        self.keyframes.append(keyframe)
        self.semantics.observe(keyframe.class_ids)
        observed = self._observations.of(keyframe)
        if self.options.fuse_depth:
            with self._recorder.timed(Stage.DEPTH_FUSION):
                fuse_depth(self.map, observed.measured_m)
        others = self.keyframes[:-1]
        free_space = others and is_measured(self.options.free_space, self.keyframes)
        if free_space:
            with self._recorder.timed(Stage.FREE_SPACE):
                mask = self._free_space.contradicted(self.gaussians.means, keyframe, others)
                self._remove(mask)
        with self._recorder.timed(Stage.SEEDING):
            view, options = self.view(keyframe), self.options
            hide_moving_objects(
                keyframe, view, others, options.moving_objects, options.min_silhouette
            )
            observed = self._observations.of(keyframe)
            empty = partial(self._free_space.seen_through, others=others) if free_space else None
            seeded = self._densification.seed(self.map, keyframe, view, observed, empty)
        all_new = seeded == len(self.gaussians)
        steps = options.first_iterations if all_new else options.iterations
        if self.deferred is None:
            effort = Effort(steps, steps if all_new else max(options.max_iterations, steps))
            loss = self._optimise(effort)
        else:
            effort, loss = Effort(0, 0), float("nan")
            self.deferred.add(keyframe, steps)
        return MappingResult(seeded, self._densification.prune(self.map), loss, effort.taken)

    def keyframes_from(self, index: int) -> list[Keyframe]:
        """The active submap's keyframe of a frame index and the one after it, as far as exist."""
        for position in reversed(range(len(self.keyframes))):
            if self.keyframes[position].index == index:
                return self.keyframes[position : position + 2]
        return []

    def unmapped_pixels(
        self, frame: Frame, T_map_camera: NDArray[np.float64], keyframes: Sequence[Keyframe]
    ) -> NDArray[np.bool_]:
        """Mask [H, W] of a frame's measured pixels without Gaussians that no keyframe shows.

        Args:
            T_map_camera: [4, 4] pose of the frame.
            keyframes: those next to the frame.
        """
        view = self.render(self.gaussians, frame.camera, T_map_camera)
        mask = ~self._densification.covered(view).cpu().numpy() & (frame.depth_m > 0)
        points_map = se3.transform_points(T_map_camera, frame.camera.unproject(frame.depth_m)[mask])
        mask[mask] = ~np.any([k.reaches(points_map) for k in keyframes], axis=0)
        return mask

    def seed_pixels(
        self,
        frame: Frame,
        T_map_camera: NDArray[np.float64],
        mask: NDArray[np.bool_],
        keyframe: Keyframe,
    ) -> None:
        """Seed Gaussians for pixels of a frame that does not become a keyframe.

        Args:
            frame: at the map's exposure, with labels of the map's taxonomy.
            T_map_camera: [4, 4] pose of the frame.
            mask: [H, W], which pixels.
            keyframe: the Gaussians move with it.
        """
        if self.semantics.channels == 0:
            frame = replace(frame, labels=None)
        if frame.labels is not None:
            self.semantics.observe(torch.from_numpy(frame.labels[mask]))
        seeds = self._densification.seeds(frame, T_map_camera, mask)
        self.map.append(seeds, keyframe)

    def take_deferred_step(self) -> None:
        """Take one of the deferred steps, if there are any."""
        due = None if self.deferred is None else self.deferred.next()
        if self.deferred is None or due is None:
            return
        if not due.window:
            position = next(i for i, k in enumerate(self.keyframes) if k is due.keyframe)
            due.window = self._window(self.keyframes[: position + 1])
        objective = Objective(self.options.bundle_adjustment)
        self.step(self._pick(due.window), (due.taken, due.total), objective)
        self.deferred.take(due)

    def optimise_window(self, steps: int, poses: bool = False) -> None:
        """Optimise the window of the newest keyframe (G: at a boundary between submaps).

        If steps are deferred, these are skipped.

        Args:
            steps: number of optimisation steps.
            poses: optimise the poses of keyframes too, except the first keyframe's.
        """
        if self.deferred is not None:
            self.deferred.skip(steps)
            return
        self._optimise(Effort(steps, steps), poses)
        self._densification.prune(self.map)

    def optimise_keyframes(self, indices: Iterable[int], iterations: int) -> None:
        """Optimise the map over some keyframes, each equally often; their poses stay fixed.

        Args:
            indices: frame indices of the keyframes; others are ignored.
            iterations: number of optimisation steps on each keyframe.
        """
        wanted = set(indices)
        chosen = [keyframe for keyframe in self.keyframes if keyframe.index in wanted]
        if not chosen or iterations == 0:
            return
        objective = Objective()
        for done in range(iterations):
            for number, index in enumerate(self._generator.permutation(len(chosen))):
                progress = (done * len(chosen) + number, iterations * len(chosen))
                self.step(chosen[index], progress, objective)
        self._densification.prune(self.map)

    def step(self, keyframe: Keyframe, progress: tuple[int, int], objective: Objective) -> float:
        """Take one optimisation step on one keyframe; see `MapOptimisation.step`."""
        return self._optimisation.step(self.map, keyframe, progress, objective)

    def refine(self, T_map_cameras: NDArray[np.float64] | None = None) -> None:
        """Refine the map over all keyframes, at the end of a run; see `refinement.py`.

        Args:
            T_map_cameras: [P, 4, 4] poses of all frames, in front of which space is cleared; only
                those of the keyframes if absent.
        """
        if T_map_cameras is None:
            T_map_cameras = np.array([k.T_map_camera for k in self.keyframes])
        with self._recorder.timed(Stage.EXPOSURE):
            self.exposures.adjust(self.keyframes)
        if self.semantics.channels and self.options.consensus.use:
            with self._recorder.timed(Stage.MAP_CONSENSUS):
                self.map.gaussians = label_consensus(
                    self.gaussians,
                    self.keyframes,
                    self.semantics,
                    partial(self.render, features=True),
                    self.options.consensus,
                )
            self.map.optimiser.reset("features")
        self._clear_free_space(T_map_cameras)
        if self.options.fill_holes:
            with self._recorder.timed(Stage.HOLE_FILLING):
                self._fill_holes()
        refine(self.map, self._optimisation, self.options, self._generator)
        self._clear_free_space(T_map_cameras)
        self._densification.prune(self.map)

    def replace_content(self, content: MapContent) -> None:
        """Replace the Gaussians, keyframes and step counts of the map."""
        if self.deferred is not None:
            self.deferred.clear()
        self.map.replace_content(content)

    @property
    def content(self) -> MapContent:
        """The content of the map: shared if it is on the CPU, otherwise a copy."""
        return self.map.content

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues identically."""
        arrays, values = self.map.state()
        arrays |= {f"semantics/{name}": a for name, a in self.semantics.state().items()}
        return arrays, values | {"generator": self._generator.bit_generator.state}

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        self.map.restore(arrays, values)
        self.semantics.restore(arrays_below(arrays, "semantics/"))
        self._generator.bit_generator.state = values["generator"]

    def view(self, keyframe: Keyframe) -> SurfaceView:
        """Render the map from a keyframe."""
        return self.render(self.gaussians, keyframe.camera, keyframe.T_map_camera)

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

    def _clear_free_space(self, T_map_cameras: NDArray[np.float64]) -> None:
        """Remove Gaussians from space that all keyframes together measured as empty.

        Args:
            T_map_cameras: [P, 4, 4] poses of frames.
        """
        if not is_measured(self.options.free_space, self.keyframes):
            return
        with self._recorder.timed(Stage.FREE_SPACE):
            views = (DepthView.of(keyframe) for keyframe in self.keyframes)
            evidence = Evidence.of(self.gaussians.means, views)
            mask = evidence.contradicts_in_map(self.gaussians.radii_m, self.options.free_space)
            mask |= hides_view(self.gaussians.means, self.keyframes[0].camera, T_map_cameras)
        self._remove(mask)
        if mask.any():
            _log.info("Removed %d Gaussians from empty space.", int(mask.sum()))

    def _remove(self, mask: Tensor) -> None:
        """Remove the Gaussians in a mask [N]."""
        if mask.any():
            self.map.remove(mask)

    def _fill_holes(self) -> None:
        views = [DepthView.of(keyframe) for keyframe in self.keyframes]
        filled = 0
        for number, keyframe in enumerate(self.keyframes):
            others = [*views[:number], *views[number + 1 :]]
            view = self.view(keyframe)
            filled += fill_holes(self.map, keyframe, view, self._densification, others)
        if filled:
            _log.info("Seeded %d Gaussians where no depth was measured.", filled)

    def _optimise(self, effort: Effort, poses: bool = False) -> float:
        """Optimise over the window of the newest keyframe; return the loss of the last step."""
        window = self._window(self.keyframes)
        adjust_poses = poses or self.options.bundle_adjustment
        objective = Objective(adjust_poses)
        loss = float("nan")
        while effort.wanted:
            keyframe = window[0] if effort.measures else self._pick(window)
            # The weights of semantics follow the minimum, which slow sequences take.
            progress = (effort.taken, max(effort.minimum, effort.taken + 1))
            loss = self.step(keyframe, progress, objective)
            effort.took(loss if keyframe is window[0] else None)
        return loss

    def _window(self, keyframes: list[Keyframe]) -> list[Keyframe]:
        """Keyframes to optimise together with the newest of some keyframes, which comes first."""
        options = self.options
        return choose_window(keyframes, options.window, options.min_overlap, self._generator)

    def _pick(self, window: list[Keyframe]) -> Keyframe:
        if len(window) == 1 or self._generator.random() < self.options.newest_share:
            return window[0]
        return window[1 + int(self._generator.integers(len(window) - 1))]
