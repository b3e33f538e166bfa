"""Shares of a run's blocks, for job arrays whose jobs know nothing of each other."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sgam_core.errors import OptionError
from sgam_sfm.pairs import Pair


@dataclass(frozen=True, kw_only=True, slots=True)
class Shard:
    """One of `count` shares, the first is number 1."""

    number: int
    count: int

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    @staticmethod
    def parse(text: str) -> Shard:
        """The shard that `i/n` names. Raises: OptionError when it is none."""
        found = re.fullmatch(r"(\d+)/(\d+)", text.strip(), re.ASCII)
        if found is None or not 1 <= int(found[1]) <= int(found[2]):
            raise OptionError(
                f"--shard '{text}' is none; expected i/n with i from 1 to n, such as 1/4 (in a Slurm job of "
                "`sbatch --array=1-4`: $SLURM_ARRAY_TASK_ID/4)"
            )
        return Shard(number=int(found[1]), count=int(found[2]))

    def blocks(self, work: Sequence[Sequence[Pair]]) -> range:
        """The numbers of its blocks: neighbours, which share images, and about as many pairs as any other shard has.

        Every block is in one shard; with more shards than blocks some have none.
        """
        sizes = np.array([len(block) for block in work], np.int64)
        middles = np.cumsum(sizes) - sizes / 2
        edges = sizes.sum() * np.array([self.number - 1, self.number]) / self.count
        first, end = np.searchsorted(middles, edges)
        return range(int(first), int(end))
