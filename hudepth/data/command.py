"""hudepth-data: prepare a depth store, describe a data set, or audit it. ``calibrate`` is in hudepth.calibrate."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hudepth.base.errors import ConfigError, DataError
from hudepth.base.options import parse
from hudepth.base.tables import Table, say
from hudepth.data.audit.run_audit import audit
from hudepth.data.build import build_data
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.download.fetch import fetch
from hudepth.data.prepare import store_path
from hudepth.data.sources.base import Record, Source
from hudepth.data.splits import SUBSETS, make_split


@dataclass(frozen=True)
class DataOptions:
    """Options of hudepth-data, as in ``conf/data.yaml``."""

    verb: Literal["prepare", "info", "audit", "download"]
    data: Mapping[str, Any]
    trust: list[str]


def data(config: dict[str, Any]) -> None:
    """Run the verb ``prepare``, ``info``, ``audit`` or ``download``; HudepthError has one line for the user."""
    options = parse(DataOptions, config)
    datamodule = build_data(options.data, trust=options.trust)
    if options.verb == "download":
        _download(datamodule.source)
    elif options.verb == "audit":
        audit(config, datamodule)
    elif options.verb == "info":
        _describe(datamodule).show()
    else:
        say(f"{len(datamodule.store)} pairs in {datamodule.store.path}")


def _download(source: Source) -> None:
    """Fetch the file of a set into ``data.root``, a folder or the path of the file."""
    what, root = source.download, getattr(source, "root", None)
    if what is None:
        where = f"See {source.homepage}" if source.homepage else "It needs none"
        raise ConfigError(f"data: there is no download of {source.name}. {where}; docs/data.md says what goes where.")
    if not root:
        raise ConfigError(f"data.root is not set. Pass data.root=<folder for {what.file}, {what.size / 1e9:.2f} GB>.")
    path = Path(root).expanduser()
    path = fetch(what, path if path.name == what.file else path / what.file)
    say(f"{path}: complete. {source.terms}".rstrip())


def _describe(datamodule: DepthDataModule) -> Table:
    source = datamodule.source
    records = source.records()
    table = Table(("", ""), title=source.name, left=2)
    table.add("pairs", f"{len(records):,}")
    scenes = {record.scene for record in records if record.scene}
    table.add("scenes", f"{len(scenes):,}" if scenes else "none named")
    own = Counter(record.split or "none" for record in records)
    table.add("official split", ", ".join(f"{n:,} {name}" for name, n in sorted(own.items())))
    if categories := Counter(record.category for record in records if record.category).most_common(6):
        table.add("categories", ", ".join(f"{n:,} {name}" for name, n in categories))
    for kind in ("random", "scene", "official"):
        table.add(f"split={kind}", _counts(records, kind, datamodule.split_seed, datamodule.fractions))
    table.add("fingerprint", source.fingerprint()[:16])
    if source.homepage:
        table.add("homepage", source.homepage)
    path = store_path(source, size=datamodule.size, native=datamodule.native, cache=datamodule.cache.expanduser())
    if not path.exists():
        table.add("store", "not prepared yet: hudepth-data prepare")
        return table
    info = datamodule.store.info
    table.add("depth", f"{info['depth_min_m']} to {info['depth_max_m']} m, median {info['depth_median_m']} m")
    table.add("measured", f"{100 * info['valid_fraction']:.1f} % of pixels")
    table.add("skipped", str(len(info["skipped"])))
    table.add("store", f"{path} ({path.stat().st_size / 1e6:.0f} MB)")
    return table


def _counts(records: Sequence[Record], kind: str, seed: int, fractions: Sequence[float]) -> str:
    try:
        split = make_split(records, kind=kind, seed=seed, fractions=fractions)
    except DataError:
        return "not possible"
    return ", ".join(f"{len(split[name]):,} {name}" for name in SUBSETS)
