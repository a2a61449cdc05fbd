"""C++ kernels for the CPU: sources in `src/` with one folder per stage, and their loading.

Importing this package needs neither torch nor the compiled kernels.
"""

from toolkit.base.native.loading import (
    INSTRUCTION_SETS,
    ISA_VARIABLE,
    available_instruction_sets,
    built_instruction_sets,
    kernels,
    load_variant,
    rebuild_command,
    require_kernels,
)
from toolkit.base.native.tensors import address, kernels_for

__all__ = [
    "INSTRUCTION_SETS",
    "ISA_VARIABLE",
    "address",
    "available_instruction_sets",
    "built_instruction_sets",
    "kernels",
    "kernels_for",
    "load_variant",
    "rebuild_command",
    "require_kernels",
]
