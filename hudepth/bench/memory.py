"""The peak memory of this process."""

from __future__ import annotations

import re
import sys
from contextlib import suppress
from pathlib import Path

CLEAR_REFS = Path("/proc/self/clear_refs")
STATUS = Path("/proc/self/status")


def reset_peak() -> bool:
    """Restart the peak from the memory in use now; return whether the system supports that."""
    try:
        CLEAR_REFS.write_text("5", encoding="ascii")
    except OSError:  # another system, or a container that does not allow it
        return False
    return True


def peak_mb() -> float:
    """Return the peak resident memory [MB] since :func:`reset_peak`, or since the start if that is not supported."""
    with suppress(OSError):
        if found := re.search(r"^VmHWM:\s*(\d+) kB$", STATUS.read_text(encoding="ascii"), re.MULTILINE):
            return int(found[1]) * 1024 / 1e6
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
