"""Names of area matchers, point matchers and segmenters become objects, through entry points."""

from __future__ import annotations

import inspect
from importlib.metadata import EntryPoint, entry_points
from types import ModuleType
from typing import Any

from sgam_core.errors import OptionError
from sgam_sfm.nearest import did_you_mean

KINDS = {
    "matcher": "sgam_sfm.matchers",
    "segmenter": "sgam_sfm.segmenters",
    "area-matcher": "sgam_sfm.area_matchers",
}
"""The option that names a model, and the entry-point group it is looked up in."""

_VARIADIC = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def available(kind: str) -> dict[str, EntryPoint]:
    """Every installed entry point of a kind, by name, sorted."""
    return {entry.name: entry for entry in sorted(entry_points(group=KINDS[kind]), key=lambda entry: entry.name)}


def require(kind: str, name: str) -> EntryPoint:
    """The entry point of a name, which may be followed by a colon and the name of one of its models.

    Raises: OptionError, with the nearest name, when there is none.
    """
    known, prefix = available(kind), name.partition(":")[0]
    if prefix not in known:
        hint = did_you_mean(prefix, known)
        raise OptionError(f"--{kind} '{name}' is unknown; {hint}known: {', '.join(known)}")
    return known[prefix]


def takes(kind: str, name: str, setting: str) -> bool:
    """Whether the model of that name has a choice of this setting; not known, thus yes, while a package is missing.

    Raises: OptionError for an unknown name.
    """
    try:
        return setting in inspect.signature(_load(kind, name)).parameters
    except ModuleNotFoundError:  # `create` says which
        return True


def create(kind: str, name: str, **settings: Any) -> Any:
    """Make the model of that name; of `prefix:rest`, `rest` is passed on as the setting `name`.

    Of `settings` those are passed on that the model's constructor takes, so that a matcher of a few lines needs no
    constructor at all.
    Raises: OptionError for an unknown name, with the nearest one, for a `rest` that is empty or not taken, or when a
        package that it needs is not installed.
    """
    entry = require(kind, name)
    _, colon, rest = name.partition(":")
    try:
        factory = _load(kind, name)
        taken = inspect.signature(factory).parameters
        if colon and "name" not in taken:
            raise OptionError(f"--{kind} '{name}': '{entry.name}' is one model; give --{kind} {entry.name}")
        if colon and not rest:
            raise OptionError(f"--{kind} '{name}' names no model; give one after the colon: a hub id or a folder")
        settings |= {"name": rest} if colon else {}
        needed = [key for key, value in taken.items() if value.default is value.empty and value.kind not in _VARIADIC]
        if unknown := [key for key in needed if key not in settings]:
            raise OptionError(
                f"--{kind} '{name}': its constructor needs '{unknown[0]}', which no option gives; let it have a default"
            )
        return factory(**{key: value for key, value in settings.items() if key in taken})
    except ModuleNotFoundError as error:
        raise OptionError(f"--{kind} '{name}' needs the package '{error.name}'; run `{install(entry)}`") from error


def _load(kind: str, name: str) -> Any:
    """What an entry point names. Raises: OptionError when its module does not have it."""
    entry = require(kind, name)
    try:
        return entry.load()
    except AttributeError as error:
        if isinstance(error.obj, ModuleType) and error.name in entry.attr.split("."):
            raise OptionError(
                f"--{kind} '{name}': there is no '{entry.value}', as its package says ({error})"
            ) from error
        raise  # a fault of the module itself


def install(entry: EntryPoint) -> str:
    """The command that brings what a model needs: its package, with the extras that its entry point names."""
    package = entry.dist.name if entry.dist else entry.module.partition(".")[0]
    return f"pip install '{package}[{','.join(entry.extras)}]'" if entry.extras else f"pip install '{package}'"
