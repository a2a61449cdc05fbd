"""render --video: read back by OpenCV and Pillow."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from PIL import Image
from test_finished_run_programs import one_line_of_error

from toolkit.io.images import read_rgb
from toolkit.tools.cli.main import main

SHORT = ["--video-s", "0.5", "--video-fps", "20"]


def frames_of(path) -> list[np.ndarray]:
    capture, frames = cv2.VideoCapture(str(path)), []
    while (frame := capture.read())[0]:
        frames.append(frame[1][..., ::-1] / 255.0)
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(20)
    return frames


def test_a_video_starts_and_ends_at_the_outer_keyframes(run, tmp_path):
    assert main(["render", str(run), "--video", str(tmp_path / "fly.mp4"), *SHORT]) == 0
    frames = frames_of(tmp_path / "fly.mp4")
    assert len(frames) == 10
    words = ["--what", "colour", "--out", str(tmp_path / "views")]
    assert main(["render", str(run), *words]) == 0
    for frame, index in ((frames[0], 0), (frames[-1], 5)):
        still = read_rgb(tmp_path / f"views/colour_{index:06d}.png")
        assert np.abs(frame - still).mean() < 0.05
    assert np.abs(frames[0] - frames[-1]).mean() > 0.05


def test_a_gif_is_small_and_passes_through_views(run, tmp_path):
    views = ["--view", "0", "0", "0", "0", "0", "0.2", "0", "0", "20", "0"]
    words = [*views, "--image-size", "640", "480", "--video", str(tmp_path / "fly.gif"), *SHORT]
    assert main(["render", str(run / "map.ply"), *words]) == 0
    with Image.open(tmp_path / "fly.gif") as gif:
        assert gif.size == (320, 240)
        assert gif.n_frames == 5
        assert gif.info["duration"] == 100


def test_labels_can_be_filmed(tiny_run, tmp_path):
    words = ["--what", "labels", "--video", str(tmp_path / "a.mp4"), *SHORT]
    assert main(["render", str(tiny_run), *words]) == 0
    assert len(frames_of(tmp_path / "a.mp4")) == 10


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["RUN", "--video", "OUT/a.avi"], ".mp4 or .gif"),
        (["RUN", "--video", "OUT/no/a.mp4"], "there is no folder"),
        (["RUN", "--video", "OUT/a.mp4", "--what", "strip"], "strips"),
        (["RUN", "--video", "OUT/a.mp4", "--video-s", "0"], "--video-s"),
        (["RUN/map.ply", "--video", "OUT/a.mp4"], "give --view or --trajectory"),
    ],
)
def test_bad_videos_are_reported_in_one_line(run, tmp_path, capsys, words, said):
    words = [word.replace("RUN", str(run)).replace("OUT", str(tmp_path)) for word in words]
    assert said in one_line_of_error(capsys, "render", *words)
