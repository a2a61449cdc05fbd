"""Which runs the tables of the papers need: plans by name."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from benchmarks.papers.runs import Group, Place

Values = dict[str, Any]

# The steps of office0's views (9 cm, 6 degrees) are beyond the reach of 40 steps of Adam.
_OFFICE = Place("office0", (160, 90), 20, options={"poses": "given"})
_SYNTHETIC = {"office0": _OFFICE, "room": Place("room", (160, 120), 30)}
REAL_FRAMES = 40
REAL = {
    "redkitchen": Place("redkitchen", (160, 120), REAL_FRAMES),
    "fr1_rpy": Place("fr1_rpy", (160, 120), REAL_FRAMES),
    "hololens": Place("hololens", (180, 120), REAL_FRAMES),
}
_RINGS = {f"ring-{seed}": Place("ring-small", (160, 120), None, seed) for seed in range(5)}
LONG = {
    "redkitchen": Place("redkitchen", (160, 120), 120),
    "fr1_rpy": Place("fr1_rpy", (160, 120), 120),
    "hololens": Place("hololens", (180, 120), 120),
}


def _options(**options: Any) -> Values:
    return {"options": options}


def _preset(name: str, **options: Any) -> Values:
    return {"preset": name, "options": options}


def _coded(kind: str) -> Values:
    return {"semantics": {"code": {"kind": kind}}}


_NO_LOOPS: Values = {"loops": {"use": False}}
_NO_REFINEMENT: Values = {"mapping": {"final_iterations": 0}}
_GAUSEM_NO_REFINEMENT: Values = {"mapping": {"final_iterations": 0, "final_anchors": False}}
_GIVEN: Values = {"poses": "given"}
_TESTED: Values = {
    "loops": {"verify": True, "pose_graph": {"confidence": 0.999, "kernel": "cauchy"}}
}
_NETWORK: Values = {"segmenter": {"kind": "indoor"}}
_CELLS: Values = {"seeding": {"choice": "cells", "max_cell": 1}}
_MOTION: Values = {"submaps": {"allocation": {"rule": "motion"}}}
_UNTESTED: Values = {
    "verify": False,
    "closing": {"min_visible": 0.0},
    "pose_graph": {"confidence": 1.0, "kernel": "none"},
    "candidates": {"threshold": "fixed"},
}


def _beside_network(settings: dict[str, Values]) -> dict[str, Values]:
    """The settings, and the same with the indoor network instead of labels."""
    return settings | {
        f"{name}-network": entry | _options(**entry.get("options", {}), **_NETWORK)
        for name, entry in settings.items()
    }


GROUPS: dict[str, Group] = {
    "gausem-ablation": Group(
        {"ring-slow": Place("ring-slow", (120, 90))},
        {
            "gausem": _preset("gausem"),
            "motion": _preset("gausem", **_MOTION),
            "cells": _preset("gausem", mapping=_CELLS),
            "no-loops": _preset("gausem", **_NO_LOOPS),
            "no-refinement": _preset("gausem", **_GAUSEM_NO_REFINEMENT),
            "tested": _preset("gausem", **_TESTED),
            "default": {},
        },
    ),
    # Neither 40 steps of Adam nor a map of every fifth frame can follow the fast ring; given poses
    # show what the parts of mapping are worth.
    "gausem-given": Group(
        {"ring-0": Place("ring-small", (120, 90), options=_GIVEN)},
        {
            "gausem": _preset("gausem"),
            "motion": _preset("gausem", **_MOTION),
            "cells": _preset("gausem", mapping=_CELLS),
            "no-refinement": _preset("gausem", **_GAUSEM_NO_REFINEMENT),
        },
    ),
    "ablation": Group(
        _RINGS,
        {
            "default": {},
            "allocation-motion": _options(**_MOTION),
            "seeding-semantic": _options(mapping={"seeding": {"choice": "semantic"}}),
            "no-loops": _options(**_NO_LOOPS),
            "no-refinement": _options(**_NO_REFINEMENT),
        },
    ),
    "papers-real": Group(REAL, {"hier-slam": _preset("hier-slam"), "gausem": _preset("gausem")}, 3),
    "ours-real": Group(REAL, {"default": {}, "best": _preset("best")}, 3),
    "loops": Group(
        {name: _RINGS[name] for name in ("ring-0", "ring-1", "ring-2")},
        {
            "descriptor": _options(
                loops=_UNTESTED | {"landmarks": {"min_count": 10**9}}, **_NO_REFINEMENT
            ),
            "landmarks": _options(loops=_UNTESTED, **_NO_REFINEMENT),
            "landmarks-printed": _options(
                loops=_UNTESTED | {"landmarks": {"weighting": "paper", "counted": "gaussians"}},
                **_NO_REFINEMENT,
            ),
            "default": _options(**_NO_REFINEMENT),
        },
    ),
    # With classes from depth alone beside true ones.
    "classes": Group(
        {"room": replace(_SYNTHETIC["room"], indoor=True)},
        _beside_network(
            {"hier-slam": _preset("hier-slam"), "gausem": _preset("gausem"), "default": {}}
        ),
    ),
    "classes-loops": Group(
        {f"ring-{k}": replace(_RINGS[f"ring-{k}"], indoor=True) for k in range(3)},
        _beside_network({"landmarks": _options(loops=_UNTESTED, **_NO_REFINEMENT), "default": {}}),
    ),
    "ours-synthetic": Group(_SYNTHETIC, {"default": {}, "best": _preset("best")}, 5),
    "gausem-synthetic": Group(_SYNTHETIC, {"gausem": _preset("gausem")}, 5),
    "hier-synthetic": Group(
        _SYNTHETIC,
        {
            "hier-slam": _preset("hier-slam"),
            "hier-slam-binary": _preset("hier-slam", **_coded("binary")),
        },
        2,
    ),
    "cost": Group(
        {"room": Place("room", (160, 120), 6)},
        {
            "none": _preset("hier-slam", semantics={"code": {"kind": "none"}, "reader": "path"}),
            "flat": _preset("hier-slam", **_coded("flat")),
            "one-hot": _preset("hier-slam", **_coded("one-hot")),
            "binary": _preset("hier-slam", **_coded("binary")),
        },
    ),
    "ms-ssim": Group(
        {"room": Place("room", (240, 180), 8)},
        {
            "hier-slam": _preset("hier-slam"),
            "gausem": _preset("gausem"),
            "default": {},
            "best": _preset("best"),
        },
    ),
    "long": Group(LONG, {"default": {}}),
    "long-gausem": Group(
        LONG | {"ring-0": Place("ring-small", (120, 90))}, {"gausem": _preset("gausem")}
    ),
}
