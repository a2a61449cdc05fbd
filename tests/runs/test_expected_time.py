"""The expected duration of a run: when it is logged, its value, and the proposed image size."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest

from toolkit.base.geometry.camera import Camera
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.expected_time import ExpectedTime, with_expected_motion_time
from toolkit.runs.settings import RunSettings
from toolkit.slam.mapping.options import MapperOptions

VGA = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
QVGA = Camera(262.5, 262.5, 159.5, 119.5, 320, 240)
SETTINGS = RunSettings(mapping=MapperOptions(final_iterations=10, final_shape="spheres"))


class Run:
    """Frames of a run with a fake clock; every fifth frame is a keyframe."""

    def __init__(self, camera=VGA, settings=SETTINGS, frames=range(1000), frame_s=0.4):
        self.now_s, self.frame_s, self.processed = 0.0, frame_s, 0
        self.recorder = StageRecorder()
        self.expected = ExpectedTime(settings, camera, frames, self.recorder, lambda: self.now_s)

    def process(self, count, keyframe_every=5):
        """Process frames; the first one takes 2 s. Optimisation steps take 50 ms."""
        for _ in range(count):
            keyframe = self.processed % keyframe_every == 0
            if keyframe:
                self.recorder.durations_ms.setdefault("map forward", []).append(30.0)
                self.recorder.durations_ms.setdefault("map backward", []).append(20.0)
            self.now_s += 2.0 if self.processed == 0 else self.frame_s
            self.expected.frame_processed(keyframe)
            self.processed += 1


@pytest.fixture
def messages(caplog):
    caplog.set_level(logging.INFO, "toolkit.runs.expected_time")
    return lambda: [record.getMessage() for record in caplog.records]


def test_the_time_is_logged_once(messages):
    run = Run()
    run.process(20)
    assert not messages()
    run.process(40)
    # 2 + 0.4 * 999 s, and 0.5 s of refinement for each of 200 keyframes.
    assert messages() == [
        "About 8 minutes expected for 1,000 frames (0.5 s per frame, refinement included); "
        "--image-size 320 240 would take about a quarter of it."
    ]


def test_at_least_two_keyframes_are_needed(messages):
    run = Run()
    run.process(50, keyframe_every=100)
    assert not messages()
    run.process(2, keyframe_every=1)
    assert len(messages()) == 1


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"camera": QVGA}, "About 8 minutes expected"),
        ({"settings": replace(SETTINGS, image_size=(640, 480))}, "About 8 minutes expected"),
        ({"frame_s": 0.05}, "About 3 minutes expected"),
    ],
)
def test_no_size_is_proposed_for_small_or_chosen_images_and_short_runs(messages, change, text):
    Run(**change).process(30)
    (message,) = messages()
    assert message.startswith(text) and "--image-size" not in message


def test_a_resumed_run_counts_the_remaining_frames_and_keeps_its_image_size(messages):
    Run(frames=range(900, 1000)).process(30)
    # 2 + 0.4 * 99 s, and 0.5 s of refinement for each of 200 keyframes.
    assert messages() == [
        "About 2 minutes expected for the remaining 100 frames "
        "(1.4 s per frame, refinement included)."
    ]


def test_votes_on_labels_count_as_steps(messages):
    run = Run(camera=QVGA)
    run.recorder.durations_ms["labelling"] = [1.0]
    run.process(30)
    assert "0.52 s per frame" in messages()[0]  # 12 instead of 10 steps per keyframe


@pytest.mark.parametrize(
    ("frame_s", "text"), [(0.01, "10 seconds"), (0.4, "3 minutes"), (20.0, "2.8 hours")]
)
def test_durations_have_a_readable_unit(messages, frame_s, text):
    settings = RunSettings(mapping=MapperOptions(final_iterations=0))
    run = Run(QVGA, settings, range(500), frame_s)
    run.process(30)
    assert messages()[0].startswith(f"About {text} expected")


def test_a_run_that_is_nearly_over_needs_no_estimate(messages):
    Run(frames=range(21)).process(21)
    assert not messages()


@pytest.mark.parametrize(("passes", "words"), [(1, "frames; mapping"), (5, "up to 5 passes")])
def test_the_time_of_the_motion_is_stated_before_it_is_over(caplog, passes, words):
    now_s, stated_at = [0.0], None
    frames = iter(range(600))
    with caplog.at_level(logging.INFO, "toolkit"):
        for number in with_expected_motion_time(frames, 600, passes, lambda: now_s[0]):
            now_s[0] += 5.0 if number < 10 else 0.5
            if caplog.records and stated_at is None:
                stated_at = number
    (record,) = caplog.records
    assert "About 5 minutes expected for the motion of 600 frames" in record.getMessage()
    assert words in record.getMessage()
    assert stated_at == 40


def test_short_sequences_need_no_statement(caplog):
    with caplog.at_level(logging.INFO, "toolkit"):
        assert list(with_expected_motion_time(iter(range(60)), 60)) == list(range(60))
    assert not caplog.records
