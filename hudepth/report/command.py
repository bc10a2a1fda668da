"""hudepth-report: what runs say, side by side."""

from __future__ import annotations

from omegaconf import DictConfig

from hudepth.base.errors import ConfigError, did_you_mean
from hudepth.base.options import plain
from hudepth.base.verbs import VERBS


def report(cfg: DictConfig) -> None:
    """Run the verb ``compare``, ``table``, ``sweep`` or ``figures``.

    Args:
        cfg: what conf/report.yaml and the command line compose to.

    Raises:
        HudepthError: with one line for the user.
    """
    config = plain(cfg)
    if isinstance(config["runs"], str):  # runs=x as well as runs=[x]
        config["runs"] = [config["runs"]]
    verb, protocols = config["verb"], [name for name, protocol in (config["protocol"] or {}).items() if protocol]
    if verb in ("compare", "sweep") and len(protocols) != 1:
        raise ConfigError(f"protocol: {verb} takes one, not {len(protocols)}. Pass protocol=eigen.")
    if verb == "compare":
        from hudepth.report.compare import compare

        compare({**config, "protocol": protocols[0]})
    elif verb == "sweep":
        from hudepth.report.ablation.command import sweep_report

        sweep_report({**config, "protocol": protocols[0]})
    elif verb == "table":
        from hudepth.report.table import table

        table({**config, "protocol": protocols})
    elif verb == "figures":
        from hudepth.report.figures import figures

        figures(config)
    else:
        hint = did_you_mean(str(verb), VERBS["report"])
        raise ConfigError(f"verb: no '{verb}'.{hint} Use hudepth-report {' or '.join(VERBS['report'])}.")
