"""One inter-level network for all submaps: what it learns of one must not undo the others."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toolkit.semantics.decoder import NetworkDecoder, ReplayMemory

CLASSES, CHANNELS = 9, 6
FIRST, SECOND = range(1, 6), range(6, 10)


def codes(classes: range, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Noisy codes [S, P] of some classes, each around a code of its own, and the ids [P]."""
    words = np.random.default_rng(7).normal(size=(CLASSES + 1, CHANNELS))
    generator = np.random.default_rng(seed)
    ids = generator.choice(list(classes), 256)
    values = words[ids] + 0.1 * generator.normal(size=(256, CHANNELS))
    return torch.from_numpy(values.T.astype(np.float32)), torch.from_numpy(ids)


def network(replay: int = 16) -> NetworkDecoder:
    generator = torch.Generator().manual_seed(0)
    return NetworkDecoder(CHANNELS, CLASSES, 16, 0.02, generator, replay)


def taught(decoder: NetworkDecoder, classes: range, steps: int) -> NetworkDecoder:
    for seed in range(steps):
        decoder.learn(*codes(classes, seed))
    return decoder


def accuracy(decoder: NetworkDecoder, classes: range) -> float:
    values, ids = codes(classes, 10_000)
    return float((decoder.logits(values).argmax(dim=0) + 1 == ids).float().mean())


@pytest.mark.parametrize("replay", [0, 16])
def test_a_retired_submap_stays_readable(replay):
    """Its classes are not in any later view; without rehearsal they are forgotten."""
    decoder = taught(taught(network(replay), FIRST, 40), SECOND, 150)
    assert accuracy(decoder, SECOND) > 0.99
    assert (accuracy(decoder, FIRST) > 0.99) is (replay > 0)


def test_rehearsal_does_not_change_what_codes_are_asked_for():
    """The gradient of a step is of its own pixels; weights before it are equal."""
    decoders = [network(replay) for replay in (0, 16)]
    for decoder in decoders:
        decoder.learn(*codes(FIRST, 0))
    (loss, gradient), (same_loss, same_gradient) = (d.learn(*codes(FIRST, 1)) for d in decoders)
    assert loss == same_loss and torch.equal(gradient, same_gradient)


def test_a_restored_network_goes_on_identically():
    decoder = taught(network(), FIRST, 5)
    other = network()
    other.restore(decoder.state())
    for each in (decoder, other):
        taught(each, SECOND, 3)
    for name, array in decoder.state().items():
        assert np.array_equal(array, other.state()[name]), name


def test_memory_is_a_uniform_sample_of_each_class():
    """Of 1,000 codes in order, 50 are kept, from the beginning, the middle and the end alike."""
    memory = ReplayMemory(1, 2, 50)
    for step in range(10):
        values = torch.arange(100 * step, 100 * (step + 1), dtype=torch.float32)[None]
        ids = torch.full((100,), 2)
        memory.add(values, ids, np.random.default_rng(step))
    kept, ids = memory.samples()
    assert kept.shape == (1, 50) and (ids == 2).all()
    counts = np.histogram(kept.numpy(), bins=4, range=(0, 1000))[0]
    assert counts.min() >= 5


def test_an_empty_memory_rehearses_nothing():
    values, ids = ReplayMemory(3, 2, 4).samples()
    assert values.shape == (3, 0) and len(ids) == 0
