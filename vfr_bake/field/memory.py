"""Memory for tables that are read at random."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def zeros(*shape: int) -> Tensor:
    """A float32 tensor of zeros whose memory NumPy has allocated.

    For large arrays NumPy asks Linux for pages of 2 MB, torch does not. A hash grid is read and written at
    random, and with pages of 4 kB nearly every access would first have to look its page up.

    >>> zeros(2, 3).shape
    torch.Size([2, 3])
    """
    return torch.from_numpy(np.zeros(shape, np.float32))
