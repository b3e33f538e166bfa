"""Shares of the blocks of a run."""

from itertools import combinations

import pytest

from sgam_core.errors import OptionError
from sgam_sfm.pairs import blocks
from sgam_sfm.runs.shards import Shard


@pytest.mark.parametrize("text", ["", "2", "0/4", "5/4", "1/0", "-1/4", "1/4/2", "a/b", "1.5/4", "²/4"])
def test_what_is_no_shard_is_told_with_an_example(text):
    with pytest.raises(OptionError, match=r"expected i/n with i from 1 to n, such as 1/4 .*\$SLURM_ARRAY_TASK_ID/4"):
        Shard.parse(text)


def test_a_shard_is_read_as_it_is_written():
    assert Shard.parse("3/12") == Shard(number=3, count=12)
    assert str(Shard.parse("3/12")) == "3/12"


@pytest.mark.parametrize("count", [1, 2, 3, 7, 200])
def test_every_block_is_in_one_shard(count):
    work = blocks(combinations([f"{number:03d}.jpg" for number in range(40)], 2), 4)
    shares = [Shard(number=number, count=count).blocks(work) for number in range(1, count + 1)]
    assert [number for share in shares for number in share] == list(range(len(work)))


def test_shards_have_about_as_many_pairs():
    work = blocks(combinations([f"{number:03d}.jpg" for number in range(40)], 2), 4)
    largest = max(map(len, work))
    for number in range(1, 6):
        pairs = sum(len(work[block]) for block in Shard(number=number, count=5).blocks(work))
        assert abs(pairs - 780 / 5) <= largest
