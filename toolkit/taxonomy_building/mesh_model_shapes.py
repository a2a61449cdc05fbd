"""Shapes of classes as a text-to-mesh model imagines them (H-4, by vectors)."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.errors import DependencyError

PACKAGE = "meshgpt_pytorch"


class MeshModelShapes:
    """The mean code vector of the mesh that MeshGPT makes of each class's name.

    H-4 averages the codes' *indices*, which are names and no quantities; here it is the
    vectors of the codebook that stand behind them.

    Args:
        weights: local folder with a text-conditioned `MeshTransformer`, as its own
            `save_pretrained` writes it; nothing is downloaded.
        most_faces: of a generated mesh, >= 1; time grows faster than it.
    """

    def __init__(self, weights: str | Path, most_faces: int = 250) -> None:
        self._weights = Path(weights)
        self._most_faces = most_faces

    def embeddings(self, classes: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """One vector [dimension of the codebook] for each class that the model makes a mesh of.

        Raises:
            DependencyError: the package or the weights are missing, or do not fit together.
        """
        transformer = self._transformer()
        vectors = {name: self._mean_code_vector(transformer, name) for name in classes}
        return {name: vector for name, vector in vectors.items() if np.isfinite(vector).all()}

    def _transformer(self) -> Any:
        if not self._weights.exists():
            raise DependencyError(
                f"mesh model weights {self._weights} are missing; give the folder of a saved "
                "MeshTransformer, or another source of shapes"
            )
        try:
            package = importlib.import_module(PACKAGE)
        except ImportError as error:
            raise DependencyError(
                f"shapes from a mesh model need {PACKAGE} ({error}); fix it with: "
                "pip install meshgpt-pytorch"
            ) from error
        try:
            transformer = package.MeshTransformer.from_pretrained(
                str(self._weights), local_files_only=True
            )
        except Exception as error:  # a foreign checkpoint fails in ways of its own
            reason = str(error).replace("\n", " ")
            raise DependencyError(
                f"{self._weights}: no MeshTransformer that {PACKAGE} can load ({reason})"
            ) from error
        return transformer.eval()

    @torch.no_grad()
    def _mean_code_vector(self, transformer: Any, name: str) -> NDArray[np.float64]:
        """Mean over the vertices; NaN where the mesh is empty."""
        autoencoder = transformer.autoencoder
        codes_a_face = autoencoder.num_vertices_per_face * autoencoder.num_quantizers
        codes = transformer.generate(
            texts=[name.replace("-", " ").replace("_", " ")],
            temperature=0.0,  # the likeliest mesh, the same each time
            max_seq_len=self._most_faces * codes_a_face,
            return_codes=True,
        )
        # [1, vertices, quantizers]; after the mesh's end come negative ids.
        real = (codes >= 0).all(dim=-1)[0]
        vectors = autoencoder.quantizer.get_output_from_indices(codes.clamp(min=0))[0]
        return vectors[real].mean(dim=0).double().cpu().numpy()
