"""Tensors that grow in place."""

from __future__ import annotations

import pytest
import torch

from toolkit.gaussians.rows import Removal, append_rows


@pytest.mark.parametrize("shape", [(), (3,), (0,)])
def test_rows_are_appended_as_by_concatenation(shape):
    generator = torch.Generator().manual_seed(0)
    joined = torch.zeros(0, *shape)
    parts = [torch.rand(count, *shape, generator=generator) for count in (5, 1, 0, 40, 3)]
    for part in parts:
        joined = append_rows(joined, part)
    assert torch.equal(joined, torch.cat(parts)) and joined.is_contiguous()


def test_appending_copies_nothing_while_there_is_room():
    first = append_rows(torch.zeros(0, 3), torch.ones(100, 3))
    second = append_rows(first, torch.full((20, 3), 2.0))
    assert second.data_ptr() == first.data_ptr()
    assert torch.equal(first, torch.ones(100, 3))
    third = append_rows(second, torch.zeros(100, 3))
    assert third.data_ptr() != second.data_ptr()


@pytest.mark.parametrize("view", [slice(2, 6), slice(None, 6), slice(None, None, 2)])
def test_memory_of_other_tensors_is_not_overwritten(view):
    whole = torch.arange(8.0)
    joined = append_rows(whole[view], torch.full((2,), -1.0))
    assert joined.tolist() == [*whole[view].tolist(), -1.0, -1.0]
    assert whole.tolist() == list(range(8))


def test_two_tensors_may_follow_the_same_one():
    first = append_rows(torch.zeros(0), torch.zeros(8))
    one, other = (append_rows(first, torch.full((2,), value)) for value in (1.0, 2.0))
    assert one[8:].tolist() == [1.0, 1.0] and other[8:].tolist() == [2.0, 2.0]


@pytest.mark.parametrize("removed", [[], [0], [9], [1, 8], [3, 4, 5, 6, 7, 8, 9], range(10)])
def test_removal_leaves_every_other_row_once(removed):
    mask = torch.zeros(10, dtype=torch.bool)
    mask[list(removed)] = True
    removal = Removal.of(mask)
    tensor = append_rows(torch.zeros(0, 2), torch.arange(20.0).reshape(10, 2))
    rest = tensor[~mask].tolist()
    left = removal.apply(tensor)
    assert sorted(left.tolist()) == rest
    # All tensors of a map are reordered alike.
    assert torch.equal(removal.apply(torch.arange(10.0)), left[:, 0] / 2)


def test_rows_are_appended_in_place_of_removed_ones():
    tensor = append_rows(torch.zeros(0), torch.arange(100.0))
    left = Removal.of(torch.arange(100) < 30).apply(tensor)
    joined = append_rows(left, torch.full((30,), -1.0))
    assert joined.data_ptr() == tensor.data_ptr() and len(joined) == 100
    assert sorted(joined.tolist()) == [-1.0] * 30 + list(range(30, 100))
