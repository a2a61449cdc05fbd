"""A fake language model behind an endpoint of this machine."""

from __future__ import annotations

import ssl
import threading
from collections.abc import Callable, Iterator

import fake_endpoint
import numpy as np
import pytest

from toolkit.taxonomy_building.language_model.chat import ModelIdentity
from toolkit.taxonomy_building.language_model.endpoint import Endpoint, RetryOptions

# Every client loads the machine's certificates, which takes ten times as long as a local
# exchange without them.
_TLS = ssl.create_default_context()


@pytest.fixture
def fake(monkeypatch) -> Iterator[fake_endpoint.FakeEndpoint]:
    """An endpoint that serves while the test runs."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(ssl, "create_default_context", lambda *_, **__: _TLS)
    server = fake_endpoint.FakeEndpoint()
    thread = threading.Thread(target=server.serve)
    thread.start()
    yield server
    server.close()
    thread.join()


@pytest.fixture
def connect(fake) -> Callable[..., tuple[Endpoint, list[float]]]:
    """Makes a client of the fake endpoint that notes its waits instead of waiting."""
    pytest.importorskip("openai")

    def connected(**retries: float) -> tuple[Endpoint, list[float]]:
        waits: list[float] = []
        identity = ModelIdentity(fake.url, "fake-1")
        limits = RetryOptions(**{"request_timeout_s": 5.0, **retries})
        key = fake_endpoint.KEY
        return Endpoint(identity, key, np.random.default_rng(0), limits, waits.append), waits

    return connected
