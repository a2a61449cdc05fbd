"""Loop closure from settings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.baselines.factory import build_fine, build_registrar
from toolkit.closing.closer import LoopCloser
from toolkit.closing.parts import ClosingOptions, ClosingParts
from toolkit.features.factory import build_describer
from toolkit.frame import Recorder
from toolkit.loops.class_counts import ClassCounter, LabelledPixels, ObservedGaussians
from toolkit.loops.detection import LoopDetector
from toolkit.loops.factory import build_candidate_finder
from toolkit.loops.log import LoopLog
from toolkit.loops.relocalisation import RelocalisationOptions, Relocaliser
from toolkit.loops.verification import VerificationOptions
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.pose_graph.factory import (
    build_consistency,
    build_loop_noise,
    build_odometry_noise,
    build_optimiser,
)
from toolkit.registration.factory import (
    build_drawer,
    matching_options,
)
from toolkit.rendering import backend
from toolkit.semantics.palette import Palette
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.settings.loop_closure import LoopClosureSettings
from toolkit.settings.loops import LandmarkSettings, LoopSettings


@dataclass(frozen=True)
class ClosingContext:
    """What loop closure shares with the rest of a run.

    Attributes:
        seed: of random choices. backend_name: the renderer.
        semantics: reads the features of submaps. taxonomy: of labels, None without.
        centred: how colours are fitted, see `MapperOptions`.
    """

    seed: int
    backend_name: str
    semantics: SemanticMapping
    taxonomy: Taxonomy | None
    centred: bool = True


def build_loop_closer(
    settings: LoopClosureSettings,
    context: ClosingContext,
    log: LoopLog | None = None,
    recorder: Recorder | None = None,
) -> LoopCloser:
    """What finds and closes the loops of a run.

    Raises:
        ToolkitError: FAISS is missing, or the encoder's weights are.
    """
    describer = build_describer(settings.features)
    found = LoopSettings(candidates=settings.candidates, landmarks=settings.landmarks)
    finder = build_candidate_finder(found, describer)
    taxonomy = context.taxonomy
    painter = None
    if taxonomy is not None:
        colours = Palette(taxonomy).classes

        def painter(class_ids: NDArray[np.integer]) -> Tensor:
            return torch.from_numpy(colours[class_ids]).permute(2, 0, 1).float() / 255.0

    detector = LoopDetector(describer, finder, _class_counter(settings.landmarks, context), painter)
    drawer = build_drawer(
        settings.registration, context.semantics, context.backend_name, context.centred
    )
    matching = matching_options(settings.registration.coarse.matching)
    relocalisation = RelocalisationOptions(**settings.relocalisation.model_dump())
    parts = ClosingParts(
        registrar=build_registrar(settings.registration, context.seed, drawer, describer),
        nearby=build_fine(settings.registration.fine, drawer, describer),
        matching=matching,
        relocaliser=Relocaliser(detector, matching, relocalisation),
        verification=VerificationOptions(**settings.verification.model_dump()),
        consistency=build_consistency(settings.pose_graph),
        noise=build_odometry_noise(settings.pose_graph),
        loop_noise=build_loop_noise(settings.pose_graph),
        optimiser=build_optimiser(settings.pose_graph),
    )
    return LoopCloser(
        detector, parts, ClosingOptions(**settings.closing.model_dump()), log, recorder
    )


def _class_counter(settings: LandmarkSettings, context: ClosingContext) -> ClassCounter:
    """What counts the classes of a keyframe."""
    classes = len(context.taxonomy) if context.taxonomy else 0
    if settings.counted == "pixels" or not context.semantics.channels:
        return LabelledPixels(classes)
    return ObservedGaussians(context.semantics, classes, backend(context.backend_name))
