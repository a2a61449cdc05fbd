"""Train the indoor segmenter on rooms that are made on the fly.

    python -m data_tools.train_segmenter indoor.safetensors --state runs/indoor.pt

A night on two cores. The state is saved every few minutes; the same command continues from it.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.utils.data import DataLoader
from tqdm import tqdm

from data_tools.training_rooms.samples import TrainingBatches, batch
from data_tools.training_rooms.structure import structure_evidence
from toolkit.io.atomic import replacing
from toolkit.semantics.segmenters.indoor.classes import INDOOR_CLASSES, INDOOR_GROUPS
from toolkit.semantics.segmenters.indoor.network import IndoorNetwork

_BATCH = 16
_RATE, _DECAY = 2e-3, 0.01
_WARM_UP = 200
# Part of the steps at the end in which the rate falls to zero.
_FALL = 0.2
# Weights are averaged over about the last thousand steps.
_MEMORY = 0.999
_GROUP_WEIGHT = 0.5
_SAVE_S = 180.0
_VALIDATION_SEED, _VALIDATION_BATCHES = 1_000_003, 24
_ROOMS = 60
# Where the processor multiplies bfloat16, a step takes 0.58 of the time, at the same loss.
_HAS_BFLOAT16 = bool(torch.cpu.get_capabilities().get("avx512_bf16", False))


class Training:
    """The state of a training that can be interrupted.

    Args:
        steps: number of all steps.
        seed: of weights and rooms.
        rate: largest learning rate.
    """

    def __init__(self, steps: int, seed: int, rate: float = _RATE) -> None:
        torch.manual_seed(seed)
        self.steps, self.seed, self.step, self.rate = steps, seed, 0, rate
        self.network = IndoorNetwork(len(INDOOR_CLASSES))
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.optimizer = torch.optim.AdamW(self.network.parameters(), rate, weight_decay=_DECAY)
        self.average = {name: value.clone() for name, value in self.network.state_dict().items()}
        self.frequency = torch.full((len(INDOOR_CLASSES),), 1.0 / len(INDOOR_CLASSES))

    def learn(self, channels: Tensor, labels: Tensor) -> float:
        """Take one step; return its loss."""
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate * self._schedule()
        counts = torch.bincount(labels.flatten().int(), minlength=len(INDOOR_CLASSES) + 1)[1:]
        self.frequency = 0.99 * self.frequency + 0.01 * counts / counts.sum().clamp(min=1)
        self.network.train()
        image = channels.float().contiguous(memory_format=torch.channels_last)
        with torch.autocast("cpu", torch.bfloat16, enabled=_HAS_BFLOAT16):
            logits = self.network(image)
        # Of each 2x2 cells, which hardly differ, one counts; each in its turn.
        part = (..., slice(self.step % 2, None, 2), slice(self.step // 2 % 2, None, 2))
        loss = class_loss(logits[part].float(), labels[part].long(), self.frequency)
        self.optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        self.step += 1
        memory = min(_MEMORY, (1 + self.step) / (20 + self.step))
        for name, value in self.network.state_dict().items():
            if value.is_floating_point():
                self.average[name].lerp_(value, 1.0 - memory)
        return float(loss.detach())

    def _schedule(self) -> float:
        left = (self.steps - self.step) / max(_FALL * self.steps, 1.0)
        return min(1.0, (self.step + 1) / _WARM_UP, max(left, 0.0))

    def averaged(self) -> IndoorNetwork:
        """The network with averaged weights, for use."""
        network = IndoorNetwork(len(INDOOR_CLASSES))
        network.load_state_dict(self.average)
        return network.eval()

    def save(self, path: Path) -> None:
        """Write the state, at once or not at all."""
        state = {
            "step": self.step,
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "average": self.average,
            "frequency": self.frequency,
        }
        with replacing(path) as temporary:
            torch.save(state, temporary)

    def restore(self, path: Path) -> None:
        """Continue from a state that `save` wrote."""
        state = torch.load(path, weights_only=True)
        self.step, self.average, self.frequency = (
            state["step"], state["average"], state["frequency"],
        )  # fmt: skip
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(state["optimizer"])


def class_loss(logits: Tensor, labels: Tensor, frequency: Tensor) -> Tensor:
    """Cross entropy over classes and over groups; cells without a label do not count.

    Args:
        logits: [B, C, h, w]. labels: [B, h, w], 0 without a label, else from 1.
        frequency: [C] of the classes; rare ones count more.
    """
    weights = (frequency + 2e-3) ** -0.4
    weights = torch.cat([torch.zeros(1), weights / (weights * frequency).sum()])
    log_p = torch.log_softmax(logits, dim=1)
    weight = weights[labels]
    total = weight.sum().clamp(min=1.0)
    nearest = (labels - 1).clamp(min=0)
    fine = -log_p.gather(1, nearest[:, None])[:, 0]
    groups = torch.from_numpy(INDOOR_GROUPS)
    membership = nn.functional.one_hot(groups).T.float()
    group_p = torch.einsum("gc,bchw->bghw", membership, log_p.exp())
    group = groups[nearest]
    coarse = -group_p.gather(1, group[:, None])[:, 0].clamp(min=1e-6).log()
    return ((fine + _GROUP_WEIGHT * coarse) * weight).sum() / total


@torch.no_grad()
def confusion(network: nn.Module, batches: Iterable[tuple[Tensor, Tensor]]) -> Tensor:
    """Confusion matrix [C, C] (true, predicted) of batches of channels and labels."""
    count = len(INDOOR_CLASSES)
    matrix = torch.zeros(count * count)
    for channels, labels in batches:
        found = network(channels.float()).argmax(dim=1)
        known = labels > 0
        pairs = (labels[known].long() - 1) * count + found[known]
        matrix += torch.bincount(pairs, minlength=count * count)
    return matrix.reshape(count, count)


def unseen_batches(count: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Views of rooms that training does not show."""
    for number in range(count):
        yield batch(np.random.default_rng([_VALIDATION_SEED, number]), _BATCH, per_room=2)


def summary(matrix: Tensor) -> Mapping[str, float]:
    """Pixel accuracy, mean IoU, and IoU by class, in percent."""
    hit = matrix.diagonal()
    iou = 100.0 * hit / (matrix.sum(0) + matrix.sum(1) - hit).clamp(min=1.0)
    by_class = {name: float(v) for name, v in zip(INDOOR_CLASSES, iou, strict=True)}
    accuracy = float(100.0 * hit.sum() / matrix.sum())
    return {"accuracy": accuracy, "mIoU": float(iou.mean()), **by_class}


def export(training: Training, out: Path) -> None:
    """Write the averaged weights in half precision."""
    tensors = {"structure": torch.from_numpy(structure_evidence(_VALIDATION_SEED, _ROOMS))}
    tensors |= {
        name: value.half().contiguous() if value.is_floating_point() else value
        for name, value in training.averaged().state_dict().items()
        if not name.endswith("num_batches_tracked")
    }
    recipe = {"steps": training.step, "batch": _BATCH, "seed": training.seed}
    header = {"classes": ",".join(INDOOR_CLASSES), "recipe": json.dumps(recipe)}
    with replacing(out) as temporary:
        save_file(tensors, temporary, header)


def main() -> None:
    """Train, or continue to train, and write the weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="file of weights to write, safetensors")
    parser.add_argument("--state", type=Path, required=True, help="file to continue from")
    parser.add_argument("--steps", type=int, default=40000, help="steps of 16 views")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, help="processes that make rooms")
    options = parser.parse_args()
    training = Training(options.steps, options.seed)
    if options.state.exists():
        training.restore(options.state)
    data = TrainingBatches(options.seed, training.step, _BATCH)
    loader = DataLoader(data, batch_size=None, num_workers=options.workers)
    saved, curve = time.monotonic(), 0.0
    bar = tqdm(total=options.steps, initial=training.step, unit="step", mininterval=10)
    try:
        for channels, labels in loader:
            if training.step >= options.steps:
                break
            loss = training.learn(channels, labels)
            curve = loss if curve == 0.0 else 0.98 * curve + 0.02 * loss
            bar.update()
            bar.set_postfix(loss=f"{curve:.3f}")
            if time.monotonic() - saved > _SAVE_S:
                training.save(options.state)
                saved = time.monotonic()
    finally:
        training.save(options.state)
    bar.close()
    export(training, options.out)
    matrix = confusion(training.averaged(), unseen_batches(_VALIDATION_BATCHES))
    for name, value in summary(matrix).items():
        print(f"{name:10} {value:5.1f}")


if __name__ == "__main__":
    main()
