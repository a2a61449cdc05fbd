"""Shape embeddings of classes from a text-to-mesh model (H-4, with codebook vectors)."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.errors import DependencyError

PACKAGE = "meshgpt_pytorch"


class MeshModelShapes:
    """Mean codebook vector of the mesh that MeshGPT generates for each class name.

    H-4 averages codebook *indices*, which have no metric. Here, the codebook vectors of the
    indices are averaged.

    Args:
        weights: local folder with a text-conditioned `MeshTransformer`, written by its
            `save_pretrained`; nothing is downloaded.
        max_faces: maximum number of faces of a generated mesh, >= 1; the time grows faster than
            linearly with it.
    """

    def __init__(self, weights: str | Path, max_faces: int = 250) -> None:
        self._weights = Path(weights)
        self._most_faces = max_faces

    def embeddings(self, classes: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """Return a vector [dimension of the codebook] for each class with a generated mesh.

        Raises:
            DependencyError: the package or the weights are missing, or are incompatible.
        """
        transformer = self._transformer()
        vectors = {name: self._mean_code_vector(transformer, name) for name in classes}
        return {name: vector for name, vector in vectors.items() if np.isfinite(vector).all()}

    def _transformer(self) -> Any:
        if not self._weights.exists():
            raise DependencyError(
                f"mesh model weights {self._weights} are missing; set the folder of a saved "
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
        except Exception as error:  # invalid checkpoints raise various exceptions
            reason = str(error).replace("\n", " ")
            raise DependencyError(
                f"{self._weights} does not contain a MeshTransformer that {PACKAGE} can load "
                f"({reason})"
            ) from error
        return transformer.eval()

    @torch.no_grad()
    def _mean_code_vector(self, transformer: Any, name: str) -> NDArray[np.float64]:
        """Return the mean over the vertices; NaN if the mesh is empty."""
        autoencoder = transformer.autoencoder
        codes_per_face = autoencoder.num_vertices_per_face * autoencoder.num_quantizers
        codes = transformer.generate(
            texts=[name.replace("-", " ").replace("_", " ")],
            temperature=0.0,  # deterministic: the most likely mesh
            max_seq_len=self._most_faces * codes_per_face,
            return_codes=True,
        )
        # [1, vertices, quantizers]; padded with negative ids after the end of the mesh.
        valid = (codes >= 0).all(dim=-1)[0]
        vectors = autoencoder.quantizer.get_output_from_indices(codes.clamp(min=0))[0]
        return vectors[valid].mean(dim=0).double().cpu().numpy()
