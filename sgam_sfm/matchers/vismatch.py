"""The matchers of vismatch, in an environment of their own: its kornia and OpenCV cannot be installed beside ours."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path

from sgam_core.errors import OptionError
from sgam_sfm import workers
from sgam_sfm.external import WorkerCommand
from sgam_sfm.matchers.external import ExternalMatcher

_log = logging.getLogger(__name__)
VARIABLE = "SGAM_SFM_VISMATCH"
"""Names the folder of vismatch's environment, where it is another than the default."""


def vismatch(
    *, worker: WorkerCommand, name: str = "", weights: Path | None = None, device: str = "cpu", seed: int = 0
) -> ExternalMatcher:
    """One of vismatch's matchers.

    Args: name: vismatch's, such as sift-nn; of the worker only what is not its script counts.
    Raises: OptionError without a name, with weights, or when vismatch's environment is not there, with the command
        that makes it; and what `ExternalMatcher` raises.
    """
    if not name:
        raise OptionError("--matcher vismatch needs a name: vismatch:loftr, vismatch:roma, vismatch:sift-nn, ...")
    if weights is not None:
        raise OptionError(f"--weights '{weights}': vismatch finds its own; leave it out")
    python = worker.python or python_of(environment())
    if worker.python is None and not python.is_file():
        raise OptionError(
            f"--matcher vismatch:{name} needs vismatch in an environment of its own, which is not in "
            f"'{environment()}'; make it with `{how_to_make()}`, or name another one by --matcher-python or {VARIABLE}"
        )
    _log.warning(
        "vismatch:%s loads its code and weights itself, from Hugging Face and elsewhere, and sgam-sfm does not check "
        "them; the licence of the matcher is its own, see vismatch's documentation",
        name,
    )
    script = Path(workers.__path__[0]) / "vismatch_worker.py"
    command = replace(worker, python=python, script=script, arguments=(name, *worker.arguments))
    return ExternalMatcher(worker=command, device=device, seed=seed)


def environment() -> Path:
    """The folder of vismatch's environment."""
    return Path(os.environ.get(VARIABLE) or Path.home() / ".sgam-sfm" / "vismatch")


def python_of(folder: Path) -> Path:
    """The Python of a virtual environment."""
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def how_to_make() -> str:
    """The command that makes vismatch's environment."""
    folder = environment()
    return f"python3 -m venv '{folder}' && '{python_of(folder)}' -m pip install vismatch"
