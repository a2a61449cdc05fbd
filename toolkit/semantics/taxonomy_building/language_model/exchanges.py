"""Disk cache, recording and replay of exchanges with a language model."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from toolkit.base.errors import FormatError, SettingsError
from toolkit.io.atomic import cannot_write, write_bytes
from toolkit.io.guarded.documents import read_json
from toolkit.semantics.taxonomy_building.language_model.chat import (
    ChatAnswer,
    ChatModel,
    ChatRequest,
    Ending,
    ModelIdentity,
)

logger = logging.getLogger(__name__)

_FORMAT = "semsplat language model exchanges 1"


class CachedModel:
    """Caches the answers of a model on disk.

    Args:
        model: the model.
        folder: folder with one file per answer, named by the hash of model and request; it is
            created if it does not exist.

    Raises:
        RunFolderError: the folder cannot be created.
    """

    def __init__(self, model: ChatModel, folder: Path) -> None:
        self._model = model
        self._folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(folder, error) from error

    @property
    def identity(self) -> ModelIdentity:
        return self._model.identity

    def complete(self, request: ChatRequest) -> ChatAnswer:
        file = self._folder / f"{_key(self.identity, request)}.json"
        if file.exists():
            try:
                return _answer(read_json(file, any_characters=True)["answer"])
            except (OSError, ValueError, KeyError, TypeError):
                logger.warning("Cache file %s is damaged; sending the request again.", file)
        answer = self._model.complete(request)
        write_bytes(file, _as_json(_exchange(request, answer) | _identity_values(self.identity)))
        return answer


class RecordingModel:
    """Writes every exchange with a model to a file, from which `ReplayedModel` answers."""

    def __init__(self, model: ChatModel, path: Path) -> None:
        self._model = model
        self._path = path
        self._exchanges: list[dict[str, Any]] = []
        self._write()  # fails before the first request if the path is not writable

    @property
    def identity(self) -> ModelIdentity:
        return self._model.identity

    def complete(self, request: ChatRequest) -> ChatAnswer:
        answer = self._model.complete(request)
        self._exchanges.append(_exchange(request, answer))
        self._write()
        return answer

    def _write(self) -> None:
        header = {"format": _FORMAT} | _identity_values(self.identity)
        write_bytes(self._path, _as_json(header | {"exchanges": self._exchanges}))


class ReplayedModel:
    """Replays recorded answers; requires neither network nor key.

    Raises:
        FormatError: the file is missing or not a recording.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            record = read_json(path, any_characters=True)
            if record["format"] != _FORMAT:
                raise ValueError(f"the format is {record['format']!r}, not {_FORMAT!r}")
            self._identity = ModelIdentity(record["base_url"], record["model"])
            self._answers = {
                _hash(each["request"]): _answer(each["answer"]) for each in record["exchanges"]
            }
        except OSError as error:
            raise FormatError(f"{path}: cannot be read ({error.strerror})") from error
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise FormatError(
                f"{path} is not a recording of a language model ({error}); create one with --record"
            ) from error

    @property
    def identity(self) -> ModelIdentity:
        return self._identity

    def complete(self, request: ChatRequest) -> ChatAnswer:
        """Return the recorded answer.

        Raises:
            SettingsError: the request is not in the recording.
        """
        answer = self._answers.get(_hash(request.to_json()))
        if answer is None:
            raise SettingsError(
                f"{self._path} has no answer to one of the {self._identity.model} questions: it "
                "was recorded with other classes, options, seed or version; record it again"
            )
        return answer


def _key(identity: ModelIdentity, request: ChatRequest) -> str:
    return _hash(_identity_values(identity) | {"request": request.to_json()})


def _hash(values: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _identity_values(identity: ModelIdentity) -> dict[str, Any]:
    return {"base_url": identity.base_url, "model": identity.model}


def _exchange(request: ChatRequest, answer: ChatAnswer) -> dict[str, Any]:
    return {
        "request": request.to_json(),
        "answer": {"text": answer.text, "ending": answer.ending},
    }


def _answer(values: Mapping[str, Any]) -> ChatAnswer:
    text, ending = values["text"], values["ending"]
    if not isinstance(text, str) or ending not in get_args(Ending):
        raise ValueError("an answer has no text or ending")
    return ChatAnswer(text, ending)


def _as_json(values: Mapping[str, Any]) -> bytes:
    # ASCII: an answer can contain unpaired surrogates, which cannot be encoded as UTF-8.
    return (json.dumps(values, indent=1) + "\n").encode("ascii")
