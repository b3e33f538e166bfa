"""Which images are matched with which: read, make and write pair lists, and the order to work through them."""

from __future__ import annotations

import codecs
import difflib
import posixpath
import re
import unicodedata
from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from sgam_core.errors import InputError
from sgam_core.wording import counted

_MAX_LINE = 2**16  # characters: of two paths, even of comments
_MAX_FAULTS = 5  # lines whose numbers are told
_NO_TEXT = (
    "the pair list {} is not a text file; expected UTF-8 text with lines of the form 'a.jpg b.jpg' "
    "(`sgam-sfm pairs from-file` makes one of a COLMAP database or hloc's matches.h5)"
)

Pair = tuple[str, str]
"""The names of two images, POSIX paths relative to the image folder."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PairList:
    """The pairs to match, in the order of their file, and what was left out.

    unreadable: pairs set aside because one of their images cannot be read. num_repeated, num_reversed, num_self: lines
    dropped because they name a pair again, name it the other way round, or pair an image with itself.
    """

    pairs: tuple[Pair, ...]
    unreadable: tuple[Pair, ...] = ()
    num_repeated: int = 0
    num_reversed: int = 0
    num_self: int = 0


def read_pairs(path: Path, names: Sequence[str]) -> PairList:
    """Read a pair list: `nameA nameB` a line, as hloc and COLMAP write it.

    Blank lines and lines that start with `#` are skipped, as are the match indices beneath a pair in COLMAP's raw lists
    (two numbers a line). A tab separates names that contain spaces. `./a.jpg` and `sub\\a.jpg` are understood where
    `a.jpg` and `sub/a.jpg` exist. The first spelling of a pair decides its direction and place.

    Args: names: the images of the collection.
    Raises: InputError when the file cannot be read, a line does not name two known images, or there is no pair.
    """
    known = {name: name for name in names}  # pairs share their names: lists of millions stay small
    pairs: dict[Pair, None] = {}
    num_repeated = num_reversed = num_self = 0
    faults, fault = array("q"), ""
    for number, line in _lines(path):
        if (pairs or num_self) and _is_match(line, known):
            continue
        pair = _pair(line, known)
        if pair is None:
            faults.append(number)
            fault = fault or _fault(line, known)
            continue
        name0, name1 = pair
        if name0 == name1:
            num_self += 1
        elif pair in pairs:
            num_repeated += 1
        elif (name1, name0) in pairs:
            num_reversed += 1
        else:
            pairs[pair] = None
    if faults:
        others = ", ".join(map(str, faults[1 : 1 + _MAX_FAULTS])) + (", ..." if len(faults) > 1 + _MAX_FAULTS else "")
        more = f" ({counted(len(faults) - 1, 'other line')} cannot be used: {others})" if others else ""
        raise InputError(f"{path}, line {faults[0]}: {fault}{more}")
    if not pairs:
        raise InputError(f"{path} names no pair of two different images; expected lines of the form 'a.jpg b.jpg'")
    return PairList(pairs=tuple(pairs), num_repeated=num_repeated, num_reversed=num_reversed, num_self=num_self)


def set_aside(listed: PairList, unreadable: Collection[str]) -> PairList:
    """The list with the pairs of images that cannot be read apart from the others."""
    if not unreadable:  # as mostly, and lists may have millions of pairs
        return listed
    broken = set(unreadable)
    kept: list[Pair] = []
    apart: list[Pair] = []
    for pair in listed.pairs:
        (apart if broken.intersection(pair) else kept).append(pair)
    return replace(listed, pairs=tuple(kept), unreadable=tuple(apart))


def write_pairs(path: Path, pairs: Iterable[Pair]) -> None:
    """Write a pair list that `read_pairs` reads back; a tab separates the names when either contains a space.

    Raises: InputError when a name cannot be written in this format.
    """
    lines = []
    for pair in pairs:
        for name in pair:
            if name != name.strip() or name.startswith("#") or any(c in name for c in "\t\r\n") or not name:
                raise InputError(
                    f"image name {name!r} cannot be written to a pair list (tabs, line breaks, outer spaces and a "
                    "leading '#' have a meaning there); rename the file"
                )
        separator = "\t" if any(len(name.split()) > 1 for name in pair) else " "
        lines.append(separator.join(pair) + "\n")
    path.write_text("".join(lines), encoding="utf-8", newline="\n")


def all_pairs(names: Sequence[str], max_images: int = 60) -> tuple[Pair, ...]:
    """Every pair of the given images, in their order.

    Raises: InputError for more than `max_images` images, since the number of pairs grows with its square.
    """
    if len(names) > max_images:
        count = len(names) * (len(names) - 1) // 2
        raise InputError(
            f"{counted(len(names), 'image')} make {counted(count, 'pair')}; matching all of them is meant for at most "
            f"{counted(max_images, 'image')}: choose those that overlap (`sgam-sfm pairs --help`), or name them in a "
            "file, and pass it with --pairs"
        )
    return tuple(combinations(names, 2))


def spread_over(pairs: Sequence[Pair], wanted: int) -> list[Pair]:
    """At most `wanted` pairs (0: all), evenly over the list."""
    if not wanted or wanted >= len(pairs):
        return list(pairs)
    return [pairs[row] for row in np.linspace(0, len(pairs) - 1, wanted).round().astype(int)]


def blocks(pairs: Iterable[Pair], images_per_tile: int = 8) -> tuple[tuple[Pair, ...], ...]:
    """An order of work that touches few images at a time, so that what was computed for them can be kept in memory.

    The images are numbered by name and the pairs sorted into the tiles of the grid (index0, index1) //
    images_per_tile: a block holds at most images_per_tile^2 pairs of at most 2 * images_per_tile images. It does not
    depend on the order of the pairs.
    """
    unique = set(pairs)
    index = {name: number for number, name in enumerate(sorted({name for pair in unique for name in pair}))}
    tiles: dict[tuple[int, int], list[Pair]] = {}
    for pair in sorted(unique, key=lambda pair: (sorted(pair), pair)):
        low, high = sorted(index[name] // images_per_tile for name in pair)
        tiles.setdefault((low, high), []).append(pair)
    return tuple(tuple(tiles[tile]) for tile in sorted(tiles))


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines that carry data, with their numbers from 1, one at a time: lists can be longer than memory."""
    try:
        with path.open("rb") as file:
            start = file.read(2**16)
        if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            raise InputError(
                f"the pair list {path} is UTF-16 text, as some Windows programs write it; save it as UTF-8"
            )
        if b"\0" in start:
            raise InputError(_NO_TEXT.format(path))
        with path.open(encoding="utf-8-sig") as text:
            for number, line in enumerate(iter(lambda: text.readline(_MAX_LINE), ""), start=1):
                if len(line) == _MAX_LINE or "\0" in line:
                    raise InputError(_NO_TEXT.format(path))
                stripped = line.strip()
                if stripped and not stripped.startswith("#"):
                    yield number, stripped
    except OSError as error:
        raise InputError(
            f"cannot read the pair list {path}: {error.strerror}; give a text file with lines of the form 'a.jpg b.jpg'"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"the pair list {path} is not UTF-8 text; save it as UTF-8") from error


def _is_match(line: str, known: Collection[str]) -> bool:
    """Whether a line holds the indices of two keypoints, and not two images that are called so."""
    fields = line.split()
    return len(fields) == 2 and all(field.isdecimal() and field not in known for field in fields)


def _fields(line: str) -> list[str]:
    return [field.strip() for field in line.split("\t") if field.strip()] if "\t" in line else line.split()


def _pair(line: str, known: Mapping[str, str]) -> Pair | None:
    """The two images that a line names, None when it does not."""
    names = [_known_name(field, known) for field in _fields(line)]
    return (names[0], names[1]) if len(names) == 2 and names[0] and names[1] else None


def _known_name(name: str, known: Mapping[str, str]) -> str:
    """The image that a list means by this name, separators and `.` folded; empty when there is none."""
    if name in known:
        return known[name]
    folded = (PurePosixPath(text).as_posix() for text in (name, name.replace("\\", "/")))
    return next((known[other] for other in folded if other in known), "")


def _fault(line: str, known: Mapping[str, str]) -> str:
    """Why a line does not name two images, and what to do."""
    fields = _fields(line)
    wanted = [name.strip() for name in line.split(",")]
    if len(wanted) > 1 and all(_known_name(name, known) for name in wanted[:2]):
        return "the names are separated by a comma; expected a space or a tab: 'a.jpg b.jpg'"
    if len(fields) == 3 and _is_number(fields[2]) and all(_known_name(name, known) for name in fields[:2]):
        return f"'{fields[2]}' in a third column looks like a score; expected two image names alone"
    if len(fields) != 2:
        return f"expected two image names but found {len(fields)}; separate names that contain spaces by a tab"
    name = next(field for field in fields if not _known_name(field, known))
    slashes, hint = name.replace("\\", "/"), _hint(name, known)
    if slashes.startswith("/") or PureWindowsPath(name).is_absolute():
        return f"'{_shown(name)}' is an absolute path; names are relative to the image folder; {hint}"
    if posixpath.normpath(slashes).startswith("../"):
        return f"'{_shown(name)}' leads out of the image folder; names are relative to that folder; {hint}"
    return f"'{_shown(name)}' is not among the {len(known)} images; {hint}"


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def _shown(text: str) -> str:
    return re.sub(r"[\x00-\x1f\x7f]", "?", text if len(text) <= 120 else text[:117] + "...")


def _hint(name: str, known: Collection[str]) -> str:
    names = sorted(known)
    twin = next(
        (other for other in names if unicodedata.normalize("NFC", other) == unicodedata.normalize("NFC", name)), ""
    )
    if twin:
        return f"'{twin}' looks the same but has other Unicode characters (NFC and NFD): copy the name from the folder"
    # The folder is what a list most often leaves out.
    file = PurePosixPath(name.replace("\\", "/")).name
    homonyms = [other for other in names if PurePosixPath(other).name == file]
    if closest := homonyms or difflib.get_close_matches(name, names, n=1):
        return f"the closest name is '{closest[0]}'"
    return f"names are such as '{names[0]}'" if names else "there are no images"
