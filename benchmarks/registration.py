"""Registration of submaps: how often it succeeds, how far off, how long it takes.

    python benchmarks/registration.py --pairs 8
    SEMSPLAT_DATA=DATA python benchmarks/registration.py --places room kitchen

Submaps are pieces of a recording, mapped at their given poses with the default settings; no
frame is in two of them. "room" is a synthetic room with its true labels, "kitchen" 7-Scenes
RedKitchen, whose truth is itself good to 1-2 cm only. Pairs overlap by 30-100 %. Methods that
need a start get the truth moved by up to 0.5 m and 30 degrees, the same one for all; the others
begin from nothing. Success is 5 cm and 2 degrees. Descriptors are small thumbnails.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import tyro
from machine import describe_machine  # type: ignore[import-not-found]
from numpy.typing import NDArray
from tqdm import tqdm

from toolkit.datasets.registry import open_dataset
from toolkit.datasets.synthetic import SensorModel, tiny_room
from toolkit.datasets.synthetic.vocabulary import CLASS_NAMES
from toolkit.frame import Frame
from toolkit.geometry import se3
from toolkit.mapping.factory import build_mapper, build_semantic_mapping
from toolkit.mapping.keyframes import Keyframe
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.registration.coarse import CoarseOptions, register_coarse
from toolkit.registration.fallbacks import CloudOptions, CloudRegistration
from toolkit.registration.fine import FineOptions, FineRegistration
from toolkit.registration.result import RegistrationResult
from toolkit.registration.sgr import SemanticGuidedRegistration, SgrOptions
from toolkit.registration.two_way import TwoWayRegistration
from toolkit.registration.views import ViewDrawer
from toolkit.semantics.factory import build_code
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.settings.run import RunSettings
from toolkit.submaps.submap import Submap

Array = NDArray[np.float64]
Place = Literal["room", "kitchen"]

SPAN, STEP = 40, 5  # frames of a submap, and from keyframe to keyframe
LEAST_OVERLAP = 0.3
CANDIDATES = 40  # spans drawn for a pair
MOST_M, MOST_DEG = 0.5, 30.0
SUCCESS_M, SUCCESS_DEG = 0.05, 2.0


@dataclass(frozen=True)
class Options:
    """Measure registration."""

    pairs: int = 8
    """Pairs of submaps of each place."""
    places: tuple[Place, ...] = ("room",)
    """Where the submaps come from."""
    methods: tuple[str, ...] = ()
    """Rows to run; all without it."""
    noise: bool = False
    """Give the synthetic room's camera a sensor's noise."""
    frames: int = 150
    """Frames of the synthetic room."""
    size: tuple[int, int] = (320, 240)
    """Width and height of the images."""
    seed: int = 0
    """Of pairs, starts and maps."""


@dataclass(frozen=True)
class Recording:
    """Frames, their poses, and how to read their labels."""

    frames: Sequence[Frame]
    T_world_camera: Array
    semantics: SemanticMapping


@dataclass(frozen=True)
class Pair:
    """Two submaps, the true motion, a start, and the share of the source the target sees."""

    target: Submap
    source: Submap
    T_target_source: Array
    start: Array
    overlap: float


def main() -> None:
    """Print one table a place."""
    options = tyro.cli(Options)
    print(describe_machine(), flush=True)
    for place in options.places:
        recording = kitchen(options) if place == "kitchen" else room(options)
        generator = np.random.default_rng(options.seed)
        pairs = [
            make_pair(recording, generator)
            for _ in tqdm(range(options.pairs), desc=f"{place}: submaps", file=sys.stderr)
        ]
        show(place, pairs, recording, options)


def room(options: Options) -> Recording:
    """A synthetic room with labels."""
    sensor = SensorModel() if options.noise else None
    frames, truth = tiny_room(options.frames, *options.size, options.seed, sensor)
    settings = RunSettings()
    tree = Taxonomy({"everything": list(CLASS_NAMES)}, classes=CLASS_NAMES)
    code = build_code(settings.semantics.code, tree)
    semantics = build_semantic_mapping(settings.semantics, code, options.seed)
    return Recording(frames, truth.T_world_camera, semantics)


def kitchen(options: Options) -> Recording:
    """A real recording, out and back, without labels."""
    path = Path(os.environ["SEMSPLAT_DATA"]) / "7scenes_redkitchen"
    dataset = open_dataset("seven-scenes", path, options.size, None)
    assert dataset.ground_truth is not None
    frames = [dataset[i] for i in range(len(dataset))]
    return Recording(frames, dataset.ground_truth.T_world_camera, SemanticMapping())


def make_pair(recording: Recording, generator: np.random.Generator) -> Pair:
    """Two submaps of random spans, with about as much overlap as a number drawn evenly."""
    wanted = generator.uniform(LEAST_OVERLAP, 1.0)
    drawn = [spans(len(recording.frames), generator) for _ in range(CANDIDATES)]
    shares = [overlap_of(recording, *pair) for pair in drawn]
    possible = [i for i, share in enumerate(shares) if share >= LEAST_OVERLAP]
    chosen = min(possible, key=lambda i: abs(shares[i] - wanted))
    numbers, others = drawn[chosen]
    seed = int(generator.integers(2**31))
    poses = recording.T_world_camera
    truth = se3.inverse(poses[numbers[0]]) @ poses[others[0]]
    return Pair(
        target=submap(recording, numbers, seed),
        source=submap(recording, others, seed),
        T_target_source=truth,
        start=truth @ random_motion(generator),
        overlap=shares[chosen],
    )


def spans(frames: int, generator: np.random.Generator) -> tuple[range, range]:
    """Keyframes of a target and of a shorter source, none of which is in both."""
    first, second = (int(n) for n in generator.integers(0, frames - SPAN, size=2))
    numbers = range(first, first + SPAN, STEP)
    others = range(second, second + SPAN - 2 * STEP, STEP)
    if set(numbers) & set(others):
        others = range(others.start + STEP // 2, others.stop + STEP // 2, STEP)
    return numbers, others


def overlap_of(recording: Recording, numbers: range, others: range) -> float:
    """Mean share of a source view's points that some target view sees, occlusion aside."""
    poses = recording.T_world_camera
    keyframes = [Keyframe.from_frame(recording.frames[i], poses[i]) for i in others]
    shares = [max(k.share_seen_by(poses[i]) for i in numbers) for k in keyframes]
    return float(np.mean(shares))


def submap(recording: Recording, numbers: range, seed: int) -> Submap:
    """Some frames mapped at their given poses, in the frame of the first."""
    mapper = build_mapper(
        RunSettings().mapping, np.random.default_rng(seed), semantics=recording.semantics
    )
    T_submap_world = se3.inverse(recording.T_world_camera[numbers[0]])
    for i in numbers:
        mapper.add_keyframe(recording.frames[i], T_submap_world @ recording.T_world_camera[i])
    words = np.array([thumbnail(keyframe) for keyframe in mapper.keyframes])
    return Submap(0, np.eye(4), mapper.gaussians, mapper.keyframes, descriptors=words)


def thumbnail(keyframe: Keyframe) -> NDArray[np.float32]:
    """A weight-free descriptor [768] of unit length: 16x16 pixels, less their mean."""
    image = keyframe.rgb.permute(1, 2, 0).contiguous().numpy().astype(np.float32)
    small = cv2.resize(image, (16, 16), interpolation=cv2.INTER_AREA).ravel()
    small -= small.mean()
    return small / max(float(np.linalg.norm(small)), 1e-6)


def random_motion(generator: np.random.Generator) -> Array:
    """A motion of up to MOST_M and MOST_DEG in a random direction."""
    direction = generator.normal(size=(2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    metres, radians = generator.random(2) * [MOST_M, np.deg2rad(MOST_DEG)]
    return se3.exp(np.concatenate([metres * direction[0], radians * direction[1]]))


Method = Callable[[Pair], RegistrationResult]


def methods(semantics: SemanticMapping, seed: int) -> dict[str, Method]:
    """Every row's registration; (start) marks those that are given one."""

    def drawer() -> ViewDrawer:
        return ViewDrawer(semantics=semantics)

    def coarse(options: CoarseOptions) -> Method:
        def run(pair: Pair) -> RegistrationResult:
            generator = np.random.default_rng(seed)
            return register_coarse(pair.target, pair.source, options, generator).result

        return run

    def sgr(fine: FineOptions) -> Method:
        registrar = SemanticGuidedRegistration(SgrOptions(fine=fine, seed=seed), drawer())
        return lambda pair: registrar.register(pair.target, pair.source)

    def clouds(options: CloudOptions) -> Method:
        registrar = CloudRegistration(replace(options, seed=seed), drawer())
        return lambda pair: registrar.register(pair.target, pair.source)

    def started(registrar: FineRegistration | TwoWayRegistration) -> Method:
        return lambda pair: registrar.register(pair.target, pair.source, pair.start)

    def after_coarse(registrar: TwoWayRegistration) -> Method:
        def run(pair: Pair) -> RegistrationResult:
            start = coarse(CoarseOptions())(pair).T_target_source
            return registrar.register(pair.target, pair.source, start)

        return run

    return {
        "coarse, Z = I (G-5)": coarse(CoarseOptions(offsets="none")),
        "coarse, measured Z": coarse(CoarseOptions()),
        "fine (start)": started(FineRegistration(drawer=drawer())),
        "SGR": sgr(FineOptions()),
        "SGR, classes ignored": sgr(FineOptions(semantic_gate=False)),
        "SGR, first-order fine (G-6)": sgr(FineOptions(optimiser="first-order")),
        "two-way (start)": started(TwoWayRegistration(drawer=drawer())),
        "two-way after coarse": after_coarse(TwoWayRegistration(drawer=drawer())),
        "FPFH, RANSAC, ICP": clouds(CloudOptions()),
        "FPFH, fast global, ICP": clouds(CloudOptions(search="fast")),
        "FPFH, RANSAC, coloured ICP": clouds(CloudOptions(icp="coloured")),
    }


COLUMNS = ("success", "converged", "median cm", "median deg", "median s", "renders", "chi2 / 6")


def show(place: Place, pairs: list[Pair], recording: Recording, options: Options) -> None:
    """Run every method on every pair and print a row a method."""
    overlaps = [f"{100 * pair.overlap:.0f}" for pair in pairs]
    print(f"\n### {place}: {len(pairs)} pairs, overlap {' '.join(overlaps)} %")
    print("\n| method | " + " | ".join(COLUMNS) + " |")
    print("|---|" + "---:|" * len(COLUMNS), flush=True)
    for name, method in methods(recording.semantics, options.seed).items():
        if options.methods and name not in options.methods:
            continue
        print(f"| {name} | " + " | ".join(row(method, pairs)) + " |", flush=True)


def row(method: Method, pairs: list[Pair]) -> list[str]:
    """Cells of one method."""
    metres, degrees, seconds, renders, chi2, converged = [], [], [], [], [], 0
    for pair in pairs:
        begin = time.perf_counter()
        result = method(pair)
        seconds.append(time.perf_counter() - begin)
        error = se3.inverse(result.T_target_source) @ pair.T_target_source
        metres.append(float(np.linalg.norm(error[:3, 3])))
        degrees.append(float(np.rad2deg(se3.rotation_angle_rad(error[:3, :3]))))
        renders.append(result.renders)
        tangent = se3.log(error)
        chi2.append(float(tangent @ result.information @ tangent) / 6.0)
        converged += result.converged
    good = sum(m < SUCCESS_M and d < SUCCESS_DEG for m, d in zip(metres, degrees, strict=True))
    return [
        f"{good}/{len(pairs)}",
        f"{converged}/{len(pairs)}",
        f"{100 * np.median(metres):.2f}",
        f"{np.median(degrees):.3f}",
        f"{np.median(seconds):.2f}",
        f"{np.median(renders):.0f}",
        f"{np.median(chi2):.3g}",
    ]


if __name__ == "__main__":
    main()
