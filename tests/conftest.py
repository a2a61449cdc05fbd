"""Common to all tests: reproducible property tests, kernels without a GPU, real recordings."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import hypothesis
import pytest
import torch
from tiny_recording import write_tiny_recording

# Triton asks once, at its import, whether to run kernels in Python: they are tested so where
# there is no GPU to compile them for.
if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")

# The same examples each time, and no limit on their time: machines differ.
hypothesis.settings.register_profile("semsplat", deadline=None, derandomize=True)
hypothesis.settings.load_profile("semsplat")


@pytest.fixture
def real_data() -> Callable[[str], Path]:
    """The folder of a real recording by name; skips where it is not at hand."""

    def find(name: str) -> Path:
        root = os.environ.get("SEMSPLAT_DATA")
        if not root:
            pytest.skip("SEMSPLAT_DATA is not set")
        if not (Path(root) / name).exists():
            pytest.skip(f"{name} is not in SEMSPLAT_DATA")
        return Path(root) / name

    return find


@pytest.fixture(scope="session")
def tiny_dinov2(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a DINOv2 with random weights, patches of 8 pixels, 16 channels."""
    transformers = pytest.importorskip("transformers")
    import torch

    folder = tmp_path_factory.mktemp("models") / "dinov2"
    torch.manual_seed(0)
    config = transformers.Dinov2Config(
        hidden_size=16,
        num_hidden_layers=1,
        num_attention_heads=2,
        patch_size=8,
        image_size=32,
        mlp_ratio=2,
    )
    transformers.Dinov2Model(config).save_pretrained(folder)
    return folder


@pytest.fixture(scope="session")
def tiny_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of kind `folder`: six frames of 64x48 pixels with labels and poses. Read only."""
    return write_tiny_recording(tmp_path_factory.mktemp("tiny") / "recording")


@pytest.fixture(scope="session")
def tiny_run(tiny_recording: Path) -> Path:
    """The folder of a finished run over `tiny_recording`. Read only: copy it to change it."""
    from toolkit.tools.cli.main import main

    out = tiny_recording.with_name("run")
    words = ["--dataset.kind", "folder", "--dataset.path", str(tiny_recording)]
    assert main(["run", *words, "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="session")
def resumable_run(tiny_recording: Path) -> Path:
    """The folder of a run like `tiny_run` that still has its checkpoints. Read only."""
    from killed_runs import kept_checkpoints

    from toolkit.tools.cli.main import main

    out = tiny_recording.with_name("resumable")
    words = ["--dataset.kind", "folder", "--dataset.path", str(tiny_recording)]
    with kept_checkpoints():
        assert main(["run", *words, "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="session")
def submaps_run(tmp_path_factory) -> Path:
    """The folder of a finished run of several submaps. Read only: copy it to change it."""
    from toolkit.datasets.synthetic_rooms import tiny_room
    from toolkit.datasets.synthetic_rooms.writer import prepare_folder, write_sequence
    from toolkit.tools.cli.main import main

    folder = tmp_path_factory.mktemp("submaps")
    frames, truth = tiny_room(14, 96, 72)
    prepare_folder(folder / "room")
    write_sequence(folder / "room", frames, frames[0].camera, truth.T_world_camera)
    words = [
        *("--dataset.kind", "synthetic", "--dataset.path", str(folder / "room")),
        *("--mapping.first-iterations", "8", "--mapping.iterations", "3"),
        *("--mapping.final-iterations", "1", "--mapping.keyframes.interval", "1"),
        *("--submaps.allocation.min-keyframes", "3", "--submaps.allocation.max-keyframes", "5"),
        *("--loops.candidates.min-gap-frames", "100", "--out", str(folder / "run")),
    ]
    assert main(["run", *words]) == 0
    return folder / "run"
