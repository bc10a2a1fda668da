"""Fetch one large file: in pieces, resumed where it stopped, and kept only if its checksum is right."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator
from http.client import HTTPException, HTTPResponse
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

from hudepth.base.console import log, track
from hudepth.base.errors import DataError
from hudepth.data.sources.base import Download

_PIECE = 1 << 23  # bytes
_TIMEOUT_S = 30


def fetch(what: Download, target: Path) -> Path:
    """Return ``target``, downloaded unless it is there. What arrived before an interruption is kept and continued.

    Raises DataError, with what to do, if the address cannot be reached, the disk is full, the connection ends early, or
    the file is not the one that its authors published.
    """
    if target.is_file():
        _check(what, target)
        log.info("'%s' is there and complete", target)
        return target
    part = target.with_name(f"{target.name}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        held = part.stat().st_size if part.is_file() else 0
        if (free := shutil.disk_usage(target.parent).free) < what.size - held:
            needed = f"{(what.size - held) / 1e9:.2f} GB are needed, {free / 1e9:.2f} GB are free"
            raise DataError(f"data.root: {needed} in '{target.parent}'. Free some, or pass data.root=<another folder>.")
        if held < what.size:
            _receive(what, part, held)
        _check(what, part)
        part.replace(target)
    except (HTTPException, TimeoutError, URLError) as error:
        raise _unreachable(what, target, part, error) from None
    except OSError as error:
        raise DataError(f"data.root: cannot write '{target}' ({error.strerror or error}).") from None
    return target


def _receive(what: Download, part: Path, held: int) -> None:
    """Append to ``part``, which holds so many bytes already; start again if the server cannot continue."""
    request = Request(what.url, headers={"Range": f"bytes={held}-"} if held else {})
    with urlopen(request, timeout=_TIMEOUT_S) as response:
        continued = response.status == 206 and held > 0
        left = what.size - (held if continued else 0)
        if held:
            how = "continued" if continued else "the server cannot continue, so begun again"
            log.info("%s after %.1f MB", how, held / 1e6)
        with part.open("ab" if continued else "wb") as file:
            pieces = -(-left // _PIECE)
            for piece in track(_pieces(response, left), total=pieces, what=f"downloading {part.stem}, 8 MiB pieces"):
                file.write(piece)
    if (found := part.stat().st_size) < what.size:
        raise URLError(f"the connection ended after {found / 1e6:,.1f} of {what.size / 1e6:,.1f} MB")


def _pieces(response: HTTPResponse, left: int) -> Iterator[bytes]:
    """Yield at most ``left`` bytes: a server that never ends does not fill the disk."""
    while left > 0:
        try:
            piece = response.read(min(_PIECE, left))
        except OSError as error:  # not one of the file that is written
            raise URLError(error) from error
        if not piece:
            return
        left -= len(piece)
        yield piece


def _check(what: Download, path: Path) -> None:
    """Compare size and MD5 with those of the published file; what cannot be completed any more is deleted."""
    size = path.stat().st_size
    if size == what.size:
        with path.open("rb") as file:
            if hashlib.file_digest(file, lambda: hashlib.md5(usedforsecurity=False)).hexdigest() == what.md5:
                return
    found = "another MD5" if size == what.size else f"{size:,} bytes instead of {what.size:,}"
    if path.suffix == ".part":
        path.unlink()
        raise DataError(f"'{what.url}' has {found}, so it is not the published file. It was deleted; try again.")
    raise DataError(f"'{path}' has {found}, so it is not the published file. Move it away and download again.")


def _unreachable(what: Download, target: Path, part: Path, error: Exception) -> DataError:
    if isinstance(error, HTTPError):
        reason = f"{error.code} {error.reason}"
    else:
        reason = str(getattr(error, "reason", "") or error or type(error).__name__)
    kept = part.stat().st_size if part.is_file() else 0
    again = f"run the same command again to continue after {kept / 1e6:,.1f} MB" if kept else "try again"
    fix = f"Go online and {again}, or copy the file to '{target}' from another machine"
    return DataError(f"cannot download {what.url} ({reason}). {fix}.")
