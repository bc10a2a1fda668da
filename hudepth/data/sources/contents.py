"""A hash over what the files of a source hold: sets of equal names, sizes and times are still told apart."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from stat import S_ISREG
from typing import Any

from hudepth.base.errors import DataError
from hudepth.base.files import read_json, write_text

_THREADS = 8
_SETTLED_NS = 2 * 10**9
"""A file changed more recently is read again next time: a further change could leave its stat as it is."""


def hash_contents(name: str, files: Sequence[Path], *, cache: Path) -> str:
    """Return a hash over the contents of all ``files`` of the set ``name``, in order; missing files count as such.

    A file is read only if its size, times or inode differ from what a JSON file in ``cache`` remembers. Raises
    DataError if a file cannot be read.
    """
    if not files:
        return ""
    folder = os.path.commonpath([file.absolute().parent for file in files])
    memo = cache / f"contents-{name}-{hashlib.sha256(os.fsencode(folder)).hexdigest()[:16]}.json"
    known = _read_memo(memo)
    now = time.time_ns()
    with ThreadPoolExecutor(_THREADS) as pool:  # hashing and reading release the interpreter's lock
        found = list(pool.map(lambda file: _state(file, known), files))
    digests = [digest for _, digest in found]
    entries: dict[str, Any] = {
        str(file): [*stat, digest] for file, (stat, digest) in zip(files, found, strict=True) if stat
    }
    entries = {name: entry for name, entry in entries.items() if max(entry[1], entry[2]) < now - _SETTLED_NS}
    if entries != known:
        with suppress(OSError):  # a cache that can only be read, or is full: they are read again next time
            write_text(memo, json.dumps(entries))
    return hashlib.sha256("\n".join(digests).encode()).hexdigest()


def _read_memo(memo: Path) -> dict[str, Any]:
    try:
        known = read_json(memo)
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def _state(file: Path, known: dict[str, Any]) -> tuple[Sequence[int], str]:
    """Return size, times and inode of a file, and the digest of its contents; ``()`` and a word if it is missing."""
    try:
        stat = file.stat()
        if not S_ISREG(stat.st_mode):  # a device or a pipe never ends
            return (), "missing"
        state = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]
        entry = known.get(str(file))
        if isinstance(entry, list) and len(entry) == 5 and entry[:4] == state and isinstance(entry[4], str):
            return state, entry[4]
        with file.open("rb") as stream:
            return state, hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
    except (FileNotFoundError, NotADirectoryError):
        return (), "missing"
    except OSError as error:
        raise DataError(f"'{file}': cannot be read ({error.strerror or error}). Make it readable.") from error
