"""The options of `sgam-sfm compare`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sgam_core.errors import OptionError
from sgam_sfm.options import MatchOptions


@dataclass(frozen=True, kw_only=True)
class CompareOptions(MatchOptions):
    """Several methods on the same photos, pairs, cameras and mapping options, side by side.

    A method is area-matcher:point-matcher[@option=value,...], or sift (COLMAP's own SIFT on the same pairs).
    none:xfeat-star@budget=match matches as many pixels as sgam:xfeat-star does. Options of `match` mean the same here.
    Writes OUT/<method>/ (all of its output), OUT/compare.json and OUT/report.html.
    """

    methods: tuple[str, ...]
    """For example: sgam:xfeat-star none:xfeat-star none:xfeat-star@budget=match sift."""
    ground_truth: Path | None = None
    """Known poses: Strecha's cameras, a ScanNet scene, a COLMAP model, a CSV, ...; matched by image name."""
    repeats: int = 1
    """Runs with different seeds; differences within their spread are ties."""
    hard: tuple[str, ...] = ()
    """A harder cut of the photos: every=K (every K-th of them), scale=S (scaled down), zoom=Z (of every other one the
    centre alone, so that scale changes within pairs), turn=Q (every other one by Q quarter turns, as if the camera had
    been held sideways)."""
    scene_scale: float = 1.0
    """Scale all photos by this before anything else, for a first table in less time."""
    max_pairs: int = 0
    """Match only this many pairs, evenly over the list (0: all)."""
    report: bool = True
    """Write OUT/report.html."""
    budget_image_size: int = 4096
    """The longest side of a whole image that memory allows a method with a budget."""

    def __post_init__(self) -> None:
        MatchOptions.__post_init__(self)
        if self.executor != "local" or self.shard:
            raise OptionError(
                "--executor ray and --shard are for `sgam-sfm match`; leave them out: compare is one process"
            )
        if (self.matcher, self.area_matcher) != (MatchOptions.matcher, MatchOptions.area_matcher):
            raise OptionError(
                "--matcher and --area-matcher are for `sgam-sfm match`; here methods name theirs: --methods "
                f"{self.area_matcher}:{self.matcher} ..."
            )
        if self.database is not None or self.append:
            raise OptionError("--database and --append are for `sgam-sfm match`; compare makes its own")
