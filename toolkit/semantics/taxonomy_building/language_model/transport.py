"""HTTP requests through the `openai` package, with a time limit and without leaking the key."""

from __future__ import annotations

import asyncio
import email.utils
import sys
import time
from collections.abc import AsyncIterator, Coroutine, Mapping
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

from toolkit.base.errors import DependencyError, SettingsError, ToolkitError
from toolkit.base.printable import printable
from toolkit.io.guarded.content import size_text
from toolkit.semantics.taxonomy_building.language_model.chat import NoModelError

# Shorter keys are placeholders for servers without authentication ("EMPTY") and are not redacted,
# because they can occur in answers.
_MIN_SECRET_LENGTH = 8
_MAX_EXCERPT_LENGTH = 200  # maximum number of characters of a response in an error
# The longest answers of models have a few hundred kilobytes.
_MAX_RESPONSE_BYTES = 2**24


class TransientError(ToolkitError):
    """A transient error; a retry may succeed.

    Attributes:
        wait_s: time to wait requested by the endpoint in seconds; 0 if unspecified.
    """

    def __init__(self, message: str, wait_s: float = 0.0) -> None:
        super().__init__(message)
        self.wait_s = wait_s


class RefusedError(ToolkitError):
    """A permanent error; a retry of the same request fails.

    Attributes:
        status: HTTP status.
        text: complete text of the response.
    """

    def __init__(self, status: int, text: str) -> None:
        super().__init__(f"status {status}: {one_line(text)}")
        self.status = status
        self.text = text


class TooLongError(ToolkitError):
    """A response is too long, or compressed, so that its length is unknown."""


class Transport:
    """Posts chat requests to one endpoint.

    Args:
        base_url: http or https URL without credentials.
        api_key: sent as a bearer token; it is redacted in responses and errors.

    Raises:
        SettingsError: the URL or the key is invalid.
        DependencyError: the package `openai` is missing.
    """

    def __init__(self, base_url: str, api_key: str) -> None:
        self._base_url = _checked_url(base_url)
        self._api_key = _checked_key(api_key)
        self._openai = _openai()

    def post(self, body: Mapping[str, Any], time_s: float) -> str:
        """Return the JSON text of the response to a chat completion request.

        Args:
            body: the request.
            time_s: time limit of the complete response in seconds.

        Raises:
            TransientError: timeout, connection error, status 408, 429 or 5xx.
            RefusedError: any other error status.
            NoModelError: any other error of the client.
        """
        openai = self._openai
        try:
            return self._without_key(_finished(self._response(body, time_s)))
        except (openai.APITimeoutError, TimeoutError):
            raise TransientError(f"no answer within {time_s:.0f} s") from None
        except TooLongError as error:
            raise NoModelError(str(error)) from None
        except openai.APIConnectionError as error:
            if isinstance(error.__cause__, TooLongError):
                raise NoModelError(str(error.__cause__)) from None
            reason = self._without_key(one_line(str(error.__cause__ or error)))
            raise TransientError(f"no connection ({reason})") from None
        except openai.APIStatusError as error:
            text = self._without_key(error.response.text)
            wait_s = _seconds(error.response.headers.get("retry-after"))
            raise status_error(error.status_code, text, wait_s) from None
        except openai.OpenAIError as error:
            raise NoModelError(self._without_key(one_line(str(error)))) from None

    async def _response(self, body: Mapping[str, Any], time_s: float) -> str:
        # The client's timeout restarts with every received byte; this one does not.
        async with asyncio.timeout(time_s):
            async with self._openai.AsyncOpenAI(
                base_url=self._base_url,
                api_key=self._api_key or "none",  # otherwise the client reads OPENAI_API_KEY
                max_retries=0,
                timeout=time_s,
                default_headers={"Accept-Encoding": "identity"},
                http_client=self._openai.DefaultAsyncHttpxClient(
                    event_hooks={"response": [self._limit]}
                ),
            ) as client:
                response = await client.chat.completions.with_raw_response.create(**body)
                return response.http_response.text

    async def _limit(self, response: Any) -> None:
        """Stop reading a response of httpx at the limit; called before its content is read."""
        encoding = response.headers.get("content-encoding", "identity")
        if encoding != "identity":
            raise TooLongError(
                f"{self._base_url} compresses its answers by {one_line(encoding)}, although it "
                "must not; switch compression off there"
            )
        response.stream = _limited(response, self._base_url)

    def _without_key(self, text: str) -> str:
        hidden = len(self._api_key) >= _MIN_SECRET_LENGTH
        return text.replace(self._api_key, "***") if hidden else text


def _limited(response: Any, base_url: str) -> Any:
    """The stream of a response, which ends with an error at the limit."""
    # httpx, or httpx2 of recent versions of openai, which accept streams of their own class only.
    library = sys.modules[type(response).__module__.partition(".")[0]]
    stream = response.stream

    class Limited(library.AsyncByteStream):  # type: ignore[name-defined]
        async def __aiter__(self) -> AsyncIterator[bytes]:
            count = 0
            async for part in stream:
                count += len(part)
                if count > _MAX_RESPONSE_BYTES:
                    raise TooLongError(
                        f"{base_url} sent more than {size_text(_MAX_RESPONSE_BYTES)} as an answer; "
                        "check --base-url"
                    )
                yield part

        async def aclose(self) -> None:
            await stream.aclose()

    return Limited()


def status_error(status: int, text: str, wait_s: float = 0.0) -> TransientError | RefusedError:
    """Return the error that corresponds to an HTTP status."""
    refused = RefusedError(status, text)
    if status in (408, 429) or status >= 500:
        passing = TransientError(str(refused), wait_s)
        # Some servers report an unknown parameter as an internal error.
        return refused if "response_format" in text else passing
    return refused


def one_line(text: str) -> str:
    """Return the beginning of a text on one line, for an error message."""
    line = printable(" ".join(text[: 100 * _MAX_EXCERPT_LENGTH].split()))
    return line if len(line) <= _MAX_EXCERPT_LENGTH else line[: _MAX_EXCERPT_LENGTH - 3] + "..."


def _finished(work: Coroutine[Any, Any, str]) -> str:
    """Run a coroutine, also if the caller runs an event loop (notebooks)."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return asyncio.run(work)
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, work).result()


def _seconds(retry_after: str | None) -> float:
    """Parse a Retry-After header with a number or a date; return 0 if it is invalid."""
    if not retry_after:
        return 0.0
    try:
        wait_s = float(retry_after)
    except ValueError:
        try:
            wait_s = email.utils.parsedate_to_datetime(retry_after).timestamp() - time.time()
        except (ValueError, OverflowError):
            return 0.0
    return wait_s if wait_s > 0.0 else 0.0  # also for NaN


def _checked_url(base_url: str) -> str:
    try:
        parts = urlsplit(base_url)
        good = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        raise SettingsError(f"--base-url {base_url!r} is not a URL") from None
    if not good:
        raise SettingsError(f"--base-url {base_url!r} must be http://... or https://...")
    if parts.username or parts.password or parts.query or parts.fragment:
        # The URL is written to files and logs, which must not contain a key.
        raise SettingsError(
            "--base-url must not contain user, password, '?' or '#'; "
            "set the key in SEMSPLAT_LLM_API_KEY"
        )
    return base_url


def _checked_key(api_key: str) -> str:
    key = api_key.strip()
    if not (key.isascii() and key.isprintable()) or " " in key:
        raise SettingsError("the key in SEMSPLAT_LLM_API_KEY contains invalid characters")
    return key


def _openai() -> ModuleType:
    try:
        import openai
    except ImportError as error:
        raise DependencyError(
            "a language model needs the package 'openai': pip install 'semsplat[language-model]'"
        ) from error
    return openai
