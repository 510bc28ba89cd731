"""Learning algorithms, one file each.

PyTorch's own functions, and those of MKL that it calls, come out differently on processors with wider registers or of
another maker. What they are used for beside :mod:`rl2grid.dense` runs on PyTorch's code for AVX2 wherever there are
such, and on MKL's for any processor, so that trainings are the same on all of them. A process that has used them before
has chosen already; so has who sets the variables.
"""

from __future__ import annotations

import os

from llvmlite.binding import get_host_cpu_features

if get_host_cpu_features().get("avx2"):
    os.environ.setdefault("ATEN_CPU_CAPABILITY", "avx2")
os.environ.setdefault("MKL_CBWR", "COMPATIBLE")
