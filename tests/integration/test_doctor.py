"""`sgam-sfm doctor`: what it finds here, and what it says of a machine that is not well."""

import io
from types import SimpleNamespace

from rich.console import Console

from sgam_sfm import cli, doctor
from sgam_sfm.commands.doctor import DoctorOptions, run
from sgam_sfm.exit_codes import DONE, ERROR, USAGE


def test_this_machine_is_well(tmp_path, capsys):
    assert cli.run(["doctor", "--output", str(tmp_path / "not" / "there" / "yet")]) == DONE
    lines = {line.split()[1]: line for line in capsys.readouterr().out.splitlines() if line.startswith("ok")}
    assert {"memory", "disk", "area-matcher", "matcher", "segmenter", "self-test"} <= set(lines)
    assert "verified matches of two rendered images, off by 0." in lines["self-test"]
    assert "xfeat-star" in lines["matcher"]
    assert f"GB free at '{tmp_path}'" in lines["disk"]


def test_what_is_wrong_is_told_with_its_mend(monkeypatch, capsys):
    monkeypatch.setattr(doctor.psutil, "disk_usage", lambda path: SimpleNamespace(free=1e8))
    packages = [SimpleNamespace(name=name) for name in ("opencv-python", "opencv-python-headless", "numpy")]
    monkeypatch.setattr(doctor, "distributions", lambda: packages)
    assert cli.run(["doctor", "--no-self-test"]) == ERROR
    printed = capsys.readouterr().out
    assert "bad disk         0.1 GB free at" in printed
    assert "-> choose an --output on another disk" in printed
    assert "bad opencv       2 packages install cv2: opencv-python, opencv-python-headless" in printed
    assert "pip uninstall -y opencv-python opencv-python-headless && pip install --force-reinstall opencv-" in printed
    assert "self-test" not in printed


def test_a_self_test_that_finds_nothing_is_bad(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "_TEST_MAX_ERROR_PX", 0.0)
    assert cli.run(["doctor"]) == ERROR
    assert "-> the models give wrong results here: report it with this output" in capsys.readouterr().out


def test_a_device_that_is_not_there(capsys):
    assert cli.run(["doctor", "--device", "cuda:7", "--no-self-test"]) == USAGE
    assert "--device 'cuda:7' cannot be used" in capsys.readouterr().err


def test_a_terminal_is_told_that_it_takes_a_while_and_a_file_is_not(capsys):
    for terminal in (True, False):
        console = Console(file=io.StringIO(), force_terminal=terminal)
        assert run(DoctorOptions(self_test=False), console) == DONE
        told = console.file.getvalue()
        assert ("the first time takes a minute or two" in told) is terminal
        assert bool(told) is terminal
        assert "GB free at" in capsys.readouterr().out
