"""Malformed input as a user sees it: a process with one line on stderr and status 2."""

from __future__ import annotations

import pytest
from folder_content import content_of
from programs import semsplat

COMMANDS = [
    "run --dataset.kind folder --dataset.path data --out out --max-frames 0",
    "run --dataset.kind folder --dataset.path data --out out --hold-out 1",
    "run --dataset.kind folder --dataset.path data --out out --seed -1",
    "run --dataset.kind folder --dataset.path data --out out --image-size 100000 100000",
    "run --config nothing.yaml --out out",
    "doctor extra",
    "render run --image-size 100000 100000",
    "query run unicorn",
    "export nothing --to out.ply",
    "no-such-job",
]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_process_prints_one_line(place, command):
    before = content_of(place)
    done = semsplat(*command.split(), cwd=place)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert done.stderr.startswith("semsplat: error: ")
    assert content_of(place) == before
