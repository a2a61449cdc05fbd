"""Accuracy, image quality and time of every preset.

    SEMSPLAT_DATA=DATA python -m benchmarks.accuracy.presets [--only NAMES]

The presets of the papers take many seconds per frame; all presets process the same frames.
"""

from __future__ import annotations

from typing import get_args

from benchmarks.accuracy.sequences import measure
from benchmarks.shared.runner import Page
from benchmarks.shared.tables import table_of
from toolkit.runs.settings import PresetName

FRAMES = 60
SEQUENCES = {"RedKitchen": "redkitchen", "fr1_rpy": "fr1_rpy", "room": "room"}
# The monocular system needs weights.
PRESETS = tuple(name for name in get_args(PresetName) if name != "hier-slam-mono")
COLUMNS = (
    *("trajectory.ate_rmse_cm", "images.mapped.psnr_db", "images.mapped.ssim"),
    *("depth.mapped.l1_cm", "semantics.mapped.miou_percent", "frames.lost", "map.gaussians"),
    *("time.online_ms_per_frame", "time.total_ms_per_frame", "frames.total"),
)
DESCRIPTION = f"""\
The presets of `semsplat run` on the first {FRAMES} frames of three sequences, all at 320x240:
7-Scenes RedKitchen, TUM fr1/rpy and the synthetic room (`semsplat make-room`). Labels are those of
planes on RedKitchen and fr1/rpy and those of the dataset in the room. ATE after SE(3) alignment;
PSNR is the mean over views of the dB over all pixels, of at most 100 evenly spaced views. The
online time is the wall-clock time of processing a frame, loop closure and relocalisation included;
the total also contains the final refinement, spread over the frames."""
ROWS = {
    f"{title}, {preset}": [sequence, "--preset", preset, "--max-frames", str(FRAMES)]
    for title, sequence in SEQUENCES.items()
    for preset in PRESETS
}
PAGE = Page(
    "presets",
    "Presets",
    DESCRIPTION,
    ROWS,
    measure,
    lambda rows: [table_of(COLUMNS, rows, "sequence, preset")],
)

if __name__ == "__main__":
    PAGE.main()
