"""Whole masks that texts mean are ignored, and the tracker sees the others."""

from __future__ import annotations

import logging
import zlib

import numpy as np
import pytest
import torch

from toolkit.base.errors import DatasetError, FormatError
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.scene.instances.ignoring import IgnoredMasks, IgnoredTexts, MeantClasses, NearestTexts
from toolkit.scene.instances.masks import InstanceMasks
from toolkit.scene.instances.options import InstanceOptions
from toolkit.scene.instances.tracking import InstanceTracker
from toolkit.semantics.labeller import without_pixels
from toolkit.semantics.taxonomy import Taxonomy

CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
TAXONOMY = Taxonomy({"furniture": ["chair", "sofa"], "structure": ["wall", "floor"]})
HEIGHT, WIDTH = 48, 64
# Three masks side by side: columns 0 to 15, 16 to 31 and 32 to 47; the last 16 have none.
IDS = np.repeat(np.array([1, 2, 3, 0], np.int32), 16)[None].repeat(HEIGHT, axis=0)


class Words:
    """Embeds each text in a direction of its own."""

    name, dimensions = "words", 32

    def embed_texts(self, texts):
        vectors = [np.random.default_rng(zlib.crc32(t.encode())).normal(size=32) for t in texts]
        return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


class Source:
    """The same masks in every frame, counted."""

    def __init__(self, classes=(None, None, None), embeddings=None, model="words") -> None:
        found = np.zeros((3, 0), np.float32) if embeddings is None else embeddings
        self.found = InstanceMasks(IDS, classes, np.ones(3, np.float32), found, model)
        self.calls = 0

    def class_names(self) -> set[str]:
        return {name for name in self.found.classes if name}

    def masks(self, keyframe: Keyframe) -> InstanceMasks:
        self.calls += 1
        return self.found


def frame(index: int = 0, labels: np.ndarray | None = None) -> Frame:
    rgb = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    return Frame(index, 0.0, rgb, np.full((HEIGHT, WIDTH), 2.0, np.float32), CAMERA, labels)


def ignored(source: IgnoredMasks, labels: np.ndarray | None = None) -> list[int]:
    """The masks that are ignored in a frame; pixels without a mask are 0."""
    none = np.zeros(IDS.shape, bool)
    return np.unique(IDS[source.pixels(frame(), none if labels is None else labels)]).tolist()


def of_texts(texts: list[str], embeddings: np.ndarray, **source) -> IgnoredMasks:
    others = IgnoredTexts(texts, taxonomy=TAXONOMY).others()
    nearest = NearestTexts(Words(), texts, others)
    return IgnoredMasks(Source(embeddings=embeddings, **source), MeantClasses(texts), nearest)


def test_masks_of_a_class_that_a_text_means_are_ignored():
    source = Source(("person", None, "dog"))
    assert ignored(IgnoredMasks(source, MeantClasses(["people"]))) == [1]
    assert ignored(IgnoredMasks(source, MeantClasses(["animal", "person"]))) == [1, 3]
    assert ignored(IgnoredMasks(source, MeantClasses(["cat"]))) == []


def test_masks_of_a_class_of_the_labels_are_ignored_by_its_group():
    source = Source(("sofa", "wall", "Chair"))
    assert ignored(IgnoredMasks(source, MeantClasses(["furniture"], ["chair", "sofa"]))) == [1, 3]


def test_a_text_does_not_mean_classes_that_include_more():
    means = MeantClasses(["armchair", "couch"])
    assert [name for name in ("chair", "armchair", "sofa") if means(name)] == ["armchair", "sofa"]


def test_a_mask_is_ignored_as_a_whole_if_most_of_its_pixels_have_ignored_labels():
    source = IgnoredMasks(Source(), MeantClasses([]))
    labels = np.zeros(IDS.shape, bool)
    labels[:, :8] = True  # exactly half of the first mask
    labels[:25, 16:32] = True  # more than half of the second one
    labels[:, 60:] = True  # no mask
    found = source.pixels(frame(), labels)
    assert (found[:, 16:32]).all() and not found[:, 8:16].any() and found[:, :8].all()
    assert not found[:, 32:60].any() and found[:, 60:].all()


def test_masks_whose_embeddings_are_nearest_to_a_text_are_ignored():
    vectors = Words().embed_texts(["man with a hat", "chair", "wall"])
    vectors[2] = 0.0  # unknown
    vectors[0] += 0.1 * vectors[1]
    assert ignored(of_texts(["man with a hat"], vectors)) == [1]
    assert ignored(of_texts(["a ghost"], vectors)) == []


def test_a_text_is_not_compared_with_classes_that_it_means():
    texts = IgnoredTexts(["chairs", "red wall"], taxonomy=TAXONOMY)
    assert texts.others() == ["sofa", "wall", "floor"]


def test_without_labels_embeddings_are_compared_with_common_classes():
    others = IgnoredTexts(["people"]).others()
    assert "person" not in others and {"chair", "wall", "box"} <= set(others)
    assert not [name for name in others if name.startswith("other")]


@pytest.mark.parametrize(
    ("dimensions", "model", "words"),
    [
        (16, "words", "of length 16, those of --instances.encoder have 32; use the model"),
        (32, "clip", "made by 'clip', --instances.encoder is 'words'.*store its name"),
        (32, "", "of an unnamed model"),
    ],
)
def test_embeddings_of_another_model_are_one_error(dimensions, model, words):
    source = of_texts(["a ghost"], np.ones((3, dimensions), np.float32), model=model)
    with pytest.raises(DatasetError, match=f"frame 0 have embeddings {words}"):
        ignored(source)


def test_masks_without_embeddings_are_noted_once(caplog):
    source = of_texts(["a ghost"], np.zeros((3, 0), np.float32))
    with caplog.at_level(logging.WARNING):
        assert ignored(source) == ignored(source) == []
    assert [r.message for r in caplog.records if "no embeddings" in r.message] == [
        "The masks of frame 0 have no embeddings to compare with --semantics.ignore."
    ]


def test_texts_that_no_class_means_are_classes_of_masks_or_errors():
    unmatched = {"people": FormatError("no class or group means 'people'")}
    texts = IgnoredTexts(["people"], taxonomy=TAXONOMY, unmatched=unmatched)
    texts.check(Source(("person", None, None)))
    with pytest.raises(FormatError, match=r"no class or group means 'people'.*instances\.encoder"):
        texts.check(Source(("dog", None, None)))


@pytest.mark.parametrize("by_labels", [False, True])
def test_the_tracker_sees_the_other_masks_only(by_labels):
    classes = ("chair", None if by_labels else "person", "sofa")
    inner = Source(classes)
    source = IgnoredMasks(inner, MeantClasses(["person"]))
    tracker = InstanceTracker(InstanceOptions("folder"), source)
    keyframes = []
    for index in range(2):
        labels = np.where(IDS == 2, 3, 1).astype(np.int32)
        of_label = (labels == 3) & by_labels
        seen = frame(index, labels)
        seen = without_pixels(seen, source.pixels(seen, of_label))
        assert not seen.depth_m[IDS == 2].any() and not seen.labels[IDS == 2].any()
        assert (seen.depth_m[IDS != 2] == 2.0).all() and (seen.labels[IDS != 2] == 1).all()
        keyframes.append(Keyframe.from_frame(seen, np.eye(4)))
        tracker.update(0, keyframes)
    assert inner.calls == 2, "the masks of a keyframe are made once"
    assert sorted(one.class_name for one in tracker.objects.values()) == ["chair", "sofa"]
    assert all(len(record.objects) == 2 for record in tracker.records)
    assert isinstance(keyframes[0].depth_m, torch.Tensor)
