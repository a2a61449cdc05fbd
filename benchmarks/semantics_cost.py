"""Times one mapping step on a map of one view, for each semantic code."""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import numpy as np
import torch

from benchmarks.recordings import RECORDINGS
from benchmarks.report import publish
from benchmarks.results_file import Results, current_header
from benchmarks.tables import Table, Target, target_table
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.base.options import validated
from toolkit.datasets.registry import open_dataset
from toolkit.runs.settings import RunSettings
from toolkit.semantics.factory import build_code
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.trees import shipped_taxonomy
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.optimisation import Objective
from toolkit.slam.mapping.semantic_mapping import build_semantic_mapping
from toolkit.splatting.rendering import backend

STAGES = ("forward", "backward", "renderer", "step")
DESCRIPTION = """\
One view of Replica office0 at 600x340, one Gaussian per pixel; codes take turns within each
repetition, and times are medians. The renderer's two passes are timed with gradients for every
channel; a step is forward pass, losses, backward pass (semantics do not move geometry) and Adam.
By default only every third mapping step includes semantics; these times are of steps that do.
"x" columns are relative to the flat code with the same inter-level term."""
MEASURES = (
    "toolkit/splatting/losses",
    "toolkit/slam/mapping",
    "toolkit/base/native",
    "toolkit/splatting/rendering",
)

# Name, code, and pixels of the inter-level term: 0 for all, None without the term.
CASES = (
    ("none", "none", None),
    ("flat", "flat", None),
    ("one-hot", "one-hot", None),
    ("binary", "binary", None),
    ("flat, inter sampled", "flat", 2048),
    ("one-hot, inter sampled", "one-hot", 2048),
    ("binary, inter sampled", "binary", 2048),
    ("flat, inter on all", "flat", 0),
    ("one-hot, inter on all", "one-hot", 0),
    ("binary, inter on all", "binary", 0),
)


class MappedView:
    """A map of one view of office0 with one code.

    Args:
        kind: of the code.
        inter: pixels of the inter-level term, 0 for all, None without the term.
    """

    def __init__(self, kind: str, inter: int | None) -> None:
        dataset = open_dataset("replica", RECORDINGS["office0"].path, None, 1)
        taxonomy = shipped_taxonomy("replica")
        settings = validated(
            RunSettings,
            {
                "mapping": {"first_iterations": 1, "seeding": {"max_cell": 1}},
                "semantics": {
                    "code": {"kind": kind},
                    "loss": {"inter_pixels": inter or 0, "inter_from": 0},
                    "network": {"use": inter is not None},
                },
            },
        )
        self._mapper = self._build(settings, taxonomy)
        self._submap = self._mapper.first_submap()
        self._mapper.add_keyframe(self._submap, Keyframe.from_frame(dataset[0], np.eye(4)))
        self.channels = 4 + self._mapper.semantics.channels
        cloud = self._submap.gaussians
        self.map_mb = len(cloud) * (8 + self._mapper.semantics.channels) * 4 / 1e6

    @staticmethod
    def _build(settings: RunSettings, taxonomy: Taxonomy) -> Mapper:
        chosen = build_code(settings.semantics.code, taxonomy)
        semantics = build_semantic_mapping(settings.semantics, chosen, 0)
        generator = np.random.default_rng(0)
        return Mapper(settings.mapping, generator, "auto", None, semantics)

    def step(self) -> dict[str, float]:
        """Seconds of the renderer's two passes by themselves and of a whole mapping step."""
        mapper, submap = self._mapper, self._submap
        cloud, keyframe = submap.gaussians, submap.keyframes[0]
        T_camera_map = se3.inverse(keyframe.T_map_camera)
        times = {}
        start = time.perf_counter()
        drawn = backend().forward(cloud, keyframe.camera, T_camera_map, cloud.features, None)
        times["forward"] = time.perf_counter() - start
        gradient = torch.ones_like(drawn.images)
        start = time.perf_counter()
        drawn.backward(gradient)
        times["backward"] = time.perf_counter() - start
        times["renderer"] = times["forward"] + times["backward"]
        del drawn
        start = time.perf_counter()
        # The first step of a call includes semantics.
        mapper.step(submap, keyframe, (0, 4), Objective(False))
        times["step"] = time.perf_counter() - start
        return times


def measure_cost(rounds: int, out: Path) -> None:
    """Time all codes and write the results.

    Args:
        rounds: timed repetitions.
        out: folder of the results file.
    """
    header = current_header([0], MEASURES)
    views = {name: MappedView(kind, inter) for name, kind, inter in CASES}
    times: dict[str, dict[str, list[float]]] = {name: {} for name in views}
    for turn in range(rounds + 1):
        for name, view in views.items():
            for stage, seconds in view.step().items():
                if turn:  # the first round warms caches and buffers
                    times[name].setdefault(stage, []).append(1e3 * seconds)
    medians = {n: {s: statistics.median(t[s]) for s in STAGES} for n, t in times.items()}
    rows = []
    for name, view in views.items():
        flat = medians[_flat(name)]
        cells = [(f"{medians[name][s]:.1f}", f"{medians[name][s] / flat[s]:.2f}") for s in STAGES]
        flattened = [cell for pair in cells for cell in pair]
        rows.append((name, str(view.channels), f"{view.map_mb:.1f}", *flattened))
    columns = [column for stage in STAGES for column in (f"{stage} ms", f"{stage} x")]
    table = Table(("", "channels", "map MB", *columns), tuple(rows))
    targets = target_table(_targets(views, medians))
    name, title = "semantics-cost", "Cost of one mapping step, by semantic code"
    publish(Results(name, title, DESCRIPTION, header, (table, targets)), out)


def _flat(name: str) -> str:
    """The flat code with the same inter-level term."""
    _, comma, term = name.partition(",")
    return f"flat{comma}{term}"


def _targets(views: dict[str, MappedView], medians: dict[str, dict[str, float]]) -> list[Target]:
    targets = []
    for code, channels, renderer, step, size in (
        ("one-hot", 26, 0.45, 0.6, 0.35),
        ("binary", 14, 0.35, 0.5, 0.22),
    ):
        sampled = f"{code}, inter sampled"
        drawing = medians[code]["renderer"] / medians["flat"]["renderer"]
        whole = medians[sampled]["step"] / medians["flat, inter sampled"]["step"]
        share = views[code].map_mb / views["flat"].map_mb
        targets += [
            Target(f"{code}, semantic channels", views[code].channels - 4, at_most=channels),
            Target(f"{code}, renderer's time of flat's", drawing, at_most=renderer),
            Target(f"{code}, step with sampled inter term, of flat's", whole, at_most=step),
            Target(f"{code}, map size of flat's", share, at_most=size),
        ]
    return targets
