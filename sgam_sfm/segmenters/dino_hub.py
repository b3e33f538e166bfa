"""Patch features of a DINOv2 or DINOv3 vision transformer of the Hugging Face hub: those of its last block."""

from __future__ import annotations

import hashlib

import numpy as np
import torch
from jaxtyping import Float16, UInt8

from sgam_core.errors import OptionError
from sgam_sfm.hub import load, load_network, transformers_for
from sgam_sfm.machine import find_device
from sgam_sfm.segmenters.dino import in_whole_patches, unit_grid

_KINDS = ("dinov2", "dinov2_with_registers", "dinov3_vit")


class HubPatchFeatures:
    """Features of the patches of an image, after the transformer's last norm.

    name: a hub id or a folder. image_size: pixels of the longer side at which the image enters the network. digest: of
    the weights and the version of torch, which features follow from.

    Raises: WeightsError when the model cannot be loaded; OptionError when it is neither DINOv2 nor DINOv3, or when
        transformers is not installed.
    """

    def __init__(self, name: str, *, image_size: int, device: str = "cpu") -> None:
        model = f"coseg:{name}"
        transformers = transformers_for(model)
        self._device = find_device(device)
        self._image_size = image_size
        config = load(transformers.AutoConfig.from_pretrained, name, model)
        if config.model_type not in _KINDS:
            raise OptionError(
                f"'{model}' is a {config.model_type}; expected a vision transformer of DINOv2 or DINOv3, such as "
                "coseg:facebook/dinov2-base"
            )
        self._patch = config.patch_size
        self._first = 1 + getattr(config, "num_register_tokens", 0)  # before it: the whole image, and registers
        self._net = load_network(transformers.AutoModel, name, model, self._device)
        processor, _ = load(transformers.ImageProcessingMixin.get_image_processor_dict, name, model)
        self._mean, self._std = (np.array(processor[key], np.float32) for key in ("image_mean", "image_std"))
        digest = hashlib.sha256(torch.__version__.encode())
        for key, value in sorted(self._net.state_dict().items()):
            digest.update(key.encode() + value.cpu().contiguous().numpy().tobytes())
        self.digest = digest.hexdigest()

    @torch.inference_mode()
    def __call__(self, pixels: UInt8[np.ndarray, "H W 3"]) -> Float16[np.ndarray, "rows columns C"]:
        """Unit-length features (rows, columns, C) on a grid of patches that covers the whole image."""
        network_input = in_whole_patches(pixels, self._image_size, self._patch, self._mean, self._std)
        found = self._net(pixel_values=torch.from_numpy(network_input).to(self._device))
        tokens = found.last_hidden_state[0, self._first :].float().cpu().numpy()
        return unit_grid(tokens, network_input, self._patch)
