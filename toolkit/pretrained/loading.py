"""Models of the `transformers` library from a folder on disk: nothing is ever downloaded."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from toolkit.errors import DependencyError, FormatError

_MEND = "pip install 'semsplat[semantics]'"
_LONGEST_REASON = 200


def transformers() -> ModuleType:
    """The transformers module.

    Raises:
        DependencyError: it cannot be loaded.
    """
    try:
        import transformers as module
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"transformers cannot be loaded ({error}); fix it with: {_MEND}"
        ) from error
    return module


def load_model(auto_class: str, folder: Path, may_be_new: tuple[str, ...] = ()) -> Any:
    """A model with its weights, ready to infer.

    Args:
        auto_class: name of the class of `transformers` that reads the folder.
        folder: holds `config.json` and the weights.
        may_be_new: prefixes of parameters that the weights may lack.

    Raises:
        DependencyError: transformers cannot be loaded.
        FormatError: the folder is missing, is of another kind, or its weights are missing,
            damaged or of another model.
    """
    library = transformers()
    check_folder(folder)
    with _quiet(library), _as_format_error(folder, f"no model for {auto_class}"):
        model, found = getattr(library, auto_class).from_pretrained(
            folder, local_files_only=True, output_loading_info=True, dtype=torch.float32
        )
    # transformers fills what the weights lack with random numbers.
    missing = sorted(name for name in found["missing_keys"] if not name.startswith(may_be_new))
    if missing:
        raise FormatError(
            f"{folder}: the weights lack {missing[0]} and {len(missing) - 1} more of the "
            f"parameters of {type(model).__name__}; give the folder of a model that was "
            "trained for this"
        )
    return model.eval().requires_grad_(False)


def load_image_processor(folder: Path) -> Any:
    """The model's own preparation of images, by the variant that works without torchvision.

    Raises:
        DependencyError: transformers cannot be loaded.
        FormatError: the folder has none, or not of a known kind.
    """
    library = transformers()
    check_folder(folder)
    with _quiet(library), _as_format_error(folder, "no image processor"):
        return library.AutoImageProcessor.from_pretrained(
            folder, local_files_only=True, backend="pil"
        )


def check_folder(folder: Path) -> None:
    """See that a folder looks like a model's.

    Raises:
        FormatError: it does not.
    """
    if not (folder / "config.json").is_file():
        raise FormatError(
            f"{folder} has no config.json; give a folder that holds a transformers model "
            "(config.json, model.safetensors, preprocessor_config.json)"
        )


def device_of(name: str) -> torch.device:
    """The device called "cpu" or "cuda"; "auto" is a GPU where there is one.

    Raises:
        DependencyError: there is no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name == "cuda" and not torch.cuda.is_available():
        raise DependencyError("no CUDA device is there; choose device cpu")
    return torch.device(name)


@contextlib.contextmanager
def _quiet(library: ModuleType) -> Iterator[None]:
    """Without the library's own bars and tables: a fault becomes our one line."""
    log = library.utils.logging
    verbosity, bars = log.get_verbosity(), log.is_progress_bar_enabled()
    log.set_verbosity_error()
    log.disable_progress_bar()
    try:
        yield
    finally:
        log.set_verbosity(verbosity)
        if bars:
            log.enable_progress_bar()


@contextlib.contextmanager
def _as_format_error(folder: Path, what: str) -> Iterator[None]:
    """Turn what the library raises over a wrong folder into one line."""
    from safetensors import SafetensorError

    faults = (OSError, ValueError, KeyError, RuntimeError, AttributeError, SafetensorError)
    try:
        yield
    except ImportError as error:
        raise DependencyError(f"{folder} needs another package: {_short(error)}") from error
    except faults as error:
        raise FormatError(
            f"{folder} holds {what}: {_short(error)}; download it again, or give another"
        ) from error


def _short(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= _LONGEST_REASON else text[:_LONGEST_REASON] + " ..."
