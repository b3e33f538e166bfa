"""Files that appear only when they are whole."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from threading import get_native_id
from typing import Any

from pydantic_core import to_jsonable_python

_PARTIAL = re.compile(r"\..+\.\d+\.partial(-wal|-shm|-journal)?")


@contextmanager
def replacing(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """A path beside `path` to write to; it takes the place of `path` when all went well, and is removed otherwise.

    Args: durable: wait until the content is on the disk, so that not even a power cut leaves the name with half of it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{get_native_id()}.partial")  # threads may write the same
    try:
        yield partial
        if durable:
            flush(partial)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def remove_partials(output: Path) -> None:
    """Remove what a process that was killed left half-written in a run's folder; nobody else may be writing there."""
    folders = [output, *(output / name for name in ("pairs", "labels", "cache"))]
    for folder in folders:
        for path in list(folder.glob(".*.partial*") if folder == output else folder.rglob(".*.partial*")):
            if _PARTIAL.fullmatch(path.name):
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def content_digest(path: Path) -> str:
    """The SHA-256 of a file, or of the names and the content of all maps (`.png`, `.json`) in a folder."""
    if not path.is_dir():
        return _file_digest(path, path.stat().st_mtime_ns)
    digest = hashlib.sha256()
    for file in sorted(file for file in path.rglob("*") if file.suffix.lower() in (".png", ".json")):
        digest.update(f"{file.relative_to(path)} {_file_digest(file, file.stat().st_mtime_ns)}\n".encode())
    return digest.hexdigest()


@cache
def _file_digest(path: Path, changed: int) -> str:
    """Args: changed: when the file was; a digest is asked for whenever options are written."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def flush(path: Path) -> None:
    """Wait until a file that was written is on the disk."""
    with path.open("r+b") as file:
        os.fsync(file.fileno())


def write_json(path: Path, content: Any, *, durable: bool = True) -> Any:
    """Dataclasses, paths and plain values as JSON. Returns: the content as it is read back."""
    text = json.dumps(to_jsonable_python(content), indent=2)
    with replacing(path, durable=durable) as partial:
        partial.write_text(text + "\n", encoding="utf-8")
    return json.loads(text)


def require_space(path: Path, num_bytes: int) -> None:
    """Refuse to write a file that the disk has no room for, where what writes it cannot be trusted to fail well.

    Raises: OSError (ENOSPC).
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if shutil.disk_usage(path.parent).free < num_bytes:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def disk_is_full(error: BaseException) -> bool:
    """Whether an error comes from a full disk; libraries that write files tell it in their own words."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return True
    return any(words in str(error) for words in ("disk is full", "No space left on device", "Disk quota exceeded"))
