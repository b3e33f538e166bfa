"""Cameras that are mounted together: COLMAP's rig configuration, applied to the images of a database."""

from __future__ import annotations

import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from sgam_core.errors import InputError

_EXAMPLE = (
    '[{"cameras": [{"image_prefix": "left/", "ref_sensor": true}, {"image_prefix": "right/", "cam_from_rig_rotation": '
    '[1, 0, 0, 0], "cam_from_rig_translation": [-0.1, 0, 0]}]}]'
)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Rigs:
    """A rig configuration. path: where it was read."""

    path: Path
    configs: tuple[pycolmap.RigConfig, ...]

    @property
    def cameras(self) -> tuple[pycolmap.RigConfigCamera, ...]:
        """The cameras of all rigs."""
        return tuple(camera for config in self.configs for camera in config.cameras)

    def prefix_of(self, name: str) -> str:
        """The prefix that tells an image's camera in its rig; empty when it is in none."""
        return next((c.image_prefix for c in self.cameras if name.startswith(c.image_prefix)), "")

    def with_given_camera(self, names: Iterable[str]) -> set[str]:
        """The images whose camera the configuration gives."""
        given = {camera.image_prefix for camera in self.cameras if camera.camera is not None}
        return {name for name in names if self.prefix_of(name) in given}


def read_rigs(path: Path, names: Collection[str]) -> Rigs:
    """Read COLMAP's rig configuration (JSON).

    Args: names: the images of the collection.
    Raises: InputError when it cannot be read, or a camera has no image or no place in its rig.
    """
    try:
        rigs = Rigs(path=path, configs=tuple(pycolmap.read_rig_config(path)))
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"--rigs '{path}' is no rig configuration of COLMAP ({_reason(error)}); expected JSON like {_EXAMPLE}"
        ) from error
    for camera in rigs.cameras:
        if not any(name.startswith(camera.image_prefix) for name in names):
            raise InputError(
                f"--rigs '{path}': no image begins with '{camera.image_prefix}'; names are relative to the image folder"
            )
        if camera.cam_from_rig is None and not camera.ref_sensor:
            raise InputError(
                f"--rigs '{path}': '{camera.image_prefix}' has no cam_from_rig_rotation (w, x, y, z) and "
                "cam_from_rig_translation; COLMAP's mappers need the place of every camera in its rig"
            )
    return rigs


def apply_rigs(database_path: Path, rigs: Rigs) -> None:
    """Write rigs and frames into a database whose images are imported: those that are equal but for the prefix are one.

    Raises: InputError when COLMAP cannot apply them.
    """
    with pycolmap.Database.open(database_path) as database:
        try:
            pycolmap.apply_rig_config(list(rigs.configs), database)
        except (RuntimeError, ValueError) as error:
            raise InputError(f"--rigs '{rigs.path}' cannot be applied: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    return str(error).strip().splitlines()[0].rpartition("Check failed: ")[2]
