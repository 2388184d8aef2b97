"""Caches on disk, by fingerprint: results of :func:`xplain.experiment.pipeline.prepare`, and
episodes.

Data, types, labelers and traces are the same for every λ and solver. The episodes of the oracle and
of the clairvoyant are the same for every solver. A solver's episodes with true labels are the same
for every learner. The key of an entry covers its configuration and all code that made it
(:mod:`xplain.experiment.fingerprint`), so an entry cannot be out of date. A damaged entry is
computed again. Entries are arrays and JSON; nothing is unpickled.
"""

import hashlib
import json
import zipfile
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.experiment.config import SOURCE_GROUPS
from xplain.experiment.fingerprint import fingerprint
from xplain.experiment.pipeline import PreparedData
from xplain.interaction.metrics import Record
from xplain.storage import decode, encode, open_atomic, write_text

SOURCE = (*SOURCE_GROUPS, "traces", "max_steps", "seed")
"""Configuration keys that decide data, types and traces."""


def source_fingerprint(config: Mapping[str, Any]) -> str:
    """Computes the cache key of a resolved configuration. The cache key depends only
    on the settings of the data, the types, the labelers, the traces and the possible questions. So
    configurations that differ only in other settings have the same cache key."""
    pool = {key: config["ask"][key] for key in ("kinds", "clips")}
    return fingerprint({key: config[key] for key in SOURCE} | {"ask": pool})


def load_or_prepare(
    folder: Path | None, key: str, make: Callable[[], PreparedData]
) -> PreparedData:
    """Reads the entry of this key, or computes and stores it.

    Processes that need the same entry at the same time wait for the first one. If the folder cannot
    be written, the entry is not shared.

    Args:
        folder: folder of the cache; None stores nothing.
        key: key from :func:`source_fingerprint`.
        make: computes the entry.
    """
    from filelock import FileLock

    if folder is None:
        return make()
    path = folder / f"{key}.npz"
    if (kept := _try_read(path)) is not None:
        return kept
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / f"{key}.lock").acquire()
    except OSError:
        return make()
    with lock:
        if (kept := _try_read(path)) is None:
            kept = make()
            _write_entry(path, kept)
        return kept


def _try_read(path: Path) -> PreparedData | None:
    try:
        return _read_entry(path, path.stat().st_mtime_ns)
    except (OSError, EOFError, ValueError, LookupError, TypeError, zipfile.BadZipFile, zlib.error):
        return None


@lru_cache(maxsize=1)
def _read_entry(path: Path, written: int) -> PreparedData:
    """Reads an entry. Keeps the last entry in memory, because the jobs of a batch share it."""
    with path.open("rb") as stored, np.load(stored, allow_pickle=False) as file:
        arrays = dict(file)
    prepared: PreparedData = decode(PreparedData, json.loads(str(arrays["content"])), arrays)
    return prepared


def _write_entry(path: Path, prepared: PreparedData) -> None:
    arrays: dict[str, NDArray[Any]] = {}
    content = np.array(json.dumps(encode(prepared, arrays)))
    # If the cache cannot be written, the result is kept but not shared.
    with suppress(OSError), open_atomic(path, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, content=content, **arrays)


@dataclass(frozen=True)
class EpisodeCache:
    """Episodes that several results share, on disk.

    Attributes:
        folder: folder of the cache; None stores nothing.
        config: the resolved configuration.
    """

    folder: Path | None
    config: Mapping[str, Any]

    def load_or_make(
        self, prepared: PreparedData, parts: tuple[str, ...], make: Callable[[], list[Record]]
    ) -> list[Record]:
        """Reads the episodes of the traces and users in ``prepared``, or computes and stores them.
        The cache key covers all of ``prepared``, and the configuration of explainers and users
        without ``parts``.

        Args:
            prepared: the traces, and what explainers and users know of them. It should contain
                nothing else, because any other content would change the key.
            parts: configuration keys without influence on the episodes.
            make: computes the episodes.
        """
        if self.folder is None:
            return make()
        arrays: dict[str, NDArray[Any]] = {}
        content = json.dumps(encode(prepared, arrays), sort_keys=True).encode()
        digest = hashlib.sha256(content)
        for array in arrays.values():
            digest.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
        apart = {*SOURCE, "points", "certify", *parts} - {"seed"}
        others = {key: value for key, value in self.config.items() if key not in apart}
        path = self.folder / f"{fingerprint(others | {'prepared': digest.hexdigest()})}.json"
        try:
            found: tuple[Record, ...] = decode(
                tuple[Record, ...], json.loads(path.read_text(encoding="utf-8"))
            )
        except (OSError, ValueError, LookupError, TypeError):
            made = make()
            with suppress(OSError):
                write_text(path, json.dumps(encode(made)))
            return made
        return [
            # JSON does not keep the shape of an empty array.
            replace(
                own, episode=replace(own.episode, questions=own.episode.questions.reshape(-1, 3))
            )
            for own in found
        ]
