"""Whether torch failed for want of memory."""

from __future__ import annotations

import torch


def is_out_of_memory(error: Exception) -> bool:
    """Whether that is what an error says."""
    # Torch has a type of its own for it on CUDA, and says it in a plain RuntimeError on the CPU.
    known = isinstance(error, (MemoryError, torch.cuda.OutOfMemoryError))
    return known or "DefaultCPUAllocator" in str(error) or "out of memory" in str(error)
