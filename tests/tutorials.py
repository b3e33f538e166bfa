"""The tutorials of docs/, followed line by line.

Of a page's fenced blocks, those with a title are files, which are written, and `sh` holds commands, which are run.
`console` has other programs and is left alone.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from sgam_sfm import cli
from sgam_sfm.exit_codes import DONE

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
_FENCE = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)
_SGAM_SFM = 'sgam-sfm() { python -m sgam_sfm "$@"; }\n'


@dataclass(frozen=True)
class Block:
    """A fenced block of a page; `title` is the name of the file that it shows."""

    language: str
    title: str
    text: str

    @property
    def commands(self) -> list[str]:
        """Its lines, those that end with a backslash joined with the next."""
        return [line for line in self.text.replace("\\\n", " ").splitlines() if line.strip()]


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in their order."""
    return [Block(*(part or "" for part in found)) for found in _FENCE.findall(page.read_text(encoding="utf-8"))]


def follow(page: Path, folder: Path, *, packages: Path | None = None) -> list[str]:
    """Follow a page in a folder. Returns: the commands that were run.

    Without `packages`, commands of ours run in this process, which spares their imports. With it, everything runs in
    processes of its own, and what pip installs goes to that folder.
    """
    done: list[str] = []
    for block in blocks(page):
        if block.title:
            path = folder / block.title
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text, encoding="utf-8")
        for command in block.commands if block.language == "sh" else ():
            if packages is None and command.startswith("sgam-sfm "):
                code = _ours(command, folder)
            else:
                code = _shell(command, folder, packages)
            assert code == DONE, f"{page.name}: `{command}` ended with exit code {code}"
            done.append(command)
    return done


def _ours(command: str, folder: Path) -> int:
    with contextlib.chdir(folder):
        try:
            return cli.run(shlex.split(command)[1:])
        except SystemExit as ended:  # of a usage error, or of --help
            return int(ended.code or 0)


def _shell(command: str, folder: Path, packages: Path | None) -> int:
    environment = {**os.environ, "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])}
    places = [str(ROOT), str(packages) if packages else "", os.environ.get("PYTHONPATH", "")]
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, places))
    if packages:  # a plugin alone: no network, nothing beside it, nothing in the environment of the tests
        environment |= {"PIP_TARGET": str(packages), "PIP_NO_INDEX": "1", "PIP_NO_DEPS": "1"}
        environment |= {"PIP_NO_BUILD_ISOLATION": "0"}  # pip reads it as the value of --build-isolation
    shell = ["bash", "-e", "-o", "pipefail", "-c", _SGAM_SFM + command]
    return subprocess.run(shell, cwd=folder, env=environment, check=False).returncode
