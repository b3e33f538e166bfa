"""The YFCC100M test pairs: SuperGlue's yfcc_test_pairs_with_gt.txt and OANet's images.

The folder holds the list (here or in `assets`) and the images, `<scene>/test/images/<image>.jpg`, beside it or in
`yfcc100m`, `raw_data/yfcc100m`. The list is of the format `pair-list`, whose conventions hold.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from sgam_core.errors import InputError
from sgam_sfm.evaluation.ground_truth.pair_list import read_pair_list
from sgam_sfm.evaluation.ground_truth.reading import first_existing, text_lines
from sgam_sfm.evaluation.ground_truth.types import Format, GroundTruth

_LIST = "yfcc_test_pairs_with_gt.txt"


def _list_file(path: Path) -> Path | None:
    return first_existing(path / _LIST, path / "assets" / _LIST)


def _read(path: Path, images: Path | None) -> GroundTruth:
    if (file := _list_file(path)) is None:
        raise InputError(f"{path} has no {_LIST}; expected {FORMAT.expects}")
    first = next((line.split()[0] for _, line in text_lines(file) if line and not line.startswith("#")), "")
    roots = [images] if images else [path, path / "yfcc100m", path / "raw_data" / "yfcc100m"]
    root = next((root for root in roots if first and (root / first).is_file()), roots[0])
    return replace(read_pair_list(file, root), source=path, format="yfcc100m")


FORMAT = Format(
    name="yfcc100m",
    expects=f"a folder with {_LIST} and OANet's images",
    detects=lambda path: _list_file(path) is not None,
    read=_read,
    place="outdoor",
)
