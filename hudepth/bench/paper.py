"""The rates that Turkmen & Akgun (2025) state in table 3, beside those of this machine."""

from __future__ import annotations

from collections.abc import Sequence

from hudepth.bench.backends import REFERENCE
from hudepth.bench.rows import Row

RATES = {1: 249.84, 4: 1011.47, 8: 1087.35, 16: 1176.84, 32: 1212.19}
"""Images/s by batch, of the hybrid UNet at :data:`SIZE`."""
NETWORK, SIZE, GPU = "HybridUNet", (224, 224), "RTX 4090"


def describe_paper(rows: Sequence[Row], *, name: str, gpu: str) -> list[str]:
    """Return a sentence for the least and the largest batch of table 3 that was measured; none for another network.

    ``name`` is the network's class; ``gpu`` the device of the rows.
    """
    ours = [row for row in rows if row.kind == "backend" and (row.height, row.width) == SIZE]
    batches = sorted({row.batch for row in ours} & RATES.keys()) if name == NETWORK else []
    lines = []
    for batch in sorted({*batches[:1], *batches[-1:]}):
        here = [row for row in ours if row.batch == batch]
        exact = [row for row in here if row.exact]
        shown = {row.contender: row for row in here if row.contender == REFERENCE}
        shown |= {
            row.contender: row for row in (max(some, key=lambda row: row.speed) for some in (exact, here) if some)
        }
        rates = ", ".join(f"{row.contender} {row.images_per_s:.0f} ({row.precision})" for row in shown.values())
        lines.append(
            f"Images/s at batch {batch}: {RATES[batch]:g} on the paper's {GPU} (table 3); on this {gpu}: {rates}."
        )
    return lines
