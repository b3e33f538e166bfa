"""The one place that opens ONNX models."""

from __future__ import annotations

import logging
from pathlib import Path

import onnxruntime

from sgam_core.errors import WeightsError

_log = logging.getLogger(__name__)


def open_session(model: Path | bytes, name: str, device: str, threads: int) -> onnxruntime.InferenceSession:
    """An ONNX Runtime session that gives equal output for equal input.

    Args: name of the model, for messages. device: a torch device; where this ONNX Runtime has no CUDA the model runs on
        the CPU, with a warning, since its CUDA build is another package than torch's. threads: 0 for all cores.
    Raises: WeightsError when the model cannot be loaded.
    """
    providers: list[str | tuple[str, dict[str, str]]] = ["CPUExecutionProvider"]
    kind, _, index = device.partition(":")
    if kind == "cuda":
        if "CUDAExecutionProvider" in onnxruntime.get_available_providers():
            providers.insert(0, ("CUDAExecutionProvider", {"device_id": index or "0"}))
        else:
            _log.warning("%s runs on the CPU, since onnxruntime has no CUDA here; onnxruntime-gpu brings it", name)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.use_deterministic_compute = True
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # leave the cores to torch in between
    try:
        return onnxruntime.InferenceSession(model, options, providers=providers)
    except Exception as error:  # ONNX Runtime has no common class for what can be wrong with a file
        reason = str(error).splitlines()[0]
        raise WeightsError(f"{name} cannot be loaded as an ONNX model ({reason}); get its file again") from error
