"""The shipped presets: they load by name, and build a system that runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from toolkit.datasets.synthetic import tiny_room
from toolkit.datasets.synthetic.vocabulary import CLASS_IDS
from toolkit.errors import SettingsError
from toolkit.options import as_plain, validated
from toolkit.runs.building import build_slam
from toolkit.runs.settings import RunSettings, load_settings, preset_names


class TinyDataset:
    """What a system asks of a dataset before the first frame."""

    ground_truth = None

    @property
    def label_names(self) -> dict[int, str]:
        return {number: name for name, number in CLASS_IDS.items()}


def test_gausem_has_the_values_of_the_paper():
    settings = load_settings(Path("gausem"))
    tracking, mapping, loops = settings.tracking, settings.mapping, settings.loops
    assert (tracking.kind, tracking.first_order.preset) == ("first-order", "gausem")
    assert (mapping.loss.colour, mapping.loss.depth) == (1.0, 0.5)  # G-3
    assert (settings.semantics.loss.weight, settings.semantics.loss.structure) == (0.5, 0.2)
    assert settings.semantics.code.kind == "colour"
    assert (loops.landmarks.counted, loops.landmarks.weighting) == ("gaussians", "paper")  # G-7
    fine = loops.registration.fine
    assert (fine.optimiser, fine.first_order.semantic) == ("first-order", 1.0)  # G-6
    assert fine.first_order.feature == 0.5
    assert loops.closing.mapping_iterations == 10


@pytest.mark.parametrize("name", preset_names())
def test_a_preset_builds_a_system_that_tracks_and_maps(name):
    frames, _ = tiny_room(2, 48, 36)
    settings = as_plain(load_settings(Path(name)))
    settings["mapping"] |= {"first_iterations": 3, "iterations": 2, "final_iterations": 1}
    settings["tracking"]["first_order"]["iterations"] = 3
    slam = build_slam(TinyDataset(), validated(RunSettings, settings))
    for frame in frames:
        slam.process_frame(frame)
    gaussians = slam.finish().gaussians
    assert len(gaussians) > 0 and gaussians.features.shape[1] == 3


def test_a_name_that_is_no_file_and_no_preset_is_an_error():
    with pytest.raises(SettingsError, match="cannot read settings"):
        load_settings(Path("gausen"))


def test_a_file_takes_precedence_over_a_preset(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("gausem").write_text("seed: 7\n")
    assert load_settings(Path("gausem")).seed == 7
    assert load_settings(Path("gausem")).tracking.kind == "dense"
