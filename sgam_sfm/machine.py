"""What this machine has and what this process has used of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sgam_core.errors import OptionError

if TYPE_CHECKING:
    import torch

Precision = Literal["auto", "full", "half"]
"""Of a network's numbers: 32 bits, or 16 where they suffice."""


def find_device(name: str, named: str = "device") -> torch.device:
    """The torch device of that name; `auto` is cuda where there is one.

    Args: named: how a message calls what the user gave.
    Raises: OptionError for a device that this machine does not have.
    """
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise OptionError(f"{named} '{name}' cannot be used ({reason}); try 'cpu', or 'cuda' with a GPU") from error
    return device


def runs_half(precision: Precision, device: torch.device) -> bool:
    """Whether a network that holds its results in half precision is to run so: `auto`, where that is faster.

    Raises: OptionError for half precision on the CPU, where networks take longer with it.
    """
    if precision == "half" and device.type == "cpu":
        raise OptionError(
            "--precision half: on the CPU networks take one and a half times as long in half precision, or more; leave "
            "it out, or give --device cuda with a GPU"
        )
    return precision == "half" or (precision == "auto" and device.type == "cuda")


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether it is a CPU with instructions for products of bfloat16, which take half as long as those of 32 bits."""
    import torch

    known: Mapping[str, object] = getattr(torch.cpu, "get_capabilities", dict)()  # older versions of torch do not tell
    return device.type == "cpu" and any(known.get(name) for name in ("avx512_bf16", "amx_bf16"))


def use_threads(number: int) -> None:
    """Let torch and OpenCV use this many CPU threads (0: as many as they would by themselves).

    Raises: OptionError for less than none.
    """
    if number < 0:
        raise OptionError(f"--threads is {number}; expected a number of cores, or 0 for all")
    import cv2
    import torch

    for_torch, for_opencv = _default_threads()
    torch.set_num_threads(number or for_torch)
    cv2.setNumThreads(number or for_opencv)


@contextmanager
def single_threads() -> Iterator[int]:
    """Torch and OpenCV use one thread for whoever calls them inside. Yields: how many torch used before."""
    import cv2
    import torch

    for_torch, for_opencv = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        yield for_torch
    finally:
        torch.set_num_threads(for_torch)
        cv2.setNumThreads(for_opencv)


@cache
def _default_threads() -> tuple[int, int]:
    """Those of torch and OpenCV before any were set: results differ in their last digits with the number."""
    import cv2
    import torch

    return torch.get_num_threads(), cv2.getNumThreads()


def out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory is used up; libraries tell it in their own words."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    words = ("out of memory", "DefaultCPUAllocator", "Failed to allocate memory", "Insufficient memory", "bad_alloc")
    return isinstance(error, Exception) and any(word in str(error) for word in words)


def peak_memory_mb() -> float | None:
    """The most memory this process has held, MB; None where the system does not tell (Windows)."""
    status = Path("/proc/self/status")
    if status.exists():  # on Linux ru_maxrss starts at what the parent held
        peak = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(peak.split()[1]) / 1024
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2  # bytes on macOS
