"""The mapper from settings."""

from __future__ import annotations

import numpy as np

from toolkit.frame import Recorder
from toolkit.gaussians.seeding import SeedingOptions
from toolkit.losses.photometric import RgbdLossWeights
from toolkit.mapping.keyframes import KeyframePolicy
from toolkit.mapping.mapper import Mapper, MapperOptions
from toolkit.mapping.sparse_adam import LearningRates
from toolkit.settings.mapping import MappingSettings


def build_mapper(
    settings: MappingSettings,
    generator: np.random.Generator,
    backend_name: str = "auto",
    recorder: Recorder | None = None,
) -> Mapper:
    """The mapper that the settings describe."""
    values = settings.model_dump()
    values["keyframes"] = KeyframePolicy(**values["keyframes"])
    values["seeding"] = SeedingOptions(**values["seeding"])
    values["rates"] = LearningRates(**values["rates"])
    values["loss"] = RgbdLossWeights(**values["loss"])
    return Mapper(MapperOptions(**values), generator, backend_name, recorder)
