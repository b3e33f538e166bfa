"""The two seams of the framework: any area matcher, any point matcher (paper, Sec. III-A)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int32

from sgam_core.types import Crop, Image, Matches, PutativeAreas


@runtime_checkable
class PointMatcher(Protocol):
    """Finds point matches between two crops (PM in the paper)."""

    def match(self, pairs: Sequence[tuple[Crop, Crop]]) -> list[Matches]:
        """Match every pair of crops, in batches where the model can.

        Args: pairs of crops, whose sizes may all differ.
        Returns: one `Matches` a pair, in its order; points in crop pixels (corner origin), scores in [0, 1], no point
            outside its crop or under its crop's mask.
        """
        ...


@runtime_checkable
class AreaMatcher(Protocol):
    """Finds areas of two images that show the same thing (AM in the paper).

    Areas are cropped by `sgam_core.crops.area_crop`, unless the area matcher has a method `crop(image, box, options)`.
    Where it has an attribute `guides` that is true, photos taken sideways or aslant are turned first, and a second
    round of guided areas follows.
    """

    @property
    def needs_labels(self) -> bool:
        """Whether `describe` wants a label map; without, nobody makes one."""
        ...

    def describe(self, image: Image, labels: Int32[np.ndarray, "H W"] | None) -> Any:
        """All that depends on one image alone; computed once per image and handed to `match`."""
        ...

    def match(self, description0: Any, description1: Any, match_whole: Callable[[], Matches]) -> PutativeAreas:
        """Propose area matches. `match_whole()` gives the plain whole-image matches, computed at most once a pair."""
        ...
