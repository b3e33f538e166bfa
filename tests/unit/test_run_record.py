"""OUT/progress.json: what a run does, and that only one works in a folder."""

import json
import os
import subprocess
import sys
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sgam_core.errors import InputError, StageError
from sgam_sfm.progress import Stages, duration
from sgam_sfm.runs import run_record
from sgam_sfm.runs.run_record import read_run_record, recording
from sgam_sfm.runs.status import read_status
from sgam_sfm.runs.supervision import Terminated


def test_a_run_tells_its_stage_while_it_lasts(tmp_path):
    stages = Stages(quiet=True)
    with recording(tmp_path, stages), stages.stage("Matching pairs", 10) as advance:
        advance(4)
        record = read_run_record(tmp_path)
        assert (record.state, record.stage, record.total) == ("running", "Matching pairs", 10)
    record = read_run_record(tmp_path)
    assert (record.state, record.stage, record.error) == ("done", "Matching pairs", "")


@pytest.mark.parametrize(
    ("error", "state", "reason"),
    [
        (KeyboardInterrupt(), "stopped", "stopped by Ctrl-C"),
        (StageError("COLMAP failed"), "failed", "COLMAP failed"),
        (ValueError("odd"), "failed", "ValueError: odd"),
    ],
)
def test_how_a_run_ended_is_kept(tmp_path, error, state, reason):
    with pytest.raises(type(error)), recording(tmp_path, Stages(quiet=True)):
        raise error
    record = read_run_record(tmp_path)
    assert (record.state, record.error) == (state, reason)


def test_a_second_run_in_the_same_folder_is_refused(tmp_path):
    second = recording(tmp_path, Stages(quiet=True))
    with recording(tmp_path, Stages(quiet=True)), pytest.raises(InputError) as error:
        second.__enter__()
    assert str(error.value).startswith(f"another run is working in '{tmp_path}'")
    assert str(error.value).endswith("wait for it, stop it, or choose another --output")


def test_a_killed_run_is_told_from_a_running_one(tmp_path):
    code = (
        "import sys, os, signal; from pathlib import Path; from sgam_sfm.runs.run_record import recording;"
        "from sgam_sfm.progress import Stages; stages = Stages(quiet=True);"
        "run = recording(Path(sys.argv[1]), stages); run.__enter__();"
        "stage = stages.stage('Mapping', 3); stage.__enter__(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert json.loads((tmp_path / "progress.json").read_text())["state"] == "running"
    record = read_run_record(tmp_path)
    assert (record.state, record.stage, record.error) == ("killed", "Mapping", "it ended without a word: killed?")


def test_a_stopped_run_goes_on_by_the_command_that_it_was(tmp_path):
    with pytest.raises(KeyboardInterrupt), recording(tmp_path, Stages(quiet=True), "localize"):
        raise KeyboardInterrupt
    (tmp_path / "options.json").write_text("{}")
    assert read_status(tmp_path).next == "start the same `sgam-sfm localize` again"


def test_no_run(tmp_path):
    assert read_run_record(tmp_path) is None
    Path(tmp_path / "progress.json").write_text("{")
    assert read_run_record(tmp_path) is None


def test_the_eta_does_not_count_what_an_earlier_run_has_done(tmp_path):
    stages, told = Stages(quiet=True), []
    stages.listen = told.append
    with stages.stage("Matching pairs", 1000, done=990) as advance:
        assert told[-1].eta_seconds is None
        time.sleep(0.05)
        advance(1)
    assert told[-1].done == 991
    assert 9 * 0.05 <= told[-1].eta_seconds < 60  # not a thousandth of it


def test_the_eta_of_a_resumed_run_starts_with_the_pace_of_the_one_before(tmp_path):
    with recording(tmp_path, stages := Stages(quiet=True)), stages.stage("Matching pairs", 10) as advance:
        time.sleep(0.02)
        advance(4)
    pace = read_run_record(tmp_path).seconds_per_step
    assert 0.005 <= pace < 5
    with recording(tmp_path, stages := Stages(quiet=True)) as before, stages.stage("Matching pairs", 10, done=4):
        assert before.state == "done"
        record = read_run_record(tmp_path)
        assert (record.done, record.total, record.eta_seconds) == (4, 10, pytest.approx(6 * pace))


def test_a_heart_beats_while_nothing_else_happens(tmp_path, monkeypatch):
    monkeypatch.setattr(run_record, "SECONDS_BETWEEN_BEATS", 0.02)
    path = tmp_path / "progress.json"
    stages = Stages(quiet=True)
    with recording(tmp_path, stages), stages.stage("Matching pairs", 10):
        stages.working_on(("a.jpg", "b.jpg"))
        stages.counts.update(pairs=10, pairs_failed=1)
        end = time.monotonic() + 30
        while json.loads(path.read_text())["counts"] != {"pairs": 10, "pairs_failed": 1}:
            assert time.monotonic() < end
            time.sleep(0.01)
        record = read_run_record(tmp_path)
        assert (record.state, record.pid, record.pair) == ("running", os.getpid(), ("a.jpg", "b.jpg"))
        assert datetime.now(UTC) - datetime.fromisoformat(record.updated) < timedelta(minutes=1)


def test_a_stop_by_a_scheduler_is_told_by_its_signal(tmp_path):
    with pytest.raises(KeyboardInterrupt), recording(tmp_path, Stages(quiet=True)):
        raise Terminated("SIGTERM")
    record = read_run_record(tmp_path)
    assert (record.state, record.error) == ("stopped", "stopped by SIGTERM")


@pytest.mark.parametrize(
    ("seconds", "told"), [(0, "0 s"), (29, "29 s"), (31, "1 min"), (3540, "59 min"), (7260, "2 h 01 min")]
)
def test_durations_for_people(seconds, told):
    assert duration(seconds) == told


def test_what_a_killed_process_left_half_written_is_removed(tmp_path):
    ours = [".database.db.12.partial", ".cameras.db.345.partial-wal", "pairs/.00001.h5.7.partial", ".sparse.8.partial"]
    others = ["pairs/00001.h5", ".hidden.partial", "sub/.a.txt.12.partial"]
    for name in (*ours, *others):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / ours[-1]).unlink()
    (tmp_path / ours[-1] / "0").mkdir(parents=True)  # of a mapper
    with recording(tmp_path, Stages(quiet=True)):
        pass
    assert [(tmp_path / name).exists() for name in (*ours, *others)] == [False] * 4 + [True] * 3


def test_the_state_of_a_run_in_a_folder_of_somebody_else(tmp_path, monkeypatch):
    def refuse(*_args, **_options):
        raise PermissionError(".lock")

    with recording(tmp_path, stages := Stages(quiet=True)), stages.stage("Matching pairs", 10):
        monkeypatch.setattr(run_record.FileLock, "acquire", refuse)
        assert read_run_record(tmp_path).state == "running"
