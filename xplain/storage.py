"""Values in files: dataclasses as JSON and arrays, and files that are written atomically.

Reading creates only objects that a type hint names; nothing is ever unpickled.
"""

import os
import tempfile
import types
import typing
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

ALIAS = getattr(typing, "TypeAliasType", ())
"""The class of NDArray since numpy 2.5. Python 3.11 does not have it."""


@contextmanager
def open_atomic(path: Path, mode: str = "w") -> Iterator[IO[Any]]:
    """Opens a file for writing, which replaces ``path`` after all its content is on the disk.

    If the process is killed, the disk is full or the block raises, ``path`` stays unchanged.

    Args:
        path: path of the file.
        mode: ``w`` for UTF-8 text, ``wb`` for bytes.

    Raises:
        OSError: the file cannot be written; the error names ``path``.
    """
    temporary = ""
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(handle, mode, encoding=None if "b" in mode else "utf-8") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_read_umask())  # the group may read results
        os.replace(temporary, path)
    except BaseException as error:
        if temporary:
            Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def write_text(path: Path, text: str) -> None:
    """Writes a text atomically (:func:`open_atomic`)."""
    with open_atomic(path) as file:
        file.write(text)


@cache
def _read_umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def encode(value: Any, arrays: dict[str, NDArray[Any]] | None = None) -> Any:
    """Converts a value of dataclasses, tuples, mappings, numbers, text and arrays to JSON values.

    Args:
        value: the value.
        arrays: receives the arrays of the value, and the JSON contains their names; without this
            argument arrays become lists.
    """
    if isinstance(value, np.ndarray):
        if arrays is None:
            return value.tolist()
        name = f"array_{len(arrays)}"
        arrays[name] = value
        return name
    if isinstance(value, np.generic):
        return value.item()
    if is_dataclass(value):
        return {field.name: encode(getattr(value, field.name), arrays) for field in fields(value)}
    if isinstance(value, Mapping):
        return {key: encode(item, arrays) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [encode(item, arrays) for item in value]
    return value


def decode(kind: Any, value: Any, arrays: Mapping[str, NDArray[Any]] | None = None) -> Any:
    """Makes a value of the type ``kind`` from the result of :func:`encode`.

    Raises:
        KeyError, TypeError, ValueError: ``value`` does not fit the type.
    """
    origin, options = typing.get_origin(kind), typing.get_args(kind)
    if isinstance(origin, ALIAS):
        return decode(origin.__value__[options], value, arrays)
    if origin in (types.UnionType, typing.Union):
        if value is None:
            return None
        inner = [option for option in options if option is not type(None)]
        # If an array or a dataclass is allowed, a mapping is a dataclass.
        of_mapping = [one for one in inner if is_dataclass(one) == isinstance(value, Mapping)]
        return decode((of_mapping or inner)[0], value, arrays)
    if origin is np.ndarray:
        if arrays is not None:
            return arrays[value]
        (scalar,) = typing.get_args(options[1])
        return np.array(value, dtype=scalar)
    if origin is tuple:
        kinds = [options[0]] * len(value) if options[-1] is ... else list(options)
        return tuple(decode(k, item, arrays) for k, item in zip(kinds, value, strict=True))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {key: decode(options[1], item, arrays) for key, item in value.items()}
    if is_dataclass(kind) and isinstance(kind, type):
        hints, plain = _read_hints(kind), _plain_fields(kind)
        return kind(
            **{
                name: item if name in plain else decode(hints[name], item, arrays)
                for name, item in value.items()
            }
        )
    return value


@cache
def _read_hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)


@cache
def _plain_fields(kind: type) -> frozenset[str]:
    """Returns the fields of a dataclass whose values JSON can hold directly."""
    return frozenset(name for name, hint in _read_hints(kind).items() if _is_plain(hint))


def _is_plain(kind: Any) -> bool:
    origin = typing.get_origin(kind)
    if origin in (types.UnionType, typing.Union):
        return all(map(_is_plain, typing.get_args(kind)))
    return origin is None and not is_dataclass(kind)
