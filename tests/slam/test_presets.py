"""The presets: every value is applied, files take precedence, each system runs."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest
import yaml

from toolkit.base.errors import SettingsError
from toolkit.base.options import as_plain, validated
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_IDS
from toolkit.runs.building import build_slam
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.settings import PRESETS, PresetName, RunSettings, load_settings

NAMES = get_args(PresetName)


class TinyDataset:
    """What a system asks of a dataset before the first frame."""

    ground_truth = None

    @property
    def label_names(self) -> dict[int, str]:
        return {number: name for name, number in CLASS_IDS.items()}


def leaves(values: dict, prefix: str = "") -> dict[str, object]:
    """Values of nested dictionaries by dotted key."""
    found: dict[str, object] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            found |= leaves(value, f"{prefix}{key}.")
        else:
            found[prefix + key] = value
    return found


def shortened(name: str, **mapping) -> RunSettings:
    """A preset with few iterations."""
    values = as_plain(load_settings(preset=name))
    values["mapping"] |= {"first_iterations": 3, "iterations": 2, "final_iterations": 1} | mapping
    values["tracking"]["first_order"]["iterations"] = 3
    return validated(RunSettings, values)


def test_every_preset_has_a_file():
    assert sorted(NAMES) == sorted(path.stem for path in PRESETS.glob("*.yaml"))


@pytest.mark.parametrize("name", NAMES)
def test_every_value_is_applied_and_no_other(name):
    chosen = leaves(yaml.safe_load((PRESETS / f"{name}.yaml").read_text()))
    defaults = leaves(as_plain(RunSettings()))
    assert set(chosen) <= set(defaults)
    assert leaves(as_plain(load_settings(preset=name))) == defaults | chosen


def test_gausem_has_the_values_of_the_paper():
    settings = load_settings(preset="gausem")
    tracking, mapping, loops = settings.tracking, settings.mapping, settings.loops
    assert (tracking.kind, tracking.first_order.preset) == ("first-order", "gausem")
    assert (mapping.loss.colour, mapping.loss.depth) == (1.0, 0.5)  # G-3
    assert (settings.semantics.loss.weight, settings.semantics.loss.structure) == (0.5, 0.2)
    assert settings.semantics.code.kind == "colour"
    assert mapping.first_iterations == 1000
    assert not settings.submaps.boundary.inherit  # otherwise a submap has no 1000 iterations
    assert (loops.landmarks.counted, loops.landmarks.weighting) == ("gaussians", "paper")  # G-7
    registration = settings.registration
    assert registration.optimiser == "first-order"  # G-6
    assert registration.feature == 0.5
    assert loops.closing.mapping_iterations == 10


def test_hier_slam_has_the_values_of_the_paper():
    settings = load_settings(preset="hier-slam")
    mapping, semantics = settings.mapping, settings.semantics
    assert (mapping.loss.depth, mapping.loss.colour, semantics.loss.weight) == (1.0, 0.5, 0.2)
    assert semantics.loss.inter_from == 15
    assert semantics.code.start == "random" and not semantics.code.normalise
    assert not settings.submaps.use and not settings.loops.use
    assert (settings.tracking.first_order.iterations, mapping.iterations) == (40, 60)


def test_the_monocular_hier_slam_differs_in_its_depth_alone():
    depth, mono = (load_settings(preset=name) for name in ("hier-slam", "hier-slam-mono"))
    assert (mono.depth, mono.depth_prior.kind, mono.depth_prior.use) == (
        "none",
        "dust3r",
        "track",
    )
    correction = mono.depth_prior.correction
    assert not correction.robust and not correction.filter  # H-16
    assert (correction.grid, correction.share) == (1, "frame")
    for stage in ("tracking", "placement", "mapping", "semantics", "submaps", "loops"):
        assert getattr(mono, stage) == getattr(depth, stage)


@pytest.mark.parametrize("name", [name for name in NAMES if name != "hier-slam-mono"])
def test_a_preset_builds_a_system_that_tracks_and_maps(name):
    frames, _ = tiny_room(3, 64, 48)
    settings, recorder = shortened(name), StageRecorder()
    slam = build_slam(TinyDataset(), settings, recorder=recorder)
    results = [slam.process_frame(frame) for frame in frames]
    assert not any(result.lost for result in results)
    gaussians = slam.finish().gaussians
    assert len(gaussians) > 0
    assert (gaussians.features.shape[1] == 3) == (name == "gausem")
    assert ("map consensus" in recorder.durations_ms) == settings.mapping.consensus.use


def test_random_codes_are_drawn_for_each_gaussian():
    frames, _ = tiny_room(1, 64, 48)
    features = []
    for _ in range(2):
        slam = build_slam(TinyDataset(), shortened("hier-slam", first_iterations=0))
        slam.process_frame(frames[0])
        features.append(slam.atlas.gaussians.features)
    assert features[0].equal(features[1])  # same seed
    assert features[0].mean().abs() < 0.05 and abs(features[0].std() - 1.0) < 0.05


def test_a_file_takes_precedence_over_a_preset(tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text("mapping: {final_iterations: 4}\nplacement: {max_width: 200}\n")
    settings = load_settings(file, "hier-slam")
    assert settings.mapping.final_iterations == 4 and settings.mapping.iterations == 60
    assert settings.placement.max_width == 200 and not settings.placement.use


def test_an_unknown_preset_is_an_error_that_names_all():
    with pytest.raises(SettingsError, match=r"no preset 'fats'; presets: .*; did you mean fast\?"):
        load_settings(preset="fats")


def test_a_preset_given_as_a_file_is_an_error_that_names_the_option():
    with pytest.raises(SettingsError, match="--preset gausem"):
        load_settings(Path("gausem"))


def test_the_colour_code_cannot_start_at_random_values():
    values = as_plain(shortened("gausem"))
    values["semantics"]["code"]["start"] = "random"
    with pytest.raises(SettingsError, match=r"semantics\.code\.start"):
        build_slam(TinyDataset(), validated(RunSettings, values))
