"""Checkpoints: what a render needs to go on later as if it had never stopped.

A file of a guide alone (`wavefront.guide_file`) is one of these too, of another kind.

The file is an npz as NumPy reads it, without pickle: an uncompressed ZIP of ``about.json`` and of arrays in sections,
``film/L.npy`` and so on. Arrays are streamed, so that no copy of the film is made, and ZIP's checksums tell a damaged
file. It is written under a temporary name, forced to the disk and then renamed: whenever the process or the machine
dies, the last whole checkpoint is there.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO

import numpy as np
import warp as wp

from wavefront.errors import WavefrontError
from wavefront.film import Film, FilmArrays
from wavefront.identity import explain_differences

FORMAT = 1
_ABOUT = "about.json"
_CHUNK = 1 << 20  # entries of an array that are copied at once
_OLDEST_DATE = (1980, 1, 1, 0, 0, 0)  # of every entry, so that equal renders give equal files

Sections = Mapping[str, Mapping[str, wp.array]]


class CheckpointError(WavefrontError):
    """A checkpoint that cannot be written, read or used for this render."""


def film_sections(film: Film) -> dict[str, dict[str, wp.array]]:
    """The section of a film: all sums that it holds, by their names in `FilmArrays`."""
    arrays = {name: getattr(film.arrays, name) for name in FilmArrays.vars}
    return {"film": {name: array for name, array in arrays.items() if array is not None and array.size}}


# --- writing -----------------------------------------------------------------------------------------------------


def write_checkpoint(path: str | os.PathLike, about: dict, sections: Sections, kind: str = "checkpoint") -> None:
    """Replaces `path` by a new checkpoint; after an error what was there is still there, and nothing else is.

    Args:
        path: The file.
        about: Plain values; `format` and `kind` are added.
        sections: One-dimensional arrays by section and name, on any device.
        kind: What the file is, for those who read it.

    Raises:
        CheckpointError: No space, no permission, or another process that writes to the same file.
    """
    target = Path(os.path.realpath(path))  # a link stays one
    temporary = target.with_name(f".{target.name}.tmp")
    try:
        with _locked(temporary) as file:
            try:
                with zipfile.ZipFile(file, "w") as archive:
                    text = json.dumps({"format": FORMAT, "kind": kind} | about, indent=1)
                    archive.writestr(zipfile.ZipInfo(_ABOUT, _OLDEST_DATE), text)
                    for section, arrays in sections.items():
                        for name, array in arrays.items():
                            _write_array(archive, f"{section}/{name}.npy", array)
                file.flush()
                os.fsync(file.fileno())
                os.replace(temporary, target)
            except BaseException:
                temporary.unlink(missing_ok=True)
                raise
        _sync_folder(target.parent)
    except (OSError, ValueError) as error:  # zipfile hides the cause behind a ValueError of its own
        raise CheckpointError(f"{path}: cannot be written: {_reason(error)}") from None


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[IO[bytes]]:
    """An empty file that no other process writes to. Its name is fixed: what a killed process left is used again."""
    with open(path, "r+b", opener=lambda name, flags: os.open(name, flags | os.O_CREAT, 0o666)) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            same = os.path.samestat(os.fstat(file.fileno()), os.stat(path))
        except (BlockingIOError, FileNotFoundError):
            same = False
        if not same:  # locked, or renamed since it was opened
            raise OSError("another process is writing it")
        file.truncate(0)
        yield file


def _write_array(archive: zipfile.ZipFile, name: str, array: wp.array) -> None:
    first = array[:1].numpy()
    header = {"descr": np.lib.format.dtype_to_descr(first.dtype), "fortran_order": False}
    header["shape"] = (array.shape[0], *first.shape[1:])
    with archive.open(zipfile.ZipInfo(name, _OLDEST_DATE), "w", force_zip64=True) as entry:
        np.lib.format.write_array_header_1_0(entry, header)
        for chunk in _chunks(array):
            entry.write(chunk.numpy().data)


def _chunks(array: wp.array) -> Iterator[wp.array]:
    """Views that together are the array."""
    for start in range(0, len(array), _CHUNK):
        yield array[start : min(start + _CHUNK, len(array))]


def _sync_folder(folder: Path) -> None:
    """Forces a rename to the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _reason(error: BaseException) -> str:
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError):
            return cause.strerror or str(cause)
        cause = cause.__context__
    return str(error)


# --- reading -----------------------------------------------------------------------------------------------------


def read_checkpoint(
    path: str | os.PathLike,
    identity: dict,
    sections: Sections,
    check: Callable[[dict], None] = lambda about: None,
    kind: str = "checkpoint",
    of: str = "render",
) -> dict:
    """Reads a checkpoint into `sections`, which are changed only if the whole file is sound and is of this render.

    Args:
        path: The file.
        identity: What `about["identity"]` must be.
        sections: Arrays to fill, of the shapes and types that were written.
        check: Called with `about` before anything is changed; may raise a CheckpointError.
        kind: What the file must be.
        of: What a file of this kind belongs to, for messages.

    Returns:
        `about`.

    Raises:
        CheckpointError: No such file; damaged; of another format; or of another render, with what differs.
    """
    path = Path(path)
    try:
        file = open(path, "rb")  # noqa: SIM115 (its errors are told apart from those of reading)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror or error}") from None
    with file:
        try:
            with zipfile.ZipFile(file) as archive:
                about = json.loads(archive.read(_ABOUT))
                _check_identity(path, about, identity, kind, of)
                check(about)
                damaged = archive.testzip()
                if damaged is not None:
                    raise ValueError(f"the checksum of {damaged} is wrong")
                arrays = {f"{s}/{name}.npy": array for s, part in sections.items() for name, array in part.items()}
                found = set(archive.namelist()) - {_ABOUT}
                if found != set(arrays):
                    raise ValueError(f"holds {', '.join(sorted(found))}; needed: {', '.join(sorted(arrays))}")
                for read in (_check_array, _read_array):
                    for name, array in arrays.items():
                        with archive.open(name) as entry:
                            read(entry, name, array)
                return about
        except CheckpointError:
            raise
        except Exception as error:  # zipfile and json raise a dozen kinds on bytes that make no sense
            text = " ".join(str(error).split())
            raise CheckpointError(f"{path}: not a {kind}, or a damaged one: {text}") from None


def _check_identity(path: Path, about: dict, identity: dict, kind: str, of: str) -> None:
    if about["format"] != FORMAT:
        raise CheckpointError(f"{path}: format {about['format']} of checkpoints; this version reads {FORMAT}")
    there = about.get("kind", "checkpoint")
    if there != kind:
        raise CheckpointError(f"{path}: is a {there}; allowed: a {kind}")
    differs = explain_differences(json.loads(json.dumps(identity)), about["identity"], f"the {kind}")
    if differs:
        raise CheckpointError(f"{path}: is a {kind} of another {of}: {differs}")


def _check_array(entry: IO[bytes], name: str, array: wp.array) -> None:
    expected = array[:1].numpy()
    np.lib.format.read_magic(entry)
    shape, _, dtype = np.lib.format.read_array_header_1_0(entry)
    if (shape, dtype) != ((array.shape[0], *expected.shape[1:]), expected.dtype):
        raise ValueError(f"{name} is {dtype} {shape}")


def _read_array(entry: IO[bytes], name: str, array: wp.array) -> None:
    np.lib.format.read_magic(entry)
    shape, _, dtype = np.lib.format.read_array_header_1_0(entry)
    for chunk in _chunks(array):
        data = entry.read(len(chunk) * math.prod(shape[1:]) * dtype.itemsize)
        chunk.assign(np.frombuffer(data, dtype).reshape(-1, *shape[1:]))


# --- during a render ---------------------------------------------------------------------------------------------


class CheckpointWriter:
    """Writes checkpoints of a render from time to time; a failure is a warning, and is tried again the next time.

    Args:
        renderer: The render, with whatever it was resumed from.
        path: The file.
        every: Seconds between checkpoints.
        warn: Called with one line after a failure.
        saved_samples: Per pixel, in the checkpoint that is there; None if there is none.
    """

    def __init__(
        self, renderer, path: Path, every: float, warn: Callable[[str], None], saved_samples: int | None = None
    ):
        self.renderer, self.path, self.every, self.warn = renderer, path, every, warn
        self.saved_samples = saved_samples
        self.last = time.monotonic()
        renderer.scene_records  # noqa: B018 (reads the scene's files now: later they may have changed)

    def after_pass(self) -> None:
        """To be called after every pass."""
        if time.monotonic() - self.last >= self.every:
            self.write()

    def write(self) -> None:
        """Writes a checkpoint now, unless the last one has all samples."""
        if self.saved_samples == self.renderer.sample_count:
            return
        try:
            self.renderer.save_checkpoint(self.path)
            self.saved_samples = self.renderer.sample_count
        except CheckpointError as error:
            kept = ", and the last checkpoint is kept" if self.saved_samples is not None else ""
            self.warn(f"{error}; the render goes on{kept}")
        self.last = time.monotonic()
