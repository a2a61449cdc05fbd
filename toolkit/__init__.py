"""semsplat: semantic 3D Gaussian Splatting SLAM.

The public names below are imported on first use, so that `import toolkit` takes no time and
loads neither torch nor Open3D.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from toolkit.base.threads import allow_forks, limit_waiting
from toolkit.base.version import __version__ as __version__

__all__ = [
    "Camera",
    "Frame",
    "RunSettings",
    "build_slam",
    "evaluate",
    "load_run",
    "load_settings",
    "open_dataset",
    "render",
    "run",
]

if TYPE_CHECKING:
    from toolkit.base.frame import Frame
    from toolkit.base.geometry.camera import Camera
    from toolkit.datasets.registry import open_dataset
    from toolkit.runs.building import build_slam
    from toolkit.runs.execution import run
    from toolkit.runs.maps.finished import load_run
    from toolkit.runs.scoring import evaluate
    from toolkit.runs.settings import RunSettings, load_settings
    from toolkit.splatting.rendering import render

_MODULES = {
    "Camera": "toolkit.base.geometry.camera",
    "Frame": "toolkit.base.frame",
    "RunSettings": "toolkit.runs.settings",
    "build_slam": "toolkit.runs.building",
    "evaluate": "toolkit.runs.scoring",
    "load_run": "toolkit.runs.maps.finished",
    "load_settings": "toolkit.runs.settings",
    "open_dataset": "toolkit.datasets.registry",
    "render": "toolkit.splatting.rendering",
    "run": "toolkit.runs.execution",
}

limit_waiting()
allow_forks()


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'toolkit' has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
