"""The table's rows, and what follows from them in words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hudepth.bench.backends import REFERENCE
from hudepth.bench.rounds import Sample
from hudepth.bench.stats import gflop_per_s, images_per_s, summarise, times_as_fast

EXACT_MM = 1.0
"""Up to this difference from the reference at any pixel a backend counts as exact."""


@dataclass(frozen=True)
class Entry:
    """What is known of a contender beside its times."""

    name: str
    """As its process is called."""
    label: str
    """As the table calls it."""
    size: tuple[int, int]
    """(height, width)."""
    peer: bool
    parameters: int | None
    flops: int | None
    """Of an image, of the network as it was trained."""
    about: str
    """For the notes."""


@dataclass(frozen=True)
class Row:
    """A contender at a batch size; the columns of bench.csv."""

    contender: str
    kind: str
    """``backend`` or ``peer``."""
    height: int
    width: int
    batch: int
    passes: int
    images_per_s: float
    ms_per_image: float
    p25_ms: float
    p50_ms: float
    p75_ms: float
    p95_ms: float
    times_eager: float | None
    """Images a second over those of this model in the reference, median over rounds."""
    difference_mm: float | None
    """Largest difference from the reference's depth at any pixel; None for peers."""
    peak_mb: float
    first_pass_s: float
    parameters: int | None
    gflop_per_image: float | None
    gflop_per_s: float | None
    share_of_peak: float | None
    """gflop_per_s over the rate of the machine's matrix products."""

    @property
    def exact(self) -> bool:
        """Whether it gives what the reference gives."""
        return self.difference_mm is not None and self.difference_mm <= EXACT_MM


def make_rows(
    samples: Sequence[Sample], entries: Sequence[Entry], *, peak_gflop_per_s: float | None, max_depth_m: float
) -> list[Row]:
    """Return a row for each sample, batch by batch, contenders in the order of ``entries``.

    Args:
        samples: what was measured, each with at least one round.
        entries: what is known of the contenders.
        peak_gflop_per_s: best rate of matrix products; None if it was not measured.
        max_depth_m: what unit depth 1 stands for.
    """
    by_place = {(sample.batch, sample.name): sample for sample in samples}
    batches = sorted({sample.batch for sample in samples})
    return [
        _row(by_place[place], entry, by_place.get((batch, REFERENCE)), peak_gflop_per_s, max_depth_m)
        for batch in batches
        for entry in entries
        if (place := (batch, entry.name)) in by_place
    ]


def _row(sample: Sample, entry: Entry, reference: Sample | None, peak: float | None, max_depth_m: float) -> Row:
    timing = summarise(sample.rounds)
    rate = images_per_s(sample.batch, timing.p50_ms)
    work = None if entry.flops is None else gflop_per_s(entry.flops, rate)
    return Row(
        contender=entry.label,
        kind="peer" if entry.peer else "backend",
        height=entry.size[0],
        width=entry.size[1],
        batch=sample.batch,
        passes=timing.passes,
        images_per_s=rate,
        ms_per_image=timing.p50_ms / sample.batch,
        p25_ms=timing.p25_ms,
        p50_ms=timing.p50_ms,
        p75_ms=timing.p75_ms,
        p95_ms=timing.p95_ms,
        times_eager=None if reference is None else times_as_fast(sample.rounds, reference.rounds),
        difference_mm=None if entry.peer or reference is None else _difference_mm(sample, reference, max_depth_m),
        peak_mb=sample.peak_mb,
        first_pass_s=sample.first_pass_s,
        parameters=entry.parameters,
        gflop_per_image=None if entry.flops is None else entry.flops / 1e9,
        gflop_per_s=work,
        share_of_peak=None if work is None or peak is None else work / peak,
    )


def _difference_mm(sample: Sample, reference: Sample, max_depth_m: float) -> float | None:
    difference = 1000 * max_depth_m * float(np.abs(sample.result - reference.result).max())
    return difference if math.isfinite(difference) else None


def efficiency(rows: Iterable[Row], *, peak_gflop_per_s: float | None, merged_flops: int | None) -> str:
    """Say what the fastest exact backend makes of the machine at batch 1; empty if that was not measured."""
    exact = [row for row in rows if row.batch == 1 and row.exact and row.gflop_per_s and row.share_of_peak]
    if not exact or peak_gflop_per_s is None:
        return ""
    best = max(exact, key=_speed)
    assert best.gflop_per_s is not None
    assert best.share_of_peak is not None
    merged = ""
    if merged_flops and best.contender not in (REFERENCE, "channels_last"):
        rate = gflop_per_s(merged_flops, best.images_per_s)
        merged = f"; of the {merged_flops / 1e9:.2f} GFLOP that are left when it is merged, {rate:.0f} GFLOP/s"
        merged += f" or {100 * rate / peak_gflop_per_s:.0f} %"
    return (
        f"Fastest exact backend at batch 1: {best.contender}, {best.images_per_s:.1f} images/s, "
        f"{best.gflop_per_s:.0f} nominal GFLOP/s, {100 * best.share_of_peak:.0f} % of the {peak_gflop_per_s:.0f} "
        f"GFLOP/s of a single-precision matrix product here{merged}."
    )


def beside_peers(rows: Sequence[Row]) -> list[Row]:
    """Return the peers and, at the same batch size, this model as it would be used; empty if there are no peers.

    The batch is the smallest at which both were measured.
    """
    both = {row.batch for row in rows if row.kind == "peer"} & {row.batch for row in rows if row.contender == REFERENCE}
    here = [row for row in rows if both and row.batch == min(both)]
    exact = [row for row in here if row.exact]
    shown = {REFERENCE, "default", *(max(exact, key=_speed).contender for _ in exact[:1])}
    return [row for row in here if row.kind == "peer" or row.contender in shown]


def comparisons(rows: Sequence[Row], *, size: tuple[int, int]) -> list[str]:
    """Say how fast each peer is beside this model in PyTorch, then which of them are faster than what."""
    here = beside_peers(rows)
    if not here:
        return []
    peers = [row for row in here if row.kind == "peer"]
    ours = [row for row in here if row.kind == "backend"]
    in_torch = [row for row in ours if row.contender in (REFERENCE, "default")]
    lines = [f"Images/s at batch {here[0].batch} over those of this model at {spelt(size)}:"]
    near = []
    for name in dict.fromkeys(row.contender for row in peers):
        own = [row for row in peers if row.contender == name]
        lines.append(f"{name} (random weights, eager): {'; '.join(_beside(row, in_torch) for row in own)}.")
        near.append(min(own, key=lambda row: abs(row.height * row.width - size[0] * size[1])))
    faster = [_faster(near, own) for own in ours]
    return [*lines, f"Of the peers, at the size nearest to this model's: {'; '.join(faster)}."]


def spelt(size: tuple[int, int]) -> str:
    """Spell (height, width)."""
    return str(size[0]) if size[0] == size[1] else f"{size[0]} x {size[1]}"


def _speed(row: Row) -> float:
    return row.images_per_s if row.times_eager is None else row.times_eager  # the latter is blind to drifts


def _beside(row: Row, ours: Sequence[Row]) -> str:
    ratios = [f"{_speed(row) / _speed(own):.2f} x {own.contender}" for own in ours]
    return f"at {spelt((row.height, row.width))} {' and '.join(ratios)}"


def _faster(peers: Sequence[Row], own: Row) -> str:
    names = [row.contender for row in peers if _speed(row) > _speed(own)]
    return f"{' and '.join(names) or 'none'} {'are' if len(names) > 1 else 'is'} faster than {own.contender}"


def plain(row: Row) -> dict[str, Any]:
    """Return a row as the columns of bench.csv."""
    return {name: getattr(row, name) for name in Row.__dataclass_fields__}
