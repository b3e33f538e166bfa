"""A furnished room made of analytic shapes: the contents of the demo scene that `sgam_sfm.scene` renders.

Metres; x to the right, y away from the cameras, z up.
"""

from sgam_sfm.room.furniture import LABELS, furnished_room

__all__ = ["LABELS", "furnished_room"]
