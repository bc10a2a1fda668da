"""Facts about each metric: unit, direction, decimals, where it is shown, and the source of its formula.

Tables, plots, cards, comparisons and progress lines read them here. To add a metric, write its function and register
it; it is then part of validation and of hudepth-test::

    register(MetricInfo("worst", "largest error", unit="m", shown="narrow"), worst)

with ``worst(pred_m, target_m, valid)``, each [b, 1, h, w], which returns [b]: NaN for images where it is undefined.
hudepth imports the packages in ``trust=[my_package]`` first, so a package of your own can register metrics on import.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

Level = Literal["headline", "narrow", "wide", "scale", "edge", "edges", "files"]
LEVELS: tuple[tuple[Level, ...], ...] = (("headline", "narrow", "wide"), ("scale",), ("edge", "edges"))
"""Tables of rising width; each has the metrics of those before it."""
Function = Callable[..., Any]
"""(pred_m, target_m, valid) -> [b]"""


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
    """The narrowest table that has it: ``headline``, ``narrow`` or ``wide``; ``scale``: that of the images' scales; of
    depth edges ``edge`` (in tables of many runs too) or ``edges``; ``files``: only metrics.json and per_image.csv."""
    pool: Literal["pixels", "squares", "images"] = "images"
    """What ``averaging=pooled`` takes: the mean over all pixels, the root of the mean square, or, for metrics that are
    undefined for some images, still the mean over images."""

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
_FUNCTIONS: dict[str, Function] = {}


def register(info: MetricInfo, function: Function | None = None) -> None:
    """Add a metric, or replace it; ``function`` computes it for each image (None: hudepth computes it elsewhere)."""
    if function is not None:
        _FUNCTIONS[info.name] = function
        info = replace(info, pool="images")
    _CATALOGUE[info.name] = info


def _edge_level(kind: str, threshold: str) -> Level:
    return "files" if kind != "f1" else "edges" if threshold == "1" else "edge"


def registered_functions() -> Mapping[str, Function]:
    """Return the functions of metrics that were registered with one, by name."""
    return dict(_FUNCTIONS)


for _info in (
    MetricInfo("abs_rel", _PAPER, shown="headline", pool="pixels"),
    MetricInfo("sq_rel", _EIGEN, unit="m", shown="wide", pool="pixels"),
    MetricInfo("mse", _PAPER, unit="m^2", pool="pixels"),
    MetricInfo("rmse", _EIGEN, unit="m", shown="headline", pool="squares"),
    MetricInfo("rmse_pooled", f"{_EIGEN}; over the pixels of all images at once", unit="m", shown="scale"),
    MetricInfo("rmse_log", _EIGEN, shown="wide", pool="squares"),
    MetricInfo("log10", _PAPER, shown="narrow", pool="pixels"),
    MetricInfo("silog", _EIGEN, shown="wide", pool="pixels"),
    MetricInfo("mae", "mean absolute error", unit="m", shown="wide", pool="pixels"),
    MetricInfo("scale_sd", "Godard et al. 2019 (Monodepth2), of logarithms", shown="scale"),
    MetricInfo("abs_rel_aligned", "Zhou et al. 2017", shown="scale"),
    MetricInfo("ssim", "Wang et al. 2004", higher_is_better=True, shown="narrow"),
    MetricInfo("delta1", _EIGEN, higher_is_better=True, shown="headline", pool="pixels"),
    MetricInfo("delta2", _EIGEN, higher_is_better=True, shown="narrow", pool="pixels"),
    MetricInfo("delta3", _EIGEN, higher_is_better=True, shown="narrow", pool="pixels"),
    *(
        MetricInfo(f"edge_{kind}_{threshold}", _HU, higher_is_better=True, shown=_edge_level(kind, threshold))
        for kind in ("precision", "recall", "f1")
        for threshold in ("0.25", "0.5", "1")
    ),
    MetricInfo("si_boundary_f1", "Bochkovskii et al. 2024 (Depth Pro)", higher_is_better=True, shown="edge"),
    MetricInfo("dbe_acc_px", _DBE, unit="px", shown="edges"),
    MetricInfo("dbe_comp_px", _DBE, unit="px", shown="edges"),
    MetricInfo("flip_ause", "Ilg et al. 2018, of the relative error"),
    MetricInfo("flip_rank_corr", "Spearman, with the relative error", higher_is_better=True),
):
    register(_info)


def metric_info(name: str) -> MetricInfo:
    """Return the facts about a metric, also as ``val/abs_rel``; an unknown one counts as an error: lower is better."""
    name = name.rpartition("/")[2]
    return _CATALOGUE.get(name) or MetricInfo(name, "unknown")


def metric_names(shown: Level, *, among: Iterable[str] | None = None) -> list[str]:
    """Return the metrics of a table, in its order; only those ``among``, if given."""
    levels = next((level[: level.index(shown) + 1] for level in LEVELS if shown in level), (shown,))
    names = [name for name, info in _CATALOGUE.items() if info.shown in levels]
    return names if among is None else [name for name in names if name in set(among)]


def depth_names() -> tuple[str, ...]:
    """Return the metrics that follow from sums over pixels, defined for every image with a valid pixel."""
    return tuple(name for name, info in _CATALOGUE.items() if info.pool != "images")
