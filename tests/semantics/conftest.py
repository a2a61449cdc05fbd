"""A small tree for the tests of codes and losses."""

from __future__ import annotations

import pytest

from toolkit.semantics.taxonomy import Taxonomy


@pytest.fixture(scope="session")
def tree() -> Taxonomy:
    """Nine classes on three levels, one of which ends early."""
    return Taxonomy(
        {
            "large": {"soft": ["bed", "sofa", "mattress"], "hard": ["table", "desk"]},
            "small": {"round": ["cup", "plate", "vase"], "phone": {}},
        },
        levels=["size", "shape", "class"],
    )
