"""Segmentation models of the Hugging Face hub: OneFormer, Mask2Former, MaskFormer, EoMT, SegFormer and their like.

Every pixel gets the class of the highest score, of panoptic models too, whose instances of a class are one label.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int32, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from sgam_core.errors import OptionError
from sgam_core.semantic import LABEL_WIDTH
from sgam_sfm.hub import load, load_network, transformers_for
from sgam_sfm.images import ImageFile
from sgam_sfm.label_set import Label, LabelSet
from sgam_sfm.machine import find_device
from sgam_sfm.segmenters.protocol import one_by_one

_PLANES = 16  # classes that are enlarged together: maps of many classes stay small in memory
_MASK_OUTPUTS = (("class_queries_logits", "masks_queries_logits"), ("logits", "pred_masks"))


class HubSegmenter:
    """Segmenter (`sgam_sfm.segmenters.protocol.Segmenter`) of a hub id or of a folder, one image at a time.

    name: the hub id or the folder. Labels are the model's classes counted from 1, in the order and with the names of
    its configuration; maps are 640 pixels wide, or as wide as the image where that is narrower.

    Raises: WeightsError when the model cannot be loaded; OptionError when it is none that segments, or when packages
        are missing.
    """

    def __init__(self, *, name: str = "", device: str = "cpu") -> None:
        self._model = model = f"hf:{name}"
        transformers = transformers_for(model)
        self._device = find_device(device)
        config = load(transformers.AutoConfig.from_pretrained, name, model)
        kind = (config.architectures or [""])[0]
        if not kind.endswith("Segmentation") or not hasattr(transformers, kind):
            raise OptionError(
                f"'{model}' is a {kind or config.model_type}, which does not segment images; expected a model for "
                "semantic, instance or panoptic segmentation, such as OneFormer, Mask2Former, SegFormer or EoMT"
            )
        self._prepare = _preparation(transformers, config, name, model)
        self._net = load_network(getattr(transformers, kind), name, model, self._device)
        labels = (Label(id=index + 1, name=str(text).strip()) for index, text in sorted(config.id2label.items()))
        self.label_set = LabelSet(segmenter=model, labels=tuple(labels))

    def segment(
        self, images: Sequence[ImageFile], advance: Callable[[float], None]
    ) -> Iterator[tuple[ImageFile, Int32[np.ndarray, "H W"] | Exception]]:
        return one_by_one(self._labels, images, advance)

    @torch.inference_mode()
    def _labels(self, pixels: UInt8[np.ndarray, "H W 3"]) -> Int32[np.ndarray, "h w"]:
        rows, columns = pixels.shape[:2]
        inputs = self._prepare(pixels).to(self._device)
        scores = self._scores(self._net(**inputs))
        if offsets := inputs.get("patch_offsets"):
            windows = interpolate(scores, inputs["pixel_values"].shape[-2:], mode="bilinear")
            scores = _joined(windows, offsets, upright=rows > columns)
        width = min(LABEL_WIDTH, columns)
        height = max(1, round(width * rows / columns))
        grid = _grid(height, width, self._prepare.share_shown(inputs, rows, columns)).to(scores)
        best = torch.full((height, width), -torch.inf, device=scores.device)
        labels = torch.zeros((height, width), dtype=torch.int32, device=scores.device)
        for start in range(0, scores.shape[1], _PLANES):
            planes = grid_sample(scores[:, start : start + _PLANES], grid, padding_mode="border", align_corners=False)
            score, index = planes[0].max(dim=0)
            labels = torch.where(score > best, (index + start + 1).int(), labels)
            best = torch.maximum(best, score)
        found: np.ndarray = labels.cpu().numpy()
        return found

    def _scores(self, outputs: Any) -> Float[Tensor, "B C h w"]:
        """How well every class fits at every point: as given, or by the masks of the model's queries."""
        for classes, masks in _MASK_OUTPUTS:
            if classes in outputs and masks in outputs:
                likely = outputs[classes].softmax(-1)[..., :-1]  # the last one stands for no object
                return torch.einsum("bqc,bqhw->bchw", likely, outputs[masks].sigmoid())
        if "logits" in outputs and outputs["logits"].ndim == 4:
            logits: Tensor = outputs["logits"]
            return logits
        raise OptionError(
            f"'{self._model}' gives {', '.join(outputs.keys())}; expected scores of classes or of masks, as OneFormer, "
            "Mask2Former, SegFormer or EoMT give"
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class _Preparation:
    """How images enter a network: as its processor resizes, pads and normalises them.

    settings: of every call. pads: whether the processor pads without telling where.
    """

    processor: Any
    settings: Mapping[str, Any] = field(default_factory=dict)
    pads: bool = False

    def __call__(self, pixels: UInt8[np.ndarray, "H W 3"]) -> Any:
        return self.processor(images=pixels, return_tensors="pt", input_data_format="channels_last", **self.settings)

    def share_shown(self, inputs: Any, rows: int, columns: int) -> tuple[float, float]:
        """The part of the network's frame that an image of (rows, columns) covers from the top left: down, across."""
        if "pixel_mask" in inputs:
            mask = inputs["pixel_mask"][0].bool()
            return float(mask.any(1).float().mean()), float(mask.any(0).float().mean())
        if not self.pads:
            return 1.0, 1.0
        high, wide = inputs["pixel_values"].shape[-2:]
        scale = min(high / rows, wide / columns)
        return min(1.0, round(rows * scale) / high), min(1.0, round(columns * scale) / wide)


def _preparation(transformers: Any, config: Any, name: str, model: str) -> _Preparation:
    """The processor of a model; of OneFormer with the words of its semantic task."""
    read = transformers.AutoImageProcessor.from_pretrained
    if config.model_type == "oneformer":
        # Its class list lies in another repository, and only serves training and instances.
        processor = load(read, name, model, class_info_file=None)
        words = load(transformers.AutoTokenizer.from_pretrained, name, model)
        length = config.task_seq_len
        both = transformers.OneFormerProcessor(
            image_processor=processor, tokenizer=words, max_seq_length=length, task_seq_length=length
        )
        return _Preparation(processor=both, settings={"task_inputs": ["semantic"]})
    processor = load(read, name, model)
    whole = {"do_center_crop": False} if getattr(processor, "do_center_crop", None) else {}
    pads = config.model_type.startswith("eomt") and bool(processor.do_pad)
    return _Preparation(processor=processor, settings=whole, pads=pads)


def _joined(windows: Float[Tensor, "B C n n"], offsets: Sequence[Tensor], *, upright: bool) -> Float[Tensor, "1 C h w"]:
    """Scores of square windows along the longer side of an image, the mean where they overlap.

    Args: offsets: (image, start, end) of every window, in its pixels.
    """
    size, length = windows.shape[-1], max(int(end) for _, _, end in offsets)
    total = windows.new_zeros(windows.shape[1], length, size)
    count = windows.new_zeros(length, 1)
    for window, (_, start, end) in zip(windows, offsets, strict=True):
        total[:, int(start) : int(end)] += window if upright else window.mT
        count[int(start) : int(end)] += 1
    mean = total / count
    return (mean if upright else mean.mT)[None]


def _grid(height: int, width: int, shown: tuple[float, float]) -> Float[Tensor, "1 height width 2"]:
    """Where `grid_sample` finds the centres of the pixels of a label map, in a frame of which a part is `shown`."""
    down, across = (
        2 * share * (torch.arange(length) + 0.5) / length - 1
        for length, share in zip((height, width), shown, strict=True)
    )
    return torch.stack(torch.meshgrid(across, down, indexing="xy"), dim=-1)[None]
