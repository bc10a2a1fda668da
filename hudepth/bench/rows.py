"""The rows of the table, from the times of passes."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hudepth.bench.backends import REFERENCE
from hudepth.bench.rounds import Sample

EXACT_MM = 1.0
"""A backend counts as exact up to this difference from the reference at any pixel."""


@dataclass(frozen=True)
class Entry:
    """What is known of a contender apart from its times: its name, ``label`` in the table, ``about`` in the notes."""

    name: str
    label: str
    size: tuple[int, int]
    about: str = ""
    parameters: int | None = None
    flops: int | None = None
    """Per image, of the network as trained."""
    kind: str = "backend"
    """``backend`` of the measured network, or ``peer``: another network."""
    precision: str = "float32"
    """What it computes in."""
    yardstick: str | None = "float32"
    """The precision of the matrix product that it is compared with; None if it runs on another device."""


@dataclass(frozen=True)
class Row:
    """A contender at a batch size; the columns of bench.csv."""

    contender: str
    kind: str
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
    """Images/s relative to the reference, median over rounds."""
    difference_mm: float | None
    """Largest difference from the reference's depth at any pixel; None for peers."""
    peak_mb: float
    first_pass_s: float
    parameters: int | None
    gflop_per_image: float | None
    gflop_per_s: float | None
    share_of_peak: float | None
    """gflop_per_s relative to the machine's matrix products."""
    precision: str

    @property
    def exact(self) -> bool:
        """Whether the depth is that of the reference, and not by chance."""
        return self.precision == "float32" and self.difference_mm is not None and self.difference_mm <= EXACT_MM

    @property
    def speed(self) -> float:
        """Images/s, relative to the reference where possible, which is blind to drifts of the machine."""
        return self.images_per_s if self.times_eager is None else self.times_eager


def make_rows(
    samples: Sequence[Sample], entries: Sequence[Entry], *, peaks: Mapping[str, float], max_depth_m: float
) -> list[Row]:
    """Return a row for each sample (of at least one round), by batch, then in the order of ``entries``.

    ``peaks`` are the best rates [GFLOP/s] of matrix products, by precision; ``max_depth_m`` is the maximum depth [m]:
    the network predicts depth / max_depth_m.
    """
    by_place = {(sample.batch, sample.name): sample for sample in samples}
    return [
        _row(by_place[place], entry, by_place.get((batch, REFERENCE)), peaks.get(entry.yardstick or ""), max_depth_m)
        for batch in sorted({sample.batch for sample in samples})
        for entry in entries
        if (place := (batch, entry.name)) in by_place
    ]


def _row(sample: Sample, entry: Entry, reference: Sample | None, peak: float | None, max_depth_m: float) -> Row:
    passes, p25, p50, p75, p95 = quantiles_ms(sample.rounds)
    rate = 1000 * sample.batch / p50
    work = None if entry.flops is None else entry.flops * rate / 1e9
    return Row(
        contender=entry.label, kind=entry.kind, height=entry.size[0], width=entry.size[1], batch=sample.batch,
        passes=passes, images_per_s=rate, ms_per_image=p50 / sample.batch, p25_ms=p25, p50_ms=p50, p75_ms=p75,
        p95_ms=p95, peak_mb=sample.peak_mb, first_pass_s=sample.first_pass_s, parameters=entry.parameters,
        times_eager=None if reference is None else times_as_fast(sample.rounds, reference.rounds),
        difference_mm=_difference_mm(sample, reference, max_depth_m) if entry.kind == "backend" else None,
        gflop_per_image=None if entry.flops is None else entry.flops / 1e9,
        gflop_per_s=work, share_of_peak=None if work is None or peak is None else work / peak,
        precision=entry.precision,
    )  # fmt: skip


def _difference_mm(sample: Sample, reference: Sample | None, max_depth_m: float) -> float | None:
    if reference is None:
        return None
    difference = 1000 * max_depth_m * float(np.abs(sample.result - reference.result).max())
    return difference if math.isfinite(difference) else None


def quantiles_ms(rounds: Sequence[Sequence[float]]) -> tuple[int, float, float, float, float]:
    """Return the number of passes of all rounds [s], and their p25, p50, p75, p95 [ms], linearly interpolated."""
    times_ms = 1000 * np.asarray([time for times in rounds for time in times], np.float64)
    p25, p50, p75, p95 = (float(value) for value in np.percentile(times_ms, [25, 50, 75, 95]))
    return len(times_ms), p25, p50, p75, p95


def times_as_fast(rounds: Sequence[Sequence[float]], reference: Sequence[Sequence[float]]) -> float:
    """Return how many times as fast as the reference something is: the median over rounds of the ratio in a round.

    Both ran shortly after one another in each round, with as many images per pass, so whatever slowed the machine for
    a while slowed both.
    """
    pairs = zip(rounds, reference, strict=True)
    return statistics.median(statistics.median(theirs) / statistics.median(own) for own, theirs in pairs)


def describe_efficiency(rows: Iterable[Row], *, peak_gflop_per_s: float | None, merged_flops: int | None) -> str:
    """Say how much of the machine the fastest exact backend uses at batch 1; empty if that was not measured."""
    exact = [row for row in rows if row.batch == 1 and row.exact and row.gflop_per_s and row.share_of_peak]
    if not exact or peak_gflop_per_s is None:
        return ""
    best = max(exact, key=lambda row: row.speed)
    merged = ""
    if merged_flops and best.contender not in (REFERENCE, "channels_last"):
        rate = merged_flops * best.images_per_s / 1e9
        merged = f"; of the {merged_flops / 1e9:.2f} GFLOP that remain when it is merged, {rate:.0f} GFLOP/s"
        merged += f" or {100 * rate / peak_gflop_per_s:.0f} %"
    return (
        f"Fastest exact backend at batch 1: {best.contender}, {best.images_per_s:.1f} images/s, "
        f"{best.gflop_per_s or 0:.0f} nominal GFLOP/s, {100 * (best.share_of_peak or 0):.0f} % of the "
        f"{peak_gflop_per_s:.0f} GFLOP/s of a single-precision matrix product here{merged}."
    )
