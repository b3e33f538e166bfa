"""A method that runs in a process of its own does not outlive the comparison."""

from __future__ import annotations

import signal
import subprocess
import sys

STARTS_ONE_AND_IS_KILLED = """
import os, signal, time
from sgam_sfm.comparison.running import new_process

if __name__ == "__main__":
    pool = new_process()
    print(pool.submit(os.getpid).result(), flush=True)
    pool.submit(time.sleep, 600)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_process_of_a_method_ends_with_the_comparison(tmp_path):
    script = tmp_path / "compare.py"
    script.write_text(STARTS_ONE_AND_IS_KILLED)
    # Both write to the pipe that this waits for: it times out when the child goes on.
    killed = subprocess.run([sys.executable, script], stdout=subprocess.PIPE, text=True, timeout=60, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert killed.stdout.strip().isdecimal()  # the child had begun
