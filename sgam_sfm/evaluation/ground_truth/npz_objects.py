"""Published pair lists are pickled numpy objects: read them without running what a pickle may carry."""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from sgam_core.errors import InputError

# What a pickle of plain numpy arrays and numbers needs; any other name is refused.
_ALLOWED = {
    ("multiarray", "_reconstruct"),
    ("multiarray", "scalar"),
    ("numeric", "_frombuffer"),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
}

# What broken archives and pickles are known to raise.
_BROKEN = (
    OSError,
    ValueError,
    EOFError,
    LookupError,
    AttributeError,
    ImportError,
    TypeError,
    zipfile.BadZipFile,
    pickle.UnpicklingError,
)


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module.rpartition(".")[2], name) not in _ALLOWED or module.partition(".")[0] not in ("numpy", "_codecs"):
            raise pickle.UnpicklingError(f"it holds {module}.{name}, which is not data")
        # numpy 2 renamed the modules that older files name.
        home = module.replace("numpy.core", "numpy._core") if np.lib.NumpyVersion(np.__version__) >= "2.0.0" else module
        return super().find_class(home, name)


def read_npz(path: Path, *keys: str) -> dict[str, np.ndarray]:
    """The named arrays of an .npz file that are there; raises InputError when the first is missing or it is broken."""
    try:
        with zipfile.ZipFile(path) as file:
            names = {*file.namelist()}
            found = {key: _array(file.read(f"{key}.npy")) for key in keys if f"{key}.npy" in names}
    except _BROKEN as error:
        raise InputError(f"'{path}' cannot be read as a list of numpy arrays ({error})") from error
    if keys[0] not in found:
        raise InputError(f"'{path}' has no array '{keys[0]}'; expected {', '.join(keys)}")
    return found


def _array(data: bytes) -> np.ndarray:
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    _, _, dtype = header(stream)
    if not dtype.hasobject:
        return np.load(io.BytesIO(data), allow_pickle=False)
    return np.asarray(_Unpickler(stream, encoding="latin1").load())
