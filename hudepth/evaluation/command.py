"""hudepth-test: score a checkpoint under one or more protocols, beside trivial baselines."""

from __future__ import annotations

from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from hudepth.base.console import log
from hudepth.base.options import plain
from hudepth.evaluation.score import score_checkpoint
from hudepth.evaluation.test_data import open_data
from hudepth.runs.checkpoint import load_checkpoint


def test(cfg: DictConfig) -> None:
    """Score a checkpoint and write ``test/<protocol>/`` of its run directory.

    Args:
        cfg: what conf/test.yaml and the command line compose to.

    Raises:
        HudepthError: with one line for the user.
    """
    config = plain(cfg)
    checkpoint = load_checkpoint(str(config["checkpoint"]), runs=config["paths"]["runs"])
    # The checkpoint may be a stranger's: it says what to read, but not where to write.
    typed = {"cache": config["paths"]["cache"], **(config.get("data") or {})}
    log.info("checkpoint: %s, after %d epochs on %s", checkpoint.path, checkpoint.epoch, checkpoint.data.get("source"))
    datamodule, other_data = open_data(
        checkpoint, typed, overrides=list(HydraConfig.get().overrides.task), trust=config["trust"]
    )
    output = config["output"] or (checkpoint.run / "test" if checkpoint.run else f"test_{checkpoint.path.stem}")
    if config["output"] is None and other_data and checkpoint.run:
        output = checkpoint.run / f"test_{datamodule.source.name}"
    score_checkpoint(checkpoint, config=config, output=Path(output), datamodule=datamodule)
