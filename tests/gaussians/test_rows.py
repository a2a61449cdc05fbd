"""Tensors that grow in place."""

from __future__ import annotations

import pytest
import torch

from toolkit.splatting.gaussians.rows import append_rows, select_rows


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


def test_selected_rows_have_room_for_more():
    tensor = torch.arange(12.0).reshape(6, 2)
    indices = torch.tensor([0, 3, 5])
    selected = select_rows(tensor, indices)
    assert torch.equal(selected, tensor[indices])
    joined = append_rows(selected, torch.zeros(1, 2))
    assert joined.data_ptr() == selected.data_ptr()
    assert torch.equal(joined, torch.cat([tensor[indices], torch.zeros(1, 2)]))
