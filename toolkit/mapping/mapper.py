"""Builds the map: seed what is missing, settle it, optimise it over a window of keyframes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.alignment.pose_adam import PoseAdam, pose_gradient
from toolkit.features.builtin import BuiltinEncoder
from toolkit.frame import Frame, NullRecorder, Recorder
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.gaussians.seeding import seed
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.io.arrays import arrays_below
from toolkit.keyframe import Keyframe
from toolkit.losses.features import FeatureLoss
from toolkit.losses.photometric import rgbd_loss
from toolkit.mapping.consensus import agree
from toolkit.mapping.content import MapContent
from toolkit.mapping.density import missing, useless
from toolkit.mapping.depth_fusion import measured_centres
from toolkit.mapping.keyframes import choose_window
from toolkit.mapping.observations import Observations
from toolkit.mapping.options import MapperOptions
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.mapping.sparse_adam import PARAMETERS, SparseAdam
from toolkit.mapping.surfaces import Surfaces
from toolkit.native.constants import BASE_CHANNELS
from toolkit.rendering import DrawOptions, SurfaceView, backend, draw_surface
from toolkit.rendering.output import COLOUR
from toolkit.rendering.texture import resample_at_centres

# Gaussians that have had more steps begin the final refinement as if they had had so many: fitted
# to be tracked against, they have some way to go. 0.7 dB, for 0.15 mm of depth (a room).
_FRESH_STEPS = 15


@dataclass(frozen=True)
class MappingResult:
    """What one mapping call did.

    Attributes:
        seeded, pruned: Gaussians added and removed.
        loss: the last step's, nan where no step was taken.
    """

    seeded: int
    pruned: int
    loss: float


class Mapper:
    """Owns the Gaussians, the keyframes and the optimiser of one map.

    Args:
        device: where the map is kept and optimised, "cpu" or "cuda".
    """

    def __init__(
        self,
        options: MapperOptions | None = None,
        generator: np.random.Generator | None = None,
        backend_name: str = "auto",
        recorder: Recorder | None = None,
        semantics: SemanticMapping | None = None,
        device: str = "cpu",
    ) -> None:
        self.options = options or MapperOptions()
        self.semantics = semantics or SemanticMapping()
        self.device = torch.device(device)
        self.gaussians = GaussianCloud.empty(self.semantics.channels, self.device)
        self.keyframes: list[Keyframe] = []
        rates = self.options.rates
        rates = replace(rates, features=rates.features * self.semantics.unit)
        self.optimiser = SparseAdam(rates, self.semantics.channels, self.device)
        self.seeded_by = torch.zeros(0, dtype=torch.int32, device=self.device)
        self._generator = generator or np.random.default_rng(0)
        self._backend = backend(backend_name)
        self._observations = Observations(self.device)
        self._recorder = recorder or NullRecorder()

    def wants(self, frame: Frame, T_map_camera: NDArray[np.float64]) -> bool:
        """Whether a tracked frame should become a keyframe."""
        if not self.keyframes:
            return True
        last = self.keyframes[-1]
        overlap = last.share_seen_by(T_map_camera)
        return self.options.keyframes.wants(frame.index - last.index, overlap)

    def add_keyframe(self, keyframe: Keyframe) -> MappingResult:
        """Extend and optimise the map with a keyframe.

        Args:
            keyframe: at its pose in the map's frame. Its class ids are those of the map's
                taxonomy; a map without semantics drops them.
        """
        if self.semantics.channels == 0:
            keyframe.class_ids = None
        self.keyframes.append(keyframe)
        self.semantics.observe(keyframe.class_ids)
        if self.options.fuse_depth:
            with self._recorder.timed("depth fusion"):
                self._fuse_depth(keyframe)
        with self._recorder.timed("seeding"):
            seeded = self._seed(keyframe)
        all_new = seeded == len(self.gaussians)
        loss = self._optimise(self.options.first_iterations if all_new else self.options.iterations)
        return MappingResult(seeded, self._prune(), loss)

    def settle(self, steps: int, poses: bool = False) -> None:
        """Optimise further around the newest keyframe (G: at a boundary between submaps).

        Args:
            poses: the keyframes' poses as well, but for the first one's.
        """
        self._optimise(steps, poses)
        self._prune()

    def optimise_keyframes(self, indices: Iterable[int], iterations: int) -> None:
        """Optimise the map over some keyframes, each equally often; their poses stay fixed.

        Args:
            indices: frame indices of the keyframes; others are ignored.
            iterations: of each keyframe.
        """
        wanted = set(indices)
        chosen = [keyframe for keyframe in self.keyframes if keyframe.index in wanted]
        if not chosen or iterations == 0:
            return
        for done in range(iterations):
            for number, place in enumerate(self._generator.permutation(len(chosen))):
                progress = (done * len(chosen) + number, iterations * len(chosen))
                self._step(chosen[place], progress, centred=self.options.centred)
        self._prune()

    def take(self, content: MapContent) -> None:
        """Work on other content from now on, with an optimiser that knows only its steps."""
        self.gaussians, self.keyframes = content.gaussians.to(self.device), content.keyframes
        self.seeded_by = content.seeded_by.to(self.device)
        self.optimiser = SparseAdam(self.optimiser.rates, self.semantics.channels, self.device)
        self.optimiser.extend(len(self.gaussians))
        self.optimiser.steps = content.steps.to(self.device, copy=True)

    @property
    def content(self) -> MapContent:
        """What the mapper works on: shared, or a copy on the CPU of what lies on a GPU."""
        seeded_by, steps = self.seeded_by.cpu(), self.optimiser.steps.cpu()
        return MapContent(self.gaussians.to("cpu"), self.keyframes, seeded_by, steps)

    def _optimise(self, steps: int, poses: bool = False) -> float:
        """Steps over the window of the newest keyframe; the last one's loss."""
        window = choose_window(
            self.keyframes, self.options.window, self.options.min_overlap, self._generator
        )
        loss, adjust = float("nan"), poses or self.options.bundle_adjustment
        for step in range(steps):
            keyframe = self._pick(window)
            loss = self._step(keyframe, (step, steps), adjust, self.options.centred)
        return loss

    def refine(self) -> None:
        """Optimise over all keyframes, each equally often, in random order.

        What was fitted to be tracked against becomes what looks best.
        """
        self._agree()
        worked = self.optimiser.steps
        if self.options.centred:
            self.optimiser.steps = worked.clamp(max=_FRESH_STEPS)
        rested = worked - self.optimiser.steps
        options, count = self.options, len(self.keyframes)
        rounds, words = options.final_iterations, None
        adjust = options.final_poses or options.bundle_adjustment
        if options.final_feature > 0:
            words = FeatureLoss(BuiltinEncoder(), options.final_feature)
        surfaces = None
        if options.final_on_surfaces and rounds:
            surfaces = Surfaces.of(self.gaussians.means)
        for done in range(rounds):
            for number, i in enumerate(self._generator.permutation(count)):
                progress = (done * count + number, rounds * count)
                self._step(self.keyframes[i], progress, adjust, words=words)
            if surfaces is not None:
                means = surfaces.nearest(self.gaussians.means)
                self.gaussians = replace(self.gaussians, means=means)
        self.optimiser.steps = self.optimiser.steps + rested
        self._prune()

    def _agree(self) -> None:
        """Set features to what all keyframes together say, and overrule wrong labels."""
        if self.semantics.channels == 0:
            return
        with self._recorder.timed("map consensus"):
            self.gaussians = agree(
                self.gaussians, self.keyframes, self.semantics, self._draw, self.options.consensus
            )
        self.optimiser.forget("features")

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues identically."""
        arrays = {
            f"gaussians/{name}": getattr(self.gaussians, name).cpu().numpy() for name in PARAMETERS
        }
        arrays |= {f"optimiser/{name}": a for name, a in self.optimiser.state().items()}
        arrays["seeded_by"] = self.seeded_by.cpu().numpy()
        # Copies: the next step changes the map in place.
        arrays = {name: array.copy() for name, array in arrays.items()}
        arrays |= {f"semantics/{name}": a for name, a in self.semantics.state().items()}
        for number, keyframe in enumerate(self.keyframes):
            arrays |= {f"keyframes/{number}/{k}": a for k, a in keyframe.arrays().items()}
        values = {
            "keyframes": [keyframe.values() for keyframe in self.keyframes],
            "generator": self._generator.bit_generator.state,
        }
        return arrays, values

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Take over an earlier `state`."""
        tensors = {n: torch.from_numpy(np.array(arrays[f"gaussians/{n}"])) for n in PARAMETERS}
        self.gaussians = GaussianCloud(**tensors).to(self.device)
        self.optimiser.restore(arrays_below(arrays, "optimiser/"))
        self.seeded_by = torch.from_numpy(np.array(arrays["seeded_by"])).to(self.device)
        self.semantics.restore(arrays_below(arrays, "semantics/"))
        self.keyframes = [
            Keyframe.from_state(arrays_below(arrays, f"keyframes/{number}/"), value)
            for number, value in enumerate(values["keyframes"])
        ]
        self._generator.bit_generator.state = values["generator"]

    def view(self, keyframe: Keyframe) -> SurfaceView:
        """The map as a keyframe sees it."""
        return self.draw(self.gaussians, keyframe.camera, keyframe.T_map_camera)

    def draw(
        self, gaussians: GaussianCloud, camera: Camera, T_map_camera: NDArray[np.float64]
    ) -> SurfaceView:
        """Any Gaussians as a camera sees them."""
        return draw_surface(self._backend, gaussians, camera, se3.inverse(T_map_camera))

    def _draw(self, gaussians: GaussianCloud, keyframe: Keyframe) -> SurfaceView:
        T_camera_map = se3.inverse(keyframe.T_map_camera)
        options = DrawOptions(features=True)
        return draw_surface(self._backend, gaussians, keyframe.camera, T_camera_map, options)

    def _pick(self, window: list[Keyframe]) -> Keyframe:
        if len(window) == 1 or self._generator.random() < self.options.newest_share:
            return window[0]
        return window[1 + int(self._generator.integers(len(window) - 1))]

    def _step(
        self,
        keyframe: Keyframe,
        progress: tuple[int, int],
        poses: bool = False,
        centred: bool = False,
        words: FeatureLoss | None = None,
    ) -> float:
        """One optimisation step on one keyframe (H-24).

        Args:
            progress: its place in the call.
            poses: adjust the keyframe's pose as well, unless it is the first one.
            centred: fit colours where the Gaussians are, to track against; else where they are
                drawn, to look at (see `rendering/texture.py`).
            words: one more term, on the whole picture.
        """
        T_camera_map = se3.inverse(keyframe.T_map_camera)
        rgb, depth_m, labels = keyframe.observed(self._observations.of(keyframe))
        if not self.semantics.takes_part(progress[0]):
            labels = None
        with self._recorder.timed("map forward"):
            options = DrawOptions(features=labels is not None)
            view = draw_surface(
                self._backend, self.gaussians, keyframe.camera, T_camera_map, options
            )
        with self._recorder.timed("map loss"):
            rgb = resample_at_centres(rgb, view) if centred else rgb
            images = view.drawn.images
            by_images = images.new_empty(len(images) - 3, *images.shape[1:])
            loss, _ = rgbd_loss(view, rgb, depth_m, self.options.loss, by_images[:BASE_CHANNELS])
            if words is not None:
                described, by_colour = words.gradient(images[COLOUR], rgb)
                by_images[COLOUR] += by_colour
                loss += described
        with self._recorder.timed("map semantic loss"):
            semantic, by_images, detached = self.semantics.gradient(
                view, labels, progress, by_images
            )
        with self._recorder.timed("map backward"):
            gradients = view.drawn.backward(by_images, detached=detached)
        with self._recorder.timed("map update"):
            names = ["means", "log_radii", "opacity_logits", "colours"]
            names += ["features"] if len(by_images) > BASE_CHANNELS else []
            named = {name: getattr(gradients, name) for name in names}
            self.optimiser.step(self.gaussians, named, gradients.ids)
            if poses and keyframe is not self.keyframes[0]:
                self._adjust_pose(keyframe, gradients.T_camera_map.cpu().numpy())
        return loss + semantic

    def _adjust_pose(self, keyframe: Keyframe, by_matrix: NDArray[np.float64]) -> None:
        """One step on a keyframe's pose, from the derivative [3, 4] by its entries."""
        options = self.options
        adam = PoseAdam(
            options.pose_translation_m, options.pose_rotation_rad, keyframe.pose_moments
        )
        keyframe.pose_moments = adam.moments
        T_camera_map = se3.inverse(keyframe.T_map_camera)
        step = adam.step(pose_gradient(by_matrix, T_camera_map))
        keyframe.T_map_camera = se3.orthonormalise(se3.inverse(se3.exp(step) @ T_camera_map))

    def _fuse_depth(self, keyframe: Keyframe) -> None:
        """Move the centres that the newest keyframe measures."""
        depth_m = self._observations.of(keyframe).depth_m
        found = measured_centres(self.gaussians, self.seeded_by, self.keyframes, depth_m)
        means = self.gaussians.means.index_copy(0, found.places, found.centres)
        self.gaussians = replace(self.gaussians, means=means)
        self.seeded_by = self.seeded_by.index_fill(0, found.places[found.anew], keyframe.index)

    def _seed(self, keyframe: Keyframe) -> int:
        observed = self._observations.of(keyframe)
        uncovered = missing(
            self.view(keyframe),
            observed.depth_m,
            self.options.min_silhouette,
            self.options.depth_floor,
            self.options.depth_factor,
        )
        seeds = seed(
            keyframe.as_frame(),
            keyframe.T_map_camera,
            uncovered.cpu().numpy(),
            self.options.seeding,
            self.semantics.start_values,
            self._generator,
        )
        if len(seeds) == 0:
            return 0
        self.gaussians = GaussianCloud.concatenate([self.gaussians, seeds.to(self.device)])
        self.optimiser.extend(len(seeds))
        origin = self.seeded_by.new_full((len(seeds),), keyframe.index)
        self.seeded_by = torch.cat([self.seeded_by, origin])
        return len(seeds)

    def _prune(self) -> int:
        """Remove what is invisible, far too large or not finite."""
        cloud, options = self.gaussians, self.options
        bad = useless(cloud, options.min_opacity, options.max_radius_m)
        count = int(bad.sum())
        if count:
            self.gaussians = cloud.select(~bad)
            self.optimiser.keep(~bad)
            self.seeded_by = self.seeded_by[~bad]
        return count
