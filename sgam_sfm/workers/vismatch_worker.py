"""Worker for `--matcher vismatch:NAME`: any matcher of the package vismatch, which is installed in an environment of
its own. Arguments: NAME [MAX_KEYPOINTS].
"""

import sys

import numpy as np
from sgam_worker import serve_matcher

# Those that turn coordinates of -1..1 over the whole image into pixels, and LoFTR and its heirs: the corner of the
# first pixel is (0, 0). Detectors count pixels: its centre is.
CORNER = (
    "roma",
    "dkm",
    "dedode",
    "redimatch",
    "loma",
    "loftr",
    "xoftr",
    "aspanformer",
    "matchformer",
    "topicfm",
    "edm",
)


def origin(name):
    """Where vismatch's matcher of that name has its origin."""
    steerers = name in ("steerers", "affine-steerers")  # of DeDoDe
    return "corner" if steerers or any(part in name for part in CORNER) else "center"


def load(settings):
    """The matcher, tried once: a matcher that fails for want of a file or package does so here."""
    import torch
    from vismatch import get_matcher

    torch.manual_seed(settings.seed)
    if settings.threads:
        torch.set_num_threads(settings.threads)
    options = {"max_num_keypoints": int(sys.argv[2])} if len(sys.argv) > 2 else {}
    model = get_matcher(sys.argv[1], device=settings.device, **options)

    def match_pair(image0, image1):
        torch.manual_seed(settings.seed)  # some sample their matches
        found = model(*(np.float32(image.transpose(2, 0, 1)) / 255 for image in (image0, image1)))
        scores = found.get("matched_confidences")
        return (
            found["matched_kpts0"],
            found["matched_kpts1"],
            None if scores is None else np.clip(np.reshape(scores, -1), 0, 1),
        )

    def match(pairs):
        results = []
        for pair in pairs:
            try:
                results.append(match_pair(*pair))
            except Exception as error:  # many fail where an image shows nothing; what fails always did so in `load`
                print(f"no matches of a pair: {type(error).__name__}: {error}")
                results.append((np.zeros((0, 2)), np.zeros((0, 2)), None))
        return results

    blocks = np.random.default_rng(0).integers(0, 256, (30, 40, 3), np.uint8)
    texture = np.repeat(np.repeat(blocks, 16, axis=0), 16, axis=1)
    match_pair(texture, texture)
    return match


serve_matcher(load, origin=origin(sys.argv[1]))
