"""Runs that end before their time: Ctrl-C at every stage, a full disk, folders that cannot be written."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sgam_sfm import cli
from sgam_sfm.colmap.reading import database_content
from sgam_sfm.exit_codes import DONE, ERROR, INTERRUPTED, USAGE
from tests.room import Room, write_room

# Presses Ctrl-C, which reaches the process and its children alike, once the stage has lasted for a while.
STOPPED_AT = """
import os, signal, sys, threading
from contextlib import contextmanager
from sgam_sfm import cli, progress

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the tests run in the background of a shell
wanted, seconds, plain = sys.argv[1], float(sys.argv[2]), progress.Stages.stage

@contextmanager
def stage(self, name, total, done=0.0):
    with plain(self, name, total, done) as advance:
        if name == wanted:
            threading.Timer(seconds, os.killpg, (0, signal.SIGINT)).start()
        yield advance

progress.Stages.stage = stage
sys.exit(cli.run(sys.argv[3:]))
"""
STAGES = {
    "Reading images": 0.0,
    "Segmenting images": 0.0,
    "Matching pairs": 1.0,
    "Merging keypoints": 0.0,
    "Verifying pairs": 0.0,
    "Mapping": 1.0,
}


@pytest.fixture(scope="module")
def folder(room: Room, tmp_path_factory) -> Path:
    return write_room(room, tmp_path_factory.mktemp("room"))


def arguments(folder: Path, output: Path) -> list[str]:
    return [
        *("match", "--images", str(folder / "images"), "--cameras", str(folder / "cameras.txt")),
        *("--labels", str(folder / "labels"), "--output", str(output)),
        *("--block-images", "2", "--area-size", "320", "--image-size", "480", "--max-crop-pixels", "300000"),
    ]


def test_ctrl_c_at_every_stage_stops_cleanly_and_loses_nothing(folder, tmp_path, capsys):
    output = tmp_path / "out"
    for name, seconds in STAGES.items():
        command = [sys.executable, "-c", STOPPED_AT, name, str(seconds), *arguments(folder, output)]
        done = subprocess.run(command, capture_output=True, text=True, start_new_session=True, check=False)
        assert done.returncode == INTERRUPTED, f"{name}: {done.stderr}"
        assert "Traceback" not in done.stderr, name
        assert "stopped; the same command continues where it was" in done.stderr, name
        assert cli.run(["status", str(output)]) == DONE
        status = capsys.readouterr().out
        assert status.startswith("state      stopped"), name
        assert f"next       sgam-sfm match --config '{output}/options.json'" in status or name == "Reading images"
    assert cli.run(["match", "--config", str(output / "options.json")]) == DONE
    assert cli.run(arguments(folder, tmp_path / "undisturbed")) == DONE
    assert database_content(output / "database.db") == database_content(tmp_path / "undisturbed" / "database.db")


@pytest.fixture
def small_disk(tmp_path):
    """A folder with room for a few megabytes."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(disk)], capture_output=True)
    if mounted.returncode:
        pytest.skip(f"a small file system cannot be mounted here: {mounted.stderr.decode().strip()}")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_full_disk_is_one_line_and_the_run_goes_on_when_there_is_space(folder, small_disk, tmp_path, capsys):
    output = small_disk / "out"
    ballast = small_disk / "ballast"
    for free in (0, 100_000, 400_000, 800_000):  # full at the start, in the middle, at the end
        ballast.unlink(missing_ok=True)
        ballast.write_bytes(bytes(max(shutil.disk_usage(small_disk).free - free, 0)))
        assert cli.run(arguments(folder, output)) == ERROR
        errors = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
        assert "error: the disk is full; free some space, then start the same command again" in errors[-1], errors
        assert not any("Traceback" in line for line in errors)
    ballast.unlink()
    subprocess.run(["mount", "-o", "remount,size=200m", str(small_disk)], check=True)
    assert cli.run(arguments(folder, output)) == DONE


def test_an_output_that_cannot_be_written_is_one_line(folder, tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    assert cli.run(arguments(folder, tmp_path / "file" / "out")) == ERROR
    assert "a file is in the place of a folder; choose another folder" in capsys.readouterr().err
    assert cli.run(arguments(folder, tmp_path / "file")) == ERROR
    assert "a file is in the place of a folder; choose another folder" in capsys.readouterr().err


def test_an_output_that_cannot_be_made_is_one_line(folder, capsys):
    assert cli.run(arguments(folder, Path("/proc/out"))) == ERROR
    told = "error: '/proc/out' cannot be made (No such file or directory: '/proc/out'); choose another --output"
    assert told in capsys.readouterr().err
    assert (
        cli.run(["pairs", "exhaustive", "--images", str(folder / "images"), "--output", "/proc/out/pairs.txt"]) == ERROR
    )
    assert "'/proc/out/pairs.txt' cannot be made" in capsys.readouterr().err
    assert cli.run(["segment", "--images", str(folder / "images"), "--output", "/proc/out"]) == ERROR
    assert told in capsys.readouterr().err


def test_a_folder_that_may_not_be_written_is_one_line(folder, small_disk, capsys):
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    assert cli.run(arguments(folder, small_disk / "out")) == ERROR
    error = capsys.readouterr().err
    assert f"'{small_disk}/out' cannot be written: the file system is read-only; choose a folder that can be" in error


def test_status_of_a_finished_run_and_of_no_run(folder, tmp_path, capsys):
    output = tmp_path / "out"
    assert cli.run([*arguments(folder, output), "--no-mapping"]) == DONE
    capsys.readouterr()
    assert cli.run(["status", str(output), "--json"]) == DONE
    status = json.loads(capsys.readouterr().out)
    assert status["run"]["state"] == "done"
    assert (status["images"], status["labels"], status["pairs"], status["pairs_done"]) == (6, 6, 15, 15)
    assert status["summary"]["pairs"]["verified"] > 3
    assert cli.run(["status", str(tmp_path)]) == ERROR
    assert f"'{tmp_path}' holds no run of sgam-sfm; did you mean '{output}'?" in capsys.readouterr().err
    assert cli.run(["status", str(tmp_path / "nowhere")]) == ERROR
    assert f"'{tmp_path}/nowhere' does not exist; give the --output folder of `sgam-sfm match`" in (
        capsys.readouterr().err
    )


def test_status_of_a_run_that_did_not_begin_names_no_command_that_goes_on(tmp_path, capsys):
    output = tmp_path / "out"
    assert cli.run(["match", "--images", str(tmp_path / "nowhere"), "--output", str(output)]) == ERROR
    capsys.readouterr()
    assert cli.run(["status", str(output)]) == DONE
    status = capsys.readouterr().out
    assert status.startswith("state      failed")
    assert "next" not in status


@pytest.mark.parametrize(
    "wrong", [["--pairs", "PAIRS"], ["--camera-model", "PINHOL"], ["--device", "cud"], ["--labels", "nowhere"]]
)
def test_wrong_options_are_told_before_images_are_read(folder, tmp_path, wrong, capsys):
    (tmp_path / "pairs.txt").write_text("no.jpg other.jpg\n")
    wrong = [word.replace("PAIRS", str(tmp_path / "pairs.txt")) for word in wrong]
    assert cli.run([*arguments(folder, tmp_path / "out"), *wrong]) in (ERROR, USAGE)
    assert "Reading images" not in capsys.readouterr().err
