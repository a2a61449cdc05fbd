"""One HTTP exchange through the `openai` package, bounded in time and silent about the key."""

from __future__ import annotations

import asyncio
import email.utils
import time
from collections.abc import Coroutine, Mapping
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

from toolkit.errors import DependencyError, SettingsError, ToolkitError
from toolkit.taxonomy_building.language_model.chat import NoModelError

# Shorter keys are words for servers that want none ("EMPTY"); to blot such a word out of
# every answer would spoil them.
_SHORTEST_SECRET = 8
_LONGEST_EXCERPT = 200  # characters of an endpoint's own words in an error


class PassingError(ToolkitError):
    """What may be gone at the next try.

    Attributes:
        wait_s: how long the endpoint asks to wait; 0 where it does not say.
    """

    def __init__(self, message: str, wait_s: float = 0.0) -> None:
        super().__init__(message)
        self.wait_s = wait_s


class RefusedError(ToolkitError):
    """What the endpoint will refuse again.

    Attributes:
        status: of HTTP. text: what it says, whole.
    """

    def __init__(self, status: int, text: str) -> None:
        super().__init__(f"status {status}: {one_line(text)}")
        self.status = status
        self.text = text


class Transport:
    """Posts chat requests to one endpoint.

    Args:
        base_url: http or https, without credentials in it.
        api_key: sent as a bearer token; it never leaves this object otherwise, not even in
            what the endpoint sends back.

    Raises:
        SettingsError: the URL or the key cannot be one.
        DependencyError: the package `openai` is missing.
    """

    def __init__(self, base_url: str, api_key: str) -> None:
        self._base_url = _checked_url(base_url)
        self._api_key = _checked_key(api_key)
        self._openai = _openai()

    def post(self, body: Mapping[str, Any], time_s: float) -> str:
        """The response to a chat completion, its JSON as text.

        Args:
            time_s: to the last byte of it.

        Raises:
            PassingError: time-out, broken connection, status 408, 429 or 5xx.
            RefusedError: any other status of failure.
            NoModelError: what the client itself cannot do.
        """
        openai = self._openai
        try:
            return self._without_key(_finished(self._response(body, time_s)))
        except (openai.APITimeoutError, TimeoutError):
            raise PassingError(f"no answer within {time_s:.0f} s") from None
        except openai.APIConnectionError as error:
            reason = self._without_key(one_line(str(error.__cause__ or error)))
            raise PassingError(f"no connection ({reason})") from None
        except openai.APIStatusError as error:
            text = self._without_key(error.response.text)
            wait_s = _seconds(error.response.headers.get("retry-after"))
            raise status_error(error.status_code, text, wait_s) from None
        except openai.OpenAIError as error:
            raise NoModelError(self._without_key(one_line(str(error)))) from None

    async def _response(self, body: Mapping[str, Any], time_s: float) -> str:
        # The client's own time-out starts anew with every byte; ours does not.
        async with asyncio.timeout(time_s):
            async with self._openai.AsyncOpenAI(
                base_url=self._base_url,
                api_key=self._api_key or "none",  # else the client looks for one of its own
                max_retries=0,
                timeout=time_s,
            ) as client:
                response = await client.chat.completions.with_raw_response.create(**body)
                return response.http_response.text

    def _without_key(self, text: str) -> str:
        hidden = len(self._api_key) >= _SHORTEST_SECRET
        return text.replace(self._api_key, "***") if hidden else text


def status_error(status: int, text: str, wait_s: float = 0.0) -> PassingError | RefusedError:
    """The error of a response that is none."""
    refused = RefusedError(status, text)
    if status in (408, 429) or status >= 500:
        passing = PassingError(str(refused), wait_s)
        # Some servers call a parameter that they do not know an error of their own.
        return refused if "response_format" in text else passing
    return refused


def one_line(text: str) -> str:
    """The beginning of a text, fit for an error message."""
    line = " ".join(text.split())
    return line if len(line) <= _LONGEST_EXCERPT else line[: _LONGEST_EXCERPT - 3] + "..."


def _finished(work: Coroutine[Any, Any, str]) -> str:
    """The result of a coroutine, also where the caller runs an event loop (a notebook)."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return asyncio.run(work)
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, work).result()


def _seconds(retry_after: str | None) -> float:
    """Of a Retry-After header: a number or a date; 0 for nonsense."""
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
        raise SettingsError(f"--base-url {base_url!r} is no URL") from None
    if not good:
        raise SettingsError(f"--base-url {base_url!r} must be http://... or https://...")
    if parts.username or parts.password or parts.query or parts.fragment:
        # It is written to files and logs, where a key has no place.
        raise SettingsError(
            "--base-url must hold neither user, password, '?' nor '#'; "
            "the key goes into SEMSPLAT_LLM_API_KEY"
        )
    return base_url


def _checked_key(api_key: str) -> str:
    key = api_key.strip()
    if not (key.isascii() and key.isprintable()) or " " in key:
        raise SettingsError("the key in SEMSPLAT_LLM_API_KEY holds characters that no key has")
    return key


def _openai() -> ModuleType:
    try:
        import openai
    except ImportError as error:
        raise DependencyError(
            "a language model needs the package 'openai': pip install 'semsplat[language-model]'"
        ) from error
    return openai
