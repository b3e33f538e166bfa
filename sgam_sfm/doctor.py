"""What this machine is to a run: versions, device, memory, models, and a small run of the whole path."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import distributions
from pathlib import Path

import numpy as np
import psutil

from sgam_core import Matches
from sgam_core.errors import SGAMError
from sgam_core.wording import counted
from sgam_sfm.machine import find_device
from sgam_sfm.models import list_models
from sgam_sfm.options import MatchOptions
from sgam_sfm.runs.runner import match_collection
from sgam_sfm.runs.store import read_pairs_of
from sgam_sfm.runs.summary import versions
from sgam_sfm.scene import correspond, demo_views, write_scene

_LITTLE_MEMORY_GB, _LITTLE_DISK_GB = 3.0, 2.0
_TEST_WIDTH, _TEST_VIEWS, _TEST_LABELS = 320, (3, 4), 8
_TEST_MIN_INLIERS, _TEST_MAX_ERROR_PX = 30, 1.5


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """One line of the report. good: None where there is nothing to judge. mend: what to do when it is not."""

    what: str
    text: str
    good: bool | None = None
    mend: str = ""


def examine(folder: Path, device: str, *, self_test: bool = True) -> Iterator[Finding]:
    """All findings, the self-test last. folder: where results would go."""
    import torch

    yield Finding(what="system", text=f"{platform.platform()}, Python {platform.python_version()} ({sys.executable})")
    yield Finding(what="versions", text=", ".join(f"{name} {number}" for name, number in versions().items()))
    yield from _clashes()
    chosen = find_device(device, "--device")
    name = torch.cuda.get_device_name(chosen) if chosen.type == "cuda" else platform.processor() or platform.machine()
    threads = f"{counted(torch.get_num_threads(), 'thread')} of {counted(os.cpu_count() or 1, 'core')}"
    yield Finding(what="device", text=f"{chosen} ({name}), {threads}")
    yield from _onnx(chosen.type)
    memory = psutil.virtual_memory()
    yield Finding(
        what="memory",
        text=f"{memory.available / 1e9:.1f} GB free of {memory.total / 1e9:.1f}",
        good=memory.available > _LITTLE_MEMORY_GB * 1e9,
        mend="close other programs, or lower --max-crop-pixels and --block-images",
    )
    disk = psutil.disk_usage(str(folder))
    yield Finding(
        what="disk",
        text=f"{disk.free / 1e9:.1f} GB free at '{folder.absolute()}'",
        good=disk.free > _LITTLE_DISK_GB * 1e9,
        mend="choose an --output on another disk",
    )
    yield from _default_models()
    if self_test:
        yield _self_test(str(chosen))


def _clashes() -> Iterator[Finding]:
    """Several OpenCV packages overwrite each other's files."""
    found = sorted({d.name for d in distributions() if (d.name or "").lower().replace("_", "-").startswith("opencv-")})
    if len(found) > 1:
        yield Finding(
            what="opencv",
            text=f"{len(found)} packages install cv2: {', '.join(found)}",
            good=False,
            mend=f"pip uninstall -y {' '.join(found)} && pip install --force-reinstall opencv-python-headless",
        )


def _onnx(device: str) -> Iterator[Finding]:
    import onnxruntime

    if device == "cuda" and "CUDAExecutionProvider" not in onnxruntime.get_available_providers():
        yield Finding(
            what="onnx",
            text="ONNX Runtime has no CUDA here: coseg and coarse-loftr run on the CPU",
            good=False,
            mend="pip uninstall -y onnxruntime && pip install 'sgam-sfm[cuda]'",
        )


def _default_models() -> Iterator[Finding]:
    """What `sgam-sfm match` without further options runs."""
    options = MatchOptions(images=Path(), output=Path())
    used = {("area-matcher", options.area_matcher), ("matcher", options.matcher), ("segmenter", options.segmenter)}
    for state in list_models():
        if (state.kind, state.name) in used:
            yield Finding(what=state.kind, text=f"{state.name}: {state.where}", good=state.ready, mend=state.get)


def _self_test(device: str) -> Finding:
    """Two rendered views through the default run, verification included, against the exact truth."""
    start = time.perf_counter()
    views = [demo_views(_TEST_WIDTH)[index] for index in _TEST_VIEWS]
    try:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            write_scene(folder, views)
            options = MatchOptions(
                images=folder / "images", output=folder / "out", device=device, num_labels=_TEST_LABELS, mapping=False
            )
            summary = match_collection(options)
            (record,) = read_pairs_of(options.output)
    except SGAMError as error:
        return Finding(what="self-test", text=str(error), good=False, mend="mend what is named here, then try again")
    by_name = {view.name: view for view in views}
    matches = record.result.matches if record.result else Matches.empty()
    truth, visible = correspond(matches.points0, *(by_name[name] for name in record.pair))
    errors = np.linalg.norm(truth - matches.points1, axis=1)[visible]
    median = float(np.median(errors)) if len(errors) else np.inf
    return Finding(
        what="self-test",
        text=f"{summary['pairs']['inliers']} verified matches of two rendered images, off by {median:.2f} px, in "
        f"{time.perf_counter() - start:.0f} s",
        good=summary["pairs"]["inliers"] >= _TEST_MIN_INLIERS and median < _TEST_MAX_ERROR_PX,
        mend="the models give wrong results here: report it with this output",
    )
