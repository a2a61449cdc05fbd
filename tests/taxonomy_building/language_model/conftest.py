"""A fake language model behind an endpoint of this machine."""

from __future__ import annotations

import ssl
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from chat_server import ChatServer
from fake_endpoint import KEY, honest

from toolkit.semantics.taxonomy_building.language_model.chat import ModelIdentity
from toolkit.semantics.taxonomy_building.language_model.endpoint import Endpoint, RetryOptions

# Every client loads the machine's certificates, which takes ten times as long as a local
# exchange without them.
_TLS = ssl.create_default_context()


@pytest.fixture
def fake(monkeypatch) -> Iterator[ChatServer]:
    """An endpoint that serves while the test runs."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(ssl, "create_default_context", lambda *_, **__: _TLS)
    with ChatServer(honest).serving() as server:
        yield server


@pytest.fixture
def connect(fake) -> Callable[..., tuple[Endpoint, list[float]]]:
    """Makes a client of the fake endpoint that notes its waits instead of waiting."""
    pytest.importorskip("openai")

    def connected(**retries: float) -> tuple[Endpoint, list[float]]:
        waits: list[float] = []
        identity = ModelIdentity(fake.url, "fake-1")
        limits = RetryOptions(**{"request_timeout_s": 5.0, **retries})
        return Endpoint(identity, KEY, np.random.default_rng(0), limits, waits.append), waits

    return connected
