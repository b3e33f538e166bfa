"""The frames that sgam-sfm and its workers exchange, and the one module that workers have of us."""

import ast
import io
import json
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sgam_sfm.workers import sgam_worker
from sgam_sfm.workers.sgam_worker import (
    DTYPES,
    MAGIC,
    MAX_ARRAY_BYTES,
    MAX_HEADER_BYTES,
    ProtocolError,
    read_message,
    write_message,
)

SCRIPTS = sorted(Path(sgam_worker.__file__).parent.glob("*_worker.py"))
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)
ARRAYS = st.lists(
    st.sampled_from(sorted(DTYPES)).flatmap(
        lambda name: hnp.arrays(name, hnp.array_shapes(min_dims=1, max_dims=4, min_side=0, max_side=4))
    ),
    max_size=3,
)


def framed(header: object, payload: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return MAGIC + struct.pack("<I", len(text)) + text + payload


def read(data: bytes):
    return read_message(io.BytesIO(data))


def written(header: dict, arrays: list[np.ndarray]) -> bytes:
    stream = io.BytesIO()
    write_message(stream, header, arrays)
    return stream.getvalue()


@given(st.dictionaries(st.text().filter(lambda key: key not in ("type", "arrays")), JSON), ARRAYS)
def test_what_is_written_is_read_back(content, arrays):
    header = {**content, "type": "match"}
    stream = io.BytesIO(2 * written(header, arrays))
    for _ in range(2):  # one message does not eat of the next
        back, found = read_message(stream)
        assert back == header
        assert len(found) == len(arrays)
        for array, other in zip(arrays, found, strict=True):
            assert array.dtype == other.dtype
            assert other.flags.writeable  # torch warns of arrays that are not
            np.testing.assert_array_equal(array, other)
    with pytest.raises(EOFError):
        read_message(stream)


def refuse(data: bytes) -> None:
    """Bytes that are a message by chance are one; all others are refused in the two ways that are expected."""
    stream = io.BytesIO(data)
    while True:
        try:
            header, _ = read_message(stream)
        except (EOFError, ProtocolError):
            return
        assert isinstance(header["type"], str)


@given(st.binary(max_size=64))
def test_any_bytes_are_a_message_or_refused(data):
    refuse(data)
    refuse(MAGIC + data)
    refuse(framed(data))


@given(JSON, st.binary(max_size=32))
def test_any_header_is_a_message_or_refused(header, payload):
    refuse(framed(header, payload))
    refuse(framed({"type": "match", "arrays": header}, payload))
    refuse(framed({"type": "match", "arrays": [header]}, payload))
    refuse(framed({"type": "match", "arrays": [{"dtype": "uint8", "shape": header}]}, payload))


@given(ARRAYS, st.data())
def test_a_damaged_message_is_refused_or_read(arrays, data):
    message = bytearray(written({"type": "match"}, arrays))
    for _ in range(3):
        message[data.draw(st.integers(0, len(message) - 1))] = data.draw(st.integers(0, 255))
    refuse(bytes(message[: data.draw(st.integers(0, len(message)))]))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"Hello, world", "expected a message, got b'Hello, w'"),
        (MAGIC + struct.pack("<I", 2**31), f"a header of {2**31} bytes; at most {MAX_HEADER_BYTES} are allowed"),
        (framed(b"nonsense"), "the header is not JSON: Expecting value"),
        (framed(100_000 * b"["), "the header is not JSON: "),
        (framed(["match"]), "the header has no type"),
        (framed({"type": "match", "arrays": 1}), "the arrays are not a list"),
        (framed({"type": "match", "arrays": [{"dtype": "object", "shape": [1]}]}), "an array is described by {'dtype'"),
        (framed({"type": "match", "arrays": [{"dtype": "uint8", "shape": [-1]}]}), "an array is described by {'dtype'"),
        (
            framed({"type": "match", "arrays": [{"dtype": "uint8", "shape": [2**20, 0, 2**20]}]}),
            rf"an array of shape \(1048576, 0, 1048576\); at most {MAX_ARRAY_BYTES} bytes are allowed",
        ),
    ],
)
def test_what_is_no_message_is_told(data, message):
    with pytest.raises(ProtocolError, match=message):
        read(data)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_scripts_are_python_3_8(script):
    ast.parse(script.read_text(), feature_version=(3, 8))


def test_the_module_of_workers_needs_numpy_and_the_standard_library_alone():
    tree = ast.parse(Path(sgam_worker.__file__).read_text())
    names = {
        alias.name if isinstance(node, ast.Import) else node.module
        for node in ast.walk(tree)
        if isinstance(node, (ast.Import, ast.ImportFrom))
        for alias in node.names
    }
    assert {name.partition(".")[0] for name in names} - sys.stdlib_module_names == {"numpy", "sgam_worker"}
