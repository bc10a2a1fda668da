"""Sources, the depth store, splits and batches."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hudepth.data.nyu_depth import NYUDepth

__all__ = ["NYUDepth"]


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name == "NYUDepth":  # on first use: processes that prepare data import this package and need no torch
            from hudepth.data.nyu_depth import NYUDepth

            return NYUDepth
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
