"""Loading of `transformers` models from local folders; nothing is downloaded."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from toolkit.base.errors import DependencyError, FormatError
from toolkit.io.guarded.documents import read_json

_REMEDY = "pip install 'semsplat[semantics]'"
_MAX_REASON_LENGTH = 200
_VOCABULARIES = ("tokenizer.json", "vocab.json", "spiece.model", "tokenizer.model", "vocab.txt")


def transformers() -> ModuleType:
    """Import transformers.

    Raises:
        DependencyError: transformers cannot be loaded.
    """
    try:
        import transformers as module
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"transformers cannot be loaded ({error}); fix it with: {_REMEDY}"
        ) from error
    return module


def load_model(auto_class: str, folder: Path, may_be_new: tuple[str, ...] = ()) -> Any:
    """Load a model with its weights in evaluation mode.

    Args:
        auto_class: name of the `transformers` auto class, such as "AutoModel".
        folder: folder with `config.json` and the weights.
        may_be_new: prefixes of parameters that may be missing in the weights.

    Raises:
        DependencyError: transformers cannot be loaded.
        FormatError: the folder is missing or does not contain such a model, or its weights are
            missing, damaged or of another model.
    """
    library = transformers()
    check_folder(folder)
    if not hasattr(library, auto_class):
        raise DependencyError(
            f"transformers {library.__version__} has no {auto_class}, which {folder} needs; update "
            f"it with: {_REMEDY} --upgrade"
        )
    with _quiet(library), _as_format_error(folder, f"no model for {auto_class}"):
        model, found = getattr(library, auto_class).from_pretrained(
            folder, local_files_only=True, output_loading_info=True, dtype=torch.float32
        )
    # transformers initialises missing parameters randomly.
    missing = sorted(name for name in found["missing_keys"] if not name.startswith(may_be_new))
    if missing:
        raise FormatError(
            f"{folder}: the weights lack {missing[0]} and {len(missing) - 1} more of the "
            f"parameters of {type(model).__name__}; set the folder of a model that was "
            "trained for this task"
        )
    return model.eval().requires_grad_(False)


def load_image_processor(folder: Path) -> Any:
    """Load the model's image processor (the variant that does not need torchvision).

    Raises:
        DependencyError: transformers cannot be loaded.
        FormatError: the folder contains no supported image processor.
    """
    library = transformers()
    check_folder(folder)
    with _quiet(library), _as_format_error(folder, "no image processor"):
        return library.AutoImageProcessor.from_pretrained(
            folder, local_files_only=True, backend="pil"
        )


def load_tokenizer(folder: Path) -> Any:
    """Load the model's tokenizer.

    Raises:
        DependencyError: transformers cannot be loaded.
        FormatError: the folder contains no supported tokenizer.
    """
    library = transformers()
    check_folder(folder)
    # transformers replaces a missing vocabulary by an empty one.
    if not any((folder / name).is_file() for name in _VOCABULARIES):
        raise FormatError(
            f"{folder} contains no tokenizer ({' or '.join(_VOCABULARIES)}); download it again, or "
            "set another folder"
        )
    with _quiet(library), _as_format_error(folder, "no tokenizer"):
        return library.AutoTokenizer.from_pretrained(folder, local_files_only=True)


def model_type(folder: Path) -> str:
    """Return the kind of model that a folder contains, as its config.json names it.

    Raises:
        FormatError: there is no config.json, or it is damaged or names no kind.
    """
    check_folder(folder)
    file = folder / "config.json"
    try:
        found = read_json(file).get("model_type")
    except (OSError, ValueError, AttributeError) as error:
        raise FormatError(f"{file} cannot be read ({error}); download it again") from error
    if not isinstance(found, str):
        raise FormatError(f"{file} names no model_type; set the folder of a transformers model")
    return found


def weights_digest(model: Any) -> str:
    """Return the SHA-256 of the weights: other copies of a model have the same, others do not."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def check_folder(folder: Path) -> None:
    """Check that a folder contains a model.

    Raises:
        FormatError: the folder has no config.json.
    """
    if not (folder / "config.json").is_file():
        raise FormatError(
            f"{folder} has no config.json; set a folder that contains a transformers model "
            "(config.json, model.safetensors, preprocessor_config.json)"
        )


def device_of(name: str) -> torch.device:
    """Return the device "cpu" or "cuda"; "auto" selects a GPU if available.

    Raises:
        DependencyError: the device is not available.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name == "cuda" and not torch.cuda.is_available():
        raise DependencyError("no CUDA device is available; choose device cpu")
    return torch.device(name)


@contextlib.contextmanager
def _quiet(library: ModuleType) -> Iterator[None]:
    """Disable the library's progress bars and tables."""
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
    """Convert exceptions of the library for invalid folders to a one-line FormatError."""
    from safetensors import SafetensorError

    faults = (OSError, ValueError, KeyError, RuntimeError, AttributeError, SafetensorError)
    try:
        yield
    except ImportError as error:
        raise DependencyError(f"{folder} needs another package: {_short(error)}") from error
    except faults as error:
        raise FormatError(
            f"{folder} contains {what}: {_short(error)}; download it again, or set another folder"
        ) from error


def _short(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= _MAX_REASON_LENGTH else text[:_MAX_REASON_LENGTH] + " ..."
