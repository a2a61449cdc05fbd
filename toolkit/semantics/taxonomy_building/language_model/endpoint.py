"""A chat model with an OpenAI-compatible endpoint, with retries and time limits."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from toolkit.base.errors import SettingsError
from toolkit.io.guarded.documents import parse_json
from toolkit.semantics.taxonomy_building.language_model.chat import (
    ChatAnswer,
    ChatRequest,
    ModelIdentity,
    NoModelError,
)
from toolkit.semantics.taxonomy_building.language_model.transport import (
    RefusedError,
    TransientError,
    Transport,
    one_line,
    status_error,
)

logger = logging.getLogger(__name__)

# Error messages of endpoints for requests that exceed the context length.
_TOO_LONG = re.compile(r"context.?(length|size|window)|maximum context|too (many|long|large)", re.I)
# Response formats, strictest first. Not all endpoints support all of them.
_FORMATS = ("json_schema", "json_object", "text")

URL_VARIABLE = "SEMSPLAT_LLM_BASE_URL"
MODEL_VARIABLE = "SEMSPLAT_LLM_MODEL"
KEY_VARIABLE = "SEMSPLAT_LLM_API_KEY"


@dataclass(frozen=True)
class RetryOptions:
    """Time limits and retries of requests.

    Attributes:
        request_timeout_s: time limit of one request in seconds.
        total_timeout_s: time limit of all attempts, including the delays between them, in seconds.
        max_attempts: maximum number of attempts.
        first_delay_s: maximum delay before the second attempt; it doubles with every attempt.
        max_delay_s: maximum delay between attempts, unless the endpoint requests more.
    """

    request_timeout_s: float = 120.0
    total_timeout_s: float = 600.0
    max_attempts: int = 6
    first_delay_s: float = 1.0
    max_delay_s: float = 60.0


class Endpoint:
    """A chat model on the network.

    Requests are retried after transient errors only: status 408, 429 and 5xx, timeouts and
    connection errors. Delays grow exponentially with jitter, or follow the endpoint's request.
    Structured output, temperature and seed are omitted once the endpoint has rejected them.

    Args:
        identity: the base URL, which often ends in /v1, and the model's name.
        api_key: sent as a bearer token; empty for endpoints without authentication.
        generator: random generator of the jitter.
        retries: time limits and retries.
        sleep: function that waits for a number of seconds.

    Raises:
        SettingsError: the URL or the key is invalid.
        DependencyError: the package `openai` is missing.
    """

    def __init__(
        self,
        identity: ModelIdentity,
        api_key: str,
        generator: np.random.Generator,
        retries: RetryOptions | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._identity = identity
        self._transport = Transport(identity.base_url, api_key)
        self._generator = generator
        self._retries = retries or RetryOptions()
        self._sleep = sleep
        self._unsupported: set[str] = set()
        self._format = 0

    @property
    def identity(self) -> ModelIdentity:
        return self._identity

    def complete(self, request: ChatRequest) -> ChatAnswer:
        """Return the answer of the model.

        Raises:
            NoModelError: the endpoint cannot be reached, rejects the request, or times out.
        """
        left_s = self._retries.total_timeout_s
        attempts = 0
        while True:
            attempts += 1
            start = time.monotonic()
            try:
                return self._adapting(request, min(self._retries.request_timeout_s, left_s))
            except TransientError as error:
                wait_s = max(self._wait_s(attempts), error.wait_s)
                left_s -= time.monotonic() - start + wait_s
                if attempts == self._retries.max_attempts or left_s <= 0.0:
                    raise self._gave_up(error, attempts) from None
                logger.info("%s: %s; retrying in %.1f s.", self._identity, error, wait_s)
            self._sleep(wait_s)

    def _wait_s(self, attempts: int) -> float:
        doubled = self._retries.first_delay_s * 2.0 ** (attempts - 1)
        return min(doubled, self._retries.max_delay_s) * self._generator.uniform(0.5, 1.0)

    def _gave_up(self, error: TransientError, attempts: int) -> NoModelError:
        asked = f", and it asks to wait {error.wait_s:.0f} s" if error.wait_s else ""
        return NoModelError(
            f"no answer from {self._identity} in {attempts} attempts: {error}{asked}; check "
            "--base-url and the network, or use --grouper rules"
        )

    def _adapting(self, request: ChatRequest, time_s: float) -> ChatAnswer:
        """Return the answer; omit the parameters that the endpoint does not support."""
        while True:
            try:
                return self._answer(self._transport.post(self._body(request), time_s))
            except RefusedError as refused:
                if _TOO_LONG.search(refused.text):
                    return ChatAnswer("", "length")
                if not self._adapts(refused):
                    raise self._final(refused) from None

    def _adapts(self, refused: RefusedError) -> bool:
        """Disable the rejected parameter; return whether a retry without it is possible."""
        names_format = "response_format" in refused.text
        if refused.status not in (400, 422) and not names_format:
            return False
        for parameter in ("temperature", "seed"):
            named = re.search(rf"\b{parameter}\b", refused.text) and not names_format
            if named and parameter not in self._unsupported:
                logger.info("%s does not support the parameter %s.", self._identity, parameter)
                self._unsupported.add(parameter)
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
        for parameter in {"temperature", "seed"} - self._unsupported:
            body[parameter] = getattr(request, parameter)
        kind = _FORMATS[self._format]
        if kind != "text":
            body["response_format"] = {"type": kind}
        if kind == "json_schema":
            schema = {"name": "groups", "strict": True, "schema": request.schema}
            body["response_format"]["json_schema"] = schema
        return body

    def _answer(self, body: str) -> ChatAnswer:
        """Parse a response."""
        try:
            values = parse_json(body, any_characters=True)
            if values.get("error"):
                code = values["error"].get("code")
                raise status_error(code if isinstance(code, int) else 400, body)
            choice = values["choices"][0]
            message = choice["message"]
            text = _text(message.get("content"))
            refusal = message.get("refusal") or choice.get("finish_reason") == "content_filter"
        except (ValueError, RecursionError, AttributeError, LookupError, TypeError):
            raise NoModelError(
                f"{self._identity} did not send a chat completion but: {one_line(body)}; check "
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
    """Build the endpoint from arguments and environment variables.

    Args:
        base_url: URL of the endpoint; None reads SEMSPLAT_LLM_BASE_URL.
        model: name of the model; None reads SEMSPLAT_LLM_MODEL.
        generator: random generator of the jitter.
        environment: environment variables; the key is read from SEMSPLAT_LLM_API_KEY only.

    Raises:
        SettingsError: URL or model are missing, or URL or key are invalid.
        DependencyError: the package `openai` is missing.
    """
    base_url = base_url or environment.get(URL_VARIABLE)
    model = model or environment.get(MODEL_VARIABLE)
    if not base_url:
        raise SettingsError(
            f"a language model needs --base-url or {URL_VARIABLE}, such as http://localhost:11434/v1"
        )
    if not model:
        raise SettingsError(
            f"a language model needs --model or {MODEL_VARIABLE}: its name at the endpoint"
        )
    key = environment.get(KEY_VARIABLE, "")
    return Endpoint(ModelIdentity(base_url, model), key, generator)


def _text(content: object) -> str:
    """Return the text of a message, whose content can be a list of parts."""
    if isinstance(content, list):
        return "".join(part["text"] for part in content if "text" in part)
    return content if isinstance(content, str) else ""
