"""Average the weights of checkpoints that started from the same weights, as far as it helps on validation pairs.

    python -m experiments.soup soup.ckpt <run> <run> ... [--protocol eigen] [--metric abs_rel]

A greedy soup (Wortsman et al. 2022): the best checkpoint first, then each other, from good to bad, if the average with
it is better. Cycles of a training (experiment=strong, then finetune from its weights, then again) or seeds that share
init= can be averaged; others lie in different basins. The file is that of the best checkpoint with the averaged
weights, and names what it was made of.
"""

from __future__ import annotations

import argparse
import copy
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from experiments.validation import Validation
from hudepth.base.errors import ConfigError, HudepthError
from hudepth.evaluation.lineage import BEFORE, lineage
from hudepth.metrics.catalogue import metric_info
from hudepth.runs.bundles import is_bundle
from hudepth.runs.checkpoint import KEY, NET_PREFIX, Checkpoint, load_checkpoint, read_plain

State = Mapping[str, Tensor]


def average(states: Sequence[State]) -> dict[str, Tensor]:
    """Return the mean of the tensors by name; counters are those of the first."""

    def mean(name: str, first: Tensor) -> Tensor:
        if not first.is_floating_point():
            return first
        return torch.stack([state[name].double() for state in states]).mean(0).to(first.dtype)

    return {name: mean(name, first) for name, first in states[0].items()}


def greedy(states: Mapping[str, State], scores: Mapping[str, float], score: Callable[[State], float]) -> list[str]:
    """Return the names whose average is best, found greedily; ``scores`` and ``score`` are better if smaller."""
    order = sorted(states, key=lambda name: scores[name])
    chosen, best = order[:1], scores[order[0]]
    for name in order[1:]:
        value = score(average([states[each] for each in (*chosen, name)]))
        if value < best:
            chosen, best = [*chosen, name], value
    return chosen


def check(checkpoints: Mapping[str, Checkpoint], output: Path) -> None:
    """Raise HudepthError, before anything is scored, for checkpoints that cannot be averaged or written."""
    first, *others = checkpoints.values()
    shapes = {name: tensor.shape for name, tensor in first.state.items()}
    for each in others:
        if {name: tensor.shape for name, tensor in each.state.items()} != shapes:
            raise ConfigError(f"'{each.path}' is of another network than '{first.path}'.")
    if bundle := next((each.path for each in checkpoints.values() if is_bundle(each.path)), None):
        raise ConfigError(f"'{bundle}' is a bundle. Pass the checkpoint that it was made of.")
    if not output.parent.is_dir():
        raise ConfigError(f"no folder '{output.parent}' to write the soup to.")


def make_soup(output: Path, paths: Sequence[str], *, protocol: str, metric: str) -> list[str]:
    """Write the soup of checkpoints to ``output``; return lines about it."""
    checkpoints = {path: load_checkpoint(path) for path in paths}
    check(checkpoints, output)
    validation = Validation(checkpoints, protocol=protocol)
    nets = {name: each.build_net(trust=[]) for name, each in checkpoints.items()}
    sign = -1 if metric_info(metric).higher_is_better else 1
    probe = copy.deepcopy(next(iter(nets.values())))

    def score(state: State) -> float:
        probe.load_state_dict(state)
        return sign * validation.summarise(validation.score({"soup": probe})["soup"])[metric]

    states = {name: net.state_dict() for name, net in nets.items()}
    scores = {name: sign * validation.summarise(table)[metric] for name, table in validation.score(nets).items()}
    chosen = greedy(states, scores, score)
    lines = [f"{metric} {sign * scores[name]:.4f}  {name}{'  (in the soup)' * (name in chosen)}" for name in scores]
    state = average([states[name] for name in chosen])
    content = read_plain(checkpoints[chosen[0]].path)
    content["state_dict"] = {f"{NET_PREFIX}{name}": tensor for name, tensor in state.items()}
    content[KEY]["soup"] = chosen
    content[KEY]["data"][BEFORE] = [past for name in chosen for past in lineage(checkpoints[name])][1:]
    torch.save(content, output)
    return [*lines, f"{metric} {sign * score(state):.4f}  {output}, the average of {len(chosen)}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, help="checkpoint to write")
    parser.add_argument("runs", nargs="+", help="checkpoints or run directories")
    parser.add_argument("--protocol", default="eigen")
    parser.add_argument("--metric", default="abs_rel", help="what to improve")
    options = parser.parse_args()
    print("\n".join(make_soup(options.output, options.runs, protocol=options.protocol, metric=options.metric)))


if __name__ == "__main__":
    try:
        main()
    except HudepthError as error:
        sys.exit(f"soup: {error}")
