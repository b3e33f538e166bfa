"""Words in what is told to people."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """`1 pair`, `2 pairs`, `0 matches`: a number with its noun, which is given in the singular."""
    plural = "es" if noun.endswith(("ch", "s", "x")) else "s"
    return f"{number} {noun}{'' if number == 1 else plural}"
