"""Choose what makes masks by the kind of model that a folder contains."""

from __future__ import annotations

from pathlib import Path

from toolkit.base.errors import FormatError, SettingsError
from toolkit.scene.instances.masks import MaskSource
from toolkit.scene.instances.models.grounding_dino import GroundingDinoMasks
from toolkit.scene.instances.models.sam2 import Sam2Masks
from toolkit.scene.instances.models.universal import UniversalMasks
from toolkit.scene.instances.options import InstanceModelOptions
from toolkit.semantics.features.pretrained.loading import model_type

_SAM2 = ("sam2", "sam2_video")
_UNIVERSAL = ("mask2former", "oneformer")
_GROUNDING = ("grounding-dino",)


def model_masks(folder: Path, options: InstanceModelOptions) -> MaskSource:
    """Load a model.

    Raises:
        DependencyError: transformers or the device is missing, or transformers is too old.
        FormatError: the folder contains no such model, or is incomplete.
        SettingsError: the words to search are missing, or have no effect.
    """
    kind = model_type(folder)
    if kind in _GROUNDING:
        if not any(word.strip() for word in options.text):
            raise SettingsError(
                "Grounding DINO searches words: add --instances.model.text chair table ..."
            )
        return GroundingDinoMasks(folder, options)
    if options.text:
        raise SettingsError(
            f"--instances.model.text has no effect with a {kind} model; remove it, or use "
            "Grounding DINO"
        )
    if kind in _SAM2:
        return Sam2Masks(folder, options)
    if kind in _UNIVERSAL:
        return UniversalMasks(folder, options)
    raise FormatError(
        f"{folder} contains a {kind} model; set the folder of a sam2, mask2former, oneformer or "
        "grounding-dino model"
    )
