"""The settings of a run: the options of all stages, and those of the run itself."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import yaml

from toolkit.base.errors import SettingsError
from toolkit.base.options import (
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Range,
    accepted,
    as_plain,
    validated,
    with_home,
)
from toolkit.datasets.options import DatasetOptions
from toolkit.depth.depth_priors.options import DepthPriorOptions
from toolkit.depth.monocular.options import ScaleOptions
from toolkit.io.guarded.documents import read_yaml
from toolkit.runs.evaluation.options import EvaluationOptions
from toolkit.scene.growing.options import GrowingSceneOptions
from toolkit.scene.instances.options import InstanceOptions
from toolkit.semantics.options import SegmenterOptions, SemanticsOptions
from toolkit.slam.loops.closing.options import LoopClosureOptions
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.pacing.options import FramesPerSecond, PacingOptions
from toolkit.slam.submaps.options import SubmapOptions
from toolkit.slam.tracking.options import PlacementOptions, TrackingOptions

# Sets of settings to start from: one YAML file each in PRESETS, with the source of every value.
PresetName = Literal["fast", "default", "best", "hier-slam", "hier-slam-mono", "gausem"]
PRESETS = Path(__file__).with_name("presets")


@dataclass(frozen=True)
class CheckpointOptions:
    """How often a run saves a checkpoint."""

    every_s: PositiveFloat = 30.0
    """Maximum time between checkpoints, in seconds."""
    every_keyframes: PositiveInt = 50
    """Maximum number of keyframes between checkpoints. With `--pace`, only `every_s` applies."""


@dataclass(frozen=True)
class RunSettings:
    """Everything that determines the result of a run."""

    dataset: DatasetOptions = DatasetOptions()
    image_size: tuple[PositiveInt, PositiveInt] | None = None
    """Width and height in pixels to which images are resized. By default, images keep their size,
    except large ones without depth."""
    seed: NonNegativeInt = 0
    """Seed of all random choices."""
    max_frames: PositiveInt | None = None
    """Maximum number of frames to process. By default, all frames are processed."""
    hold_out: Annotated[int, Range(ge=2)] | None = None
    """Exclude every n-th frame from mapping and evaluate it as a novel view. By default, no frame
    is excluded."""
    denoise: bool = True
    """Smooth depth images according to their estimated noise, remove flying pixels, and close gaps
    of a pixel."""
    depth: Literal["sensor", "none"] = "sensor"
    """Depth of the images: that of the dataset (sensor), or estimated from the images alone (none).
    Without depth, the unit of length is arbitrary, unless a length is known (scale)."""
    depth_prior: DepthPriorOptions = DepthPriorOptions()
    poses: Literal["slam", "given"] = "slam"
    """Source of the camera poses: tracking (slam) or the dataset's ground truth (given)."""
    pace: FramesPerSecond = 0.0
    """Frames that arrive per second. Mapping uses the time that remains; if it is too short, frames
    are dropped. Results are not reproducible. 0 processes all frames completely."""
    map: Path | None = None
    """Map to localise in and extend: folder of a finished run, or splat file of another tool (as
    for semsplat view), whose scale is determined. By default, a new map is started."""
    # Not "auto": the GPU path has not been validated on a GPU, so it must be requested.
    device: Literal["auto", "cpu", "cuda"] = "cpu"
    """Device for tracking and mapping. CUDA is experimental."""
    backend: Literal["auto", "native", "reference", "cuda", "gsplat"] = "auto"
    """Renderer."""
    tracking: TrackingOptions = TrackingOptions()
    placement: PlacementOptions = PlacementOptions()
    mapping: MapperOptions = MapperOptions()
    segmenter: SegmenterOptions = SegmenterOptions()
    semantics: SemanticsOptions = SemanticsOptions()
    instances: InstanceOptions = InstanceOptions()
    scene: GrowingSceneOptions = GrowingSceneOptions()
    submaps: SubmapOptions = SubmapOptions()
    loops: LoopClosureOptions = LoopClosureOptions()
    registration: RegistrationOptions = RegistrationOptions()
    scale: ScaleOptions = ScaleOptions()
    pacing: PacingOptions = PacingOptions()
    checkpoint: CheckpointOptions = CheckpointOptions()
    evaluation: EvaluationOptions = EvaluationOptions()


def load_settings(path: Path | None = None, preset: str = "default") -> RunSettings:
    """Read settings from a preset and a YAML file; keys of the file take precedence.

    Args:
        path: YAML file. Absent keys keep the values of the preset; None for the preset alone.
        preset: name of a preset (`PresetName`).

    Raises:
        SettingsError: the preset is unknown, the file is unreadable, or a key is unknown or a
            value invalid.
    """
    names = get_args(PresetName)
    if preset not in names:
        similar = difflib.get_close_matches(preset, names, n=1)
        hint = f"; did you mean {similar[0]}?" if similar else ""
        raise SettingsError(f"there is no preset '{preset}'; presets: {', '.join(names)}{hint}")
    values = _read(PRESETS / f"{preset}.yaml")
    if path is None:
        return validated(RunSettings, values, f"preset {preset}")
    path = with_home(path)
    if not path.exists() and str(path) in names:
        raise SettingsError(f"there is no file {path}; select the preset by --preset {path}")
    return validated(RunSettings, overridden(values, _read(path)), str(path))


def load_stored_settings(path: Path) -> tuple[RunSettings, tuple[str, ...]]:
    """Read the settings of a run, which another version may have written.

    Args:
        path: config.yaml of a run folder.

    Returns:
        The settings, and the keys in the file that are ignored: options that this version lacks,
        and, if there are such, values that it does not accept. These options have their defaults.

    Raises:
        SettingsError: the file is unreadable, or a value is invalid.
    """
    return accepted(RunSettings, _read(path), str(path))


def other_keys(path: Path) -> tuple[str, ...]:
    """Keys of the options that only a stored file or only this version has.

    Args:
        path: config.yaml of a run folder, in which every option of the version has a value.

    Raises:
        SettingsError: the file is unreadable, or a value is invalid.
    """
    stored, known = _keys(_read(path)), _keys(as_plain(RunSettings()))
    return (*(key for key in stored if key not in known), *(k for k in known if k not in stored))


def _keys(content: dict[str, Any], prefix: str = "") -> list[str]:
    """Dotted keys of all values in nested dictionaries."""
    keys = []
    for key, value in content.items():
        name = f"{prefix}{key}"
        keys += _keys(value, f"{name}.") if isinstance(value, dict) else [name]
    return keys


def _read(path: Path) -> dict[str, Any]:
    """The keys and values of a YAML file."""
    try:
        content = read_yaml(path)
    except OSError as error:
        raise SettingsError(f"cannot read settings {path}: {error.strerror}") from error
    except ValueError as error:
        raise SettingsError(f"{path} is not YAML: {error}") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise SettingsError(f"{path} must contain keys and values, not {type(content).__name__}")
    return content


def overridden(values: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Both nested dictionaries; the second one takes precedence."""
    merged = dict(values)
    for key, value in changes.items():
        nested = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = overridden(merged[key], value) if nested else value
    return merged


def dump_settings(settings: RunSettings) -> str:
    """All settings as YAML; identical for equal settings."""
    content: dict[str, Any] = as_plain(settings)
    return str(yaml.safe_dump(content, sort_keys=False))
