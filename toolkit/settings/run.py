"""All settings of one run."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from toolkit.settings.base import Settings
from toolkit.settings.loop_closure import LoopClosureSettings
from toolkit.settings.mapping import MappingSettings
from toolkit.settings.registration import PlacementSettings
from toolkit.settings.semantics import SemanticsSettings
from toolkit.settings.submaps import SubmapSettings
from toolkit.settings.tracking import TrackingSettings

DatasetKind = Literal["synthetic", "tum", "replica", "seven-scenes", "scannet", "folder"]


class DatasetSettings(Settings):
    """The sequence."""

    kind: DatasetKind = Field("synthetic", description="its layout")
    path: Path | None = Field(None, description="its folder; a synthetic room needs none")


class CheckpointSettings(Settings):
    """How often a run saves itself."""

    every_s: float = Field(30.0, gt=0, description="at least so often, seconds")
    every_keyframes: int = Field(50, ge=1, description="at least so often, keyframes")


class EvaluationSettings(Settings):
    """Which additional metrics are computed at the end of a run."""

    lpips_weights: tuple[Path, ...] = Field(
        (),
        description="files with the weights of LPIPS: torchvision's AlexNet and the linear "
        "weights of the lpips package; without them LPIPS is not computed",
    )
    subset: bool = Field(
        False,
        description="compute the papers' subset mIoU, for which each view is decoded among the "
        "classes of its true labels alone",
    )


class RunSettings(Settings):
    """Everything that decides the outcome of a run."""

    dataset: DatasetSettings = DatasetSettings()
    image_size: tuple[int, int] | None = Field(None, description="width height; native if unset")
    seed: int = Field(0, ge=0, description="of all random choices")
    max_frames: int | None = Field(None, ge=1, description="stop after so many")
    hold_out: int | None = Field(None, ge=2, description="keep every n-th frame out of the map")
    denoise: bool = Field(True, description="smooth depth as much as its noise asks for")
    poses: Literal["slam", "given"] = Field("slam", description="track, or take the truth's")
    map: Path | None = Field(None, description="folder of a finished run to begin in and extend")
    # Not "auto": nothing has been run on a GPU yet, and nobody shall be the first unasked.
    device: Literal["auto", "cpu", "cuda"] = Field(
        "cpu", description="where tracking and mapping run; on a GPU not yet tried"
    )
    backend: Literal["auto", "native", "reference", "cuda", "gsplat"] = Field(
        "auto", description="renderer"
    )
    tracking: TrackingSettings = TrackingSettings()
    placement: PlacementSettings = PlacementSettings()
    mapping: MappingSettings = MappingSettings()
    semantics: SemanticsSettings = SemanticsSettings()
    submaps: SubmapSettings = SubmapSettings()
    loops: LoopClosureSettings = LoopClosureSettings()
    checkpoint: CheckpointSettings = CheckpointSettings()
    evaluation: EvaluationSettings = EvaluationSettings()
