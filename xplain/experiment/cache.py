"""Work done once: what :func:`xplain.experiment.pipeline.prepare` made, kept on disk by its stamp.

Data, types, labelers and traces are the same for every λ and solver. The key covers their
configuration and every piece of code that made them (:mod:`xplain.experiment.fingerprint`), so an
entry cannot be stale; one that is damaged is made again. Entries are arrays and JSON, nothing is
unpickled.
"""

from __future__ import annotations

import dataclasses
import json
import os
import tempfile
import types
import typing
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.experiment.fingerprint import stamp
from xplain.experiment.pipeline import Prepared

SOURCE = (
    "domain",
    "users",
    "observers",
    "labeler",
    "clusterer",
    "traces",
    "max_steps",
    "seed",
)
"""The configuration's keys that decide data, types and traces."""


def source_stamp(config: dict[str, Any]) -> str:
    """The key of a resolved configuration: the same for all that share data and types."""
    return stamp({key: config[key] for key in SOURCE})


def prepared_once(folder: Path, key: str, make: Callable[[], Prepared]) -> Prepared:
    """The entry of this key; made, and kept, where there is none.

    Processes that want the same entry at once wait for the first. A folder that cannot be
    written costs the sharing, not the result.

    Args:
        folder: of the cache.
        key: of :func:`source_stamp`.
        make: does the work.
    """
    from filelock import FileLock

    path = folder / f"{key}.npz"
    kept = _read(path)
    if kept is not None:
        return kept
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / f"{key}.lock")
        lock.acquire()
    except OSError:
        return make()
    with lock:
        kept = _read(path)
        if kept is None:
            kept = make()
            _write(path, kept)
        return kept


def _read(path: Path) -> Prepared | None:
    try:
        with path.open("rb") as stored, np.load(stored, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        content = json.loads(str(arrays["content"]))
        prepared: Prepared = _decode(Prepared, content, arrays)
        return prepared
    except (OSError, EOFError, ValueError, LookupError, TypeError, zipfile.BadZipFile, zlib.error):
        return None


def _write(path: Path, prepared: Prepared) -> None:
    arrays: dict[str, NDArray[Any]] = {}
    content = np.array(json.dumps(_encode(prepared, arrays), default=lambda number: number.item()))
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".new.", suffix=".npz")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez_compressed(file, allow_pickle=False, content=content, **arrays)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError:
        Path(temporary).unlink(missing_ok=True)


def _encode(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """JSON of a dataclass; its arrays go into ``arrays``, their names into the JSON."""
    if isinstance(value, np.ndarray):
        name = f"array_{len(arrays)}"
        arrays[name] = value
        return name
    if dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value)]
        return {name: _encode(getattr(value, name), arrays) for name in names}
    if isinstance(value, tuple):
        return [_encode(item, arrays) for item in value]
    return value


def _decode(kind: Any, value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """The value of type ``kind`` that :func:`_encode` made ``value`` of."""
    origin = typing.get_origin(kind)
    if origin in (types.UnionType, typing.Union):
        inner = [option for option in typing.get_args(kind) if option is not type(None)]
        return None if value is None else _decode(inner[0], value, arrays)
    if origin is np.ndarray:
        return arrays[value]
    if origin is tuple:
        items, ellipsis = typing.get_args(kind), ...
        inner = [items[0]] * len(value) if items[-1] is ellipsis else list(items)
        return tuple(_decode(k, v, arrays) for k, v in zip(inner, value, strict=True))
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        hints = typing.get_type_hints(kind)
        return kind(**{name: _decode(hints[name], value[name], arrays) for name in value})
    return value
