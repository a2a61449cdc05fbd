"""Build loop closure from its options."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.errors import SettingsError
from toolkit.base.frame import Recorder
from toolkit.base.pose_graph.noise import LoopNoise, OdometryNoise
from toolkit.base.pose_graph.retraction import PoseGraphOptimiser
from toolkit.semantics.features.factory import build_describer, build_differentiable_describer
from toolkit.semantics.palette import Palette
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.loops.candidates import CandidateFinder
from toolkit.slam.loops.class_counts import ClassCounter, GaussianClassCounter, PixelClassCounter
from toolkit.slam.loops.closing.closer import LoopCloser
from toolkit.slam.loops.closing.object_loops import ObjectHypotheses, SubmapInstances
from toolkit.slam.loops.closing.options import LoopClosureOptions
from toolkit.slam.loops.closing.pair_matching import PairMatcher
from toolkit.slam.loops.closing.parts import ClosingParts
from toolkit.slam.loops.detection import LoopDetector
from toolkit.slam.loops.log import LoopLog
from toolkit.slam.loops.options import LandmarkOptions
from toolkit.slam.loops.registration.factory import build_fine, build_registrar, needs_describer
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.views import ViewRenderer
from toolkit.slam.loops.relocalisation import Relocaliser
from toolkit.slam.loops.verification import VerificationLimits
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.splatting.rendering import backend


@dataclass(frozen=True)
class ClosingContext:
    """Values that loop closure shares with the rest of a run.

    Attributes:
        seed: random seed.
        backend_name: rendering backend.
        semantics: decodes the features of submaps.
        taxonomy: classes of the labels; None without semantics.
        instances: tracks objects; None without instances.
    """

    seed: int
    backend_name: str
    semantics: SemanticMapping
    taxonomy: Taxonomy | None
    instances: SubmapInstances | None = None


def build_loop_closer(
    options: LoopClosureOptions,
    context: ClosingContext,
    log: LoopLog | None = None,
    recorder: Recorder | None = None,
    registration: RegistrationOptions | None = None,
) -> LoopCloser:
    """Build loop detection and closure.

    Args:
        registration: how submaps are registered; default if None.

    Raises:
        SettingsError: options of landmarks that have no effect, or need Gaussians to be counted.
        ToolkitError: FAISS or the encoder's weights are missing.
    """
    _check_landmarks(options)
    registration = registration or RegistrationOptions()
    describer = build_describer(options.features)
    finder = CandidateFinder(
        describer.dimensions, describer.threshold, options.candidates, options.landmarks
    )
    taxonomy = context.taxonomy
    class_colours = None
    if taxonomy is not None:
        colours = Palette(taxonomy).classes

        def class_colours(class_ids: NDArray[np.integer]) -> Tensor:
            return torch.from_numpy(colours[class_ids]).permute(2, 0, 1).float() / 255.0

    detector = LoopDetector(
        describer, finder, _class_counter(options.landmarks, context), class_colours
    )
    renderer = ViewRenderer(context.backend_name, context.semantics)
    differentiable = None
    if needs_describer(registration):
        differentiable = build_differentiable_describer(options.features)
    parts = ClosingParts(
        registrar=build_registrar(registration, context.seed, renderer, differentiable),
        nearby=build_fine(registration, renderer, differentiable),
        matcher=PairMatcher(tests=options.verify),
        relocaliser=Relocaliser(detector, options.relocalisation),
        verification=VerificationLimits() if options.verify else None,
        pose_graph=options.pose_graph,
        noise=OdometryNoise(),
        loop_noise=LoopNoise(),
        optimiser=PoseGraphOptimiser(options.pose_graph),
        objects=_objects(options, context),
    )
    return LoopCloser(detector, parts, options.closing, log, recorder)


def _objects(options: LoopClosureOptions, context: ClosingContext) -> ObjectHypotheses | None:
    """Build the comparison of objects; None if it is off."""
    if not options.objects.use:
        return None
    if not options.verify:
        raise SettingsError("--loops.objects.use has no effect with --loops.no-verify; omit one")
    if not context.semantics.channels:
        raise SettingsError(
            "--loops.objects.use needs classes; omit it, or use another --semantics.code.kind than "
            "none and another --segmenter.kind than none"
        )
    gap = options.candidates.min_gap_frames
    return ObjectHypotheses(context.semantics, gap, context.instances)


def _check_landmarks(options: LoopClosureOptions) -> None:
    """Reject options of landmarks that would not do what they say."""
    landmarks = options.landmarks
    if landmarks.weighting == "paper" and landmarks.counted != "gaussians":
        raise SettingsError(
            "--loops.landmarks.weighting paper counts Gaussians; add "
            "--loops.landmarks.counted gaussians, or use the weighting inverse"
        )
    if landmarks != LandmarkOptions() and options.candidates.threshold == "rank":
        raise SettingsError(
            "--loops.landmarks has no effect on candidates that are ranked by descriptor; add "
            "--loops.candidates.threshold fixed (or adaptive)"
        )


def _class_counter(options: LandmarkOptions, context: ClosingContext) -> ClassCounter:
    """Build the counter of the classes that a keyframe shows."""
    classes = len(context.taxonomy) if context.taxonomy else 0
    if options.counted == "pixels" or not context.semantics.channels:
        return PixelClassCounter(classes)
    return GaussianClassCounter(
        context.semantics,
        classes,
        backend(context.backend_name),
        whole=options.weighting == "paper",
    )
