"""Semantics of a map: initial values, loss and decoding of the Gaussians' features."""

from __future__ import annotations

import functools
import math
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.native.constants import BASE_CHANNELS, SILHOUETTE
from toolkit.io.arrays import arrays_below
from toolkit.semantics.codes import SemanticCode
from toolkit.semantics.decoder import NetworkDecoder, check_reader
from toolkit.semantics.decoding import Decoding, decode, decode_level
from toolkit.semantics.options import SemanticsOptions
from toolkit.semantics.palette import Palette
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.splatting.losses.semantic import INTER_WEIGHT, SemanticLoss
from toolkit.splatting.rendering import RenderOutput, SurfaceView
from toolkit.splatting.rendering.output import FEATURES

# Pixels with a smaller silhouette are decoded as void.
_MIN_SILHOUETTE = 0.5
# Hidden units and learning rate of the network; the paper prints neither.
_HIDDEN, _LEARNING_RATE = 64, 5e-3


class SemanticMapping:
    """Semantics of one map.

    Args:
        loss: loss of the semantic code; None for a map without semantics (S = 0).
        reader: decode classes along the paths of the tree, or with the trained network.

    Raises:
        ValueError: the loss has no network to decode with.
    """

    def __init__(
        self, loss: SemanticLoss | None = None, reader: Literal["path", "network"] = "path"
    ) -> None:
        self._loss = loss
        self._by_network = reader == "network" and loss is not None
        if loss is not None and self._by_network and loss.network is None:
            raise ValueError("reader 'network' needs a loss with a network")
        self.channels = 0 if loss is None else loss.code.channels
        self.unit = 1.0 if loss is None else loss.code.unit
        classes = 0 if loss is None else len(loss.code.taxonomy)
        self._observed = torch.zeros(classes, dtype=torch.bool)

    @property
    def start_values(self) -> Tensor:
        """Features [C + 1, S] of a new Gaussian by the class id of its pixel."""
        if self._loss is None:
            return torch.zeros(1, 0, dtype=torch.float32)
        return self._loss.code.start_values

    @property
    def random_start(self) -> bool:
        """Whether new Gaussians have random features instead of `start_values`."""
        return self._loss is not None and self._loss.code.random_start

    def is_due(self, step: int, complete: bool) -> bool:
        """Whether a step of a mapping call, counted from 0, includes the semantic loss.

        Args:
            complete: of the final refinement. With the loss in a third of its steps, codes of new
                ellipsoids lose 0.4 to 0.9 points of mIoU.
        """
        return self._loss is not None and (complete or step % self._loss.weights.every == 0)

    def observe(self, class_ids: Tensor | None) -> None:
        """Record the observed classes; only these are decoded.

        Otherwise the blend of two classes at a border could be decoded as a third class.

        Args:
            class_ids: those of new pixels on the CPU, of any shape, 0 void; None without labels.
        """
        if class_ids is not None and self._loss is not None:
            ids = class_ids.unique().long()
            self._observed[ids[ids > 0] - 1] = True

    def codewords(self, labels: Tensor) -> Tensor:
        """Codewords [S, H, W] of an image of class ids [H, W]."""
        assert self._loss is not None
        codewords = self._loss.code.codewords.to(labels.device)
        rows = codewords.index_select(0, labels.reshape(-1).long())
        return rows.T.reshape(-1, *labels.shape)

    def votes(
        self, view: SurfaceView, codewords: Tensor, valid: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Sum the codewords of the pixels that each visible Gaussian contributes to.

        Each pixel is weighted by the Gaussian's blending weight. The sums are computed by the
        backward pass of the composited features, with the codewords in place of the gradient.

        Args:
            codewords: [S, H, W].
            valid: [H, W] bool, pixels whose blending weights are summed.

        Returns:
            Indices [V] of the visible Gaussians, their votes [V, S] and the sums of their blending
            weights [V].
        """
        gradient = view.images.new_zeros(BASE_CHANNELS + self.channels, *valid.shape)
        gradient[0] = valid
        gradient[BASE_CHANNELS:] = codewords
        sums = view.forward_pass.backward(gradient, detached=True)
        assert sums.colours is not None
        return sums.ids, sums.features, sums.colours[:, 0]

    def from_votes(self, votes: Tensor, total: Tensor) -> Tensor:
        """Features [N, S] fitted to sums of votes; see `SemanticCode.from_votes`."""
        assert self._loss is not None
        return self._loss.code.from_votes(votes, total)

    def add_gradient(
        self,
        view: SurfaceView,
        labels: Tensor | None,
        progress: tuple[int, int],
        gradient: Tensor,
    ) -> tuple[float, Tensor, bool]:
        """Compute the semantic loss and add its gradient to that of colour and depth.

        Args:
            labels: [H, W] int32 class ids, or None if the keyframe has none.
            progress: index of the step within the mapping call, and number of steps.
            gradient: [5 + S, H, W], changed in place; the first five channels contain the gradient
                of colour and depth.

        Returns:
            The loss, the gradient for the backward pass (five channels if the features have no
            gradient), and whether the semantic loss must not be propagated to geometry.
        """
        if self._loss is None or labels is None:
            return 0.0, gradient[:BASE_CHANNELS], False
        silhouette = view.output.silhouette
        out = gradient[BASE_CHANNELS:]
        result = self._loss(view.features, silhouette, labels, progress, out)
        if result.silhouette is not None:
            gradient[SILHOUETTE] += result.silhouette
        return result.value, gradient, result.silhouette is None

    def decode_view(self, view: SurfaceView, among: NDArray[np.integer] | None = None) -> Decoding:
        """Decode each pixel of a view [H * W].

        Args:
            among: class ids to choose from; by default, all classes that the map has observed.
        """
        values, labelled = self._pixels(view)
        return decode(values, self._logits, self._taxonomy, labelled, self._candidates(among))

    def decode_view_level(self, view: SurfaceView, level: int) -> NDArray[np.int32]:
        """Return the most likely node of each pixel [H * W] at a level, -1 without a class."""
        values, labelled = self._pixels(view)
        candidates = self._candidates(None)
        return decode_level(values, self._logits, self._taxonomy, labelled, level, candidates)

    def _pixels(self, view: SurfaceView) -> tuple[Tensor, Tensor]:
        """Return the values [S, H * W] of a view, and the mask [H * W] of those with a class."""
        assert self._loss is not None, "a map without semantics cannot be decoded"
        silhouette = view.output.silhouette.reshape(-1)
        solid = silhouette >= _MIN_SILHOUETTE
        safe = torch.where(solid, silhouette, torch.ones_like(silhouette))
        values = view.features.reshape(self.channels, -1) / safe
        return values, solid & self._loss.code.is_labelled(values)

    def probabilities(self, view: SurfaceView) -> tuple[NDArray[np.int64], Tensor]:
        """Observed class ids [K], ascending, and their probabilities at each pixel [K, H * W]."""
        assert self._loss is not None
        safe = view.output.silhouette.reshape(-1).clamp(min=_MIN_SILHOUETTE)
        logits = self._loss.code.logits(view.features.reshape(self.channels, -1) / safe)
        observed = self._observed.nonzero().squeeze(1)
        return observed.numpy() + 1, logits.index_select(0, observed.to(logits.device)).softmax(0)

    def class_colours(self, output: RenderOutput) -> Tensor:
        """Return the classes of a view in the colours of the palette [3, H, W]; differentiable.

        The colour of a pixel is the mean of the classes' colours, weighted by their probabilities;
        a colour code is shown as it is. Pixels that are unlabelled or have a small silhouette are
        black.
        """
        assert self._loss is not None, "a map without semantics has no class colours"
        silhouette = output.silhouette.reshape(-1)
        solid = silhouette >= _MIN_SILHOUETTE
        safe = torch.where(solid, silhouette, torch.ones_like(silhouette))
        values = output.images[FEATURES].reshape(self.channels, -1) / safe
        code = self._loss.code
        labelled = solid & code.is_labelled(values.detach())
        colours = values if code.is_colour else self._palette.T.to(values) @ self._softmax(values)
        return (colours * labelled).reshape(3, *output.silhouette.shape)

    def label_colours(self, labels: Tensor) -> Tensor:
        """Colours [3, H, W] of class ids [H, W] as in `class_colours`; void is black."""
        assert self._loss is not None, "a map without semantics has no class colours"
        palette = self._loss.code.codewords if self._loss.code.is_colour else self._with_void
        rows = palette.to(labels.device).index_select(0, labels.reshape(-1).long())
        return rows.T.reshape(3, *labels.shape)

    @property
    def _with_void(self) -> Tensor:
        """Colours [C + 1, 3] by class id."""
        return torch.cat([self._palette.new_zeros(1, 3), self._palette])

    @functools.cached_property
    def _palette(self) -> Tensor:
        """Colours [C, 3] of the classes, RGB in [0, 1]."""
        assert self._loss is not None
        colours = Palette(self._loss.code.taxonomy).classes[1:]
        return torch.from_numpy(colours.astype(np.float32) / 255.0)

    def classes_of(self, features: Tensor) -> Tensor:
        """Return the most likely class ids [N] of features [N, S]; 0 where there is none."""
        if self._loss is None:
            return torch.zeros(len(features), dtype=torch.int64, device=features.device)
        values = features.T
        return (self._softmax(values).argmax(0) + 1) * self._loss.code.is_labelled(values)

    def _softmax(self, values: Tensor) -> Tensor:
        """Class probabilities [C, P] for values [S, P]; zero for classes that were not observed."""
        assert self._loss is not None
        logits = self._loss.code.logits(values)
        if self._observed.any():
            logits = logits.masked_fill(~self._observed.to(values.device)[:, None], -torch.inf)
        return logits.softmax(0)

    def decode_gaussians(self, features: Tensor) -> Decoding:
        """Decode the class of each Gaussian from its features [N, S]; unlabelled ones are void."""
        assert self._loss is not None
        values = features.T.contiguous()
        labelled = self._loss.code.is_labelled(values)
        return decode(values, self._logits, self._taxonomy, labelled, self._candidates(None))

    @property
    def _taxonomy(self) -> Taxonomy:
        assert self._loss is not None, "a map without semantics cannot be decoded"
        return self._loss.code.taxonomy

    def _logits(self, values: Tensor) -> Tensor:
        """Class logits [C, P] of values [S, P], along the paths of the tree or by the network."""
        assert self._loss is not None
        network = self._loss.network
        if self._by_network and network is not None:
            return network.logits(values)
        return self._loss.code.logits(values)

    def _candidates(self, among: NDArray[np.integer] | None) -> Tensor | None:
        """Indices [K] of the classes to choose from: the observed classes in `among`.

        If none of the classes in `among` was observed, all of them are candidates; None stands for
        all classes of the taxonomy.
        """
        if among is None:
            candidates = self._observed
        else:
            requested = torch.zeros_like(self._observed)
            requested[torch.from_numpy(among.astype(np.int64)) - 1] = True
            observed = requested & self._observed
            candidates = observed if observed.any() else requested
        return candidates.nonzero().squeeze(1) if candidates.any() else None

    def state(self) -> dict[str, NDArray]:
        """Arrays for `restore`."""
        if self._loss is None:
            return {}
        arrays = {"observed": self._observed.numpy().copy()}
        if self._loss.network is not None:
            arrays |= {f"network/{k}": a for k, a in self._loss.network.state().items()}
        return arrays

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        if self._loss is None or not arrays:
            return
        self._observed = torch.from_numpy(np.array(arrays["observed"]))
        if self._loss.network is not None:
            self._loss.network.restore(arrays_below(arrays, "network/"))


def build_semantic_mapping(
    options: SemanticsOptions, code: SemanticCode | None, seed: int
) -> SemanticMapping:
    """Build the semantics of a map; without a code, the map has no semantics.

    Raises:
        SettingsError: codes are to be decoded by a network that is not trained.
    """
    check_reader(options)
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
    inter = INTER_WEIGHT
    if not options.code.normalise:
        # The network divides its loss by that of a uniform prediction.
        inter *= math.log(len(code.taxonomy))
    return SemanticMapping(SemanticLoss(code, options.loss, network, seed, inter), options.reader)
