"""Pair lists: the format, what is dropped and counted, and the order of work."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sgam_core.errors import InputError
from sgam_sfm.pairs import PairList, all_pairs, blocks, read_pairs, write_pairs

NAMES = ("a.jpg", "b.jpg", "sub/c.jpg", "my photo.jpg")


@pytest.fixture
def pair_file(tmp_path: Path):
    def write(content: str | bytes) -> Path:
        path = tmp_path / "pairs.txt"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write


def test_comments_blank_lines_crlf_bom_and_tabs(pair_file):
    path = pair_file("\ufeff# a comment\r\n\r\na.jpg  sub/c.jpg\r\nmy photo.jpg\tb.jpg\r\n  # indented\r\nb.jpg\ta.jpg")
    assert read_pairs(path, NAMES).pairs == (("a.jpg", "sub/c.jpg"), ("my photo.jpg", "b.jpg"), ("b.jpg", "a.jpg"))


def test_repeats_are_dropped_and_counted_and_the_first_spelling_wins(pair_file):
    path = pair_file("b.jpg a.jpg\na.jpg a.jpg\na.jpg b.jpg\nb.jpg a.jpg\na.jpg b.jpg\na.jpg sub/c.jpg\n")
    assert read_pairs(path, NAMES) == PairList(
        pairs=(("b.jpg", "a.jpg"), ("a.jpg", "sub/c.jpg")), num_repeated=1, num_reversed=2, num_self=1
    )


def test_pairs_of_unreadable_images_are_set_aside(pair_file):
    path = pair_file("a.jpg bad.jpg\na.jpg b.jpg\nbad.jpg a.jpg\nbad.jpg bad.jpg\n")
    assert read_pairs(path, NAMES, unreadable={"bad.jpg"}) == PairList(
        pairs=(("a.jpg", "b.jpg"),), unreadable=(("a.jpg", "bad.jpg"),), num_reversed=1, num_self=1
    )


@pytest.mark.parametrize(("wrong", "closest"), [("c.jpg", "sub/c.jpg"), ("sup/d.jpg", "sub/c.jpg"), ("b.jp", "b.jpg")])
def test_unknown_name_is_refused_with_line_and_closest_name(pair_file, wrong, closest):
    path = pair_file(f"# pairs\na.jpg {wrong}\n")
    with pytest.raises(InputError) as error:
        read_pairs(path, NAMES)
    assert str(error.value) == f"{path}, line 2: '{wrong}' is not among the 4 images; the closest name is '{closest}'"


@pytest.mark.parametrize(("line", "count"), [("a.jpg", 1), ("my photo.jpg b.jpg", 3), ("a.jpg\tb.jpg\tsub/c.jpg", 3)])
def test_other_than_two_names_hints_at_tabs(pair_file, line, count):
    path = pair_file(f"a.jpg b.jpg\n{line}\n")
    with pytest.raises(InputError) as error:
        read_pairs(path, NAMES)
    assert str(error.value) == (
        f"{path}, line 2: expected two image names but found {count}; separate names that contain spaces by a tab"
    )


@pytest.mark.parametrize("content", ["", "# only a comment\n", "a.jpg a.jpg\n"])
def test_list_without_pairs_is_refused(pair_file, content):
    with pytest.raises(InputError, match="names no pair of two different images"):
        read_pairs(pair_file(content), NAMES)


def test_file_that_cannot_be_read(pair_file, tmp_path):
    with pytest.raises(InputError, match=r"cannot read the pair list .*missing\.txt: No such file or directory"):
        read_pairs(tmp_path / "missing.txt", NAMES)
    with pytest.raises(InputError, match="is not UTF-8 text; save it as UTF-8"):
        read_pairs(pair_file("a.jpg b.jpg".encode("utf-16")), NAMES)


def test_written_pairs_read_back(tmp_path):
    pairs = (("my photo.jpg", "a.jpg"), ("a.jpg", "b.jpg"), ("b.jpg", "sub/c.jpg"))
    write_pairs(tmp_path / "pairs.txt", pairs)
    assert (tmp_path / "pairs.txt").read_bytes() == b"my photo.jpg\ta.jpg\na.jpg b.jpg\nb.jpg sub/c.jpg\n"
    assert read_pairs(tmp_path / "pairs.txt", NAMES).pairs == pairs


@pytest.mark.parametrize("name", ["a\tb.jpg", "#a.jpg", " a.jpg", "a\nb.jpg", ""])
def test_names_that_the_format_cannot_hold(tmp_path, name):
    with pytest.raises(InputError, match="cannot be written to a pair list"):
        write_pairs(tmp_path / "pairs.txt", [(name, "b.jpg")])


def test_all_pairs():
    assert all_pairs(("b", "a", "c")) == (("b", "a"), ("b", "c"), ("a", "c"))
    assert len(all_pairs([str(i) for i in range(60)])) == 1770
    with pytest.raises(InputError, match=r"61 images make 1830 pairs; .* pass it with --pairs"):
        all_pairs([str(i) for i in range(61)])


def test_blocks_of_a_full_grid():
    names = [f"{i:02}" for i in range(20)]
    tiles = blocks(all_pairs(names))
    assert [len(tile) for tile in tiles] == [28, 64, 32, 28, 32, 6]  # 8 + 8 + 4 images
    assert tiles[1][0] == ("00", "08")


images = st.integers(0, 40).map(lambda i: f"{i:02}.jpg")


@given(st.lists(st.tuples(images, images).filter(lambda pair: pair[0] != pair[1])), st.randoms(), st.integers(1, 9))
def test_blocks_hold_every_pair_once_touch_few_images_and_ignore_the_order(pairs, random, images_per_tile):
    tiles = blocks(pairs, images_per_tile)
    assert sorted(pair for tile in tiles for pair in tile) == sorted(set(pairs))
    for tile in tiles:
        assert len({name for pair in tile for name in pair}) <= 2 * images_per_tile
        assert len({frozenset(pair) for pair in tile}) <= images_per_tile**2
    shuffled = list(pairs)
    random.shuffle(shuffled)
    assert blocks(shuffled, images_per_tile) == tiles
