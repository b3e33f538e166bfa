"""Names of area matchers, point matchers and segmenters become objects, through entry points."""

from __future__ import annotations

import inspect
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from sgam_core.errors import OptionError
from sgam_sfm.nearest import did_you_mean

KINDS = {
    "matcher": "sgam_sfm.matchers",
    "segmenter": "sgam_sfm.segmenters",
    "area-matcher": "sgam_sfm.area_matchers",
}
"""The option that names a model, and the entry-point group it is looked up in."""


def available(kind: str) -> dict[str, EntryPoint]:
    """Every installed entry point of a kind, by name, sorted."""
    return {entry.name: entry for entry in sorted(entry_points(group=KINDS[kind]), key=lambda entry: entry.name)}


def require(kind: str, name: str) -> EntryPoint:
    """The entry point of that name, or of what stands before its colon.

    Raises: OptionError, with the nearest name, when there is none.
    """
    known = available(kind)
    prefix = name.partition(":")[0]
    for each in (name, prefix):
        if each in known:
            return known[each]
    hint = did_you_mean(prefix, known)
    raise OptionError(f"--{kind} '{name}' is unknown; {hint}known: {', '.join(known)}")


def create(kind: str, name: str, **settings: Any) -> Any:
    """Make the model of that name.

    Of `settings` those are passed on that the model's constructor takes, so that a matcher of a few lines needs no
    constructor at all. Of a name `prefix:rest`, the model `prefix` takes the rest as its setting `name`.
    Raises: OptionError for an unknown name, with the nearest one, or when a package that it needs is not installed.
    """
    entry = require(kind, name)
    rest = name.removeprefix(entry.name).removeprefix(":")
    try:
        factory = entry.load()
        taken = inspect.signature(factory).parameters
        if rest and "name" not in taken:
            raise OptionError(
                f"--{kind} '{name}' is unknown; '{entry.name}' has no models by name: leave ':{rest}' out"
            )
        settings |= {"name": rest} if rest else {}
        return factory(**{key: value for key, value in settings.items() if key in taken})
    except ModuleNotFoundError as error:
        raise OptionError(f"--{kind} '{name}' needs the package '{error.name}'; run `{install(entry)}`") from error


def install(entry: EntryPoint) -> str:
    """The command that brings what a model needs: its package, with the extras that its entry point names."""
    package = entry.dist.name if entry.dist else entry.module.partition(".")[0]
    return f"pip install '{package}[{','.join(entry.extras)}]'" if entry.extras else f"pip install '{package}'"
