"""Weights from files of tensors into a network, strictly: every parameter, no other, each of its shape."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from sgam_core.errors import WeightsError


def read_tensors(path: Path, what: str) -> dict[str, Any]:
    """The tensors of a file by name, on the CPU; code in the file is not run.

    Raises: WeightsError when it is no such file; `what` names the model.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises a different type for every way in which a file can be wrong
        raise WeightsError(
            f"'{path}' cannot be loaded as {what} weights: it is damaged, or holds more than tensors, as "
            "checkpoints of a training do; get it again, or save its state dict alone where it was made"
        ) from error
    if not isinstance(content, dict):
        raise WeightsError(f"'{path}' holds no state dict of {what} but a {type(content).__name__}")
    return {str(key): value for key, value in content.items()}


def fill(net: nn.Module, state: Mapping[str, Any], path: Path, what: str) -> None:
    """Give the network these weights. Raises: WeightsError that lists what is missing, unexpected or misshapen."""
    expected = net.state_dict()
    wrong = {
        "missing": [key for key in expected if key not in state],
        "unexpected": [key for key in state if key not in expected],
        "of another shape": [key for key in expected if key in state and not _alike(state[key], expected[key])],
    }
    if any(wrong.values()):
        listed = [f"{len(keys)} {what} ({', '.join(keys[:3])})" for what, keys in wrong.items() if keys]
        raise WeightsError(f"'{path}' does not hold the weights of {what}: {'; '.join(listed)}")
    net.load_state_dict(dict(state), strict=True)


def _alike(value: object, expected: Tensor) -> bool:
    return isinstance(value, Tensor) and value.shape == expected.shape
