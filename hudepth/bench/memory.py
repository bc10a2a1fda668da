"""The most memory this process has held at once."""

from __future__ import annotations

import re
import sys
from pathlib import Path

CLEAR_REFS = Path("/proc/self/clear_refs")
STATUS = Path("/proc/self/status")


def reset_peak() -> bool:
    """Let the peak start again from what the process holds now; return whether the system can do that."""
    try:
        CLEAR_REFS.write_text("5", encoding="ascii")
    except OSError:  # another system, or a container that does not allow it
        return False
    return True


def peak_mb() -> float:
    """Return the most memory [MB] resident since :func:`reset_peak`, where that worked, else since the start."""
    try:
        found = re.search(r"^VmHWM:\s*(\d+) kB$", STATUS.read_text(encoding="ascii"), re.MULTILINE)
    except OSError:
        found = None
    if found:
        return int(found[1]) * 1024 / 1e6
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
