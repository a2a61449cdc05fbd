"""objects.npz: round trips, and one line for every kind of damage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from toolkit.base.errors import FormatError
from toolkit.io.object_embeddings import (
    CompressedEmbeddings,
    ObjectEmbeddings,
    read_objects,
    unit_rows,
    write_objects,
)


def some_objects(count: int = 5, dimensions: int = 12) -> ObjectEmbeddings:
    generator = np.random.default_rng(0)
    return ObjectEmbeddings(
        np.arange(count, dtype=np.int32) * 3 + 1,
        np.arange(count, dtype=np.int32) % 2,
        unit_rows(generator.normal(size=(count, dimensions))),
        np.linspace(0, 2, count, dtype=np.float32),
        "clip 0123",
        generator.normal(size=(count, 3)).astype(np.float32),
    )


@pytest.fixture
def file(tmp_path):
    return tmp_path / "objects.npz"


def test_objects_are_read_as_written_with_16_bits_a_value(file):
    objects = some_objects()
    write_objects(file, objects)
    read = read_objects(file)
    for name in ("ids", "class_ids", "weights", "centres_m"):
        np.testing.assert_array_equal(getattr(read, name), getattr(objects, name))
        assert getattr(read, name).dtype == getattr(objects, name).dtype
    np.testing.assert_array_equal(read.embeddings, objects.embeddings.astype(np.float16))
    assert read.model == "clip 0123"
    assert (len(read), read.dimensions) == (5, 12)
    first = file.read_bytes()
    write_objects(file, objects)
    assert file.read_bytes() == first


def test_a_map_without_objects_and_without_positions_is_valid(file):
    none = ObjectEmbeddings(
        np.empty(0, np.int32),
        np.empty(0, np.int32),
        np.empty((0, 8), np.float32),
        np.empty(0, np.float32),
        "siglip 1",
    )
    write_objects(file, none)
    read = read_objects(file)
    assert len(read) == 0
    assert read.centres_m is None


def test_compressed_embeddings_are_decoded(file):
    codes = np.array([[0, 1], [1, 0]], np.uint8)
    books = np.array([[[1, 0], [0, 1]], [[0, 0], [0, 1]]], np.float16)
    objects = replace(some_objects(2, 4), embeddings=np.eye(4, dtype=np.float32)[:2])
    write_objects(file, objects, CompressedEmbeddings(codes, books))
    expected = unit_rows(np.array([[1, 0, 0, 1], [0, 1, 0, 0]]))
    np.testing.assert_allclose(read_objects(file).embeddings, expected, atol=1e-6)
    with pytest.raises(ValueError, match="other objects"):
        write_objects(file, some_objects(), CompressedEmbeddings(codes, books))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"ids": np.array([1, 4, 4, 5, 6], np.int32)}, "object 4 appears twice in 'ids'"),
        ({"class_ids": np.array([1, -2, 0, 0, 0], np.int32)}, "'class_ids' contains -2"),
        ({"class_ids": np.zeros(4, np.int32)}, r"'class_ids' must have shape \[5\], got \[4\]"),
        ({"embeddings": np.zeros((4, 12), np.float16)}, r"'embeddings' must have shape \[5, D\]"),
        ({"embeddings": np.zeros((5, 12), np.float16)}, "embedding of object 1 has length 0"),
        ({"embeddings": np.full((5, 12), np.nan, np.float16)}, "'embeddings' of object 1 is not f"),
        ({"embeddings": np.zeros((5, 12), np.int64)}, "'embeddings' must have 2 dimensions and a"),
        ({"weights": np.full(5, -1, np.float32)}, "'weights' contains -1"),
        ({"weights": np.full(5, np.inf, np.float32)}, "'weights' of object 1 is not finite"),
        ({"centres_m": np.zeros((5, 2), np.float32)}, r"'centres_m' must have shape \[5, 3\]"),
        ({"model": np.array("")}, "'model' must have 1 to 200 characters"),
        ({"model": np.array(3)}, "'model' must have 0 dimensions and a type of kind U"),
        ({"model": None}, "the array 'model' is missing"),
        ({"codes": np.zeros((5, 2), np.uint8)}, "the array 'codebooks' is missing"),
        (
            {"codes": np.full((5, 2), 9, np.uint8), "codebooks": np.ones((2, 4, 6), np.float16)},
            "'codes' .* do not fit to 'codebooks'",
        ),
    ],
)
def test_inconsistent_files_are_refused_in_one_line(file, changes, said):
    write_objects(file, some_objects())
    with np.load(file) as content:
        arrays = dict(content)
    arrays = {name: array for name, array in (arrays | changes).items() if array is not None}
    np.savez(file, **arrays)
    with pytest.raises(FormatError, match=said) as error:
        read_objects(file)
    assert str(error.value).startswith(str(file))
    assert "\n" not in str(error.value)


def test_missing_and_damaged_files_are_refused(file):
    with pytest.raises(FormatError, match="has no embeddings of objects"):
        read_objects(file)
    write_objects(file, some_objects())
    whole = file.read_bytes()
    for content in (b"", b"no archive", whole[: len(whole) // 2]):
        file.write_bytes(content)
        with pytest.raises(FormatError, match=r"is not a readable \.npz file"):
            read_objects(file)
    np.savez(file, ids=np.array([{"a": 1}], dtype=object))
    with pytest.raises(FormatError, match=r"is not a readable \.npz file"):
        read_objects(file)
