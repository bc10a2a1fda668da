"""The tables of an audit on standard output."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from hudepth.base.tables import Cell, Table, say
from hudepth.data.audit.duplicates import NEAR_BITS
from hudepth.data.audit.findings import Finding
from hudepth.data.audit.leakage import WITHIN, AuditedSplit

SEVERITIES = ("warning", "note", "ok")


def print_audit(
    name: str, n: int, splits: Mapping[str, AuditedSplit | str], configured: str, findings: Sequence[Finding]
) -> None:
    """Print what each kind of split leaks, or why it is not possible, and the findings, the most severe first."""
    columns = ["", *(f"{kind} *" if kind == configured else kind for kind in splits)]
    table = Table(columns, title=f"{name}, {n:,} pairs: what a test split shares with training")
    cells = {kind: _cells(found) if isinstance(found, AuditedSplit) else {} for kind, found in splits.items()}
    for label in next((list(found) for found in cells.values() if found), []):
        table.add(label, *(found.get(label, "-") for found in cells.values()))
    if table.rows:
        table.show()
    say(
        "* the configured split. Frames away: places between two frames of a scene, in order of their numbers.\n"
        f"Near copies: images whose perceptual hashes differ in at most {NEAR_BITS} of 64 bits."
    )
    for kind, reason in splits.items():
        if isinstance(reason, str):
            say(f"{kind} is not possible: {reason.removeprefix(f'data.split={kind}: ')}")
    say("")
    listing = Table(["", "about", "found", "what it means"], title="findings", left=4)
    for finding in sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)):
        severity = Cell(finding.severity, bold=finding.severity == "warning", dim=finding.severity == "ok")
        listing.add(severity, finding.about, finding.found, finding.meaning)
    listing.show()


def _cells(audited: AuditedSplit) -> dict[str, str]:
    leak, copies, mean = audited.leak, audited.copies, audited.leak.mean_distance_frames
    return {
        "pairs in train / val / test": " / ".join(f"{count:,}" for count in leak.counts.values()),
        "test frames of unknown scene": f"{leak.without_scene:,}",
        "test frames whose scene is in training": _percent(leak.scene_seen),
        **{f"  with a training frame at most {k} frame{'s' * (k > 1)} away": _percent(leak.within[k]) for k in WITHIN},
        "  mean distance to the nearest [frames]": "-" if math.isnan(mean) else f"{mean:.2f}",
        "test images with an exact copy in training": _percent(copies.exact) if copies else "not looked at",
        "test images with a near copy in training": _percent(copies.near) if copies else "not looked at",
    }


def _percent(share: float) -> str:
    return "-" if math.isnan(share) else f"{share:.1%}"
