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
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
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
_SPARSE, _MATRIX, _COMPRESSED = 5, 14, 15  # a class of matrices, and types of elements
_OF_NUMBERS = range(_SPARSE, 16)  # classes of matrices
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8",
           12: "i8", 13: "u8"}
_ORDERS = {b"\0\1IM": "<", b"\1\0MI": ">"}  # heads of version 5 to 7
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
    try:
        order = _ORDERS.get(content[124:128])
        whole = _unpacked(memoryview(content)[128:], order) if order else content
        if max(len(content), len(whole)) > MAX_BYTES:
            raise ConfigError(  # noqa: TRY301
                f"{path} has more than {MAX_BYTES} bytes, or unpacks to more"
            )
        if order:
            return _matrices(memoryview(whole), order, names)
        if 0 not in content[:4]:  # as in no text in front of another version
            raise ValueError("it is of no version up to 7")  # noqa: TRY301
        numbers = [
            name for name, _, kind in whosmat(io.BytesIO(content))  # type: ignore[arg-type]
            if kind in _NUMBERS and (names is None or name in names)
        ]
        with warnings.catch_warnings(action="ignore"):  # any of SciPy's two kinds of sparse
            found: dict[str, Any] = loadmat(
                io.BytesIO(content), variable_names=numbers  # type: ignore[arg-type]
            )
    except ConfigError:
        raise
    except Exception as error:  # noqa: BLE001  a stranger's bytes: whatever a library says of them
        raise ConfigError(
            f"{path} cannot be read ({shown(str(error))}); save it with -v7"
        ) from None
    return {name: found[name] for name in numbers}


def _unpacked(content: memoryview, order: str) -> bytearray:
    """What follows the head of a MATLAB file, without compression, or the start of too much."""
    found = bytearray()
    for kind, data in _elements(content, order):
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            found += unpacker.decompress(data, max(MAX_BYTES - len(found), 0) + 1)
            if not unpacker.eof and len(found) <= MAX_BYTES:
                raise ValueError("compressed data end too soon")
        elif kind != _MATRIX:
            raise ValueError(f"no matrix has the type {kind}")
        else:
            found += struct.pack(f"{order}II", kind, len(data))
            found += data
            found += bytes(-len(data) % 8)
    return found


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Types and data of what stands one behind the other in a MATLAB file, or in a matrix of it."""
    at = 0
    while at + 8 <= len(content):
        kind, length = struct.unpack_from(f"{order}II", content, at)
        start, kind, length = (at + 4, kind & 0xFFFF, kind >> 16) if kind >> 16 else (
            at + 8, kind, length  # the others are of at most four bytes, within the tag
        )
        yield kind, content[start : start + length]
        at = start + length + (0 if kind == _COMPRESSED else -(start + length - at) % 8)


def _matrices(content: memoryview, order: str, names: Sequence[str] | None) -> dict[str, Any]:
    """The arrays of numbers among the elements; SciPy's reader may crash where one is damaged.

    ValueError: one is.
    """
    from scipy.sparse import csc_array

    def vector(kind: int, data: memoryview) -> Any:
        if kind not in _DTYPES:
            raise ValueError(f"no number has the type {kind}")
        return np.frombuffer(data, f"{order}{_DTYPES[kind]}").astype(_DTYPES[kind])

    found: dict[str, Any] = {}
    for kind, matrix in _elements(content, order):
        if kind != _MATRIX:
            raise ValueError(f"no matrix has the type {kind}")
        parts = islice(_elements(matrix, order), 8)  # a cell may have millions
        flags, shape, (_, label), *data = *parts, *[(0, memoryview(b""))] * 7
        told = int.from_bytes(flags[1][:4], "little" if order == "<" else "big")
        name, class_ = bytes(label).decode(), told & 0xFF
        if not name or class_ not in _OF_NUMBERS or (names is not None and name not in names):
            continue
        where = [vector(*part) for part in data[:2]] if class_ == _SPARSE else []
        real, imaginary, *_ = data[len(where) :]
        if where and [len(real[1])] == where[1][-1:].tolist():
            real = 2, real[1]  # truth values, which MATLAB may call doubles
        values = vector(*real) + (1j * vector(*imaginary) if told & 0x800 else 0)
        size = vector(*shape)
        if where:
            found[name] = csc_array((values, *where), shape=tuple(size.tolist()))
            found[name].check_format(full_check=True)
        else:
            found[name] = values.reshape(np.maximum(size, 0), order="F")
    return found


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
