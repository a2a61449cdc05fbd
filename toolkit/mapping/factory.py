"""The mapper from settings."""

from __future__ import annotations

import numpy as np
import torch

from toolkit.frame import Recorder
from toolkit.gaussians.seeding import SeedingOptions
from toolkit.losses.photometric import RgbdLossWeights
from toolkit.losses.semantic import SemanticLoss, SemanticLossWeights
from toolkit.mapping.consensus import ConsensusOptions
from toolkit.mapping.keyframes import KeyframePolicy
from toolkit.mapping.mapper import Mapper, MapperOptions
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.mapping.sparse_adam import LearningRates
from toolkit.semantics.codes import SemanticCode
from toolkit.semantics.decoder import NetworkDecoder
from toolkit.settings.mapping import MappingSettings
from toolkit.settings.semantics import SemanticsSettings


def build_mapper(
    settings: MappingSettings,
    generator: np.random.Generator,
    backend_name: str = "auto",
    recorder: Recorder | None = None,
    semantics: SemanticMapping | None = None,
    device: str = "cpu",
) -> Mapper:
    """The mapper that the settings describe, its map on a device."""
    values = settings.model_dump()
    values["keyframes"] = KeyframePolicy(**values["keyframes"])
    values["seeding"] = SeedingOptions(**values["seeding"])
    values["rates"] = LearningRates(**values["rates"])
    values["consensus"] = ConsensusOptions(**values["consensus"])
    values["loss"] = RgbdLossWeights(**values["loss"])
    options = MapperOptions(**values)
    return Mapper(options, generator, backend_name, recorder, semantics, device)


def build_semantic_mapping(
    settings: SemanticsSettings, code: SemanticCode | None, seed: int
) -> SemanticMapping:
    """Semantics of a map, or none where there is no code."""
    if code is None:
        return SemanticMapping()
    network = None
    if settings.network.use:
        network = NetworkDecoder(
            code.channels,
            len(code.taxonomy),
            settings.network.hidden,
            settings.network.learning_rate,
            torch.Generator().manual_seed(seed),
            settings.network.replay,
        )
    weights = SemanticLossWeights(**settings.loss.model_dump())
    loss = SemanticLoss(code, weights, network, seed)
    return SemanticMapping(loss, settings.reader)
