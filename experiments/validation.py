"""Compare checkpoints on the validation pairs of their split, with 95 % intervals over scenes.

    python -m experiments.validation name=<run> name=<run> ... [--protocol eigen] [--also METRIC] [--page README.md]

Choices are made on these pairs, so that the test images are looked at once. All checkpoints must have the same data
and split; each sees images of the size that it was trained at, so only protocols at native resolution compare sizes.
Prints a Markdown table; the last columns are paired differences from the first checkpoint.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import nn

from hudepth.base.errors import ConfigError, HudepthError
from hudepth.base.files import write_between
from hudepth.data.datamodule import DepthDataModule
from hudepth.evaluation.protocols import build_protocols
from hudepth.evaluation.routine import Evaluation
from hudepth.evaluation.score import run_evaluation
from hudepth.evaluation.scoring import image_table
from hudepth.evaluation.test_data import open_data
from hudepth.metrics.bootstrap import intervals, paired_differences
from hudepth.metrics.summary import ImageTable, summarise
from hudepth.models.inference import inference_form
from hudepth.runs.checkpoint import Checkpoint, load_checkpoint

SHOWN = ("abs_rel", "rmse", "delta1", "scale_sd", "abs_rel_aligned")
CHANGES = ("abs_rel", "delta1")


def validation_data(checkpoints: Mapping[str, Checkpoint]) -> DepthDataModule:
    """Return the data of the checkpoints with the validation pairs in the test's place."""
    opened = {name: open_data(checkpoint, {}, trust=[])[0] for name, checkpoint in checkpoints.items()}
    first, *others = opened.values()
    for name, other in zip(list(opened)[1:], others, strict=True):
        if (other.split.sha256, other.size) != (first.split.sha256, first.size):
            raise ConfigError(f"{name}: another split or size than {next(iter(opened))}.")
    first.split = replace(first.split, test=first.split.val)
    return first


class Validation:
    """The validation pairs of checkpoints, and a protocol: of those ``stated``, by default by the first checkpoint.

    Raises ConfigError if it is not among them, or the checkpoints have different data.
    """

    def __init__(
        self, checkpoints: Mapping[str, Checkpoint], *, protocol: str, stated: Mapping[str, Any] | None = None
    ) -> None:
        self.data = validation_data(checkpoints)
        stated = stated or next(iter(checkpoints.values())).config["protocol"]
        if protocol not in stated:
            raise ConfigError(f"--protocol {protocol}: the first checkpoint was trained with {', '.join(stated)}.")
        (self.protocol,) = build_protocols({protocol: stated[protocol]}, datamodule=self.data, trust=[])

    def score(self, nets: Mapping[str, nn.Module], *, edges: bool = False) -> dict[str, ImageTable]:
        """Return the metrics of each image by name of the network; of the first one also those of depth ``edges``."""
        fast = {f"{i}": inference_form(net, size=self.data.size) for i, net in enumerate(nets.values())}  # no dots
        evaluation = Evaluation(
            fast, [self.protocol], max_depth_m=self.data.max_depth_m, detailed="0" if edges else None
        )
        run_evaluation(evaluation, self.data, {"accelerator": "cpu"})
        records = [self.data.store.records[index] for index in evaluation.indices]
        boundary = [evaluation.boundary.get(self.protocol.name), *[None] * (len(nets) - 1)]
        return {
            name: image_table(self.protocol, evaluation.sums[i, self.protocol.name], records, boundary=edge)
            for name, i, edge in zip(nets, fast, boundary, strict=True)
        }

    def summarise(self, table: ImageTable) -> dict[str, float]:
        """Return the metrics of all images."""
        return summarise(table, **self.protocol.summary_options)


def compare(checkpoints: Mapping[str, Checkpoint], *, protocol: str = "eigen", also: Sequence[str] = ()) -> list[str]:
    """Return the lines of the table; ``also`` names further metrics, which are shown with their changes."""
    shown, changes = (*SHOWN, *also), (*also, *CHANGES)
    stated = next(iter(checkpoints.values())).config["protocol"]
    alone = {name: Validation({name: each}, protocol=protocol, stated=stated) for name, each in checkpoints.items()}
    validation = next(iter(alone.values()))
    for name, other in alone.items():
        same = other.data.size == validation.data.size or validation.protocol.needs_native
        if not same or other.data.split.sha256 != validation.data.split.sha256:
            what = "split" if same else "size, at which this protocol scores,"
            raise ConfigError(f"{name}: another {what} than {next(iter(alone))}.")
    tables = {
        name: alone[name].score({name: each.build_net(trust=[])}, edges=bool(also))[name]
        for name, each in checkpoints.items()
    }
    options = validation.protocol.summary_options
    first, *_ = tables.values()
    if unknown := set(also) - set(validation.summarise(first)):
        raise ConfigError(f"--also {min(unknown)}: {protocol} does not measure it.")
    heads = ["", *shown, *(f"change of {key}" for key in changes)]
    lines = [f"| {' | '.join(heads)} |".replace("|  |", "| |"), f"|{'---|' * len(heads)}"]
    for name, table in tables.items():
        values, ranges = validation.summarise(table), intervals(table, **options)
        cells = [f"{values[key]:.3f} ({ranges[key][0]:.3f} to {ranges[key][1]:.3f})" for key in shown]
        change = paired_differences(first, table, **options)
        for key in changes:
            each = change[key]
            cells.append("" if table is first else f"{each.value:+.3f} ({each.low:+.3f} to {each.high:+.3f})")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    scenes = len(set(first.scenes))
    return [*lines, "", f"{len(first.ids)} validation images of {scenes} scenes, {protocol} protocol."]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", help="name=<checkpoint or run directory>")
    parser.add_argument("--protocol", default="eigen")
    parser.add_argument("--also", nargs="*", default=[], metavar="METRIC", help="further metrics, as edge_f1_0.25")
    parser.add_argument("--page", type=Path, help="a Markdown page; the table goes between its markers")
    parser.add_argument("--marker", default="results", help="name of the markers")
    options = parser.parse_args()
    named = dict(each.split("=", 1) for each in options.checkpoints)
    checkpoints = {name: load_checkpoint(path) for name, path in named.items()}
    lines = compare(checkpoints, protocol=options.protocol, also=options.also)
    print("\n".join(lines))
    if options.page:
        write_between(options.page, options.marker, "\n".join(lines))


if __name__ == "__main__":
    try:
        main()
    except HudepthError as error:
        sys.exit(f"validation: {error}")
