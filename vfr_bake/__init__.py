"""Train Volume Feature Rendering fields and bake them into assets that `player` shows on a CPU."""

import os

__version__ = "0.1.0"

# OpenMP's threads, torch's and numba's alike, wait for work in a busy loop unless told otherwise, and take
# the cores from whatever else runs: two trainings at once on two cores took 151 s instead of 24. Threads that
# sleep at once come too late for the next of many small operations, and refinement takes 1.4 times as long.
# So they look some 20 microseconds for work, and then sleep. OpenMP reads this once, when torch or numba is
# imported.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")

# numpy's matrix products have threads of their own, which wait for one another in a busy loop at every block.
# Where another program wants the cores, each wait lasts until that has had its turn: products of 100,000 rows
# took 5 s instead of 0.4. What there is to multiply with numpy is small; torch and numba have the large work.
# OpenBLAS reads this once, when numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
