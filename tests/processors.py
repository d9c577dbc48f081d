"""Tests with the kernels of other processors: `python -m tests.processors NAME PYTEST-OPTION...`.

OpenBLAS, NumPy and the compiled kernel choose a code path by the processor, and round differently.
Each path that this processor has can be selected; one without AVX-512 cannot run `skylakex`.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy._core._multiarray_umath import (  # type: ignore[import-not-found]
    __cpu_dispatch__,
    __cpu_features__,
)

from sysid_bench.instruction_sets import VARIABLE

_AVX2: Final = ("X86_V3", "AVX2", "FMA3")
"""Names of the instruction set in versions of NumPy."""


@dataclass(frozen=True)
class Processor:
    """Kernels of OpenBLAS (empty: as the processor has it), of regressors, and those that NumPy may
    choose."""

    openblas: str
    kernel: str
    chosen: Callable[[str], bool]


PROCESSORS: Final[Mapping[str, Processor]] = {
    "haswell": Processor("Haswell", "x86-64-v3", lambda feature: feature in _AVX2),
    "sandybridge": Processor("Sandybridge", "baseline", lambda feature: False),
    "skylakex": Processor("SkylakeX", "x86-64-v4", lambda feature: True),
    "numpy": Processor("", "numpy", lambda feature: True),
}


def main() -> int:
    """Run pytest with the kernels of a processor; its exit code, 0 where it cannot run here."""
    name, *options = sys.argv[1:]
    processor = PROCESSORS[name]
    has_avx512 = any(__cpu_features__.get(feature) for feature in ("X86_V4", "AVX512_SKX"))
    if name == "skylakex" and not has_avx512:
        print(f"{name}: left out, this processor has no AVX-512.", flush=True)
        return 0
    environ = {**os.environ, VARIABLE: processor.kernel}
    if processor.openblas:
        environ["OPENBLAS_CORETYPE"] = processor.openblas
    # NumPy warns of the name of an instruction set that it does not choose here anyway.
    off = [f for f in __cpu_dispatch__ if __cpu_features__[f] and not processor.chosen(f)]
    if off:
        environ["NPY_DISABLE_CPU_FEATURES"] = " ".join(off)
    print(f"{name}: {processor.kernel}, NumPy {np.__version__} without {off}", flush=True)
    return subprocess.run([sys.executable, "-m", "pytest", *options], env=environ).returncode


if __name__ == "__main__":
    sys.exit(main())
