"""LightGlue, on kornia's model: a transformer that assigns sparse features of two images (ICCV 2023)."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from kornia.feature import LightGlue as Network
from torch import Tensor

from sgam_sfm.machine import find_device
from sgam_sfm.matchers.sparse import Assignment, Extract, Features, SparseMatcher, batch_size
from sgam_sfm.matchers.state_dicts import fill, read_tensors
from sgam_sfm.matchers.subpixel import aligned
from sgam_sfm.weights import WeightsSpec, find_all_weights

_OLD_NAME = re.compile(r"^(self_attn|cross_attn)\.(\d+)\.")
_THRESHOLDS = "confidence_thresholds"  # follows from the number of layers; not every file has it


class LightGlueAssignment:
    """Assigns features by LightGlue with the weights of a file.

    Pairs with equal numbers of features go through the network together, up to `batch_size`. Then neither the number of
    layers nor that of the points adapts to a pair: it would depend on the others. One by one it does, which saves time.
    The score of a match is the network's.

    Args:
        path: the weights. device: where to run.
        batch_size: pairs that go through the network together.
        min_score: matches exceed it.
        config: what differs from kornia's defaults, such as `input_dim`.
    """

    def __init__(
        self, path: Path, device: torch.device, *, batch_size: int, min_score: float = 0.1, **config: Any
    ) -> None:
        if batch_size > 1:
            config |= {"depth_confidence": -1, "width_confidence": -1}
        net = Network(None, filter_threshold=min_score, **config)  # type: ignore[arg-type]  # without a name it downloads nothing
        fill(net, _state(path, net), path, "LightGlue")
        self._net = net.eval().requires_grad_(False).to(device)
        self._batch_size = batch_size
        self._has_frames = bool(config.get("add_scale_ori"))

    def __call__(self, pairs: Sequence[tuple[Features, Features]]) -> list[Assignment]:
        results: list[Assignment] = [_nothing(side0) for side0, _ in pairs]
        by_counts: dict[tuple[int, int], list[int]] = {}
        for i, (side0, side1) in enumerate(pairs):
            if len(side0) and len(side1):
                by_counts.setdefault((len(side0), len(side1)), []).append(i)
        for alike in by_counts.values():
            for start in range(0, len(alike), self._batch_size):
                batch = alike[start : start + self._batch_size]
                for i, found in zip(batch, self._assign([pairs[i] for i in batch]), strict=True):
                    results[i] = found
        return results

    def _assign(self, pairs: Sequence[tuple[Features, Features]]) -> list[Assignment]:
        found = self._net({f"image{i}": self._inputs([pair[i] for pair in pairs]) for i in (0, 1)})
        return [
            Assignment(rows[:, 0], rows[:, 1], scores)
            for rows, scores in zip(found["matches"], found["scores"], strict=True)
        ]

    def _inputs(self, sides: Sequence[Features]) -> dict[str, Tensor]:
        inputs = {
            "keypoints": torch.stack([side.points for side in sides]),
            "descriptors": torch.stack([side.descriptors for side in sides]),
            "image_size": torch.tensor([side.size for side in sides], device=sides[0].points.device),
        }
        if self._has_frames:
            frames = torch.stack([side.frames for side in sides if side.frames is not None])
            inputs |= {"scales": frames[..., 0], "oris": frames[..., 1]}
        return inputs


def with_lightglue(
    extractor: Callable[[Path, int, torch.device], Extract],
    specs: tuple[WeightsSpec, WeightsSpec],
    *,
    weights: Path | None = None,
    device: str = "cpu",
    seed: int = 0,
    max_features: int = 2048,
    min_score: float = 0.1,
    photometric: bool = True,
    batch: int = 0,
    **config: Any,
) -> SparseMatcher:
    """A sparse matcher of an extractor, made of (file, max_features, device), and LightGlue.

    Args: specs: the weights of the extractor and of LightGlue. weights: a folder with both files under their own names;
        found by itself when omitted. device: a torch device. seed: accepted as by every matcher, but nothing here is
        random. max_features: of a crop, by score. min_score: matches exceed it. photometric: align the patches of the
        matches in the end, on the CPU. batch: crops, or pairs, that go through a network together; 0: 1 on the CPU, 8
        elsewhere. config: of `LightGlueAssignment`.
    Raises: WeightsError when there are no weights or they are not those of the models; OptionError for wrong options.
    """
    place, files = find_device(device), find_all_weights(specs, weights)
    together = batch_size(place, batch)
    return SparseMatcher(
        extractor(files[0], max_features, place),
        LightGlueAssignment(files[1], place, batch_size=together, min_score=min_score, **config),
        refine=aligned if photometric else None,
        batch_size=together,
    )


def _nothing(side: Features) -> Assignment:
    none = torch.zeros(0, dtype=torch.int64, device=side.points.device)
    return Assignment(none, none, side.points.new_zeros(0))


def _state(path: Path, net: Network) -> dict[str, Any]:
    """The weights of a file by the network's names.

    Files also hold the extractor that was trained along, parameters of the training alone, and layers by older names.
    """
    state = {_THRESHOLDS: net.state_dict()[_THRESHOLDS]}
    for key, value in read_tensors(path, "LightGlue").items():
        name = _OLD_NAME.sub(r"transformers.\2.\1.", key.removeprefix("matcher."))
        if not name.startswith("extractor.") and not re.fullmatch(r"log_assignment\.\d+\.r", name):
            state[name] = value
    return state
