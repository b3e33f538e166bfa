"""Shared by all tests."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import jaxtyping
import pytest

from tests.paths import DATA
from tests.room import Room, small_room


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real images, or a skip that says where it was looked for."""
    if not DATA.is_dir():
        if os.environ.get("SGAM_SFM_REQUIRE_DATA"):
            pytest.fail(f"real images not found at '{DATA}', and SGAM_SFM_REQUIRE_DATA is set")
        pytest.skip(f"real images not found at '{DATA}'; set SGAM_SFM_DATA")
    return DATA


@pytest.fixture(scope="session")
def room() -> Room:
    """The rendered room, in small."""
    return small_room()


@pytest.fixture(scope="session")
def other_python(tmp_path_factory) -> Path:
    """The Python of another environment, which has numpy and OpenCV and nothing else."""
    folder = tmp_path_factory.mktemp("other") / "env"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    python = folder / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-compile"]
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run([*install, "numpy", "opencv-python-headless"], env=clean, capture_output=True, text=True)
    if done.returncode:
        reason = f"pip cannot install OpenCV into a second environment: {done.stderr[-300:]}"
        if os.environ.get("SGAM_SFM_REQUIRE_DATA"):
            pytest.fail(f"{reason}, and SGAM_SFM_REQUIRE_DATA is set")
        pytest.skip(reason)
    return python


@pytest.fixture
def unchecked():
    """Turns the type checks of tests off, for tests of our own messages about wrong shapes."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
