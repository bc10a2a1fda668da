"""What is known of each metric: unit, direction, decimals, where it is shown, and whose formula it is.

Tables, plots, cards, comparisons and progress lines read it here. To add a metric, write its function and register it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Level = Literal["headline", "narrow", "wide", "edge", "edges", "files"]
LEVELS: tuple[tuple[Level, ...], ...] = (("headline", "narrow", "wide"), ("edge", "edges"))
"""Tables of rising width; each has the metrics of those before it."""


@dataclass(frozen=True)
class MetricInfo:
    """One metric."""

    name: str
    source: str
    """Who defined it, or where the formula is from."""
    unit: str = ""
    """``m``, ``m^2``, ``px``; empty for ratios."""
    higher_is_better: bool = False
    decimals: int = 3
    shown: Level = "files"
    """The narrowest table that has it: ``headline``, ``narrow`` or ``wide``; of depth edges ``edge`` (in tables of
    many runs too) or ``edges``; ``files``: metrics.json alone."""

    @property
    def label(self) -> str:
        """Name and unit: ``rmse [m]``."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def arrow(self) -> str:
        """↑ if higher is better, else ↓."""
        return "↑" if self.higher_is_better else "↓"

    def format(self, value: float) -> str:
        """Return a value with the metric's decimals; ``-`` for NaN."""
        if value != value:
            return "-"
        return f"{value:.{self.decimals if abs(value) < 100 else 1}f}"


_EIGEN = "Eigen et al. 2014"
_PAPER = "Turkmen and Akgun 2025, section 3.5"
_HU = "Hu et al. 2019"
_DBE = "Koch et al. 2018 (iBims-1)"

_CATALOGUE: dict[str, MetricInfo] = {}


def register(info: MetricInfo) -> None:
    """Add a metric, or replace what is known of it."""
    _CATALOGUE[info.name] = info


def _edge_level(kind: str, threshold: str) -> Level:
    return "files" if kind != "f1" else "edges" if threshold == "1" else "edge"


for _info in (
    MetricInfo("abs_rel", _PAPER, shown="headline"),
    MetricInfo("sq_rel", _EIGEN, unit="m", shown="wide"),
    MetricInfo("mse", _PAPER, unit="m^2"),
    MetricInfo("rmse", _EIGEN, unit="m", shown="headline"),
    MetricInfo("rmse_log", _EIGEN, shown="wide"),
    MetricInfo("log10", _PAPER, shown="narrow"),
    MetricInfo("silog", _EIGEN, shown="wide"),
    MetricInfo("mae", "mean absolute error", unit="m", shown="wide"),
    MetricInfo("ssim", "Wang et al. 2004", higher_is_better=True, shown="narrow"),
    MetricInfo("delta1", _EIGEN, higher_is_better=True, shown="headline"),
    MetricInfo("delta2", _EIGEN, higher_is_better=True, shown="narrow"),
    MetricInfo("delta3", _EIGEN, higher_is_better=True, shown="narrow"),
    *(
        MetricInfo(f"edge_{kind}_{threshold}", _HU, higher_is_better=True, shown=_edge_level(kind, threshold))
        for kind in ("precision", "recall", "f1")
        for threshold in ("0.25", "0.5", "1")
    ),
    MetricInfo("si_boundary_f1", "Bochkovskii et al. 2024 (Depth Pro)", higher_is_better=True, shown="edge"),
    MetricInfo("dbe_acc_px", _DBE, unit="px", shown="edges"),
    MetricInfo("dbe_comp_px", _DBE, unit="px", shown="edges"),
):
    register(_info)


def metric_info(name: str) -> MetricInfo:
    """Return what is known of a metric; ``val/abs_rel`` means ``abs_rel``, an unknown name is an error that falls."""
    name = name.rpartition("/")[2]
    return _CATALOGUE.get(name) or MetricInfo(name, "unknown")


def metric_names(shown: Level, *, among: Iterable[str] | None = None) -> list[str]:
    """Return the metrics of a table, in its order.

    Args:
        shown: how wide the table is.
        among: only these; default: all.
    """
    levels = next((level[: level.index(shown) + 1] for level in LEVELS if shown in level), (shown,))
    names = [name for name, info in _CATALOGUE.items() if info.shown in levels]
    return names if among is None else [name for name in names if name in set(among)]
