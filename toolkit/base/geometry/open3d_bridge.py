"""Lazy import of Open3D; all other modules obtain it here.

`import open3d` takes seconds and needs system libraries. It is therefore imported on first use,
and the error message contains the command that installs what is missing. With several threads,
the results of Open3D's odometry, ICP and voxel downsampling vary between runs. TBB sets the size
of its thread pool at import, so Open3D is imported with the process restricted to one core.
"""

from __future__ import annotations

import functools
import os
from types import ModuleType
from typing import Any

from toolkit.base.errors import DependencyError

SYSTEM_LIBRARIES = ("libusb-1.0-0", "libgl1", "libegl1")


@functools.cache
def open3d() -> ModuleType:
    """Import the open3d module once, restricted to a single core.

    Raises:
        DependencyError: the package or one of its system libraries is missing.
    """
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    try:
        if cores:
            os.sched_setaffinity(0, {min(cores)})
        import open3d as module

        module.utility.set_verbosity_level(module.utility.VerbosityLevel.Error)
        _start_thread_pool(module)
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"Open3D cannot be loaded ({error}); install it with: pip install open3d && "
            f"apt-get install -y {' '.join(SYSTEM_LIBRARIES)}"
        ) from error
    finally:
        if cores:
            os.sched_setaffinity(0, cores)
    return module


def _start_thread_pool(module: Any) -> None:
    """Run a small operation so that TBB creates its thread pool while one core is available."""
    points = module.core.Tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    module.t.geometry.PointCloud(points).voxel_down_sample(0.5)
