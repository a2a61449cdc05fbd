"""Codes: widths, what they decode to, and that no impossible path comes out."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.semantics.codes import ColourCode, SemanticCode, binary_code, flat_code, one_hot_code
from toolkit.semantics.decoding import decode, decode_level
from toolkit.semantics.taxonomy import Taxonomy


def colour_code(taxonomy: Taxonomy) -> ColourCode:
    palette = np.random.default_rng(0).uniform(size=(len(taxonomy), 3)).astype(np.float32)
    return ColourCode(taxonomy, palette)


CODES = {
    "flat": flat_code,
    "one-hot": one_hot_code,
    "binary": binary_code,
    "colour": colour_code,
}


@pytest.fixture(params=CODES)
def code(request, tree) -> SemanticCode:
    return CODES[request.param](tree)


def everything_seen(values):
    return torch.ones(values.shape[1], dtype=torch.bool)


def test_widths(tree):
    assert tree.level_widths == (2, 2, 3)
    assert flat_code(tree).channels == 9
    assert one_hot_code(tree).channels == 2 + 2 + 3
    assert binary_code(tree).channels == 1 + 1 + 2


def test_a_level_with_one_child_needs_no_channel():
    taxonomy = Taxonomy({"thing": {"a": ["x", "y"], "b": ["z"]}})
    assert taxonomy.level_widths == (1, 2, 2)
    assert one_hot_code(taxonomy).channels == 4
    assert binary_code(taxonomy).channels == 2


def test_decoding_among_some_classes_is_that_of_impossible_others(code, tree):
    """Their rows are left out, which must not change anything but the time."""
    values = torch.randn(code.channels, 500, generator=torch.Generator().manual_seed(1))
    among = torch.tensor([0, 2])
    others = torch.ones(len(tree), dtype=torch.bool)
    others[among] = False

    def masked(values):
        return code.logits(values).masked_fill(others[:, None], -torch.inf)

    seen = torch.arange(500) % 7 > 0
    expected = decode(values, masked, tree, seen)
    answer = decode(values, code.logits, tree, seen, among)
    for name in ("class_ids", "confidence", "nodes", "node_confidence"):
        assert np.array_equal(getattr(answer, name), getattr(expected, name)), name
    assert answer.entropy == pytest.approx(expected.entropy, abs=1e-6)
    assert set(answer.class_ids) == {0, 1, 3}
    for level in range(tree.depth):
        nodes = decode_level(values, code.logits, tree, seen, level, among)
        assert np.array_equal(nodes, expected.nodes[:, level])


def test_start_values_decode_to_their_class(code, tree):
    values = code.start_values[1:].T.contiguous()
    answer = decode(values, code.logits, tree, everything_seen(values))
    assert answer.class_ids.tolist() == list(range(1, len(tree) + 1))
    assert (answer.nodes == tree.node_ids).all()
    assert (answer.confidence > 0.5).all()


def test_heads_start_equally_sure(tree):
    for make in (flat_code, one_hot_code, binary_code):
        code = make(tree)
        first, width = code.heads.first[-1], code.heads.width[-1]
        values = code.start_values[1, first : first + width]
        if code.heads.bits:
            assert values.abs().sigmoid().tolist() == pytest.approx([0.9] * int(width))
        else:
            assert values.softmax(0).max().item() == pytest.approx(0.9)


def test_void_starts_undecided(tree):
    for make in (flat_code, one_hot_code, binary_code):
        code = make(tree)
        logits = code.logits(code.start_values[:1].T.contiguous())
        assert logits.std().item() == 0.0


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_any_values_decode_to_a_class_on_its_own_path(seed):
    """Random values spell mostly impossible paths; answers are classes all the same."""
    taxonomy = Taxonomy(
        {"a": ["x", "y", "z", "w", "v"], "b": {"c": ["p"], "d": ["q", "r"]}, "e": {}}
    )
    generator = torch.Generator().manual_seed(seed)
    for make in (flat_code, one_hot_code, binary_code):
        code = make(taxonomy)
        values = 5.0 * torch.randn(code.channels, 40, generator=generator)
        answer = decode(values, code.logits, taxonomy, everything_seen(values))
        assert (answer.class_ids >= 1).all() and (answer.class_ids <= len(taxonomy)).all()
        assert (answer.confidence > 0).all() and (answer.entropy <= 1.0 + 1e-6).all()
        # Where the map is surer than even, every level agrees with one path.
        path = taxonomy.node_ids[answer.class_ids - 1]
        sure = answer.confidence > 0.5
        assert (answer.nodes[sure] == path[sure]).all()


def test_likelihood_is_the_product_over_heads(tree):
    """Brute force over the classes: log-softmax of every head, added up along the path."""
    code = one_hot_code(tree)
    values = torch.randn(code.channels, 6, generator=torch.Generator().manual_seed(3))
    expected = torch.zeros(len(tree), 6)
    for k, (first, width) in enumerate(zip(code.heads.first, code.heads.width, strict=True)):
        logs = values[first : first + width].log_softmax(0)
        for row in range(len(tree)):
            expected[row] += logs[code.heads.targets[row, k]]
    actual = code.logits(values).log_softmax(0)
    assert torch.allclose(actual, expected.log_softmax(0), atol=1e-5)


def test_binary_likelihood_is_the_product_over_bits(tree):
    code = binary_code(tree)
    values = torch.randn(code.channels, 6, generator=torch.Generator().manual_seed(4))
    words = code.start_values[1:] > 0
    expected = torch.stack(
        [torch.where(word[:, None], values, -values).sigmoid().log().sum(0) for word in words]
    )
    actual = code.logits(values).log_softmax(0)
    assert torch.allclose(actual, expected.log_softmax(0), atol=1e-5)


def test_back_off_keeps_the_levels_that_are_sure(tree):
    """Bed and sofa equally likely: surely large and soft, not surely either."""
    code = flat_code(tree)
    values = torch.full((9, 1), -10.0)
    values[0:2] = 2.0
    answer = decode(values, code.logits, tree, everything_seen(values))
    names = [tree.nodes[i].name if i >= 0 else None for i in answer.backed_off(0.6)[0]]
    assert names == ["large", "soft", None]
    assert answer.confidence[0] == pytest.approx(0.5, abs=1e-3)


def test_unseen_columns_stay_void(tree):
    code = one_hot_code(tree)
    values = code.start_values[1:4].T.contiguous()
    answer = decode(values, code.logits, tree, torch.tensor([True, False, True]))
    assert answer.class_ids.tolist() == [1, 0, 3]
    assert answer.nodes[1].tolist() == [-1, -1, -1]


def test_a_blind_guess_costs_one_a_head(tree):
    for make in (flat_code, one_hot_code, binary_code):
        code = make(tree)
        loss = code.pixel_loss(torch.zeros(code.channels, 3), torch.tensor([1, 4, 9]))
        assert loss.tolist() == pytest.approx([float(len(code.heads.first))] * 3)


def test_a_palette_of_the_wrong_shape_is_refused(tree):
    with pytest.raises(ValueError, match=r"shape \[9, 3\], got \[3, 9\]"):
        ColourCode(tree, np.zeros((3, 9), np.float32))
