"""Which images are matched with which: read, make and write pair lists, and the order to work through them."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path, PurePosixPath

from sgam_core.errors import InputError

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


def read_pairs(path: Path, names: Sequence[str], unreadable: Collection[str] = ()) -> PairList:
    """Read a pair list: `nameA nameB` a line, as hloc and COLMAP write it.

    Blank lines and lines that start with `#` are skipped. A tab separates names that contain spaces. The first spelling
    of a pair decides its direction and place.

    Args: names: the images of the collection; unreadable: images that exist but cannot be read, whose pairs are set
        aside rather than refused.
    Raises: InputError when the file cannot be read, a line does not name two known images, or no pair is left.
    """
    known, broken = set(names), set(unreadable)
    pairs: dict[Pair, None] = {}
    set_aside: dict[Pair, None] = {}
    num_repeated = num_reversed = num_self = 0
    for number, line in _lines(path):
        name0, name1 = pair = _fields(line, path, number)
        for name in pair:
            if name not in known and name not in broken:
                raise InputError(_unknown(name, known | broken, path, number))
        target = set_aside if broken.intersection(pair) else pairs
        if name0 == name1:
            num_self += 1
        elif pair in target:
            num_repeated += 1
        elif (name1, name0) in target:
            num_reversed += 1
        else:
            target[pair] = None
    if not pairs and not set_aside:
        raise InputError(f"{path} names no pair of two different images; expected lines of the form 'a.jpg b.jpg'")
    return PairList(
        pairs=tuple(pairs),
        unreadable=tuple(set_aside),
        num_repeated=num_repeated,
        num_reversed=num_reversed,
        num_self=num_self,
    )


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
            f"{len(names)} images make {count} pairs; matching all of them is meant for at most {max_images} images: "
            "name the pairs that overlap in a file and pass it with --pairs"
        )
    return tuple(combinations(names, 2))


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


def _lines(path: Path) -> list[tuple[int, str]]:
    """The lines that carry data, with their numbers from 1."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            lines = [(number, line.strip()) for number, line in enumerate(file, start=1)]
    except OSError as error:
        raise InputError(f"cannot read the pair list {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"the pair list {path} is not UTF-8 text; save it as UTF-8") from error
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def _fields(line: str, path: Path, number: int) -> Pair:
    fields = [field.strip() for field in line.split("\t") if field.strip()] if "\t" in line else line.split()
    if len(fields) != 2:
        raise InputError(
            f"{path}, line {number}: expected two image names but found {len(fields)}; separate names that contain "
            "spaces by a tab"
        )
    return fields[0], fields[1]


def _unknown(name: str, known: Collection[str], path: Path, number: int) -> str:
    # The folder is what a list most often leaves out.
    homonyms = [other for other in sorted(known) if PurePosixPath(other).name == PurePosixPath(name).name]
    closest = homonyms or difflib.get_close_matches(name, sorted(known), n=1, cutoff=0.0)
    hint = f"the closest name is '{closest[0]}'" if closest else "there are no images"
    return f"{path}, line {number}: '{name}' is not among the {len(known)} images; {hint}"
