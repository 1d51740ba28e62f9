"""Train Volume Feature Rendering fields and bake them into assets that `player` shows on a CPU."""

import os

__version__ = "0.1.0"

# The OpenMP threads of torch and numba wait for work in a busy loop by default, and take the cores from other
# programs: two trainings at once on two cores took 151 s instead of 24. Threads that sleep immediately wake
# too late for the next of many small operations: refinement then takes 1.4 times as long. So they wait some
# 20 microseconds in a loop, and then sleep. OpenMP reads these variables once, when torch or numba is
# imported.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")

# numpy's matrix products (OpenBLAS) have threads of their own, which wait for one another in a busy loop at
# every block. If another program wants the cores, each wait lasts until that program has had its turn:
# products of 100,000 rows took 5 s instead of 0.4. One thread is enough here, because numpy's products are
# small, and torch and numba do the large work. OpenBLAS reads this variable once, when numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
