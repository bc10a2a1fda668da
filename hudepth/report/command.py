"""hudepth-report: results of runs side by side, as tables, pictures and a page."""

from __future__ import annotations

from typing import Any, Literal

from hudepth.base.errors import ConfigError
from hudepth.base.instantiate import import_trusted
from hudepth.base.options import convert, parse


def report(config: dict[str, Any]) -> None:
    """Run the verb of conf/report.yaml and its overrides; any error is a HudepthError of one line."""
    verb = convert("verb", config["verb"], Literal["compare", "table", "sweep", "figures"])
    protocols = [name for name, protocol in (config["protocol"] or {}).items() if protocol]
    if verb in ("compare", "sweep"):
        if len(protocols) != 1:
            raise ConfigError(f"protocol: {verb} takes one, not {len(protocols)}. Pass protocol=eigen.")
        config["protocol"] = protocols[0]
    import_trusted(convert("trust", config["trust"], list[str]))  # their metrics
    # each verb's imports are its own: a table needs neither matplotlib nor torch
    if verb == "compare":
        from hudepth.report.compare import CompareOptions, compare

        compare(parse(CompareOptions, config))
    elif verb == "sweep":
        from hudepth.report.ablation.command import SweepOptions, report_sweep

        report_sweep(parse(SweepOptions, config))
    elif verb == "table":
        from hudepth.report.table import TableOptions, write_table

        write_table(parse(TableOptions, {**config, "protocols": protocols}))
    else:
        from hudepth.report.figures import FiguresOptions, draw_figures

        draw_figures(parse(FiguresOptions, config))
