"""Masks that are neither tracked against nor mapped, such as people who walk through the view."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, FormatError
from toolkit.base.frame import Frame
from toolkit.base.keyframe import Keyframe
from toolkit.io.object_embeddings import unit_rows
from toolkit.scene.instances.masks import InstanceMasks, MaskSource, NamedClasses
from toolkit.semantics.lexicon.matching import match
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_parsing import folded
from toolkit.semantics.trees import taxonomy_named

_log = logging.getLogger(__name__)

Bits = NDArray[np.bool_]

# Minimum share of a mask's pixels with ignored labels.
_MOST = 0.5
# Stands beside the class of a mask in a taxonomy, which needs two.
_OTHER = "(other)"
# Without labels, embeddings are compared with the classes of this tree that have a meaning.
_COMMON, _COLLECTIVE = "nyu40", "other"


class TextEncoder(Protocol):
    """Embeds texts in the space of the masks' embeddings.

    Attributes:
        name: identifies the weights.
        dimensions: length D of an embedding.
    """

    name: str
    dimensions: int

    def embed_texts(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """Return the embeddings [N, D] of texts, of unit length."""


@dataclass(frozen=True)
class IgnoredTexts:
    """What is to be ignored in a run.

    Attributes:
        texts: names and nouns, and with an encoder any texts.
        classes: classes of the labels that are ignored.
        taxonomy: classes of the labels; None without labels.
        unmatched: texts that mean no class of the labels, with the reasons.
    """

    texts: Sequence[str] = ()
    classes: Sequence[str] = ()
    taxonomy: Taxonomy | None = None
    unmatched: Mapping[str, FormatError] = field(default_factory=dict)

    def check(self, source: MaskSource) -> None:
        """Check that every text means a class of the labels or of the masks.

        Raises:
            FormatError: one means none.
        """
        if not self.unmatched:
            return
        names = source.class_names() if isinstance(source, NamedClasses) else set()
        for text, reason in self.unmatched.items():
            if not any(map(MeantClasses([text]), names)):
                raise FormatError(
                    f"--semantics.ignore: {reason}; no class of the masks means it, and texts that "
                    "are no classes need masks with embeddings and --instances.encoder"
                ) from reason

    def others(self) -> list[str]:
        """Names of the classes that no text means, with which embeddings are compared."""
        names: Sequence[str] = ()
        if self.taxonomy is not None:
            names = self.taxonomy.classes
        else:
            common = taxonomy_named(_COMMON).classes
            names = [name for name in common if not name.startswith(_COLLECTIVE)]
        means = MeantClasses(self.texts, self.classes)
        return [name for name in names if not means(name)]


class NearestTexts:
    """Finds the embeddings that are nearer to one of some texts than to all other classes.

    Args:
        encoder: embeds both.
        texts: one text or more.
        others: names of the other classes, one or more.
    """

    def __init__(self, encoder: TextEncoder, texts: Sequence[str], others: Collection[str]) -> None:
        self._name, self._dimensions, self._count = encoder.name, encoder.dimensions, len(texts)
        names = [name.replace("-", " ") for name in others]
        self._vectors = unit_rows(encoder.embed_texts([*texts, *names]))
        self._warned = False

    def of(self, masks: InstanceMasks, index: int) -> Bits:
        """Return which masks [K] are nearest to one of the texts; unknown embeddings are not.

        Args:
            masks: the masks.
            index: of their frame, for errors.

        Raises:
            DatasetError: another model than the encoder made the embeddings.
        """
        length = masks.embeddings.shape[1]
        if not length:
            if not self._warned:
                self._warned = True
                _log.warning(
                    "The masks of frame %d have no embeddings to compare with --semantics.ignore.",
                    index,
                )
            return np.zeros(len(masks), bool)
        if length != self._dimensions:
            raise DatasetError(
                f"the masks of frame {index} have embeddings of length {length}, those of "
                f"--instances.encoder have {self._dimensions}; use the model of the masks"
            )
        if masks.model != self._name:
            made_by = f"made by '{masks.model}'" if masks.model else "of an unnamed model"
            raise DatasetError(
                f"the masks of frame {index} have embeddings {made_by}, --instances.encoder is "
                f"'{self._name}'; similarities between two models mean nothing: use the model of "
                "the masks, and store its name in their files (model)"
            )
        best = (masks.embeddings @ self._vectors.T).argmax(axis=1)
        return (best < self._count) & masks.embeddings.any(axis=1)


class IgnoredMasks:
    """Ignores whole masks, and yields the others of a source.

    A mask is ignored if its class is meant, if most of its pixels have ignored labels, or if its
    embedding is nearest to a text.

    Args:
        source: yields the masks of all frames.
        means: whether the name of a class is meant.
        nearest: compares embeddings; None to compare none.
    """

    def __init__(
        self,
        source: MaskSource,
        means: Callable[[str], bool],
        nearest: NearestTexts | None = None,
    ) -> None:
        self._source, self._means, self._nearest = source, means, nearest
        # A frame that becomes a keyframe needs its masks twice.
        self._last: tuple[tuple[int, tuple[int, int]], InstanceMasks | None] | None = None
        self._noted = False

    def pixels(self, frame: Frame, ignored: Bits) -> Bits:
        """Return the pixels [H, W] of a frame to ignore.

        Args:
            frame: the frame.
            ignored: [H, W] pixels with ignored labels.

        Raises:
            DatasetError: the masks of the frame are invalid.
        """
        masks = self._masks(Keyframe.from_frame(frame, np.eye(4)))
        if masks is None or not len(masks):
            return ignored
        areas = np.bincount(masks.ids.reshape(-1), minlength=len(masks) + 1)[1:]
        inside = np.bincount(masks.ids[ignored], minlength=len(masks) + 1)[1:]
        chosen = self._meant(masks, frame.index) | (inside > _MOST * np.maximum(areas, 1))
        if chosen.any() and not self._noted:
            self._noted = True
            _log.info("Masks are ignored from frame %d on.", frame.index)
        return ignored | np.append(False, chosen)[masks.ids]

    def masks(self, keyframe: Keyframe) -> InstanceMasks | None:
        """Return the masks of a keyframe that are not ignored; see `MaskSource`.

        The labels of a keyframe no longer show what was ignored. Of a mask that is ignored by its
        labels, neither depth nor labels have remained.
        """
        masks = self._masks(keyframe)
        if masks is None or not len(masks):
            return masks
        left = keyframe.depth_m.numpy() > 0
        if keyframe.class_ids is not None:
            left |= keyframe.class_ids.numpy() > 0
        remains = np.bincount(masks.ids[left], minlength=len(masks) + 1)[1:] > 0
        return masks.select(np.flatnonzero(remains & ~self._meant(masks, keyframe.index)))

    def _masks(self, keyframe: Keyframe) -> InstanceMasks | None:
        key = keyframe.index, keyframe.camera.size
        if self._last is None or self._last[0] != key:
            self._last = key, self._source.masks(keyframe)
        return self._last[1]

    def _meant(self, masks: InstanceMasks, index: int) -> Bits:
        chosen = np.array([name is not None and self._means(name) for name in masks.classes], bool)
        return chosen if self._nearest is None else chosen | self._nearest.of(masks, index)


class MeantClasses:
    """Whether the name of a mask's class means what is ignored.

    Args:
        texts: names and nouns.
        names: classes of the labels that are ignored.
    """

    def __init__(self, texts: Sequence[str], names: Collection[str] = ()) -> None:
        self._texts, self._names = texts, {folded(name) for name in names}
        self._known: dict[str, bool] = {}

    def __call__(self, name: str) -> bool:
        if name not in self._known:
            self._known[name] = folded(name) in self._names or any(
                _means(text, name) for text in self._texts
            )
        return self._known[name]


def _means(text: str, name: str) -> bool:
    """Whether a text means all things of a class, as `people` means `person`."""
    if folded(text) == folded(name):
        return True
    try:
        meant = match(text, Taxonomy({"classes": [name, _OTHER]}))
    except FormatError:
        return False
    return not meant.wider and [node.name for node in meant.nodes] == [name]
