"""A chat model behind an OpenAI-compatible endpoint: patient, but not for ever."""

from __future__ import annotations

import json
import logging
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from toolkit.errors import SettingsError
from toolkit.taxonomy_building.language_model.chat import (
    ChatAnswer,
    ChatRequest,
    ModelIdentity,
    NoModelError,
)
from toolkit.taxonomy_building.language_model.transport import (
    PassingError,
    RefusedError,
    Transport,
    one_line,
    status_error,
)

logger = logging.getLogger(__name__)

# How endpoints word that question and answer do not fit into the model.
_TOO_LONG = re.compile(r"context.?(length|size|window)|maximum context|too (many|long|large)", re.I)
# Ways to ask for JSON, the strictest first. Each of them some endpoints refuse.
_FORMATS = ("json_schema", "json_object", "text")

URL_VARIABLE = "SEMSPLAT_LLM_BASE_URL"
MODEL_VARIABLE = "SEMSPLAT_LLM_MODEL"
KEY_VARIABLE = "SEMSPLAT_LLM_API_KEY"


@dataclass(frozen=True)
class Patience:
    """How long to wait for an answer.

    Attributes:
        request_s: for one try, to the last byte of its answer.
        total_s: for all tries and the waits between them.
        tries: at most.
        first_wait_s: before the second try at most; the wait doubles each time.
        longest_wait_s: between tries, unless the endpoint asks for more.
    """

    request_s: float = 120.0
    total_s: float = 600.0
    tries: int = 6
    first_wait_s: float = 1.0
    longest_wait_s: float = 60.0


class Endpoint:
    """A chat model on the network.

    Only what may pass is tried again: status 408, 429 and 5xx, time-outs and broken
    connections, after growing, jittered waits or as long as the endpoint asks. What it does
    not know of structured output, temperature and seed it is not sent again.

    Args:
        identity: the base URL, which often ends in /v1, and the model's name there.
        api_key: sent as a bearer token; empty where none is needed.
        generator: of the jitter.
        patience: how long to wait, and how often.
        sleep: waits so many seconds.

    Raises:
        SettingsError: the URL or the key cannot be one.
        DependencyError: the package `openai` is missing.
    """

    def __init__(
        self,
        identity: ModelIdentity,
        api_key: str,
        generator: np.random.Generator,
        patience: Patience | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._identity = identity
        self._transport = Transport(identity.base_url, api_key)
        self._generator = generator
        self._patience = patience or Patience()
        self._sleep = sleep
        self._unknown: set[str] = set()
        self._format = 0

    @property
    def identity(self) -> ModelIdentity:
        return self._identity

    def complete(self, request: ChatRequest) -> ChatAnswer:
        """The model's answer.

        Raises:
            NoModelError: the endpoint cannot be reached, refuses, or takes too long.
        """
        left_s = self._patience.total_s
        tries = 0
        while True:
            tries += 1
            start = time.monotonic()
            try:
                return self._adapting(request, min(self._patience.request_s, left_s))
            except PassingError as trouble:
                wait_s = max(self._wait_s(tries), trouble.wait_s)
                left_s -= time.monotonic() - start + wait_s
                if tries == self._patience.tries or left_s <= 0.0:
                    raise self._gave_up(trouble, tries) from None
                logger.info("%s: %s; trying again in %.1f s", self._identity, trouble, wait_s)
            self._sleep(wait_s)

    def _wait_s(self, tries: int) -> float:
        doubled = self._patience.first_wait_s * 2.0 ** (tries - 1)
        return min(doubled, self._patience.longest_wait_s) * self._generator.uniform(0.5, 1.0)

    def _gave_up(self, trouble: PassingError, tries: int) -> NoModelError:
        asked = f", and it asks to wait {trouble.wait_s:.0f} s" if trouble.wait_s else ""
        return NoModelError(
            f"no answer from {self._identity} in {tries} tries: {trouble}{asked}; check "
            "--base-url and the network, or use --grouper rules"
        )

    def _adapting(self, request: ChatRequest, time_s: float) -> ChatAnswer:
        """The answer, without the parameters that the endpoint turns out not to know."""
        while True:
            try:
                return self._answer(self._transport.post(self._body(request), time_s))
            except RefusedError as refused:
                if _TOO_LONG.search(refused.text):
                    return ChatAnswer("", "length")
                if not self._adapts(refused):
                    raise self._final(refused) from None

    def _adapts(self, refused: RefusedError) -> bool:
        """Whether there is something to leave out next time, which it notes."""
        names_format = "response_format" in refused.text
        if refused.status not in (400, 422) and not names_format:
            return False
        for parameter in ("temperature", "seed"):
            named = re.search(rf"\b{parameter}\b", refused.text) and not names_format
            if named and parameter not in self._unknown:
                logger.info("%s does not take %s", self._identity, parameter)
                self._unknown.add(parameter)
                return True
        self._format += 1
        return self._format < len(_FORMATS)

    def _final(self, refused: RefusedError) -> NoModelError:
        key = "check the key in SEMSPLAT_LLM_API_KEY"
        address = "check --model, and whether --base-url must end in /v1"
        hint = {401: key, 403: key, 404: address, 405: address}.get(refused.status)
        return NoModelError(
            f"{self._identity} refused, {refused}; {hint or 'or use --grouper rules'}"
        )

    def _body(self, request: ChatRequest) -> dict[str, Any]:
        body: dict[str, Any] = {
            "model": self._identity.model,
            "messages": [
                {"role": "system", "content": request.system},
                {"role": "user", "content": request.user},
            ],
        }
        for parameter in {"temperature", "seed"} - self._unknown:
            body[parameter] = getattr(request, parameter)
        kind = _FORMATS[self._format]
        if kind != "text":
            body["response_format"] = {"type": kind}
        if kind == "json_schema":
            schema = {"name": "groups", "strict": True, "schema": request.schema}
            body["response_format"]["json_schema"] = schema
        return body

    def _answer(self, body: str) -> ChatAnswer:
        """Out of a response that may be anything.

        Raises:
            PassingError, RefusedError: it is an error, sent as a success.
            NoModelError: it is no chat completion at all.
        """
        try:
            values = json.loads(body)
            if values.get("error"):
                code = values["error"].get("code")
                raise status_error(code if isinstance(code, int) else 400, body)
            choice = values["choices"][0]
            message = choice["message"]
            text = _text(message.get("content"))
            refusal = message.get("refusal") or choice.get("finish_reason") == "content_filter"
        except (ValueError, RecursionError, AttributeError, LookupError, TypeError):
            raise NoModelError(
                f"{self._identity} sent no chat completion but: {one_line(body)}; check "
                "whether --base-url must end in /v1"
            ) from None
        if refusal and not text:
            return ChatAnswer("", "refused")
        return ChatAnswer(text, "length" if choice.get("finish_reason") == "length" else "stop")


def endpoint_from_environment(
    base_url: str | None,
    model: str | None,
    generator: np.random.Generator,
    environment: Mapping[str, str],
) -> Endpoint:
    """The endpoint that is given, or else named by the environment; the key by that alone.

    Args:
        environment: of the process; SEMSPLAT_LLM_BASE_URL, _MODEL and _API_KEY are read.

    Raises:
        SettingsError: URL or model are given nowhere, or URL or key cannot be one.
        DependencyError: the package `openai` is missing.
    """
    base_url = base_url or environment.get(URL_VARIABLE)
    model = model or environment.get(MODEL_VARIABLE)
    if not base_url:
        raise SettingsError(
            f"a language model needs --base-url or {URL_VARIABLE}, such as http://localhost:11434/v1"
        )
    if not model:
        raise SettingsError(f"a language model needs --model or {MODEL_VARIABLE}: its name there")
    key = environment.get(KEY_VARIABLE, "")
    return Endpoint(ModelIdentity(base_url, model), key, generator)


def _text(content: object) -> str:
    """Of a message, whose content may come in parts."""
    if isinstance(content, list):
        return "".join(part["text"] for part in content if "text" in part)
    return content if isinstance(content, str) else ""
