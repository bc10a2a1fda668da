"""Compare model=lite with the paper's network and with other small networks, in each backend and in one run.

    python -m experiments.speed.lite [--backends openvino int8 ...] [--repeats 9] [--output lite_speed]

Every network has random weights and takes images of 224 x 224, one at a time. Writes what hudepth-bench writes, and
prints how many times as fast lite is: the median over rounds of the ratio within a round, and the range of the ratios.
The other networks run in eager PyTorch, in the faster of two layouts, and in OpenVINO.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from experiments.speed.peers import PEERS
from hudepth.base.errors import HudepthError
from hudepth.base.verbs import conf_folder
from hudepth.bench.command import measure
from hudepth.bench.contenders import Contenders
from hudepth.bench.plan import Plan, make_plan
from hudepth.bench.report import write_report
from hudepth.bench.rounds import Sample
from hudepth.bench.rows import Entry
from hudepth.bench.subject import make_subject

SMALL = ("GLPN (MiT-b0)", "MobileNet UNet")
BACKENDS = ("eager", "channels_last", "default", "openvino", "int8")
FACTORIES = {"eager": "PeerRunner", "openvino": "in_openvino"}


def model(name: str) -> dict[str, object]:
    """Return the configuration of a model of ``conf/model``."""
    from omegaconf import OmegaConf

    found = OmegaConf.to_container(OmegaConf.load(conf_folder() / "model" / f"{name}.yaml"))
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items()}


def start_rivals(contenders: Contenders, plan: Plan) -> None:
    """Start the paper's network in the same backends, and each small network."""
    folder = contenders.folder / "paper"
    folder.mkdir()
    paper = make_subject(replace(plan, model=model("hybrid_unet")), folder, runs="runs")
    contenders.enter(plan.backends or (), rival=paper)
    for name in SMALL:
        size = PEERS[name].nearest(contenders.subject.size)
        for backend, factory in FACTORIES.items():
            label, about = f"{name}, {backend}", f"random weights, {backend}, float32"
            entry = Entry(label, label, size, about, kind="peer")
            options = {"peer": name, "size": size, "device": contenders.device}
            contenders.start(entry, f"experiments.speed.peers:{factory}", options)


def compare(samples: Sequence[Sample]) -> list[str]:
    """Say how many times as fast as each other network lite is, in the same backend."""
    by_name = {sample.name: sample for sample in samples}
    lines = []
    for name, sample in by_name.items():
        other, _, backend = name.rpartition(", ")
        if other and backend in by_name:
            pairs = zip(sample.rounds, by_name[backend].rounds, strict=True)
            ratios = [statistics.median(theirs) / statistics.median(ours) for theirs, ours in pairs]
            middle, low, high = statistics.median(ratios), min(ratios), max(ratios)
            lines.append(f"lite is {middle:.1f} ({low:.1f} to {high:.1f}) times as fast as {other} in {backend}.")
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backends", nargs="+", default=list(BACKENDS))
    parser.add_argument("--repeats", type=int, default=9, help="rounds")
    parser.add_argument("--seconds", type=float, default=0.7, help="of timed passes per turn")
    parser.add_argument("--output", type=Path, default=Path("lite_speed"), help="folder to write to")
    plan = make_plan({**vars(parser.parse_args(arguments)), "batches": [1], "model": model("lite"), "device": "cpu"})
    measured = measure(plan, runs="runs", more=lambda contenders: start_rivals(contenders, plan))
    write_report(measured, sentences=compare(measured.session.samples))


if __name__ == "__main__":
    try:
        main()
    except HudepthError as error:
        sys.exit(f"lite: {error}")
