"""Child processes that end with the process that started them, however that ends."""

from __future__ import annotations

import os
import threading

from sgam_sfm.exit_codes import ERROR


def end_with_parent(pipe: int) -> None:
    """End this process when the other end of a pipe is closed, which the system does for a parent that was killed."""

    def watch() -> None:
        while os.read(pipe, 4096):
            pass
        os._exit(ERROR)

    threading.Thread(target=watch, daemon=True).start()
