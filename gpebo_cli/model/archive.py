"""Files of arrays of numbers: NumPy's ``.npz`` beside a plant, sparse, without pickles; ``.mat``.

A matrix X is one array ``X``, or its entries ``X.row``, ``X.col``, ``X.data`` and ``X.shape``.
"""

from __future__ import annotations

import io
import math
import os
import struct
import warnings
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from operator import index
from typing import Any

import numpy as np

from gpebo_cli.errors import ConfigError
from gpebo_cli.model.matrix import is_empty
from gpebo_cli.reading import beside, open_regular
from gpebo_cli.schema import shown

ARCHIVE = "matrices"
"""The key of a plant that names such a file."""
MATRICES = "EABFCDH"
MAX_BYTES = 200_000_000
"""Largest size of a file of matrices, unpacked."""

_MAX_PACKED = 20_000_000  # a longer list of contents takes memory before anything can be counted
_COMPRESSED = 15
_NUMBERS = ("double", "single", "sparse", "logical",
            *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))
_PARTS = ("row", "col", "data", "shape")
_BROKEN = (ValueError, KeyError, OSError, EOFError, RuntimeError, NotImplementedError,
           zipfile.BadZipFile, zlib.error)


def with_archive(mapping: Mapping[str, object], source: str, where: str) -> Mapping[str, object]:
    """The mapping of a plant's file with the matrices of the archive that it names, if any.

    ConfigError: it is none, lies outside of the plant's folders, or a matrix is in both.
    """
    file = mapping.get(ARCHIVE)
    if file is None:
        return mapping
    if not isinstance(file, str):
        raise ConfigError(f"{where}: {ARCHIVE} is the name of an .npz file, not {shown(file)}")
    path = beside(file, source, f"{where}: {ARCHIVE}")
    found = read_archive(path)
    both = [key for key in found if not is_empty(mapping.get(key))]
    if both:
        raise ConfigError(f"{where}: {both[0]} stands in the plant and in {path}; leave one out")
    return {**mapping, **found}


def read_archive(path: str) -> dict[str, Any]:
    """The matrices of an archive by name: arrays, or SciPy's sparse ones.

    ConfigError: no regular file, no archive of matrices, or one that is too large.
    """
    arrays: dict[str, Any] = {}
    try:
        with open_regular(path) as stream:
            if os.fstat(stream.fileno()).st_size > _MAX_PACKED:
                raise ConfigError(f"{path} has more than {_MAX_PACKED} bytes")
            archive = zipfile.ZipFile(stream)
            members = archive.infolist()
            if sum(member.file_size for member in members) > MAX_BYTES:
                raise ConfigError(f"{path} unpacks to more than {MAX_BYTES} bytes")
            for member in members:
                key = member.filename.removesuffix(".npy")
                matrix, _, part = key.partition(".")
                if matrix not in tuple(MATRICES) or part not in ("", *_PARTS):
                    raise ConfigError(
                        f"{path} has {shown(key)}; expected {', '.join(MATRICES)}, or their "
                        "entries as X.row, X.col, X.data and X.shape"
                    )
                arrays[key] = _array(archive.read(member), f"{path}: {key}")
    except _BROKEN as error:
        raise ConfigError(f"{path} is no archive of matrices ({shown(str(error))})") from None
    return {
        matrix: arrays[matrix] if matrix in arrays else _sparse(arrays, matrix, path)
        for matrix in MATRICES if any(key.partition(".")[0] == matrix for key in arrays)
    }


def read_mat(path: str, names: Sequence[str] | None = None) -> dict[str, Any]:
    """The arrays of numbers in a MATLAB file up to version 7 (None: all of them), by name.

    ConfigError: no regular file, none that can be read, or one that is too large.
    """
    from scipy.io import loadmat, whosmat

    with open_regular(path) as stream:
        content = stream.read(MAX_BYTES + 1)
    if _unpacked(content) > MAX_BYTES:
        raise ConfigError(f"{path} has more than {MAX_BYTES} bytes, or unpacks to more")
    try:
        # The head of a cell array may claim any size, and memory is taken for it at once.
        numbers = [
            name for name, _, kind in whosmat(io.BytesIO(content))  # type: ignore[arg-type]
            if kind in _NUMBERS and (names is None or name in names)
        ]
        with warnings.catch_warnings(action="ignore"):  # any of SciPy's two kinds of sparse
            found: dict[str, Any] = loadmat(
                io.BytesIO(content), variable_names=numbers  # type: ignore[arg-type]
            )
    except Exception as error:  # noqa: BLE001  a stranger's bytes: whatever a library says of them
        raise ConfigError(
            f"{path} cannot be read ({shown(str(error))}); save it with -v7"
        ) from None
    return {name: found[name] for name in numbers}


def _unpacked(content: bytes) -> int:
    """Bytes of a MATLAB file when its compressed elements (of type 15) are unpacked, or too many.

    What is no such file counts as it stands; its reader says better what it is.
    """
    size, at = len(content), 128
    tag = struct.Struct("<II" if content[126:128] == b"IM" else ">II")
    while size <= MAX_BYTES and at + tag.size <= len(content):
        kind, length = tag.unpack_from(content, at)
        at += tag.size
        packed, unpacker = content[at : at + length], zlib.decompressobj()
        at += length
        while kind == _COMPRESSED and packed and size <= MAX_BYTES:
            try:
                size += len(unpacker.decompress(packed, 1 << 20))
            except zlib.error:
                break
            packed = unpacker.unconsumed_tail
    return size


def _sparse(arrays: Mapping[str, Any], matrix: str, path: str) -> Any:
    from scipy.sparse import coo_array

    try:
        row, col, data, shape = (arrays[f"{matrix}.{part}"] for part in _PARTS)
        height, width = (index(size) for size in shape)
        return coo_array((data, (row, col)), shape=(height, width))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        needed = ", ".join(f"{matrix}.{part}" for part in _PARTS)
        raise ConfigError(f"{path}: {needed} make no matrix ({error})") from None


def archive_of(matrices: Mapping[str, Any]) -> bytes:
    """An archive of SciPy's sparse matrices by name; its bytes depend on them alone."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, matrix in matrices.items():
            sparse = matrix.tocoo()
            for part in _PARTS:
                array = io.BytesIO()
                np.lib.format.write_array(array, np.ascontiguousarray(getattr(sparse, part)))
                archive.writestr(zipfile.ZipInfo(f"{name}.{part}.npy"), array.getvalue(),
                                 zipfile.ZIP_DEFLATED)
    return content.getvalue()


def _array(content: bytes, where: str) -> np.ndarray[Any, Any]:
    """The array of numbers in an ``.npy`` file; what its head promises has to be there."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise ConfigError(f"{where} is an array of version {version}; expected version (1, 0)")
    shape, _, kind = np.lib.format.read_array_header_1_0(stream)
    if kind.kind not in "iuf" or math.prod(shape) * kind.itemsize > len(content) - stream.tell():
        raise ConfigError(f"{where} is not an array of real numbers, or is cut off")
    stream.seek(0)
    array: np.ndarray[Any, Any] = np.lib.format.read_array(stream, allow_pickle=False)
    return array
