"""The one door to Open3D.

`import open3d` takes seconds and needs system libraries, so it happens on
first use, and a failure names the line that mends it. Open3D's odometry, ICP
and voxel down-sampling differ from run to run on several threads; TBB sizes
its pool at import, so importing on one core keeps them reproducible.
"""

from __future__ import annotations

import functools
import os
from types import ModuleType
from typing import Any

from toolkit.errors import DependencyError

SYSTEM_LIBRARIES = ("libusb-1.0-0", "libgl1", "libegl1")


@functools.cache
def open3d() -> ModuleType:
    """The open3d module, loaded once on a single core.

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
            f"Open3D cannot be loaded ({error}); mend it with: pip install open3d && "
            f"apt-get install -y {' '.join(SYSTEM_LIBRARIES)}"
        ) from error
    finally:
        if cores:
            os.sched_setaffinity(0, cores)
    return module


def _start_thread_pool(module: Any) -> None:
    """Run one small operation, so that TBB settles on the single core we are on."""
    points = module.core.Tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    module.t.geometry.PointCloud(points).voxel_down_sample(0.5)
