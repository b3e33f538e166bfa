"""Raw matches of pairs -> keypoints of images and tracks, as COLMAP needs them; `merge` is where to begin."""
