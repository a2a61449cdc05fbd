"""Requests to chat models, their answers, and the interface of chat models."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol

from toolkit.base.errors import ToolkitError

Ending = Literal["stop", "length", "refused"]


class NoModelError(ToolkitError):
    """The model is not available: it cannot be reached, rejects requests, or times out."""


@dataclass(frozen=True)
class ModelIdentity:
    """Identity of a model: models of the same name can differ between endpoints."""

    base_url: str
    model: str

    def __str__(self) -> str:
        return f"{self.model} at {self.base_url}"


@dataclass(frozen=True)
class ChatRequest:
    """A request; together with the identity of the model it determines the answer.

    Attributes:
        system: system prompt.
        user: user prompt.
        schema: JSON schema of the answer.
        seed: seed of the sampler.
        temperature: temperature of the sampler.
    """

    system: str
    user: str
    schema: Mapping[str, Any]
    seed: int = 0
    temperature: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """Return JSON values; they are equal for equal requests."""
        return asdict(self)


@dataclass(frozen=True)
class ChatAnswer:
    """An answer of a model.

    Attributes:
        text: text of the model; empty if it refused to answer.
        ending: reason for the end; "length" if request or answer are too long for the model.
    """

    text: str
    ending: Ending = "stop"


class ChatModel(Protocol):
    """A chat model."""

    @property
    def identity(self) -> ModelIdentity:
        """Identity of the model."""
        ...

    def complete(self, request: ChatRequest) -> ChatAnswer:
        """Return the answer of the model.

        Raises:
            NoModelError: the model is not available.
        """
        ...
