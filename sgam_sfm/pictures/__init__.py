"""Pictures of what a run did, drawn without a display: of a pair, of an image, of the whole collection."""

from sgam_sfm.pictures.canvas import save_picture
from sgam_sfm.pictures.of_run import collection_picture, image_picture, pair_picture

__all__ = ["collection_picture", "image_picture", "pair_picture", "save_picture"]
