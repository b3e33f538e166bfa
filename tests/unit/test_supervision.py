"""The process that watches a run, with children that only do what a run tells it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict

import psutil
import pytest

from sgam_sfm.exit_codes import ERROR, INTERRUPTED
from sgam_sfm.runs import supervision
from sgam_sfm.runs.supervised import Crash
from sgam_sfm.runs.supervision import supervise

CHILD = """
import json, os, signal, sys, time
from sgam_sfm.runs import supervised
supervised.begin(json.loads(sys.stdin.buffer.readline())["crashes"], int(sys.argv[1]))
"""
TWO_PAIRS = """
for done, pair in enumerate([("a", "b"), ("a", "c")]):
    supervised.tell("Matching pairs", done, pair)
    if not supervised.given_up(pair) and "b" in pair:
        os.kill(os.getpid(), signal.SIGKILL)
print(len(supervised.crashes()), supervised.given_up(("a", "b")), supervised.given_up(("a", "c")))
sys.exit(3)
"""


@pytest.fixture
def child(monkeypatch):
    def use(program: str) -> None:
        monkeypatch.setattr(supervision, "_PROGRAM", CHILD + program)

    return use


def test_a_pair_that_ends_the_process_is_tried_twice_and_the_run_goes_on(child, capfd):
    child(TWO_PAIRS)
    assert supervise(["match"]) == 3
    told = capfd.readouterr()
    assert told.err.splitlines() == 2 * [
        "the process was ended by SIGKILL (out of memory?) at a - b; it is started again"
    ]
    assert told.out.strip() == (
        "2 the process was ended by SIGKILL (out of memory?) while it matched this pair, 2 times; lower --image-size "
        "and --area-size, or take another --matcher"
    )


def test_a_stage_that_ends_the_process_twice_is_the_end(child, capfd):
    child('supervised.tell("Merging keypoints", 0.0, ()); os.kill(os.getpid(), signal.SIGSEGV)')
    assert supervise(["match"]) == ERROR
    assert capfd.readouterr().err.splitlines()[-1] == (
        "error: the process was ended by SIGSEGV at stage 'Merging keypoints', 2 times; what was matched has been "
        "kept, and the same command continues"
    )


def test_a_process_that_ends_before_it_began(child, capfd):
    child("os.abort()")
    assert supervise(["match"]) == ERROR
    assert "error: the process was ended by SIGABRT at its start, 2 times" in capfd.readouterr().err


def test_progress_between_two_ends_is_not_the_same_place():
    first = Crash(signal="SIGKILL", stage="Matching pairs", done=8)
    assert first.same_place(Crash(signal="SIGSEGV", stage="Matching pairs", done=8))
    assert not first.same_place(Crash(signal="SIGKILL", stage="Matching pairs", done=9))


@pytest.mark.parametrize("code", [0, 1, 2, 3, 4, 130])
def test_exit_codes_are_those_of_the_run(child, code):
    child(f"sys.exit({code})")
    assert supervise(["match"]) == code


REAL = """
import sys
from sgam_sfm.runs import supervision
supervision._PROGRAM = '''
import time, types
from sgam_sfm.runs import supervision

def run(arguments):
    import pycolmap  # which takes SIGTERM for itself
    try:
        print("begun", flush=True)
        time.sleep(60)
    except KeyboardInterrupt as error:
        print("stopped by", error, flush=True)
        return 130

import sys
sys.modules["sgam_sfm.cli"] = types.SimpleNamespace(run=run)  # whose imports take a second
sys.exit(supervision.child(int(sys.argv[1])))
'''
sys.exit(supervision.supervise(["match"]))
"""


@pytest.fixture
def begun():
    """A supervised run that waits, and the process id of its child."""
    run = subprocess.Popen([sys.executable, "-c", REAL], stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert run.stdout is not None
    assert run.stdout.readline() == "begun\n"
    (pid,) = [process.pid for process in psutil.Process(run.pid).children()]
    yield run, pid
    run.kill()
    run.wait()
    run.stdout.close()


def test_a_scheduler_that_stops_the_supervisor_stops_the_run_cleanly(begun):
    run, _ = begun
    run.send_signal(signal.SIGTERM)
    assert run.wait(timeout=30) == INTERRUPTED
    assert run.stdout.read() == "stopped by SIGTERM\n"


def test_ctrl_c_reaches_both_and_stops_once(begun):
    run, _ = begun
    os.killpg(run.pid, signal.SIGTERM)  # as SIGINT, which is ignored where tests run in the background of a shell
    assert run.wait(timeout=30) == INTERRUPTED
    assert run.stdout.read() == "stopped by SIGTERM\n"


def test_a_run_ends_with_its_supervisor(begun):
    run, pid = begun
    run.kill()
    run.wait()
    end = time.monotonic() + 30
    while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < end, "it goes on"
        time.sleep(0.05)


def test_the_supervisor_imports_the_standard_library_only():
    heavy = ("numpy", "rich", "pydantic")
    code = f"import sys; import sgam_sfm.runs.supervision; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_help_and_other_commands_are_not_supervised(monkeypatch, capsys):
    monkeypatch.setattr(supervision, "supervise", lambda arguments: 77)
    for arguments, code in ((["match", "--images", "a"], 77), (["match", "--help"], 0), (["no-command"], 2)):
        with pytest.raises(SystemExit) as ended:
            supervision.main(arguments)
        assert ended.value.code == code
    capsys.readouterr()


def test_what_a_crash_is_travels_as_json():
    crash = Crash(signal="SIGBUS", stage="Matching pairs", done=3.0, pair=("a", "b"))
    assert Crash.of(json.loads(json.dumps(asdict(crash)))) == crash
