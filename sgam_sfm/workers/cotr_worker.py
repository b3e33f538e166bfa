"""Worker for COTR (Jiang et al., ICCV 2021); see docs/workers/cotr.md.

Arguments: the folder of its repository, and optionally the number of matches of a pair. --weights: its checkpoint.
"""

import argparse
import os
import sys

import numpy as np
from sgam_worker import serve_matcher

MAX_MATCHES = 500
ZOOMS = np.linspace(0.5, 0.0625, 4)
BATCH = 32
SHARPNESS = 5.0  # pixels of cycle error that halve a score
CHANNELS = {"layer1": 256, "layer2": 512, "layer3": 1024, "layer4": 2048}


def load(settings):
    """The network with the weights of a checkpoint, and its engine that zooms in."""
    folder, max_matches = os.path.abspath(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else MAX_MATCHES
    sys.path.insert(0, folder)
    os.chdir(folder)  # its configuration is read from there
    import torch
    from COTR.inference.sparse_engine import SparseEngine
    from COTR.models import build_model
    from COTR.options.options import set_COTR_arguments
    from COTR.utils import utils

    if settings.weights is None:
        raise ValueError("give COTR's checkpoint.pth.tar with --weights FILE")
    parser = argparse.ArgumentParser()
    set_COTR_arguments(parser)
    options = parser.parse_args([])
    options.dim_feedforward = CHANNELS[options.layer]
    torch.set_grad_enabled(False)
    network = build_model(options)
    utils.safe_load_weights(
        network, torch.load(settings.weights, map_location="cpu", weights_only=True)["model_state_dict"]
    )
    engine = SparseEngine(network.eval().to(settings.device), BATCH, mode="tile")

    def match_pair(image0, image1):
        utils.fix_randomness(settings.seed)  # its queries are drawn
        try:
            matches, errors = engine.cotr_corr_multiscale_with_cycle_consistency(
                image0, image1, ZOOMS, 1, max_corrs=max_matches, queries_a=None, return_cycle_error=True
            )
        except AssertionError:  # its way to say that it found none
            matches, errors = np.zeros((0, 4)), np.zeros(0)
        return matches[:, :2], matches[:, 2:], 1 / (1 + errors / SHARPNESS)

    return lambda pairs: [match_pair(*pair) for pair in pairs]


serve_matcher(load, origin="corner")
