"""Names in messages: the one that was probably meant, and the first of many."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """`did you mean 'x'? ` with the nearest of the known names, in whatever case; empty when none is near."""
    by_folded = {other.casefold(): other for other in known}
    near = difflib.get_close_matches(name.casefold(), by_folded, n=1)
    return f"did you mean '{by_folded[near[0]]}'? " if near else ""


def unknown(what: str, name: str, known: Collection[str]) -> str:
    """What is said of a name that is none of a few."""
    return f"{what} '{name}' is unknown; {did_you_mean(name, known)}known: {', '.join(known)}"


def listing(names: Sequence[str], most: int = 8) -> str:
    """The first names in quotes, and how many more there are."""
    shown = ", ".join(f"'{name}'" for name in names[:most])
    return shown + (f" and {len(names) - most} more" if len(names) > most else "")


def did_you_mean_run(folder: Path, otherwise: str) -> str:
    """`did you mean 'x'?` with the first run inside a folder that is none itself; `otherwise` when there is none."""
    runs = sorted(path.parent for path in folder.glob("*/options.json"))
    return f"did you mean '{runs[0]}'?" if runs else otherwise
