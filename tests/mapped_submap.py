"""A mapper and the submap that it works on."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.keyframe import Keyframe
from toolkit.io.arrays import arrays_below
from toolkit.slam.mapping.mapper import Mapper, MappingResult
from toolkit.slam.mapping.optimisation import Objective
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import SurfaceView


class MappedSubmap:
    """The first submap of a mapper, which takes the arguments."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.mapper = Mapper(*arguments, **options)
        self.submap = self.mapper.first_submap()

    @property
    def gaussians(self) -> GaussianCloud:
        return self.submap.gaussians

    @property
    def keyframes(self) -> list[Keyframe]:
        return self.submap.keyframes

    def add_keyframe(self, keyframe: Keyframe) -> MappingResult:
        return self.mapper.add_keyframe(self.submap, keyframe)

    def step(self, keyframe: Keyframe, progress: tuple[int, int], objective: Objective) -> float:
        return self.mapper.step(self.submap, keyframe, progress, objective)

    def optimise_window(self, steps: int, poses: bool = False) -> None:
        self.mapper.optimise_window(self.submap, steps, poses)

    def optimise_moved(self, indices: Iterable[int], iterations: int) -> None:
        self.mapper.optimise_moved(self.submap, indices, iterations)

    def refine(self, T_map_cameras: NDArray[np.float64] | None = None) -> None:
        self.mapper.refine(self.submap, T_map_cameras)

    def view(self, keyframe: Keyframe) -> SurfaceView:
        return self.mapper.view(self.submap, keyframe)

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        arrays, values = self.mapper.state()
        content, submap = self.submap.state()
        own = {f"submap/{name}": array.copy() for name, array in content.items()}
        return arrays | own, values | {"submap": submap}

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        self.mapper.restore(arrays, values)
        content = arrays_below(arrays, "submap/")
        self.submap = Submap.from_state(content, values["submap"], self.mapper.device)
