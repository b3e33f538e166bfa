"""Tiny models of the Hugging Face hub's kinds with random weights, saved to folders as their publishers save them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

NAMES = {0: "wall", 1: "sky-other-merged", 2: "person", 3: "car, auto"}
_LABELS = {"id2label": NAMES, "label2id": {name: index for index, name in NAMES.items()}}
_BACKBONE = {"image_size": 32, "embed_dim": 8, "depths": [1, 1, 1, 1], "num_heads": [1, 1, 1, 1], "window_size": 2}
_SMALL = {
    **{"hidden_dim": 32, "encoder_feedforward_dim": 8, "dim_feedforward": 8, "encoder_layers": 1},
    **{"decoder_layers": 2, "num_attention_heads": 1, "num_queries": 5},
}


def save_hub_model(kind: str, folder: Path) -> Path:
    """A model of this kind in a folder of its own. Returns: the folder."""
    import transformers

    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()
    torch.manual_seed(0)
    _MAKERS[kind](transformers, folder)
    return folder


def _segformer(t: Any, folder: Path) -> None:
    config = t.SegformerConfig(
        num_encoder_blocks=2,
        depths=[1, 1],
        sr_ratios=[2, 1],
        hidden_sizes=[8, 16],
        patch_sizes=[7, 3],
        strides=[4, 2],
        num_attention_heads=[1, 2],
        mlp_ratios=[2, 2],
        decoder_hidden_size=8,
        **_LABELS,
    )
    t.SegformerForSemanticSegmentation(config).save_pretrained(folder)
    t.SegformerImageProcessor(size={"height": 64, "width": 64}).save_pretrained(folder)


def _mask2former(t: Any, folder: Path) -> None:
    backbone = t.SwinConfig(**_BACKBONE, out_features=["stage1", "stage2", "stage3", "stage4"])
    config = t.Mask2FormerConfig(backbone_config=backbone, feature_size=32, mask_feature_size=32, **_SMALL, **_LABELS)
    t.Mask2FormerForUniversalSegmentation(config).save_pretrained(folder)
    processor = t.Mask2FormerImageProcessor(
        size={"shortest_edge": 64, "longest_edge": 128}, pad_size={"height": 128, "width": 128}
    )
    processor.save_pretrained(folder)


def _oneformer(t: Any, folder: Path) -> None:
    backbone = t.SwinConfig(**_BACKBONE, out_features=["stage1", "stage2", "stage3", "stage4"])
    text = {f"text_encoder_{name}": value for name, value in (("width", 32), ("num_layers", 1), ("n_ctx", 2))}
    config = t.OneFormerConfig(
        backbone_config=backbone,
        conv_dim=32,
        mask_dim=32,
        task_seq_len=10,
        is_training=False,
        **text,
        **_SMALL,
        **_LABELS,
    )
    t.OneFormerForUniversalSegmentation(config).save_pretrained(folder)
    pieces = [f"{chr(code)}{end}" for end in ("", "</w>") for code in range(33, 127)]
    vocabulary = {piece: index for index, piece in enumerate([*pieces, "<|startoftext|>", "<|endoftext|>"])}
    t.CLIPTokenizer(vocab=vocabulary, merges=[]).save_pretrained(folder)
    t.OneFormerImageProcessor(size={"shortest_edge": 64, "longest_edge": 128}).save_pretrained(folder)
    # The published ones name a class list in another repository, which is not asked for.
    path = folder / "preprocessor_config.json"
    settings = json.loads(path.read_text()) | {
        "class_info_file": "ade20k_panoptic.json",
        "repo_path": "owner/elsewhere",
    }
    path.write_text(json.dumps(settings))


def _eomt(t: Any, folder: Path, *, split: bool) -> None:
    config = t.EomtConfig(
        hidden_size=16,
        num_hidden_layers=2,
        num_attention_heads=2,
        image_size=64,
        patch_size=16,
        num_blocks=1,
        num_queries=5,
        num_upscale_blocks=1,
        num_register_tokens=0,
        **_LABELS,
    )
    t.EomtForUniversalSegmentation(config).save_pretrained(folder)
    size = {"shortest_edge": 64, "longest_edge": None if split else 64}
    t.EomtImageProcessor(size=size, do_split_image=split, do_pad=not split).save_pretrained(folder)


def _dinov2(t: Any, folder: Path) -> None:
    config = t.Dinov2Config(hidden_size=48, num_hidden_layers=2, num_attention_heads=2, patch_size=14, image_size=56)
    t.Dinov2Model(config).save_pretrained(folder)
    t.BitImageProcessor().save_pretrained(folder)


def _dinov3(t: Any, folder: Path) -> None:
    config = t.DINOv3ViTConfig(
        hidden_size=48, intermediate_size=48, num_hidden_layers=2, num_attention_heads=2, num_register_tokens=4
    )
    t.DINOv3ViTModel(config).save_pretrained(folder)
    t.BitImageProcessor(image_mean=[0.43, 0.411, 0.296], image_std=[0.213, 0.156, 0.143]).save_pretrained(folder)


def _efficient_loftr(t: Any, folder: Path) -> None:
    config = t.EfficientLoFTRConfig(
        stage_num_blocks=[1, 1, 1, 1],
        out_features=[16, 16, 32, 32],
        hidden_size=32,
        num_attention_layers=2,
        coarse_matching_threshold=0.0,
    )
    net = t.EfficientLoFTRForKeypointMatching(config)
    for module in net.modules():  # transformers' own start is so small that all features are nearly 0
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.ones_(module.weight)
        elif isinstance(module, torch.nn.Conv2d | torch.nn.Linear):
            torch.nn.init.kaiming_normal_(module.weight)
    net.save_pretrained(folder)


_MAKERS: dict[str, Callable[[Any, Path], None]] = {
    "segformer": _segformer,
    "mask2former": _mask2former,
    "oneformer": _oneformer,
    "eomt-semantic": lambda t, folder: _eomt(t, folder, split=True),
    "eomt-panoptic": lambda t, folder: _eomt(t, folder, split=False),
    "dinov2": _dinov2,
    "dinov3": _dinov3,
    "efficient-loftr": _efficient_loftr,
}
SEGMENTERS = ("segformer", "mask2former", "oneformer", "eomt-semantic", "eomt-panoptic")
