"""Build loop closure from its options."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.features.factory import build_describer, build_differentiable_describer
from toolkit.frame import Recorder
from toolkit.loops.candidates import CandidateFinder
from toolkit.loops.class_counts import ClassCounter, GaussianClassCounter, PixelClassCounter
from toolkit.loops.closing.closer import LoopCloser
from toolkit.loops.closing.options import LoopClosureOptions
from toolkit.loops.closing.pair_matching import PairMatcher
from toolkit.loops.closing.parts import ClosingParts
from toolkit.loops.detection import LoopDetector
from toolkit.loops.log import LoopLog
from toolkit.loops.options import LandmarkOptions
from toolkit.loops.pose_graph.noise import LoopNoise, OdometryNoise
from toolkit.loops.pose_graph.retraction import PoseGraphOptimiser
from toolkit.loops.registration.factory import (
    build_fine,
    build_registrar,
    build_view_renderer,
    needs_describer,
)
from toolkit.loops.relocalisation import Relocaliser
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.rendering import backend
from toolkit.semantics.palette import Palette
from toolkit.semantics.taxonomy import Taxonomy


@dataclass(frozen=True)
class ClosingContext:
    """Values that loop closure shares with the rest of a run.

    Attributes:
        seed: random seed.
        backend_name: rendering backend.
        semantics: decodes the features of submaps.
        taxonomy: classes of the labels; None without semantics.
    """

    seed: int
    backend_name: str
    semantics: SemanticMapping
    taxonomy: Taxonomy | None


def build_loop_closer(
    options: LoopClosureOptions,
    context: ClosingContext,
    log: LoopLog | None = None,
    recorder: Recorder | None = None,
) -> LoopCloser:
    """Build loop detection and closure.

    Raises:
        ToolkitError: FAISS or the encoder's weights are missing.
    """
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
    renderer = build_view_renderer(options.registration, context.semantics, context.backend_name)
    matching = options.registration.coarse.matching
    differentiable = None
    if needs_describer(options.registration):
        differentiable = build_differentiable_describer(options.features)
    pose_graph = options.pose_graph
    parts = ClosingParts(
        registrar=build_registrar(options.registration, context.seed, renderer, differentiable),
        nearby=build_fine(options.registration.fine, renderer, differentiable),
        matcher=PairMatcher(matching, options.closing.pairs),
        relocaliser=Relocaliser(detector, matching, options.relocalisation),
        verification=options.verification,
        consistency=pose_graph.consistency,
        noise=OdometryNoise(pose_graph.odometry),
        loop_noise=LoopNoise(pose_graph.loops),
        optimiser=PoseGraphOptimiser(pose_graph.solver, pose_graph.retraction),
    )
    return LoopCloser(detector, parts, options.closing, log, recorder)


def _class_counter(options: LandmarkOptions, context: ClosingContext) -> ClassCounter:
    """Build the counter of the classes that a keyframe shows."""
    classes = len(context.taxonomy) if context.taxonomy else 0
    if options.counted == "pixels" or not context.semantics.channels:
        return PixelClassCounter(classes)
    return GaussianClassCounter(context.semantics, classes, backend(context.backend_name))
