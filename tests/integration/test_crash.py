"""Runs that are killed, files that are damaged, memory that does not suffice: nothing is lost, all of it is told."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sgam_sfm import cli
from sgam_sfm.colmap.database import is_whole
from sgam_sfm.colmap.reading import database_content
from sgam_sfm.exit_codes import DONE, ERROR, INTERRUPTED, SOME_FAILED
from sgam_sfm.progress import Stages
from sgam_sfm.runs.matching import CollectionMatcher
from sgam_sfm.runs.run_record import recording
from sgam_sfm.runs.store import stored_files
from tests.room import Room, write_room

# Found by every Python process that is started with its folder on the path.
KILLED_AT_A_PAIR = """
import os, signal
if os.environ.get("KILLED_AT"):
    from sgam_sfm.runs.matching import CollectionMatcher
    plain = CollectionMatcher.match

    def match(self, pair):
        if list(pair) == os.environ["KILLED_AT"].split():
            os.kill(os.getpid(), signal.SIGKILL)
        return plain(self, pair)

    CollectionMatcher.match = match
"""


@pytest.fixture(scope="module")
def folder(room: Room, tmp_path_factory) -> Path:
    written = write_room(room, tmp_path_factory.mktemp("room"))
    for name in sorted(room.images)[4:]:
        (written / "images" / name).unlink()
    return written


def arguments(folder: Path, output: Path) -> list[str]:
    return [
        *("match", "--images", str(folder / "images"), "--labels", str(folder / "labels"), "--output", str(output)),
        *("--matcher", "sift", "--image-size", "240", "--area-size", "160", "--block-images", "1", "--no-mapping"),
        *("--threads", "2"),
    ]


@pytest.fixture(scope="module")
def undisturbed(folder, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("undisturbed") / "out"
    assert cli.run(arguments(folder, output)) == DONE
    return output


@pytest.fixture
def output(undisturbed, tmp_path) -> Path:
    """A finished run, to be spoilt."""
    shutil.copytree(undisturbed, tmp_path / "out")
    return tmp_path / "out"


def test_a_run_that_is_killed_twice_ends_with_the_same_database(folder, undisturbed, tmp_path):
    output = tmp_path / "out"
    rng = random.Random(0)
    for kill in range(2):
        run = subprocess.Popen(
            [sys.executable, "-m", "sgam_sfm", *arguments(folder, output)],
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        end = time.monotonic() + 120
        while len(list((output / "pairs").glob("*.h5"))) <= kill:
            assert run.poll() is None
            assert time.monotonic() < end
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.1))
        os.killpg(run.pid, signal.SIGKILL)
        run.wait()
        last = max((output / "pairs").glob("*.h5"))
        if kill:
            os.truncate(last, last.stat().st_size // 2)
    assert cli.run(arguments(folder, output)) == DONE
    assert database_content(output / "database.db") == database_content(undisturbed / "database.db")


def test_a_pair_that_ends_the_process_is_tried_twice_alone_then_recorded(folder, undisturbed, tmp_path, capsys):
    (tmp_path / "sitecustomize.py").write_text(KILLED_AT_A_PAIR)
    names = sorted(path.name for path in (folder / "images").iterdir())
    output = tmp_path / "out"
    path = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(
        [sys.executable, "-m", "sgam_sfm", *arguments(folder, output), "--log-json"],
        env=os.environ | {"KILLED_AT": f"{names[0]} {names[1]}", "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == SOME_FAILED, done.stderr
    said = "the process was ended by SIGKILL (out of memory?) at {}; it is started again"
    assert done.stderr.count(said.format("stage 'Matching pairs'")) == 1  # while it matched several
    assert done.stderr.count(said.format(f"{names[0]} - {names[1]}")) == 2
    reason = (
        "the process was ended by SIGKILL (out of memory?) while it matched this pair, 2 times; lower --image-size and "
        "--area-size, or take another --matcher"
    )
    summary = json.loads((output / "summary.json").read_text())
    assert summary["pairs"]["failed"] == {f"{names[0]} - {names[1]}": reason}
    matches = database_content(undisturbed / "database.db")["matches"]
    assert database_content(output / "database.db")["matches"].keys() == matches.keys() - {(names[0], names[1])}

    lines = [json.loads(line) for line in (output / "log.jsonl").read_text().splitlines()]
    assert all({*line} == {"time", "level", "logger", "message"} for line in lines)
    assert [line["message"] for line in lines if line["level"] == "WARNING"] == [f"{names[0]} - {names[1]}: {reason}"]

    assert cli.run(["status", str(output)]) == DONE
    status = capsys.readouterr().out
    assert "crashes    ended from outside and started again 3 times (see log.txt)" in status
    assert f"           {names[0]} - {names[1]}: {reason}" in status


def test_a_run_that_is_stopped_in_the_middle_of_a_block_goes_on_there(folder, tmp_path, monkeypatch, capsys):
    whole, output = tmp_path / "whole", tmp_path / "out"
    assert cli.run([*arguments(folder, whole), "--block-images", "4"]) == DONE
    plain, matched = CollectionMatcher.match, []

    def match(self, pair):
        if len(matched) == 4:
            matched.append("stopped")
            raise KeyboardInterrupt
        matched.append(pair)
        return plain(self, pair)

    monkeypatch.setattr(CollectionMatcher, "match", match)
    assert cli.run([*arguments(folder, output), "--block-images", "4", "--threads", "1"]) == INTERRUPTED
    assert cli.run(["status", str(output)]) == DONE
    assert "pairs      4 of 6 matched and stored" in capsys.readouterr().out
    assert cli.run([*arguments(folder, output), "--block-images", "4", "--threads", "1"]) == DONE
    assert len(matched) == 7
    assert len(set(matched)) == 7
    assert [path.read_bytes() for path in stored_files(output)] == [path.read_bytes() for path in stored_files(whole)]
    assert database_content(output / "database.db") == database_content(whole / "database.db")


def test_memory_that_does_not_suffice_once_and_always(folder, tmp_path, monkeypatch):
    tries: dict[tuple, int] = {}
    plain = CollectionMatcher._match
    names = sorted(path.name for path in (folder / "images").iterdir())
    always, once = (names[0], names[1]), (names[0], names[2])

    def match(self, pair):
        tries[pair] = tries.get(pair, 0) + 1
        if pair == always or (pair == once and tries[pair] == 1):
            raise MemoryError("Unable to allocate 9 GiB")
        return plain(self, pair)

    monkeypatch.setattr(CollectionMatcher, "_match", match)
    assert cli.run(arguments(folder, tmp_path / "out")) == SOME_FAILED
    failed = json.loads((tmp_path / "out/summary.json").read_text())["pairs"]["failed"]
    assert failed == {
        " - ".join(
            always
        ): "memory does not suffice (Unable to allocate 9 GiB); lower --image-size and --area-size, or "
        "take another --matcher"
    }
    assert (tries[always], tries[once]) == (2, 2)
    assert set(tries.values()) == {1, 2}


def test_memory_that_does_not_suffice_elsewhere_is_one_line(folder, output, monkeypatch, capsys):
    def write(*arguments: object) -> None:
        raise MemoryError

    monkeypatch.setattr("sgam_sfm.runs.runner.write_database", write)
    (output / "database.db").unlink()
    assert cli.run(arguments(folder, output)) == ERROR
    assert "error: memory does not suffice (MemoryError); lower --image-size or" in capsys.readouterr().err


def test_a_finished_run_says_so_and_does_nothing_again(folder, output, capsys):
    before = {path: path.stat().st_mtime_ns for path in output.rglob("*.h5")}
    assert cli.run([*arguments(folder, output), "--verbose"]) == DONE
    error = " ".join(capsys.readouterr().err.split())
    assert (
        f"'{output}' is complete, and nothing has changed since; `sgam-sfm reconstruct` makes the model anew" in error
    )
    assert {path: path.stat().st_mtime_ns for path in output.rglob("*.h5")} == before
    counts = json.loads((output / "progress.json").read_text())["counts"]
    assert [counts[name] for name in ("images", "images_failed", "pairs", "pairs_done")] == [4, 0, 6, 6]


def test_other_options_of_merging_are_not_a_finished_run(folder, output, undisturbed, capsys):
    assert cli.run([*arguments(folder, output), "--keypoints.track-radius-px", "0"]) == DONE
    assert "is complete" not in capsys.readouterr().err
    assert database_content(output / "database.db") != database_content(undisturbed / "database.db")


def test_a_database_that_was_cut_short_is_not_whole(output):
    assert is_whole(output / "database.db")
    for length in (70_000, 0):
        os.truncate(output / "database.db", length)
        assert not is_whole(output / "database.db")


def test_files_that_were_cut_short_are_made_again(folder, undisturbed, output):
    """As after a power cut, all that a run has written, every other one to nothing."""
    names = [path.relative_to(output) for path in output.rglob("*") if path.is_file() and path.name != ".lock"]
    names.remove(Path("pairs/00001.h5"))
    kept = (output / "pairs/00001.h5").stat().st_mtime_ns
    assert len(names) > 12
    for index, name in enumerate(sorted(names)):
        os.truncate(output / name, (index % 2) * (output / name).stat().st_size * 7 // 10)
    assert cli.run(arguments(folder, output)) == DONE
    assert (output / "pairs/00001.h5").stat().st_mtime_ns == kept
    assert database_content(output / "database.db") == database_content(undisturbed / "database.db")
    for name in names:
        if name.suffix in (".h5", ".png") or name.name == "labels.json":
            assert (output / name).read_bytes() == (undisturbed / name).read_bytes(), name
    assert "is damaged" in (output / "log.txt").read_text(errors="replace")


def test_a_damaged_block_is_told(output, capsys):
    path = output / "pairs/00001.h5"
    path.write_bytes(b"cut")
    assert cli.run(["status", str(output)]) == DONE
    assert "damaged    00001.h5: the next run matches these pairs again" in capsys.readouterr().out


def test_two_runs_on_one_output(folder, output, capsys):
    with recording(output, Stages(quiet=True)):
        assert cli.run(arguments(folder, output)) == ERROR
    error = capsys.readouterr().err
    assert f"error: another run is working in '{output}' (process {os.getpid()} on " in error
    assert "wait for it, stop it, or choose another --output" in error
    assert (output / "log.txt").read_text().splitlines()[-1].endswith("or choose another --output")
