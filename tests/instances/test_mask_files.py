"""Masks from folders of images and from COCO files, and what is said of bad ones."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from panels import keyframe, panel_image

from toolkit.base.errors import DatasetError, SettingsError
from toolkit.io.images import write_png
from toolkit.scene.instances.coco import CocoMasks
from toolkit.scene.instances.factory import build_instances
from toolkit.scene.instances.mask_images import MaskImageFolder
from toolkit.scene.instances.options import InstanceOptions
from toolkit.scene.instances.rle import decoded_mask


@pytest.fixture
def folder(tmp_path):
    write_png(tmp_path / "000000.png", panel_image().astype(np.uint16) * 300)
    return tmp_path


def details(folder, **columns):
    np.savez(folder / "000000.npz", **columns)


def read(folder):
    return MaskImageFolder(folder, {0: folder / "000000.png"}).masks(keyframe(0))


def test_an_image_of_ids_alone(folder):
    masks = read(folder)
    assert len(masks) == 2
    assert masks.classes == [None, None]
    np.testing.assert_array_equal(masks.ids, panel_image())


def test_an_image_with_details(folder):
    details(
        folder,
        ids=np.array([600, 5, 300]),
        classes=np.array(["chair", "bed", ""]),
        scores=np.array([0.5, 0.1, 0.9]),
        embeddings=np.array([[0.0, 2.0], [1, 1], [3.0, 0.0]]),
    )
    masks = read(folder)
    assert masks.classes == [None, "chair"]
    np.testing.assert_allclose(masks.scores, [0.9, 0.5])
    np.testing.assert_allclose(masks.embeddings, [[1, 0], [0, 1]])


def test_a_frame_without_an_image_has_no_masks(folder):
    assert MaskImageFolder(folder, {}).masks(keyframe(0)) is None


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"classes": np.array(["a"])}, "no column ids"),
        ({"ids": np.array([1, 1])}, "lists an id twice"),
        ({"ids": np.array([1, 2]), "scores": np.ones(3)}, r"scores has shape \[3\] for 2 ids"),
        ({"ids": np.array([1]), "scores": np.array([1.5])}, "scores must lie in 0 to 1"),
        ({"ids": np.array([1]), "embeddings": np.array([[np.nan]])}, "not finite"),
        ({"ids": np.array([1]), "embeddings": np.ones(3)}, "embeddings has shape"),
        ({"ids": np.array([1]), "embeddings": np.array([[1e300, 1.0]])}, "not finite"),
        ({"ids": np.array([1]), "embeddings": np.array([[1j]])}, "must be numbers"),
        ({"ids": np.array([1]), "classes": np.array([b"a"])}, "classes must be texts"),
    ],
)
def test_bad_details_are_refused_with_their_file(folder, columns, message):
    details(folder, **columns)
    with pytest.raises(DatasetError, match=message) as caught:
        read(folder)
    assert "000000.npz" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_embeddings_of_two_lengths_are_refused(folder):
    write_png(folder / "000001.png", panel_image().astype(np.uint8))
    details(folder, ids=np.array([300]), embeddings=np.ones((1, 3)))
    np.savez(folder / "000001.npz", ids=np.array([1]), embeddings=np.ones((1, 4)))
    source = MaskImageFolder(folder, {k: folder / f"00000{k}.png" for k in (0, 1)})
    source.masks(keyframe(0))
    with pytest.raises(DatasetError, match=r"length 4, but 000000\.npz has 3"):
        source.masks(keyframe(1))


def test_the_length_of_an_embedding_does_not_matter(folder):
    values = np.array([[3e30, 4e30]])
    details(folder, ids=np.array([300]), embeddings=values)
    (embedding,) = [row for row in read(folder).embeddings if row.any()]
    np.testing.assert_allclose(embedding, [0.6, 0.8], rtol=1e-6)


NPY = io.BytesIO()
np.save(NPY, np.arange(3))


@pytest.mark.parametrize("content", [b"", b"not an archive", NPY.getvalue()])
def test_a_broken_file_of_details_is_named(folder, content):
    (folder / "000000.npz").write_bytes(content)
    with pytest.raises(DatasetError, match=r"000000\.npz cannot be read"):
        read(folder)


def test_masks_of_another_shape_are_refused(folder):
    write_png(folder / "000000.png", np.ones((50, 50), np.uint8))
    with pytest.raises(DatasetError, match="50x50"):
        read(folder)


def test_a_broken_image_is_named(folder):
    (folder / "000000.png").write_bytes(b"\x89PNG\r\n\x1a\nbroken")
    with pytest.raises(DatasetError, match=r"000000\.png"):
        read(folder)


def run_lengths(mask: np.ndarray) -> list[int]:
    flat = mask.T.reshape(-1).astype(int)
    edges = np.flatnonzero(np.diff(flat)) + 1
    counts = np.diff([0, *edges, len(flat)]).tolist()
    return [0, *counts] if flat[0] else counts


def compressed(counts: list[int]) -> str:
    """COCO's encoder, as its documentation describes it."""
    text = ""
    for k, count in enumerate(counts):
        value = count - counts[k - 2] if k > 2 else count
        more = True
        while more:
            bits = value & 0x1F
            value >>= 5
            more = value != (-1 if bits & 0x10 else 0)
            text += chr(48 + (bits | 0x20 if more else bits))
    return text


@given(st.integers(0, 10_000), st.integers(1, 40), st.integers(1, 40))
@settings(max_examples=60)
def test_run_lengths_are_decoded(seed, height, width):
    rng = np.random.default_rng(seed)
    mask = np.repeat(rng.random((height, 1)) < 0.5, width, axis=1) ^ (rng.random(width) < 0.1)
    counts = run_lengths(mask)
    for form in (counts, compressed(counts)):
        found = decoded_mask({"size": [height, width], "counts": form}, (height, width))
        np.testing.assert_array_equal(found, mask)


def test_a_polygon_covers_the_pixels_inside():
    found = decoded_mask([[2, 1, 6, 1, 6, 4, 2, 4]], (10, 10))
    expected = np.zeros((10, 10), bool)
    expected[1:4, 2:6] = True
    assert (found & expected).sum() == expected.sum()
    assert found.sum() <= 20  # borders are inside


@pytest.mark.parametrize(
    "segmentation",
    [
        [[1, 2, 3]],
        [[1, 2, 3, 4, 5, float("nan")]],
        {"size": [9, 10], "counts": [90]},
        {"size": [10, 10], "counts": [90]},
        {"size": [10, 10], "counts": [-1, 101]},
        {"size": [10, 10], "counts": "P"},
        {"size": [10, 10], "counts": "\x01"},
        "mask",
    ],
)
def test_bad_segmentations_are_refused(segmentation):
    with pytest.raises(ValueError, match=r"counts|size|polygon|segmentation"):
        decoded_mask(segmentation, (10, 10))


IMAGE = {"id": 4, "file_name": "frame000000.jpg", "height": 120, "width": 160}


def coco(annotations: list, **more) -> dict:
    categories = [{"id": 3, "name": "chair"}]
    return {"images": [IMAGE], "annotations": annotations, "categories": categories} | more


def annotation(mask: np.ndarray, **more) -> dict:
    segmentation = {"size": [120, 160], "counts": compressed(run_lengths(mask))}
    return {"image_id": 4, "segmentation": segmentation} | more


def written(tmp_path, content: dict):
    path = tmp_path / "masks.json"
    path.write_text(json.dumps(content))
    return path


def test_small_masks_lie_in_front_of_large_ones(tmp_path):
    large, small = np.ones((120, 160), bool), np.zeros((120, 160), bool)
    small[40:60, 50:90] = True
    entries = [annotation(small, category_id=3, score=0.5), annotation(large)]
    masks = CocoMasks(written(tmp_path, coco(entries))).masks(keyframe(0))
    assert masks.classes == ["chair", None]
    np.testing.assert_array_equal(masks.ids, np.where(small, 1, 2))
    np.testing.assert_allclose(masks.scores, [0.5, 1.0])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "must have images"),
        ({"images": []}, "not a COCO file"),
        (coco([{"image_id": 4}]), "segmentation"),
        (coco([annotation(np.ones((2, 2)), image_id=9)]), "image_id 9"),
        (coco([annotation(np.ones((2, 2)), image_id=[4])]), "not a COCO file"),
        (coco([annotation(np.ones((2, 2)), category_id=float("inf"))]), "not a COCO file"),
        (coco([], images=[]), "no image belongs to a frame"),
        *((coco([], images=[IMAGE | {"height": n}]), f"x{n} pixels") for n in (-1, 0, 10**6)),
        (coco([], images=[IMAGE | {"file_name": "9" * 5000}]), "not a COCO file"),
    ],
)
def test_bad_coco_files_are_refused_with_their_name(tmp_path, content, message):
    with pytest.raises(DatasetError, match=message) as caught:
        CocoMasks(written(tmp_path, content))
    assert "masks.json" in str(caught.value)


def test_a_mask_of_another_size_is_refused_with_its_place(tmp_path):
    entry = annotation(np.ones((120, 160)))
    entry["segmentation"]["size"] = [60, 80]
    source = CocoMasks(written(tmp_path, coco([entry])))
    with pytest.raises(DatasetError, match="annotation 1 of image 4: the mask has size"):
        source.masks(keyframe(0))


def test_a_file_that_is_not_json_is_refused(tmp_path):
    path = tmp_path / "masks.json"
    path.write_text("{")
    with pytest.raises(DatasetError, match="is not JSON"):
        CocoMasks(path)


def test_instances_are_off_by_default():
    assert build_instances(InstanceOptions()) is None


def test_a_source_of_files_needs_an_existing_path(tmp_path):
    with pytest.raises(SettingsError, match=r"--instances\.path"):
        build_instances(InstanceOptions("folder"))
    with pytest.raises(SettingsError, match="does not exist"):
        build_instances(InstanceOptions("folder", tmp_path / "none"))
    for kind in ("none", "geometric"):
        with pytest.raises(SettingsError, match="has no effect"):
            build_instances(InstanceOptions(kind, tmp_path))
