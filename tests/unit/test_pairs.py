"""Pair lists: the format, what is dropped and counted, and the order of work."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sgam_core.errors import InputError
from sgam_sfm.pairs import PairList, all_pairs, blocks, read_pairs, set_aside, write_pairs

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


def test_match_indices_of_colmaps_raw_lists_are_skipped(pair_file):
    path = pair_file("a.jpg b.jpg\n0 1\n2 7\n\nb.jpg sub/c.jpg\n12 3\n")
    assert read_pairs(path, NAMES).pairs == (("a.jpg", "b.jpg"), ("b.jpg", "sub/c.jpg"))
    with pytest.raises(InputError, match=r"line 1: '1' is not among the 4 images"):
        read_pairs(pair_file("1 2\n1 3\n"), NAMES)


def test_pairs_of_unreadable_images_are_set_aside(pair_file):
    path = pair_file("a.jpg bad.jpg\na.jpg b.jpg\nbad.jpg a.jpg\nbad.jpg bad.jpg\n")
    assert set_aside(read_pairs(path, (*NAMES, "bad.jpg")), {"bad.jpg"}) == PairList(
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


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("a.jpg,b.jpg", "the names are separated by a comma; expected a space or a tab: 'a.jpg b.jpg'"),
        ("a.jpg, b.jpg, 0.8", "the names are separated by a comma; expected a space or a tab: 'a.jpg b.jpg'"),
        ("a.jpg b.jpg 0.83", "'0.83' in a third column looks like a score; expected two image names alone"),
        ("a.jpg frame_000123.png", "'frame_000123.png' is not among the 4 images; names are such as 'a.jpg'"),
    ],
)
def test_what_is_wrong_with_a_line_is_told(pair_file, line, fault):
    path = pair_file(f"a.jpg b.jpg\n{line}\n")
    with pytest.raises(InputError) as error:
        read_pairs(path, NAMES)
    assert str(error.value) == f"{path}, line 2: {fault}"


def test_all_lines_with_a_fault_are_told_of(pair_file):
    path = pair_file("a.jpg x\na.jpg b.jpg\n" + "y b.jpg\n" * 7)
    told = r", line 1: 'x' is not among .* \(7 other lines cannot be used: 3, 4, 5, 6, 7, \.\.\.\)$"
    with pytest.raises(InputError, match=told):
        read_pairs(path, NAMES)


@pytest.mark.parametrize("content", ["", "# only a comment\n", "a.jpg a.jpg\n"])
def test_list_without_pairs_is_refused(pair_file, content):
    path = pair_file(content)
    with pytest.raises(InputError) as error:
        read_pairs(path, NAMES)
    assert str(error.value) == (
        f"{path} names no pair of two different images; expected lines of the form 'a.jpg b.jpg'"
    )


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("a.jpg b.jpg".encode("utf-16"), "is UTF-16 text, as some Windows programs write it; save it as UTF-8"),
        ("été.jpg b.jpg".encode("latin-1"), "is not UTF-8 text; save it as UTF-8"),
        (
            b"SQLite format 3\0\x10\0",
            "is not a text file; expected UTF-8 text with lines of the form 'a.jpg b.jpg' (`sgam-sfm pairs from-file` "
            "makes one of a COLMAP database or hloc's matches.h5)",
        ),
    ],
)
def test_file_of_another_kind(pair_file, content, expected):
    path = pair_file(content)
    with pytest.raises(InputError) as error:
        read_pairs(path, NAMES)
    assert str(error.value) == f"the pair list {path} {expected}"


@pytest.mark.parametrize(("name", "reason"), [("no.txt", "No such file or directory"), (".", "Is a directory")])
def test_file_that_cannot_be_read(tmp_path, name, reason):
    with pytest.raises(InputError) as error:
        read_pairs(tmp_path / name, NAMES)
    assert str(error.value) == (
        f"cannot read the pair list {tmp_path / name}: {reason}; give a text file with lines of the form 'a.jpg b.jpg'"
    )


def test_lone_carriage_returns_end_lines(pair_file):
    assert len(read_pairs(pair_file("a.jpg b.jpg\ra.jpg sub/c.jpg\r"), NAMES).pairs) == 2


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        (
            "../x.jpg",
            "leads out of the image folder; names are relative to that folder; the closest name is 'sub/x.jpg'",
        ),
        ("sub\\..\\..\\x.jpg", "leads out of the image folder; names are relative to that folder; the closest name is"),
        ("/data/x.jpg", "is an absolute path; names are relative to the image folder; the closest name is 'sub/x.jpg'"),
        ("C:\\x.jpg", "is an absolute path; names are relative to the image folder; the closest name is 'sub/x.jpg'"),
        ("\\\\host\\x.jpg", "is an absolute path; names are relative to the image folder; the closest name is"),
        ("sub/../x.jpg", "is not among the 2 images; the closest name is 'sub/x.jpg'"),
    ],
)
def test_names_from_outside_the_image_folder(pair_file, wrong, expected):
    path = pair_file(f"a.jpg {wrong}\n")
    with pytest.raises(InputError) as error:
        read_pairs(path, ("a.jpg", "sub/x.jpg"))
    assert str(error.value).startswith(f"{path}, line 1: '{wrong}' {expected}")


@pytest.mark.parametrize("written", ["sub\\c.jpg", ".\\sub\\c.jpg", "./sub/c.jpg", "sub//c.jpg"])
def test_other_ways_to_write_a_path_are_understood(pair_file, written):
    path = pair_file(f"a.jpg {written}\nb.jpg a.jpg\nsub/c.jpg a.jpg\n")
    assert read_pairs(path, NAMES) == PairList(pairs=(("a.jpg", "sub/c.jpg"), ("b.jpg", "a.jpg")), num_reversed=1)


def test_a_backslash_in_the_name_of_a_file_comes_first(pair_file):
    names = ("a.jpg", "sub/c.jpg", "sub\\c.jpg")
    assert read_pairs(pair_file("a.jpg sub\\c.jpg\n"), names).pairs == (("a.jpg", "sub\\c.jpg"),)


@pytest.mark.parametrize(
    ("name", "shown", "hint"),
    [
        ("x" * 5000, "x" * 117 + "...", "names are such as"),
        ("\x1b[31ma.jpg", "?[31ma.jpg", "the closest name is"),
    ],
)
def test_what_is_no_name_is_shown_in_short(pair_file, name, shown, hint):
    path = pair_file(f"a.jpg {name}\n")
    with pytest.raises(InputError) as error:
        read_pairs(path, ("a.jpg",))
    assert str(error.value) == (f"{path}, line 1: '{shown}' is not among the 1 images; {hint} 'a.jpg'")


def test_unicode_forms_are_different_names(pair_file):
    composed, decomposed = "caf\u00e9.jpg", "cafe\u0301.jpg"
    path = pair_file(f"{composed} {decomposed}\n")
    assert read_pairs(path, (composed, decomposed)).pairs == ((composed, decomposed),)
    with pytest.raises(InputError) as error:
        read_pairs(path, (composed, "b.jpg"))
    assert str(error.value) == (
        f"{path}, line 1: '{decomposed}' is not among the 2 images; '{composed}' looks the same but has other Unicode "
        "characters (NFC and NFD): copy the name from the folder"
    )


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


def test_long_lists_are_read_line_by_line(tmp_path):
    path = tmp_path / "pairs.txt"
    path.write_text("a.jpg sub/c.jpg\nsub/c.jpg a.jpg\n" * 20_000)
    tracemalloc.start()
    try:
        assert read_pairs(path, NAMES) == PairList(
            pairs=(("a.jpg", "sub/c.jpg"),), num_repeated=19_999, num_reversed=20_000
        )
        assert tracemalloc.get_traced_memory()[1] < 200_000  # bytes, of a file of 1.28 MB
    finally:
        tracemalloc.stop()


def test_the_names_of_pairs_are_shared(pair_file):
    pairs = read_pairs(pair_file("".join(f"{name} b.jpg\n" for name in ("a.jpg", "sub/c.jpg"))), NAMES).pairs
    assert pairs[0][1] is pairs[1][1] is NAMES[1]


def test_a_line_without_end_is_not_read_to_its_end(pair_file):
    with pytest.raises(InputError, match="is not a text file; expected UTF-8 text with lines"):
        read_pairs(pair_file("a.jpg b.jpg\n" + "a" * 70_000), NAMES)
