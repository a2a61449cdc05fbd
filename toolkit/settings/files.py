"""Settings from and to YAML, with errors that name the key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from toolkit.errors import SettingsError
from toolkit.settings.run import RunSettings

# Settings of the papers' systems, for comparison.
PRESETS = Path(__file__).with_name("presets")


def load(path: Path) -> RunSettings:
    """Read settings from a YAML file or a shipped preset; missing keys keep their defaults.

    Args:
        path: of the file, or the name of a preset, which a file of that name takes precedence over.

    Raises:
        SettingsError: the file is unreadable, or a key is unknown or out of range.
    """
    if not path.exists() and str(path) in preset_names():
        path = PRESETS / f"{path}.yaml"
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsError(f"cannot read settings {path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path} is not YAML: {' '.join(str(error).split())}") from error
    if content is None:
        content = {}
    if not isinstance(content, dict):
        raise SettingsError(f"{path} must hold keys and values, not a {type(content).__name__}")
    return parse(content, str(path))


def preset_names() -> list[str]:
    """Names of the shipped presets."""
    return sorted(path.stem for path in PRESETS.glob("*.yaml"))


def parse(content: dict[str, Any], origin: str) -> RunSettings:
    """Settings of nested dictionaries.

    Raises:
        SettingsError: a key is unknown or a value out of range; one line for the first fault.
    """
    try:
        return RunSettings.model_validate(content)
    except ValidationError as error:
        raise SettingsError(f"{origin}: {first_fault(error)}") from error


def first_fault(error: ValidationError) -> str:
    """The first fault of a validation in one line: key, what is wrong, how many more."""
    faults = error.errors()
    fault = faults[0]
    key = ".".join(str(part) for part in fault["loc"])
    if fault["type"] == "extra_forbidden":
        text = f"unknown setting '{key}'; `semsplat run --help` lists all"
    else:
        text = (
            f"setting '{key}': {fault['msg'][0].lower()}{fault['msg'][1:]}, got {fault['input']!r}"
        )
    return text + (f" (and {len(faults) - 1} more)" if len(faults) > 1 else "")


def dump(settings: RunSettings) -> str:
    """YAML of all settings, byte-identical for equal settings."""
    return str(yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False))
