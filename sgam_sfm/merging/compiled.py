"""Loops over arrays, compiled to machine code when they are first called and kept on disk from then on."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable)

_SETTINGS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
}  # the latter: x / 0 is infinite, not an error to look out for


def compiled(function: Function) -> Function:
    """The function as machine code that lets other threads run meanwhile; arguments are arrays and numbers."""
    plain = inspect.unwrap(function)  # what checks the shapes of arguments in tests cannot be compiled
    try:
        return cast(Function, numba.njit(plain, cache=True, **_SETTINGS))
    except RuntimeError:  # neither beside this file nor in the user's folders may anything be written
        return cast(Function, numba.njit(plain, **_SETTINGS))
