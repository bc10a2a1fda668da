"""hudepth-data: prepare a depth store, show what is known of a data set, or audit it."""

from __future__ import annotations

from collections import Counter

from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from hudepth.base.errors import ConfigError, DataError
from hudepth.base.options import plain
from hudepth.data.audit.run_audit import audit
from hudepth.data.build import build_data
from hudepth.data.prepare import store_path
from hudepth.data.splits import SUBSETS, make_split


def data(cfg: DictConfig) -> None:
    """Run the verb ``prepare``, ``info`` or ``audit``.

    Args:
        cfg: what conf/data.yaml and the command line compose to.

    Raises:
        HudepthError: with one line for the user.
    """
    config = plain(cfg)
    datamodule = build_data(config["data"], trust=config["trust"])
    if config["verb"] == "prepare":
        store = datamodule.store
        print(f"{len(store)} pairs in {store.path}")
        return
    if config["verb"] == "audit":
        audit(config, datamodule)
        return
    if config["verb"] != "info":
        raise ConfigError(
            f"verb: no '{config['verb']}'. Use hudepth-data prepare, hudepth-data info or hudepth-data audit."
        )
    source = datamodule.source
    records = source.records()
    table = Table(title=f"{source.name}", show_header=False, title_justify="left")
    table.add_row("pairs", f"{len(records):,}")
    table.add_row("scenes", f"{len({record.scene for record in records}):,}")
    own = Counter(record.split or "none" for record in records)
    table.add_row("the set's own split", ", ".join(f"{n:,} {name}" for name, n in sorted(own.items())))
    categories = Counter(record.category for record in records if record.category).most_common(6)
    if categories:
        table.add_row("categories", ", ".join(f"{n:,} {name}" for name, n in categories))
    for kind in ("random", "scene", "official"):
        table.add_row(f"split={kind}", _counts(records, kind, datamodule.split_seed, datamodule.fractions))
    table.add_row("fingerprint", source.fingerprint()[:16])
    path = store_path(source, size=datamodule.size, native=datamodule.native, cache=datamodule.cache.expanduser())
    if path.exists():
        info = datamodule.store.info
        table.add_row("depth", f"{info['depth_min_m']} to {info['depth_max_m']} m, median {info['depth_median_m']} m")
        table.add_row("measured", f"{100 * info['valid_fraction']:.1f} % of pixels")
        table.add_row("skipped", str(len(info["skipped"])))
        table.add_row("store", f"{path} ({path.stat().st_size / 1e6:.0f} MB)")
    else:
        table.add_row("store", "not prepared yet: hudepth-data prepare")
    Console(width=None if Console().is_terminal else 130).print(table)


def _counts(records: object, kind: str, seed: int, fractions: tuple[float, ...]) -> str:
    try:
        split = make_split(records, kind=kind, seed=seed, fractions=fractions)  # type: ignore[arg-type]
    except DataError:
        return "not possible"
    return ", ".join(f"{len(split[name]):,} {name}" for name in SUBSETS)
