"""Learning algorithms, one file each.

PyTorch's own functions come out differently on processors with wider registers. What they are used for beside
:mod:`rl2grid.dense` runs on those of AVX2 wherever there are such, so that trainings are the same on all of them; a
process that has imported PyTorch before has chosen already.
"""

from __future__ import annotations

import os

from llvmlite.binding import get_host_cpu_features

if get_host_cpu_features().get("avx2"):
    os.environ.setdefault("ATEN_CPU_CAPABILITY", "avx2")
