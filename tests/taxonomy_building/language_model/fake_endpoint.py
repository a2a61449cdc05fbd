"""Behaviours of a chat server on this machine that misbehaves as real ones do."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

from chat_server import (
    Behaviour,
    Groups,
    Response,
    as_text,
    clusters_of,
    fails,
    items_of,
)

KEY = "sk-a-very-secret-key"


def right_groups(request: dict[str, Any]) -> Groups:
    """A sensible answer: by the names that are given, or by the length of the name."""
    content = request["messages"][1]["content"]
    given = re.search(r"no other names for groups than (\[.*\])\.", content)
    names = json.loads(given[1]) if given else ["short things", "long things"]
    groups: Groups = {name: [] for name in names}
    for item in items_of(request):
        groups[names[len(item) % len(names)]].append(item)
    return groups


def honest(request: dict[str, Any]) -> Response:
    """Sorts, or names clusters, as it was asked to."""
    clusters = clusters_of(request)
    if clusters:
        named = [{"number": n + 1, "name": f"shape {'abcdefgh'[n]}"} for n in range(len(clusters))]
        return Response(json.dumps({"groups": named}))
    return Response(as_text(right_groups(request)))


def changed(change: Callable[[Groups], Groups]) -> Behaviour:
    """An honest answer with something done to its groups."""

    def behave(request: dict[str, Any]) -> Response:
        return Response(as_text(change(right_groups(request))))

    return behave


def says(text: str) -> Behaviour:
    """The same words, whatever the question."""
    return lambda request: Response(text)


def knows_no(*parameters: str) -> Behaviour:
    """Refuses requests that hold a parameter."""

    def behave(request: dict[str, Any]) -> Response:
        for parameter in parameters:
            name, _, value = parameter.partition("=")
            sent = request.get(name)
            if sent is not None and (not value or sent.get("type") == value):
                return fails(400, f"Unsupported parameter: '{name}'")(request)
        return honest(request)

    return behave
