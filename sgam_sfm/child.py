"""Child processes that end with the process that started them, however that ends."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from contextlib import suppress

from sgam_sfm.exit_codes import ERROR

_PR_SET_PDEATHSIG = 1


def end_with_parent(pipe: int) -> None:
    """End this process when the other end of a pipe is closed, which the system does for a parent that was killed."""
    if sys.platform == "linux":  # at once, also where native code keeps the thread below from running
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)

    def watch() -> None:
        while os.read(pipe, 4096):
            pass
        os._exit(ERROR)

    threading.Thread(target=watch, daemon=True).start()
