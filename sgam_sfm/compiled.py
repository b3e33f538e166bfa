"""Loops over arrays, compiled to machine code when they are first called and kept on disk from then on."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable)


def compiled(function: Function) -> Function:
    """The function as machine code that lets other threads run meanwhile; arguments are arrays and numbers."""
    # What checks the shapes of arguments in tests wraps functions, and cannot be compiled.
    return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function)))
