"""Frames of videos: the natural order of names, sequences by folder, and the frames that follow each one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Int

from sgam_sfm.pair_lists.ranking import ScoreRows


def find_sequences(names: Sequence[str]) -> list[Int[np.ndarray, " _"]]:
    """The rows of the frames of every folder, in the natural order of their names."""
    folders: dict[str, list[int]] = {}
    for row in sorted(range(len(names)), key=lambda row: _natural(names[row])):
        folders.setdefault(str(PurePosixPath(names[row]).parent), []).append(row)
    return [np.array(rows) for rows in folders.values()]


def following(sequence: Int[np.ndarray, " F"], overlap: int, *, quadratic: bool) -> Int[np.ndarray, "P 2"]:
    """Pairs of rows of each frame with `overlap` later ones: the next, or (quadratic) those 1, 2, 4, ... after it."""
    steps = _steps(len(sequence), overlap, quadratic=quadratic)
    pairs = [np.column_stack([sequence[:-step], sequence[step:]]) for step in steps]
    return np.concatenate([np.zeros((0, 2), np.int64), *pairs])


def beyond(scores_of: ScoreRows, sequences: Sequence[Int[np.ndarray, " _"]], overlap: int) -> ScoreRows:
    """The scores without pairs of frames that are at most `overlap` apart in a sequence: they look alike anyway."""
    count = sum(map(len, sequences))
    place, number = np.zeros(count, np.int64), np.zeros(count, np.int64)
    for index, sequence in enumerate(sequences):
        place[sequence], number[sequence] = np.arange(len(sequence)), index

    def scores_beyond(rows: Int[np.ndarray, " B"]) -> np.ndarray:
        near = (np.abs(place[rows, None] - place) <= overlap) & (number[rows, None] == number)
        return np.where(near, np.float32(-np.inf), scores_of(rows))

    return scores_beyond


def _steps(length: int, overlap: int, *, quadratic: bool) -> list[int]:
    steps = []
    for index in range(overlap):
        step = 2**index if quadratic else index + 1
        if step >= length:
            break
        steps.append(step)
    return steps


def _natural(name: str) -> tuple[tuple[tuple[int, int, str], ...], str]:
    """A key that orders numbers in names by their value; equal ones (`01`, `1`) by their spelling."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return tuple((0, int(part), "") if part[0] in "0123456789" else (1, 0, part) for part in parts), name
