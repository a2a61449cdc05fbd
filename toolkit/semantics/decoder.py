"""The small network that decodes codes to flat classes (H-12, H-13).

One network decodes all submaps of a run. It is trained on the current submap only and would forget
the classes of earlier ones, so each step also trains on stored samples of all classes.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.errors import SettingsError
from toolkit.io.arrays import arrays_below
from toolkit.semantics.options import SemanticsOptions


def check_reader(options: SemanticsOptions) -> None:
    """Check that the network that decodes codes is trained.

    Raises:
        SettingsError: with the option to change.
    """
    if options.reader == "network" and not options.network.use:
        raise SettingsError(
            "--semantics.reader network decodes with a network that is not trained; add "
            "--semantics.network.use, or remove it"
        )


class ReplayMemory:
    """A uniform sample of the codes of each class (reservoir sampling).

    Args:
        channels: number of channels S of the code.
        classes: number of classes C.
        size: maximum number of samples per class; 0 disables the memory.
    """

    def __init__(self, channels: int, classes: int, size: int) -> None:
        self._values = np.zeros((classes, size, channels), np.float32)
        self._offered = np.zeros(classes, np.int64)

    def add(self, values: Tensor, class_ids: Tensor, generator: np.random.Generator) -> None:
        """Add the codes of P pixels to the sample.

        Args:
            values: [S, P] codes.
            class_ids: [P] class ids > 0.
            generator: selects the samples that are replaced.
        """
        size = self._values.shape[1]
        if size == 0:
            return
        codes, ids = values.detach().cpu().numpy().T, class_ids.cpu().numpy() - 1
        for class_ in np.unique(ids):
            selected = codes[ids == class_]
            # Reservoir sampling: the n-th sample is stored if a random slot of n is below `size`.
            order = self._offered[class_] + np.arange(len(selected))
            slot = np.where(order < size, order, generator.integers(0, order + 1))
            kept = slot < size
            self._values[class_, slot[kept]] = selected[kept]
            self._offered[class_] += len(selected)

    def samples(self) -> tuple[Tensor, Tensor]:
        """Return the stored codes [S, P] and their class ids [P]."""
        size = self._values.shape[1]
        filled = np.arange(size) < np.minimum(self._offered, size)[:, None]
        ids = np.nonzero(filled)[0] + 1
        return torch.from_numpy(self._values[filled].T.copy()), torch.from_numpy(ids)

    def state(self) -> dict[str, NDArray]:
        """Return the arrays that `restore` accepts."""
        return {"values": self._values.copy(), "offered": self._offered.copy()}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self._values = np.array(arrays["values"], np.float32)
        self._offered = np.array(arrays["offered"], np.int64)


class NetworkDecoder:
    """Two 1x1 convolutions with a ReLU between them, and their Adam optimiser.

    A 1x1 convolution is a matrix product per pixel, so the pixels need not form an image.

    Args:
        channels: number of channels S of the code.
        classes: number of classes C.
        hidden: number of hidden units.
        learning_rate: learning rate of Adam.
        generator: random generator of the initial weights.
        replay: number of stored samples per class in every step; 0 trains on new views only.

    Attributes:
        steps: number of steps taken.
    """

    def __init__(
        self,
        channels: int,
        classes: int,
        hidden: int = 64,
        learning_rate: float = 5e-3,
        generator: torch.Generator | None = None,
        replay: int = 16,
    ) -> None:
        self._rate = learning_rate
        shapes = {"in": (hidden, channels), "out": (classes, hidden)}
        self._parameters: dict[str, Tensor] = {}
        for name, (rows, columns) in shapes.items():
            weight = torch.randn(rows, columns, generator=generator, dtype=torch.float32)
            self._parameters[f"{name}_weight"] = weight * (2.0 / columns) ** 0.5
            self._parameters[f"{name}_bias"] = weight.new_zeros(rows, 1)
        self._first = {n: torch.zeros_like(p) for n, p in self._parameters.items()}
        self._second = {n: torch.zeros_like(p) for n, p in self._parameters.items()}
        self._memory = ReplayMemory(channels, classes, replay)
        self.steps = 0

    def logits(self, values: Tensor) -> Tensor:
        """Return the logits [C, P] of the flat classes for values [S, P]."""
        p = {name: parameter.to(values) for name, parameter in self._parameters.items()}
        hidden = torch.relu(p["in_weight"] @ values + p["in_bias"])
        return p["out_weight"] @ hidden + p["out_bias"]

    def learn(self, values: Tensor, class_ids: Tensor) -> tuple[float, Tensor]:
        """Take one step on the cross-entropy (H-12).

        Args:
            values: [S, P] codes.
            class_ids: [P] int64 class ids > 0.

        Returns:
            The mean loss divided by that of a uniform prediction, and the gradient [S, P] of the
            **sum** of the loss with respect to the values.
        """
        leaves = {n: p.detach().requires_grad_() for n, p in self._parameters.items()}
        values = values.detach().requires_grad_()
        with torch.enable_grad():
            self._parameters = leaves
            loss = self._loss(values, class_ids)
            total, replayed = loss, self._memory.samples()
            if len(replayed[1]):
                total = loss + self._loss(*replayed).to(loss)
            by_values, *by_parameters = torch.autograd.grad(total, [values, *leaves.values()])
        self._parameters = {n: p.detach() for n, p in leaves.items()}
        self._memory.add(values, class_ids, np.random.default_rng(self.steps))
        self._step(dict(zip(leaves, by_parameters, strict=True)))
        return float(loss.detach()), by_values * values.shape[1]

    def _loss(self, values: Tensor, class_ids: Tensor) -> Tensor:
        """Return the mean cross-entropy divided by that of a uniform prediction."""
        logits = self.logits(values)
        return torch.nn.functional.cross_entropy(logits.T, class_ids - 1) / float(
            np.log(len(logits))
        )

    def _step(self, gradients: dict[str, Tensor]) -> None:
        beta1, beta2 = 0.9, 0.99
        self.steps += 1
        for name, gradient in gradients.items():
            first = self._first[name].mul_(beta1).add_(gradient, alpha=1 - beta1)
            second = self._second[name].mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
            scale = (second / (1 - beta2**self.steps)).sqrt() + 1e-8
            self._parameters[name] -= self._rate * first / (1 - beta1**self.steps) / scale

    def state(self) -> dict[str, NDArray]:
        """Return the arrays that `restore` accepts."""
        arrays = {"steps": np.array(self.steps)}
        for kind, tensors in self._groups():
            arrays |= {f"{kind}_{name}": t.numpy().copy() for name, t in tensors.items()}
        arrays |= {f"replay/{name}": array for name, array in self._memory.state().items()}
        return arrays

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self.steps = int(arrays["steps"])
        for kind, tensors in self._groups():
            for name in tensors:
                tensors[name] = torch.from_numpy(np.array(arrays[f"{kind}_{name}"]))
        self._memory.restore(arrays_below(arrays, "replay/"))

    def _groups(self) -> tuple[tuple[str, dict[str, Tensor]], ...]:
        return (
            ("parameter", self._parameters),
            ("first", self._first),
            ("second", self._second),
        )
