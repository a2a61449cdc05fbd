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
    values: Tensor,
    logits: Callable[[Tensor], Tensor],
    taxonomy: Taxonomy,
    seen: Tensor,
    among: Tensor | None = None,
) -> Decoding:
    """Decode values [S, P] where `seen` [P] is true.

    Args:
        logits: function from values [S, P] to class logits [C, P], of a code or a decoder.
        among: [K] indices of the classes to choose from, ascending; all C by default. The time is
            proportional to their number.
    """
    count, depth = values.shape[1], taxonomy.depth
    out = Decoding(
        np.zeros(count, np.int32),
        np.zeros(count, np.float32),
        np.ones(count, np.float32),
        np.full((count, depth), -1, np.int32),
        np.zeros((count, depth), np.float32),
    )
    classes = torch.arange(len(taxonomy)) if among is None else among.cpu()
    members = [_members(taxonomy, level, classes) for level in range(depth)]
    visible = seen.nonzero().squeeze(1)
    with torch.no_grad():
        for part in torch.split(visible, _CHUNK):
            logs = _log_probabilities(values.index_select(1, part), logits, among)
            _decode_part(logs, classes, members, part.cpu().numpy(), out)
    # Of all classes: a map with few of them is not less certain for it.
    np.divide(out.entropy, np.log(len(taxonomy)), out=out.entropy, where=seen.cpu().numpy())
    return out


def decode_level(
    values: Tensor,
    logits: Callable[[Tensor], Tensor],
    taxonomy: Taxonomy,
    seen: Tensor,
    level: int,
    among: Tensor | None = None,
) -> NDArray[np.int32]:
    """Return the column of one level of `Decoding.nodes` [P], without the time of the others."""
    found = np.full(values.shape[1], -1, np.int32)
    classes = torch.arange(len(taxonomy)) if among is None else among.cpu()
    members = _members(taxonomy, level, classes)
    with torch.no_grad():
        for part in torch.split(seen.nonzero().squeeze(1), _CHUNK):
            logs = _log_probabilities(values.index_select(1, part), logits, among)
            found[part.cpu().numpy()] = _best_nodes(logs.exp(), members)[0]
    return found


def _log_probabilities(
    values: Tensor, logits: Callable[[Tensor], Tensor], among: Tensor | None
) -> Tensor:
    """Logarithms of the probabilities [K, P] of the classes to choose from."""
    rows = logits(values)
    if among is not None:
        rows = rows.index_select(0, among.to(rows.device))
    return torch.log_softmax(rows, dim=0)


def _members(taxonomy: Taxonomy, level: int, classes: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distinct nodes of classes [K] at a level, and the index of each class's node."""
    nodes, index = np.unique(taxonomy.node_ids[classes.numpy(), level], return_inverse=True)
    return torch.from_numpy(nodes), torch.from_numpy(index)


def _best_nodes(
    probability: Tensor, members: tuple[Tensor, Tensor]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the most likely nodes [P] for probabilities of classes [K, P], and theirs."""
    nodes, index = members
    summed = probability.new_zeros(len(nodes), probability.shape[1])
    summed.index_add_(0, index.to(summed.device), probability)
    best = summed.max(dim=0)
    return nodes[best.indices.cpu()].numpy(), best.values.cpu().numpy()


def _decode_part(
    logs: Tensor,
    classes: Tensor,
    members: list[tuple[Tensor, Tensor]],
    part: NDArray[np.int64],
    out: Decoding,
) -> None:
    """Fill in the pixels `part` from log-probabilities; the entropy is not divided yet."""
    probability = logs.exp()
    best = probability.max(dim=0)
    out.class_ids[part] = classes[best.indices.cpu()].numpy() + 1
    out.confidence[part] = best.values.cpu().numpy()
    # Classes of zero probability contribute nothing to the entropy (0 log 0 = 0).
    surprise = torch.where(probability > 0, -probability * logs, torch.zeros_like(logs))
    out.entropy[part] = surprise.sum(0).cpu().numpy()
    for level, nodes in enumerate(members):
        out.nodes[part, level], out.node_confidence[part, level] = _best_nodes(probability, nodes)
