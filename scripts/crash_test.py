"""Kill a run at random points, start it again, and compare its database with that of an undisturbed run.

    python scripts/crash_test.py FOLDER [--kills 50] [--seed 0] [-- options of sgam-sfm match]

The collection is the rendered room, small. A kill is SIGKILL to every process of the run (as a power cut or a job
scheduler does it), to the supervisor alone (its children have to end by themselves), or to the process that matches
(which has to be started again by itself, at most once for each output folder, since a pair that ends the process twice
is given up), or SIGTERM to the supervisor. After one kill in four the file that was written last is cut short too. A
run that comes to its end is compared, and another one is begun in a new folder. Prints JSON; the exit code is 1 when
any database differs.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from sgam_sfm.colmap.reading import database_content
from sgam_sfm.exit_codes import DONE, INTERRUPTED, SOME_FAILED
from sgam_sfm.scene import demo_views, write_scene

OPTIONS = ("--matcher", "sift", "--image-size", "240", "--area-size", "160", "--block-images", "2", "--no-mapping")
CUT_SHARE, EARLY_SHARE = 0.25, 0.1
NOT_CUT = (".lock", "progress.json", "log.txt", "colmap.log")  # written all the time, and read by nobody on resuming
KINDS = ("all", "all", "supervisor", "worker", "stop")


@dataclass
class Outcome:
    """What was done to the runs, and what became of them."""

    kills: Counter[str] = field(default_factory=Counter)
    stages: Counter[str] = field(default_factory=Counter)
    cut: Counter[str] = field(default_factory=Counter)
    finished: int = 0
    different: list[str] = field(default_factory=list)


def main() -> int:
    """Run the test. Returns: the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--views", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("options", nargs="*", default=OPTIONS)
    arguments = parser.parse_args()
    start = time.monotonic()
    command = prepare(arguments.folder, arguments.views, tuple(arguments.options))
    outcome = torture(command, arguments.folder, arguments.kills, random.Random(arguments.seed))
    print(json.dumps(vars(outcome) | {"seconds": round(time.monotonic() - start)}, indent=2))
    return int(bool(outcome.different))


def prepare(folder: Path, views: int, options: tuple[str, ...]) -> list[str]:
    """The room in folder/scene, an undisturbed run in folder/undisturbed. Returns: the command but for --output."""
    scene = folder / "scene"
    shutil.rmtree(folder, ignore_errors=True)
    write_scene(scene, demo_views(320)[2 : 2 + views])
    command = [sys.executable, "-m", "sgam_sfm", "match", "--images", str(scene / "images"), *options]
    command += ["--labels", str(scene / "labels"), "--output"]
    subprocess.run([*command, str(folder / "undisturbed")], check=True, capture_output=True)
    return command


def torture(command: list[str], folder: Path, kills: int, rng: random.Random) -> Outcome:
    """Kill runs until there were enough kills and the last one is finished."""
    expected = database_content(folder / "undisturbed" / "database.db")
    seconds = sum(json.loads((folder / "undisturbed" / "summary.json").read_text())["seconds"].values())
    outcome = Outcome()
    worker_killed = False
    while True:
        output = folder / f"run{outcome.finished}"
        log = (folder / "errors.txt").open("ab")
        run = subprocess.Popen([*command, str(output)], stdout=log, stderr=log, start_new_session=True)
        while run.poll() is None and outcome.kills.total() < kills:
            if rng.random() > EARLY_SHARE:
                _wait_for_stage(run, output)
            time.sleep(rng.uniform(0, seconds))
            kind = rng.choice(KINDS)
            if run.poll() is not None or (kind == "worker" and worker_killed):
                continue
            outcome.stages[_record(output).get("stage", "start")] += 1
            worker_killed |= kind == "worker"
            outcome.kills[kind] += _kill(run, kind)
            if kind != "worker" and rng.random() < CUT_SHARE:
                outcome.cut[_cut_last(output, rng)] += 1
        code = run.wait()
        log.close()
        if code < 0 or code == INTERRUPTED:
            continue
        # What the last kill cut short may be a pair of an image: nothing may have failed.
        same = code == DONE and database_content(output / "database.db") == expected
        outcome.different += [] if same else [f"{output} (exit code {code}{', some failed' * (code == SOME_FAILED)})"]
        outcome.finished += 1
        worker_killed = False
        if outcome.kills.total() >= kills:
            return outcome


def _wait_for_stage(run: subprocess.Popen, output: Path) -> None:
    """Until the process that works now says that it does: the imports take longer than a small run."""
    while run.poll() is None:
        if psutil.pid_exists(_record(output).get("pid", -1)) and _record(output).get("state") == "running":
            return
        time.sleep(0.02)


def _kill(run: subprocess.Popen, kind: str) -> int:
    """Returns: how many kills this was, none when there is nothing left to kill."""
    try:
        if kind == "all":
            os.killpg(run.pid, signal.SIGKILL)
        elif kind == "stop":
            os.kill(run.pid, signal.SIGTERM)
        elif kind == "supervisor":
            children = psutil.Process(run.pid).children(recursive=True)
            os.kill(run.pid, signal.SIGKILL)
            run.wait()
            psutil.wait_procs(children, timeout=60)
            if any(child.is_running() and child.status() != psutil.STATUS_ZOMBIE for child in children):
                raise RuntimeError(f"{children} have outlived the run")
        else:
            psutil.Process(run.pid).children()[0].kill()
            return 1
        run.wait()
    except (ProcessLookupError, psutil.NoSuchProcess, IndexError):
        return 0
    return 1


def _cut_last(output: Path, rng: random.Random) -> str:
    """Cut the file that was written last to a random length. Returns: its name, digits as #."""
    files = [path for path in output.rglob("*") if path.is_file() and path.name not in NOT_CUT]
    if not files:
        return "none"
    last = max(files, key=lambda path: path.stat().st_mtime)
    os.truncate(last, rng.randrange(last.stat().st_size + 1))
    return "".join("#" if c.isdigit() else c for c in last.relative_to(output).as_posix())


def _record(output: Path) -> dict[str, Any]:
    try:
        return json.loads((output / "progress.json").read_text())
    except (OSError, ValueError):
        return {}


if __name__ == "__main__":
    sys.exit(main())
