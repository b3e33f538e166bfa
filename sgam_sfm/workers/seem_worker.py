"""Worker for SEEM (Zou et al., NeurIPS 2023), panoptic; see docs/workers/seem.md.

Arguments: the folder of its repository, its checkpoint, and optionally a configuration in the repository.
"""

import os
import sys

import numpy as np
from sgam_worker import serve_segmenter

CONFIG = "configs/seem/focall_unicl_lang_demo.yaml"
SHORT_SIDE = 512  # of what it sees

folder, checkpoint = os.path.abspath(sys.argv[1]), os.path.abspath(sys.argv[2])
sys.path.insert(0, folder)
os.chdir(folder)  # its configuration names files from there

from utils.constants import COCO_PANOPTIC_CLASSES  # noqa: E402

NAMES = [name.replace("-merged", "").replace("-other", "") for name in COCO_PANOPTIC_CLASSES]


def load(settings):
    """The network, which tells COCO's panoptic classes apart."""
    import torch
    from detectron2.data import MetadataCatalog
    from modeling import build_model
    from modeling.BaseModel import BaseModel
    from PIL import Image
    from utils.arguments import load_opt_from_config_files
    from utils.distributed import init_distributed

    torch.manual_seed(settings.seed)
    options = init_distributed(load_opt_from_config_files([sys.argv[3] if len(sys.argv) > 3 else CONFIG]))
    network = BaseModel(options, build_model(options)).from_pretrained(checkpoint).eval().to(settings.device)
    model = network.model
    names = [*COCO_PANOPTIC_CLASSES, "background"]
    with torch.no_grad():
        model.sem_seg_head.predictor.lang_encoder.get_text_embeddings(names, is_eval=True)
    model.metadata = MetadataCatalog.get("coco_2017_train_panoptic")
    for task in ("spatial", "visual", "grounding", "audio"):
        model.task_switch[task] = False

    def segment(image):
        scale = SHORT_SIDE / min(image.shape[:2])
        height, width = (max(round(scale * side), 1) for side in image.shape[:2])
        pixels = np.array(Image.fromarray(image).resize((width, height), Image.BICUBIC))
        tensor = torch.from_numpy(pixels).permute(2, 0, 1).to(settings.device)
        with torch.no_grad(), torch.autocast(device_type=tensor.device.type, enabled=tensor.is_cuda):
            result = model.evaluate([{"image": tensor, "height": height, "width": width}])
        segments, facts = result[-1]["panoptic_seg"]
        label_of = np.zeros(1 + max([fact["id"] for fact in facts], default=0), np.int32)
        for fact in facts:  # several things of a class have its one label
            label_of[fact["id"]] = 1 + fact["category_id"]
        return label_of[segments.cpu().numpy()]

    return segment


serve_segmenter(load, labels=dict(enumerate(NAMES, start=1)))
