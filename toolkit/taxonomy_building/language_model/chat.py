"""One question to a chat model and its answer, as plain values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol

from toolkit.errors import ToolkitError

Ending = Literal["stop", "length", "refused"]


class NoModelError(ToolkitError):
    """No model answers: it cannot be reached, refuses to work, or takes too long."""


@dataclass(frozen=True)
class ModelIdentity:
    """Who answers: two models of one name at two places may differ."""

    base_url: str
    model: str

    def __str__(self) -> str:
        return f"{self.model} at {self.base_url}"


@dataclass(frozen=True)
class ChatRequest:
    """All that decides an answer, but for who gives it.

    Attributes:
        system: what holds for every question.
        user: the question.
        schema: JSON schema of the answer.
        seed: asked of the model's sampler, whose temperature is 0.
    """

    system: str
    user: str
    schema: Mapping[str, Any]
    seed: int = 0
    temperature: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """JSON values; equal for equal requests."""
        return asdict(self)


@dataclass(frozen=True)
class ChatAnswer:
    """What came.

    Attributes:
        text: as the model wrote it; empty where it refused.
        ending: "length" where question or answer were too long for the model.
    """

    text: str
    ending: Ending = "stop"


class ChatModel(Protocol):
    """Answers requests, or says why it cannot."""

    @property
    def identity(self) -> ModelIdentity:
        """Who answers."""
        ...

    def complete(self, request: ChatRequest) -> ChatAnswer:
        """The model's answer.

        Raises:
            NoModelError: there is none to be had.
        """
        ...
