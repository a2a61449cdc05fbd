"""Runs that still have their checkpoints."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from toolkit.runs.session import Session


@contextmanager
def kept_checkpoints() -> Iterator[None]:
    """Runs end as if they were killed just before they remove their checkpoints."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Session, "close_results", lambda session: session.slam.store_in_metres())
        yield
