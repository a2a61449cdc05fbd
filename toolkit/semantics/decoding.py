"""From logits over classes to an answer: at any level, with confidence, entropy, back-off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.semantics.taxonomy import Taxonomy

_CHUNK = 65536  # columns at a time: 101 classes then take 26 MB


@dataclass(frozen=True)
class Decoding:
    """What P pixels or Gaussians are.

    Attributes:
        class_ids: [P] int32, the likeliest class, 0 where there was nothing to decode.
        confidence: [P] float32, its probability.
        entropy: [P] float32 of the classes, as a share of the largest possible.
        nodes: [P, L] int32, the likeliest node at each level as an index into the
            taxonomy's nodes, -1 where there was nothing to decode.
        node_confidence: [P, L] float32, its probability.
    """

    class_ids: NDArray[np.int32]
    confidence: NDArray[np.float32]
    entropy: NDArray[np.float32]
    nodes: NDArray[np.int32]
    node_confidence: NDArray[np.float32]

    def backed_off(self, min_confidence: float) -> NDArray[np.int32]:
        """Nodes [P, L], -1 at levels where the map is not that sure.

        From 0.5 on the nodes of one column lie on one path: two siblings cannot both have it.
        """
        return np.where(self.node_confidence >= min_confidence, self.nodes, -1).astype(np.int32)


def decode(
    values: Tensor, logits: Callable[[Tensor], Tensor], taxonomy: Taxonomy, seen: Tensor
) -> Decoding:
    """Decode values [S, P] where `seen` [P] is true.

    Args:
        logits: from values [S, P] to the classes' logits [C, P]; a code's, or a decoder's.
    """
    count, depth = values.shape[1], taxonomy.depth
    out = Decoding(
        np.zeros(count, np.int32),
        np.zeros(count, np.float32),
        np.ones(count, np.float32),
        np.full((count, depth), -1, np.int32),
        np.zeros((count, depth), np.float32),
    )
    members = _members(taxonomy)
    index = seen.nonzero().squeeze(1)
    with torch.no_grad():
        for part in torch.split(index, _CHUNK):
            _decode_part(logits(values.index_select(1, part)), members, part.cpu().numpy(), out)
    return out


def _members(taxonomy: Taxonomy) -> list[tuple[Tensor, Tensor]]:
    """For each level its distinct nodes, and each class's place among them."""
    levels = []
    for level in range(taxonomy.depth):
        nodes, place = np.unique(taxonomy.node_ids[:, level], return_inverse=True)
        levels.append((torch.from_numpy(nodes), torch.from_numpy(place)))
    return levels


def _decode_part(
    logits: Tensor, members: list[tuple[Tensor, Tensor]], part: NDArray[np.int64], out: Decoding
) -> None:
    logs = torch.log_softmax(logits, dim=0)
    probability = logs.exp()
    best = probability.max(dim=0)
    out.class_ids[part] = best.indices.cpu().numpy() + 1
    out.confidence[part] = best.values.cpu().numpy()
    # A class that is ruled out has no logarithm, and no part in the entropy.
    surprise = torch.where(probability > 0, -probability * logs, torch.zeros_like(logs))
    out.entropy[part] = (surprise.sum(0) / np.log(len(logs))).cpu().numpy()
    for level, (nodes, place) in enumerate(members):
        summed = probability.new_zeros(len(nodes), probability.shape[1])
        summed.index_add_(0, place.to(summed.device), probability)
        likeliest = summed.max(dim=0)
        out.nodes[part, level] = nodes[likeliest.indices.cpu()].numpy()
        out.node_confidence[part, level] = likeliest.values.cpu().numpy()
