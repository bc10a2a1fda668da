"""An audit on standard output."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from hudepth.data.audit.findings import Finding
from hudepth.data.audit.hashes import NEAR_BITS
from hudepth.data.audit.leakage import WITHIN
from hudepth.data.audit.leaks import Audited

COLOURS = {"ok": "green", "note": "yellow", "warning": "red"}


def print_audit(
    name: str, n: int, kinds: Mapping[str, Audited | str], configured: str, findings: Sequence[Finding]
) -> None:
    """Print what each kind of split shares with training, and the findings, the gravest first.

    Args:
        name: of the set.
        n: its pairs.
        kinds: what was found of each kind of split, or why it is not possible.
        configured: the kind that is asked about.
        findings: on the data.
    """
    console = Console(width=None if Console().is_terminal else 130)
    table = Table(title=f"{name}, {n:,} pairs: what a test split shares with training", title_justify="left")
    table.add_column("")
    for kind in kinds:
        table.add_column(f"{kind} *" if kind == configured else kind, justify="right")
    cells = {kind: _cells(found) if isinstance(found, Audited) else {} for kind, found in kinds.items()}
    labels = next((list(found) for found in cells.values() if found), [])
    for label in labels:
        table.add_row(Text(label), *(found.get(label, "-") for found in cells.values()))
    if labels:
        console.print(table)
    print(
        "* the configured split. Frames away: places between two frames of a scene, in order of their numbers.\n"
        f"Near copies: images whose perceptual hashes differ in at most {NEAR_BITS} of 64 bits."
    )
    for kind, found in kinds.items():
        if isinstance(found, str):
            print(f"{kind} is not possible: {found.removeprefix(f'data.split={kind}: ')}")
    listing = Table(title="\nfindings", title_justify="left")
    for heading in ("", "about", "found", "what it means"):
        listing.add_column(heading)
    for finding in sorted(findings, key=lambda finding: list(COLOURS).index(finding.severity), reverse=True):
        severity = Text(finding.severity, COLOURS[finding.severity])
        listing.add_row(severity, Text(finding.about), Text(finding.found), Text(finding.meaning))
    console.print(listing)


def _cells(audited: Audited) -> dict[str, str]:
    leak, copies, mean = audited.leak, audited.copies, audited.leak.mean_distance_frames
    return {
        "pairs in train / val / test": " / ".join(f"{count:,}" for count in leak.counts.values()),
        "test frames of unknown scene": f"{leak.without_scene:,}",
        "test frames whose scene is in training": _share(leak.scene_seen),
        **{f"  with a training frame at most {k} frame{'s' * (k > 1)} away": _share(leak.within[k]) for k in WITHIN},
        "  mean distance to the nearest [frames]": "-" if math.isnan(mean) else f"{mean:.2f}",
        "test images with an exact copy in training": _share(copies.exact) if copies else "not looked at",
        "test images with a near copy in training": _share(copies.near) if copies else "not looked at",
    }


def _share(share: float) -> str:
    return "-" if math.isnan(share) else f"{share:.1%}"
