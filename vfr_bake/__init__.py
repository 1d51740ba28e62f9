"""Train Volume Feature Rendering fields and bake them into assets that `player` shows on a CPU."""

import os

__version__ = "0.1.0"

# OpenMP's threads, torch's and numba's alike, wait for work in a busy loop unless told otherwise, and take
# the cores from whatever else runs: two trainings at once on two cores took 151 s instead of 24. Alone, a
# training is no slower without it. OpenMP reads this once, when torch or numba is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
