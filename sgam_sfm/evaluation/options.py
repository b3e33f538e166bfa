"""The options of `sgam-sfm evaluate`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

from sgam_core.errors import OptionError
from sgam_sfm.options import MatchOptions


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(MatchOptions):
    """Two-view and area metrics on pairs whose pose is known; no reconstruction.

    Matches every pair with areas and on whole images, and judges both. Options of `match` mean the same here. Writes
    OUT/evaluate.json and a table.
    """

    ground_truth: Path
    """Known poses, and depth where there is some: Strecha's cameras, a ScanNet scene, a COLMAP model, a CSV, ..."""
    ground_truth_format: str = ""
    """Its format, where it cannot be told from the files."""
    dataset: str = ""
    """One of the paper's data sets: its area size, angles and format (see docs/datasets.md)."""
    frame_difference: int = 0
    """Without --pairs: pairs of video frames whose numbers are so far apart (0: the published list, or all pairs)."""
    ablation: bool = False
    """Judge SOA, SIA, both, +GP, +GR, +GP+GR and all of it, and the paper's own rules: the paper's table."""
    max_pairs: int = 0
    """Judge only this many pairs, evenly over the list (0: all)."""
    auc_degrees: tuple[float, ...] = (1.0, 5.0, 10.0, 20.0)
    """Angles of the pose AUC (the paper: 5, 10, 20)."""

    def __post_init__(self) -> None:
        MatchOptions.__post_init__(self)
        if self.executor != "local" or self.shard:
            raise OptionError(
                "--executor ray and --shard are for `sgam-sfm match`; leave them out: evaluate is one process"
            )
        if self.database is not None or self.append:
            raise OptionError("--database and --append are for `sgam-sfm match`; evaluate writes to no database")

    @property
    def matching(self) -> MatchOptions:
        """The options of `match` among these."""
        return MatchOptions(**{field.name: getattr(self, field.name) for field in fields(MatchOptions)})
