"""What mapping knows of semantics: start values, loss and reading of one code."""

from __future__ import annotations

import functools
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.io.arrays import arrays_below
from toolkit.losses.semantic import SemanticLoss
from toolkit.native.constants import BASE_CHANNELS, SILHOUETTE
from toolkit.rendering import RenderOutput, SurfaceView
from toolkit.rendering.output import FEATURES
from toolkit.semantics.decoding import Decoding, decode
from toolkit.semantics.palette import Palette

# Pixels thinner than this are read as void.
_MIN_SILHOUETTE = 0.5


class SemanticMapping:
    """Semantics of one map; `loss=None` is a map without any, S = 0.

    Args:
        loss: the loss of its code.
        reader: whether classes are read along the code's paths or by the trained network.
    """

    def __init__(
        self, loss: SemanticLoss | None = None, reader: Literal["path", "network"] = "path"
    ) -> None:
        self._loss = loss
        self._by_network = reader == "network" and loss is not None and loss.network is not None
        self.channels = 0 if loss is None else loss.code.channels
        self.unit = 1.0 if loss is None else loss.code.unit
        classes = 0 if loss is None else len(loss.code.taxonomy)
        self._told = torch.zeros(classes, dtype=torch.bool)

    @property
    def start_values(self) -> Tensor:
        """Features of a new Gaussian by its pixel's class id, [C + 1, S]."""
        return torch.zeros(1, 0) if self._loss is None else self._loss.code.start_values

    def takes_part(self, step: int) -> bool:
        """Whether a step of a mapping call, counted from 0, is one of those with semantics."""
        return self._loss is not None and step % self._loss.weights.every == 0

    def observe(self, class_ids: Tensor | None) -> None:
        """Record which classes have been observed: the map can hold no others.

        Otherwise two classes blended at a border could decode to a third one.

        Args:
            class_ids: [H, W] of a new keyframe on the CPU, 0 void; None without labels.
        """
        if class_ids is not None and self._loss is not None:
            ids = class_ids.unique().long()
            self._told[ids[ids > 0] - 1] = True

    def codewords(self, labels: Tensor) -> Tensor:
        """What each pixel of class ids [H, W] asks the features for, [S, H, W]."""
        assert self._loss is not None
        codewords = self._loss.code.codewords.to(labels.device)
        words = codewords.index_select(0, labels.reshape(-1).long())
        return words.T.reshape(-1, *labels.shape)

    def votes(
        self, view: SurfaceView, words: Tensor, counted: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What the pixels of a view say of the Gaussians it shows.

        Each pixel gives a Gaussian its words, as far as the Gaussian shows in it: that is the
        derivative of the composited features, with the words in the gradient's place.

        Args:
            words: [S, H, W]. counted: [H, W] bool, the pixels that have a say.

        Returns:
            Gaussians [V], their votes [V, S] and the sums of their shares [V].
        """
        by_images = view.images.new_zeros(BASE_CHANNELS + self.channels, *counted.shape)
        by_images[0] = counted
        by_images[BASE_CHANNELS:] = words
        found = view.forward_pass.backward(by_images, detached=True)
        assert found.colours is not None
        return found.ids, found.features, found.colours[:, 0]

    def from_votes(self, votes: Tensor, total: Tensor) -> Tensor:
        """Features [N, S] out of added-up votes."""
        assert self._loss is not None
        return self._loss.code.from_votes(votes, total)

    def gradient(
        self,
        view: SurfaceView,
        labels: Tensor | None,
        progress: tuple[int, int],
        by_images: Tensor,
    ) -> tuple[float, Tensor, bool]:
        """Adds the semantic loss to what the images are asked for.

        Args:
            labels: [H, W] int32, or None where the keyframe has none.
            progress: step within the mapping call, and its steps.
            by_images: [5 + S, H, W]; the first five hold the gradient of colour and depth.

        Returns:
            The loss, the gradient for the backward pass (five channels where nothing is asked
            of the features), and whether geometry is to be kept out of it.
        """
        if self._loss is None or labels is None:
            return 0.0, by_images[:BASE_CHANNELS], False
        silhouette = view.output.silhouette
        out = by_images[BASE_CHANNELS:]
        result = self._loss(view.features, silhouette, labels, progress, out)
        if result.silhouette is not None:
            by_images[SILHOUETTE] += result.silhouette
        return result.value, by_images, result.silhouette is None

    def decode_view(self, view: SurfaceView, among: NDArray[np.integer] | None = None) -> Decoding:
        """Decode each pixel of a view [H * W].

        Args:
            among: class ids to choose from; all classes that the map observed by default.
        """
        silhouette = view.output.silhouette.reshape(-1)
        seen = silhouette >= _MIN_SILHOUETTE
        safe = torch.where(seen, silhouette, torch.ones_like(silhouette))
        values = view.features.reshape(self.channels, -1) / safe
        assert self._loss is not None
        return self._decode(values, seen & self._loss.code.is_labelled(values), among)

    def probabilities(self, view: SurfaceView) -> tuple[NDArray[np.int64], Tensor]:
        """Classes told of, ascending [K], and the probability of each at each pixel [K, H * W]."""
        assert self._loss is not None
        safe = view.output.silhouette.reshape(-1).clamp(min=_MIN_SILHOUETTE)
        logits = self._loss.code.logits(view.features.reshape(self.channels, -1) / safe)
        told = self._told.nonzero().squeeze(1)
        return told.numpy() + 1, logits.index_select(0, told.to(logits.device)).softmax(0)

    def picture(self, output: RenderOutput) -> Tensor:
        """Return the classes of a view in their palette's colours, [3, H, W]; differentiable.

        A pixel has the mean colour of the classes by their probabilities; the colour code has its
        own colour. Pixels without a label, or with too thin a map, are black.
        """
        assert self._loss is not None, "a map without semantics has no classes to paint"
        silhouette = output.silhouette.reshape(-1)
        seen = silhouette >= _MIN_SILHOUETTE
        safe = torch.where(seen, silhouette, torch.ones_like(silhouette))
        values = output.images[FEATURES].reshape(self.channels, -1) / safe
        code = self._loss.code
        labelled = seen & code.is_labelled(values.detach())
        colours = values if code.is_colour else self._palette.T.to(values) @ self._softmax(values)
        return (colours * labelled).reshape(3, *output.silhouette.shape)

    @functools.cached_property
    def _palette(self) -> Tensor:
        """Colours [C, 3] of the classes in [0, 1]."""
        assert self._loss is not None
        colours = Palette(self._loss.code.taxonomy).classes[1:]
        return torch.from_numpy(colours.astype(np.float32) / 255.0)

    def _softmax(self, values: Tensor) -> Tensor:
        """Probabilities [C, P] of the classes, for values [S, P]; zero for classes never seen."""
        assert self._loss is not None
        logits = self._loss.code.logits(values)
        if self._told.any():
            logits = logits.masked_fill(~self._told.to(values.device)[:, None], -torch.inf)
        return logits.softmax(0)

    def decode_gaussians(self, features: Tensor) -> Decoding:
        """What each Gaussian of features [N, S] is; those that never had a label are void."""
        assert self._loss is not None
        values = features.T.contiguous()
        return self._decode(values, self._loss.code.is_labelled(values))

    def _decode(
        self, values: Tensor, seen: Tensor, among: NDArray[np.integer] | None = None
    ) -> Decoding:
        assert self._loss is not None, "a map without semantics has nothing to decode"
        network = self._loss.network
        by_network = self._by_network and network is not None
        logits = network.logits if by_network and network else self._loss.code.logits

        candidates = self._candidates(among)

        def masked_logits(values: Tensor) -> Tensor:
            return logits(values).masked_fill(~candidates.to(values.device)[:, None], -torch.inf)

        chosen = masked_logits if candidates.any() else logits
        return decode(values, chosen, self._loss.code.taxonomy, seen)

    def _candidates(self, among: NDArray[np.integer] | None) -> Tensor:
        """Mask [C] of the classes to choose from: observed ones, of these those in `among`."""
        if among is None:
            return self._told
        asked = torch.zeros_like(self._told)
        asked[torch.from_numpy(among.astype(np.int64)) - 1] = True
        observed = asked & self._told
        return observed if observed.any() else asked

    def state(self) -> dict[str, NDArray]:
        """Arrays that `restore` takes."""
        if self._loss is None:
            return {}
        arrays = {"told": self._told.numpy().copy()}
        if self._loss.network is not None:
            arrays |= {f"network/{k}": a for k, a in self._loss.network.state().items()}
        return arrays

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Take over an earlier `state`."""
        if self._loss is None or not arrays:
            return
        self._told = torch.from_numpy(np.array(arrays["told"]))
        if self._loss.network is not None:
            self._loss.network.restore(arrays_below(arrays, "network/"))
