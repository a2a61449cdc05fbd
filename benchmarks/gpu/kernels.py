"""Compiles the Triton kernels for GPUs that need not be there, and says what they use.

Registers a thread, stack (what registers could not hold) and shared memory of each kernel, as
ptxas counts them, and the tensor cores' instructions in its machine code.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from toolkit.splatting.alignment.cuda import accumulation
from toolkit.splatting.rendering.cuda import compositing, differentiation, projection, reduction
from toolkit.splatting.rendering.cuda.tuning import Tuning, block_of

_FLOAT, _INT, _LONG = "*fp32", "*i32", "*i64"
# Types by argument; what is not named here is a 32-bit integer, and capitals are constants.
_TYPES = {
    **dict.fromkeys(("view", "means", "log_radii", "opacity_logits", "colours"), _FLOAT),
    **dict.fromkeys(("splats", "features", "images", "centre_images"), _FLOAT),
    **dict.fromkeys(("checkpoints", "transmittance"), _FLOAT),
    **dict.fromkeys(("by_images", "sums", "feature_rows", "rows", "out"), _FLOAT),
    **dict.fromkeys(("by_means", "by_log_radii", "by_opacity_logits", "by_colours"), _FLOAT),
    **dict.fromkeys(("texture", "surface", "intensity", "depth", "scalars", "parts"), _FLOAT),
    **dict.fromkeys(("counts", "pair_gaussians", "tile_begins", "batches"), _INT),
    **dict.fromkeys(("gaussians", "begins", "ids", "pair_rows"), _LONG),
    **dict.fromkeys(("rectangles", "pair_tiles"), "*i16"),
    "pose": "*fp64",
    **dict.fromkeys(("gate", "root_weight"), "fp32"),
    "region": "*u8",
}


@dataclass(frozen=True)
class Compiled:
    """One kernel as machine code.

    Attributes:
        registers: a thread. stack: bytes a thread. shared: bytes a program.
        products: instructions of the tensor cores.
    """

    name: str
    registers: int
    stack: int
    shared: int
    products: int


def compiled(kernel: Any, capability: int, warps: int = 4, **constants: Any) -> Compiled:
    """A kernel as machine code for a compute capability, 90 or 80 say."""
    names = kernel.arg_names
    types = {n: _type_of(n, kernel.__name__) for n in names if n not in constants}
    # As torch allocates them: a launch passes this to the compiler.
    aligned = {
        (i,): [["tt.divisibility", 16]] for i, n in enumerate(names) if "*" in types.get(n, "")
    }
    source = ASTSource(
        kernel,
        {n: types.get(n, "constexpr") for n in names},
        {(names.index(n),): value for n, value in constants.items()},
        aligned,
    )
    options = {"num_warps": warps}
    built = triton.compile(source, target=GPUTarget("cuda", capability, 32), options=options)
    tools = Path(triton.__file__).parent / "backends/nvidia/bin"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(built.asm["cubin"])
        file.flush()
        usage = _output(tools / "cuobjdump", "--dump-resource-usage", file.name)
        code = _output(tools / "cuobjdump", "-sass", file.name)
    found = re.search(r"REG:(\d+) STACK:(\d+)", usage)
    if found is None:
        raise RuntimeError(f"{kernel.__name__}: cuobjdump reports no registers")
    products = len(re.findall(r"\bH?G?MMA\.", code.replace("HGMMA", "HMMA")))
    registers, stack = (int(n) for n in found.groups())
    return Compiled(kernel.__name__, registers, stack, built.metadata.shared, products)


def _type_of(argument: str, kernel: str) -> str:
    # Two arguments change their type from kernel to kernel.
    if (argument, kernel) == ("last", "differentiate"):
        return "i32"
    if (argument, kernel) == ("rows", "list_pairs"):
        return _LONG
    return _TYPES.get(argument, "i32")


def _output(*command: object) -> str:
    result = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=True)
    return result.stdout


def every_kernel(capability: int, channels: int, tuning: Tuning) -> list[Compiled]:
    """All kernels of rendering with so many feature channels, and of alignment."""
    few = {"SIDE": tuning.side, "HAS_REGION": True, "BLOCK": 128}
    return [
        compiled(projection.project, capability, **few),
        compiled(projection.cover, capability, **few),
        compiled(projection.list_pairs, capability, SHAPED=False, **few),
        _of_ellipsoids(compiled(projection.list_pairs, capability, SHAPED=True, **few)),
        *_of_tiles(capability, channels, tuning, shaped=False),
        *_of_tiles(capability, channels, tuning, shaped=True),
        compiled(reduction.finish, capability, 2, SIDE=tuning.side, COLOURS=True, BLOCK=64),
        compiled(reduction.add_rows, capability, BLOCK=16, BLOCK_C=64),
        compiled(accumulation.accumulate, capability, 2, BLOCK=64),
    ]


def _of_tiles(capability: int, channels: int, tuning: Tuning, *, shaped: bool) -> list[Compiled]:
    """The kernels that process tiles, of spheres or of ellipsoids."""
    side, batch = tuning.side, tuning.batch
    block = block_of(channels, tuning.channels_forward)
    tile = {"SIDE": side, "BATCH": batch, "PRECISION": tuning.precision, "SHAPED": shaped}
    widest = tuning.channels_backward if channels else 0
    pair = [
        compiled(
            compositing.composite,
            capability,
            tuning.forward_warps(block),
            BLOCK_C=block,
            CENTRES=True,
            **tile,
        ),
        compiled(
            differentiation.differentiate,
            capability,
            tuning.backward_warps(channels),
            BLOCK_C=widest,
            GEOMETRY=True,
            MOVE=channels > 0,
            **tile,
        ),
    ]
    return [_of_ellipsoids(kernel) for kernel in pair] if shaped else pair


def _of_ellipsoids(kernel: Compiled) -> Compiled:
    return replace(kernel, name=f"{kernel.name}, ellipsoids")
