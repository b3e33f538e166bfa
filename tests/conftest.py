"""Shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import jaxtyping
import PIL.Image
import pytest

from tests.paths import DATA
from tests.room import Room, small_room
from tests.tutorials import DOCS, follow


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
def tutorial(room: Room, tmp_path_factory) -> Path:
    """A folder where the first tutorial has been followed, on three views of the room: `photos` and the run `out`."""
    folder: Path = tmp_path_factory.mktemp("tutorial")
    (folder / "photos").mkdir()
    for name in list(room.images)[:3]:
        PIL.Image.fromarray(room.images[name].pixels).save(folder / "photos" / name, quality=95)
    follow(DOCS / "tutorials/photos.md", folder)
    return folder


@pytest.fixture(scope="session")
def splat(tutorial: Path) -> Path:
    """The folder for trainers of Gaussian splatting that the tutorial for them makes of that run."""
    follow(DOCS / "tutorials/splatting.md", tutorial)
    return tutorial / "splat"


@pytest.fixture
def unchecked():
    """Turns the type checks of tests off, for tests of our own messages about wrong shapes."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
