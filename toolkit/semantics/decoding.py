"""Decode class logits into labels, confidences and entropies at every level of the tree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.semantics.taxonomy import Taxonomy

_CHUNK = 65536  # columns per batch; 26 MB for 101 classes


@dataclass(frozen=True)
class Decoding:
    """Decoded classes of P pixels or Gaussians.

    Attributes:
        class_ids: [P] int32, most likely class; 0 where nothing was decoded.
        confidence: [P] float32, probability of the most likely class.
        entropy: [P] float32, entropy over the classes divided by its maximum, in [0, 1].
        nodes: [P, L] int32, most likely node at each level as an index into the taxonomy's
            nodes; -1 where nothing was decoded.
        node_confidence: [P, L] float32, probability of the most likely node.
    """

    class_ids: NDArray[np.int32]
    confidence: NDArray[np.float32]
    entropy: NDArray[np.float32]
    nodes: NDArray[np.int32]
    node_confidence: NDArray[np.float32]

    def backed_off(self, min_confidence: float) -> NDArray[np.int32]:
        """Return nodes [P, L], -1 at levels whose confidence is below `min_confidence`.

        For thresholds of at least 0.5 the remaining nodes of a pixel lie on one path, because
        two siblings cannot both exceed 0.5.
        """
        return np.where(self.node_confidence >= min_confidence, self.nodes, -1).astype(np.int32)


def decode(
    values: Tensor, logits: Callable[[Tensor], Tensor], taxonomy: Taxonomy, seen: Tensor
) -> Decoding:
    """Decode values [S, P] where `seen` [P] is true.

    Args:
        logits: function from values [S, P] to class logits [C, P], of a code or a decoder.
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
    visible = seen.nonzero().squeeze(1)
    with torch.no_grad():
        for part in torch.split(visible, _CHUNK):
            _decode_part(logits(values.index_select(1, part)), members, part.cpu().numpy(), out)
    return out


def _members(taxonomy: Taxonomy) -> list[tuple[Tensor, Tensor]]:
    """Return, for each level, its distinct nodes and the index of each class's node among them."""
    levels = []
    for level in range(taxonomy.depth):
        nodes, index = np.unique(taxonomy.node_ids[:, level], return_inverse=True)
        levels.append((torch.from_numpy(nodes), torch.from_numpy(index)))
    return levels


def _decode_part(
    logits: Tensor, members: list[tuple[Tensor, Tensor]], part: NDArray[np.int64], out: Decoding
) -> None:
    logs = torch.log_softmax(logits, dim=0)
    probability = logs.exp()
    best = probability.max(dim=0)
    out.class_ids[part] = best.indices.cpu().numpy() + 1
    out.confidence[part] = best.values.cpu().numpy()
    # Classes of zero probability contribute nothing to the entropy (0 log 0 = 0).
    surprise = torch.where(probability > 0, -probability * logs, torch.zeros_like(logs))
    out.entropy[part] = (surprise.sum(0) / np.log(len(logs))).cpu().numpy()
    for level, (nodes, index) in enumerate(members):
        summed = probability.new_zeros(len(nodes), probability.shape[1])
        summed.index_add_(0, index.to(summed.device), probability)
        best_node = summed.max(dim=0)
        out.nodes[part, level] = nodes[best_node.indices.cpu()].numpy()
        out.node_confidence[part, level] = best_node.values.cpu().numpy()
