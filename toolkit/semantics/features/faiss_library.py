"""Loading of FAISS, a library for nearest neighbours; the only module that imports it."""

from __future__ import annotations

import functools
from types import ModuleType

from toolkit.base.errors import DependencyError


@functools.cache
def faiss() -> ModuleType:
    """Import faiss.

    Raises:
        DependencyError: faiss cannot be loaded.
    """
    try:
        import faiss as module
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"FAISS cannot be loaded ({error}); fix it with: pip install faiss-cpu"
        ) from error
    return module
