"""Worker for QuadTree attention's feature matching (Tang et al., ICLR 2022); see docs/workers/quadtree.md.

Arguments: the folder FeatureMatching of its repository, and optionally a configuration in it. --weights: its
checkpoint.
"""

import os
import sys

import numpy as np
from sgam_worker import serve_matcher

CONFIG = "configs/loftr/outdoor/loftr_ds_quadtree.py"
MULTIPLE = 32  # the coarsest level of its tree
MIN_SIDE = 256  # it looks at the best 32 of that level's cells, so that there must be as many


def load(settings):
    """The network with the weights of a checkpoint."""
    folder = os.path.abspath(sys.argv[1])
    sys.path.insert(0, folder)
    import torch
    from src.config.default import get_cfg_defaults
    from src.loftr import LoFTR
    from src.utils.misc import lower_config

    if settings.weights is None:
        raise ValueError("give the checkpoint of QuadTree attention with --weights FILE")
    config = get_cfg_defaults()
    config.merge_from_file(os.path.join(folder, sys.argv[2] if len(sys.argv) > 2 else CONFIG))
    network = LoFTR(config=lower_config(config)["loftr"])
    network.load_state_dict(
        torch.load(settings.weights, map_location="cpu", weights_only=True)["state_dict"], strict=True
    )
    network = network.eval().to(settings.device)

    def frame(image):
        gray = image @ np.array([0.299, 0.587, 0.114], np.float32) / 255
        sides = [max(MIN_SIDE, -(-side // MULTIPLE) * MULTIPLE) for side in gray.shape]
        padded = np.zeros(sides, np.float32)
        padded[: gray.shape[0], : gray.shape[1]] = gray
        return torch.from_numpy(padded)[None, None].to(settings.device)

    def match_pair(image0, image1):
        data = {"image0": frame(image0), "image1": frame(image1)}
        with torch.no_grad():
            network(data)
        points0, points1, scores = (data[name].cpu().numpy() for name in ("mkpts0_f", "mkpts1_f", "mconf"))
        shown = (points0 < image0.shape[1::-1]).all(1) & (points1 < image1.shape[1::-1]).all(1)  # not of the padding
        return points0[shown], points1[shown], scores[shown]

    return lambda pairs: [match_pair(*pair) for pair in pairs]


serve_matcher(load, origin="corner")
