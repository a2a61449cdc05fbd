"""Build the semantics of a map from options."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from toolkit.losses.semantic import SemanticLoss
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.semantics.codes import SemanticCode
from toolkit.semantics.decoder import NetworkDecoder
from toolkit.semantics.options import SemanticsOptions

# Hidden units and learning rate of the network; the paper prints neither.
_HIDDEN, _LEARNING_RATE = 64, 5e-3


def build_semantic_mapping(
    options: SemanticsOptions, code: SemanticCode | None, seed: int
) -> SemanticMapping:
    """Build the semantics of a map; without a code, the map has no semantics."""
    if code is None:
        return SemanticMapping()
    network = None
    if options.network.use:
        network = NetworkDecoder(
            code.channels,
            len(code.taxonomy),
            _HIDDEN,
            _LEARNING_RATE,
            torch.Generator().manual_seed(seed),
            options.network.replay,
        )
    weights = options.loss
    if not options.code.normalise:
        # The network divides its loss by that of a uniform prediction.
        weights = replace(weights, inter=weights.inter * math.log(len(code.taxonomy)))
    return SemanticMapping(SemanticLoss(code, weights, network, seed), options.reader)
