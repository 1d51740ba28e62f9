"""Settings that importing `vfr_bake` makes in the libraries that compute matrix products."""

from __future__ import annotations

import os
import subprocess
import sys

PROGRAM = """
import os
import vfr_bake
import numpy as np
square = np.ones((512, 512))
square @ square
print(len(os.listdir("/proc/self/task")))
"""


def test_numpy_multiplies_on_one_thread() -> None:
    """numpy multiplies on one thread: more would wait in busy loops for each other and other programs."""
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, env=environment)
    assert done.stdout == "1\n", done.stdout + done.stderr
