"""Serve sgam-sfm from another Python environment: the worker's side of external matchers and segmenters.

One file, standard library and numpy, Python 3.8 or later. A worker is a script, which sgam-sfm starts and can import
this module from:

    from sgam_worker import serve_matcher

    def load(settings):
        model = MyModel(settings.weights, settings.device)

        def match(pairs):
            return [model(image0, image1) for image0, image1 in pairs]

        return match

    serve_matcher(load, origin="corner")

What it prints goes to sgam-sfm's log.

The protocol, version 1: messages through two pipes. A message is

    4 bytes         SGAM
    4 bytes         length of the header, little-endian
    header          JSON, UTF-8: {"type": ..., "arrays": [{"dtype": "uint8", "shape": [480, 640, 3]}, ...], ...}
    arrays          their bytes one after the other, C order, little-endian

and they go to and fro:

    sgam-sfm        {"type": "hello", "protocol": 1, "kind": "matcher" or "segmenter", "settings": {...}}
    worker          {"type": "hello", "protocol": 1, "kind": "matcher", "origin": "corner" or "center"}
                    {"type": "hello", "protocol": 1, "kind": "segmenter", "labels": {"1": "wall", ...}}
    sgam-sfm        {"type": "match", "pairs": [[0, 1], [0, 2]]}: which of the arrays, crops (h, w, 3) uint8 RGB
    worker          {"type": "matches"}; arrays points0 (M, 2), points1 (M, 2), scores (M,) of each pair in turn
    sgam-sfm        {"type": "segment"}; array image (h, w, 3) uint8 RGB
    worker          {"type": "labels"}; array (h, w) int32
    worker          {"type": "error", "message": ...}, in place of an answer

Nothing is ever pickled. The worker ends when its pipe is closed.
"""

from __future__ import annotations

import json
import os
import runpy
import struct
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from io import BufferedIOBase
from types import SimpleNamespace
from typing import Any

import numpy as np

PROTOCOL = 1
MAGIC = b"SGAM"
DTYPES = {"uint8": "|u1", "int32": "<i4", "float32": "<f4", "float64": "<f8"}
MAX_HEADER_BYTES = 2**24
MAX_ARRAY_BYTES = 2**30
MAX_DIMENSIONS = 4


class ProtocolError(Exception):
    """What came is no message."""


def write_message(stream: BufferedIOBase, header: Mapping[str, Any], arrays: Sequence[np.ndarray] = ()) -> None:
    """Send a header and arrays, whose types are among `DTYPES`."""
    arrays = [np.ascontiguousarray(array, dtype=DTYPES[array.dtype.name]) for array in arrays]
    described = [{"dtype": array.dtype.name, "shape": array.shape} for array in arrays]
    text = json.dumps({**header, "arrays": described}).encode()
    stream.write(MAGIC + struct.pack("<I", len(text)) + text)
    for array in arrays:
        if array.size:
            stream.write(array.data.cast("B"))
    stream.flush()


def read_message(stream: BufferedIOBase) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The header and arrays of the next message.

    Raises: EOFError when the stream ends, ProtocolError when what comes is no message.
    """
    start = _read(stream, 8)
    if start[:4] != MAGIC:
        raise ProtocolError(f"expected a message, got {start!r}")
    (length,) = struct.unpack("<I", start[4:])
    if length > MAX_HEADER_BYTES:
        raise ProtocolError(f"a header of {length} bytes; at most {MAX_HEADER_BYTES} are allowed")
    try:
        header = json.loads(_read(stream, length).decode())
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"the header is not JSON: {error}") from error
    if not isinstance(header, dict) or not isinstance(header.get("type"), str):
        raise ProtocolError("the header has no type")
    described = header.pop("arrays", [])
    if not isinstance(described, list):
        raise ProtocolError("the arrays are not a list")
    return header, [_read_array(stream, one) for one in described]


def _read_array(stream: BufferedIOBase, described: Any) -> np.ndarray:
    try:
        dtype, shape = np.dtype(DTYPES[described["dtype"]]), tuple(described["shape"])
        good = len(shape) <= MAX_DIMENSIONS and all(type(length) is int and length >= 0 for length in shape)
    except (KeyError, TypeError):
        good = False
    if not good:
        raise ProtocolError(f"an array is described by {str(described)[:200]}")
    num_bytes = dtype.itemsize
    for length in shape:
        num_bytes *= max(length, 1)
    if num_bytes > MAX_ARRAY_BYTES:
        raise ProtocolError(f"an array of shape {shape}; at most {MAX_ARRAY_BYTES} bytes are allowed")
    array = np.empty(shape, dtype)
    if array.size and stream.readinto(array.data.cast("B")) < array.nbytes:
        raise EOFError("the stream ends within an array")
    return array


def _read(stream: BufferedIOBase, num_bytes: int) -> bytes:
    data = stream.read(num_bytes)
    if len(data) < num_bytes:
        raise EOFError("the stream ends within a message" if data else "the stream has ended")
    return data


def serve_matcher(load: Callable[[Any], Callable], *, origin: str) -> None:
    """Match the pairs of crops that sgam-sfm sends, until it has no more.

    Args:
        load: called once with the settings, whose attributes are `device` ("cpu", "cuda:0"), `weights` (what --weights
            says, or None), `seed` and `threads` (0: all cores). Returns the function that matches: of a list of pairs
            of RGB images (h, w, 3) uint8, whose sizes may all differ, for each pair (points0, points1, scores):
            points (M, 2) as (x, y) in pixels of these images, scores (M,) in [0, 1], or None for ones.
        origin: "corner" when the centre of the first pixel is at (0.5, 0.5), "center" when it is at (0, 0).
    """
    _serve("matcher", load, {"origin": origin}, _matches)


def serve_segmenter(load: Callable[[Any], Callable], *, labels: Mapping[int, str] | None = None) -> None:
    """Segment the images that sgam-sfm sends, until it has no more.

    Args:
        load: as that of `serve_matcher`, without `weights`. Returns the function that segments: of an RGB image
            (h, w, 3) uint8, a map of ids (h, w), integers, 0 where nothing is known; equal ids mean the same thing in
            all images. It may be smaller than the image, in its aspect.
        labels: names of the ids.
    """
    _serve("segmenter", load, {"labels": labels or {}}, _labels)


def _matches(match: Callable, header: Mapping[str, Any], crops: list[np.ndarray]) -> tuple[str, list[np.ndarray]]:
    pairs = [(crops[i], crops[j]) for i, j in header["pairs"]]
    arrays = []
    for points0, points1, scores in match(pairs):
        points0, points1 = np.asarray(points0, np.float64), np.asarray(points1, np.float64)
        arrays += [points0, points1, np.ones(len(points0)) if scores is None else np.asarray(scores, np.float64)]
    return "matches", arrays


def _labels(segment: Callable, header: Mapping[str, Any], images: list[np.ndarray]) -> tuple[str, list[np.ndarray]]:
    labels = np.asarray(segment(images[0]))
    if labels.dtype.kind not in "iu":
        raise TypeError(f"labels are {labels.dtype}; expected integers")
    return "labels", [labels.astype(np.int32)]


_pipes: tuple[BufferedIOBase, BufferedIOBase] | None = None  # of this process, once `_run_script` has taken them


def _serve(kind: str, load: Callable, about: Mapping[str, Any], answer: Callable) -> None:
    if _pipes is None:
        raise SystemExit(f"sgam-sfm starts this script: --{kind} external --{kind}-script {sys.argv[0]}")
    requests, answers = _pipes
    settings = read_message(requests)[0]["settings"]
    try:
        function = load(SimpleNamespace(**settings))
    except Exception as error:
        _tell(answers, error)
        raise SystemExit(1) from error
    write_message(answers, {"type": "hello", "protocol": PROTOCOL, "kind": kind, **about})
    while True:
        try:
            header, arrays = read_message(requests)
        except EOFError:
            return
        try:
            type_, results = answer(function, header, arrays)
        except Exception as error:
            _tell(answers, error)
            continue
        write_message(answers, {"type": type_}, results)


def _tell(answers: BufferedIOBase, error: Exception) -> None:
    traceback.print_exc()
    write_message(answers, {"type": "error", "message": f"{type(error).__name__}: {error}"})


def _run_script(script: str, *arguments: str) -> None:
    """Run a script as Python would, but with the protocol's pipes out of its reach: what it prints is log."""
    global _pipes
    _pipes = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    sys.argv = [script, *arguments]
    sys.path.append(sys.path[0])  # for processes that the script starts
    sys.path[0] = os.path.dirname(os.path.abspath(script))
    runpy.run_path(script, run_name="__main__")


if __name__ == "__main__":
    import sgam_worker  # this file as the module that the script imports

    sgam_worker._run_script(*sys.argv[1:])
