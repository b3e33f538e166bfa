"""Where tests find what is not part of the project."""

import os
from pathlib import Path

_SHARED = Path(__file__).parents[1] / "../shared"
DATA = Path(os.environ.get("SGAM_SFM_DATA", _SHARED / "data"))
WEIGHTS = Path(os.environ.get("SGAM_SFM_WEIGHTS", _SHARED / "weights"))
WEIGHT_FILES = {"coarse-loftr": "coarse_loftr_teacher.onnx", "ade20k": "deeplabv3_mnv2_ade20k_uint8.tflite"}
"""Those of models that no installed package carries."""


def weights_of(name: str) -> Path | None:
    """The weights that a test run was given for a model; None leaves it to the model to find its own."""
    if name == "loftr" and "SGAM_SFM_LOFTR_WEIGHTS" in os.environ:
        return Path(os.environ["SGAM_SFM_LOFTR_WEIGHTS"])
    file = WEIGHTS / WEIGHT_FILES.get(name, "")
    return file if file.is_file() else None
