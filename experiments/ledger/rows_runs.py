"""Rows that need runs: accuracy, kinds of split, units, epochs, edges."""

from __future__ import annotations

from collections.abc import Sequence

from experiments.ledger import tables
from experiments.ledger.row import Row, Sheet, not_measured
from experiments.ledger.rows_table2 import describe_test, format_value
from experiments.ledger.runs import Run, pairs

MAIN = "eigen"
"""The protocol whose figures are quoted in sentences; tables show all."""
EDGES = ("edge_f1_0.25", "si_boundary_f1", "dbe_acc_px", "dbe_comp_px")
"""Measures of depth edges: the first two are better when high, the others when low."""


def accuracy_row(runs: Sequence[Run]) -> Row:
    """The figures of the abstract against the best of the runs."""
    paper = tables.PROPOSED
    claim = "Accuracy"
    says = f"ARE {paper.abs_rel}, delta1 {paper.delta1} on random frames of NYU's training set (table 2, section 5)"
    how = (
        "The lowest test abs_rel of a trained network for each data set, kind of split and protocol, from the "
        "metrics.json files; runs that read depth as millimetres are left out."
    )
    best: dict[tuple[str, str, str], tuple[float, Run]] = {}
    for run in (run for run in runs if not run.misread):
        for protocol in run.tests:
            key = (run.tested_source(protocol), run.tested_split(protocol), protocol)
            value = run.metric(protocol, "abs_rel")
            if value is not None and (key not in best or value < best[key][0]):
                best[key] = (value, run)
    if not best:
        return not_measured("accuracy", claim, says, why="pass --runs <a run tested on NYU>", how=how)
    found = []
    for source, split, protocol in _one_protocol_each(sorted(best)):
        if _is_nyu(source):
            value, run = best[source, split, protocol]
            where = f"{split} split of {source}, protocol {protocol}"
            found.append(f"{value:.3f} and {format_value(run.metric(protocol, 'delta1'))} ({where})")
    cells = [
        [*_tested(run, key[2]), str(run.last_epoch or "?"), str(run.training_images or "?")]
        for key, (_, run) in sorted(best.items(), key=lambda item: item[0])
    ]
    reached = [key for key, (value, run) in best.items() if _reaches(run, key[2])]
    return Row(
        "accuracy",
        claim,
        says,
        f"Best ARE and delta1 on NYU: {'; '.join(found) or 'none of the runs was tested on it'}",
        how if reached else f"{how} The paper trained on {tables.SPLIT_COUNTS[0]:,} images, for 100 epochs by table 1.",
        "holds" if reached else "not reached",
        {
            "best": [
                {"data": key[0], "split": key[1], "protocol": key[2], "abs_rel": value, "run": run.name}
                for key, (value, run) in best.items()
            ]
        },
        [Sheet("Best of the runs", ("run", "test", "ARE", "delta1", "epochs", "training images"), cells)],
    )


def _one_protocol_each(keys: Sequence[tuple[str, str, str]]) -> list[tuple[str, str, str]]:
    """Keep one protocol of each data set and split: eigen where there is one."""
    chosen: dict[tuple[str, str], tuple[str, str, str]] = {}
    for key in keys:
        if key[:2] not in chosen or key[2] == MAIN:
            chosen[key[:2]] = key
    return list(chosen.values())


def _is_nyu(source: str) -> bool:
    return source.startswith(("nyu", "densedepth"))


def _reaches(run: Run, protocol: str) -> bool:
    abs_rel, delta1 = run.metric(protocol, "abs_rel"), run.metric(protocol, "delta1")
    if abs_rel is None or delta1 is None:
        return False
    return (
        _is_nyu(run.tested_source(protocol))
        and round(abs_rel, 3) <= tables.PROPOSED.abs_rel
        and round(delta1, 3) >= tables.PROPOSED.delta1
    )


def split_effect_row(runs: Sequence[Run]) -> Row:
    """The same recipe on a random and on a scene-disjoint split."""
    claim = "Score on a random split, and by scene"
    says = "All results come from one random split of frames (section 2.3)"
    how = (
        "Runs whose configurations differ in data.split alone, under one protocol; intervals as metrics.json gives "
        "them. Such splits differ in their test images and in the number of training images too."
    )
    cells, lower, unclear = [], [], []
    for a, b in pairs(runs, "data.split", "data.split_seed", "data.fractions"):
        if "random" not in (a.split, b.split):
            continue
        random, other = (a, b) if a.split == "random" else (b, a)
        common = [p for p in random.tests if p in other.tests]
        for protocol in common:
            values = random.metric(protocol, "abs_rel"), other.metric(protocol, "abs_rel")
            if None in values:
                continue
            cells += [_tested(run, protocol) for run in (random, other)]
            if protocol != MAIN and MAIN in common:
                continue
            found = (
                f"On {random.tested_source(protocol)} ARE {values[0]:.3f} random, {values[1]:.3f} {other.split} "
                f"(protocol {protocol}"
            )
            ends = random.interval(protocol, "abs_rel"), other.interval(protocol, "abs_rel")
            if ends[0] and ends[1] and ends[0][1] < ends[1][0]:
                lower.append(f"{found}): lower, intervals apart")
            else:
                unclear.append(f"{found}): {'intervals not apart' if all(ends) else 'no intervals'}")
    if not cells:
        why = "pass --runs A B: one recipe trained with data.split=random and with data.split=scene or official"
        return not_measured("random_against_scene", claim, says, why=why, how=how)
    return Row(
        "random_against_scene",
        claim,
        says,
        "; ".join([*lower, *unclear]),
        how,
        "contradicted" if lower else "measured",
        {"random_is_lower": lower, "unclear": unclear},
        [Sheet("One recipe on a random split and by scene", ("run", "test", "ARE", "delta1"), cells)],
    )


def _tested(run: Run, protocol: str) -> list[str]:
    def with_interval(name: str) -> str:
        ends = run.interval(protocol, name)
        return format_value(run.metric(protocol, name)) + (f" [{ends[0]:.3f}, {ends[1]:.3f}]" if ends else "")

    return [run.name, describe_test(run.tests[protocol], protocol), with_interval("abs_rel"), with_interval("delta1")]


def units_of_runs_row(runs: Sequence[Run]) -> Row:
    """Training on depth read rightly and as millimetres."""
    claim = "Training on misread units"
    says = (
        f"Depth 'in millimeters' is divided by 1000 (section 2.3); SSIM {tables.SSIM}, validation loss "
        f"{tables.LOSS_VAL} (section 4)"
    )
    how = (
        "Runs whose configurations differ in data.encoding alone, one of them paper_literal: validation SSIM (data "
        "range 1 on unit depth), total loss and abs_rel of the last epoch that both have."
    )
    cells, found, fits = [], [], []
    for a, b in pairs(runs, "data.encoding"):
        if not (a.misread or b.misread):
            continue
        both = (a, b) if a.misread else (b, a)
        epoch = min(a.last_epoch, b.last_epoch)
        rows = [[run.at_epoch(epoch, f"val/{name}") for name in ("ssim", "loss/total", "abs_rel")] for run in both]
        for run, row, word in zip(both, rows, ("as millimetres", "rightly"), strict=True):
            cells.append([run.name, word, str(epoch), *(format_value(value, digits=4) for value in row)])
        (ssim_misread, *_), (ssim_right, *_) = rows
        if ssim_misread is not None and ssim_right is not None:
            found.append(
                f"SSIM {ssim_misread:.3f} and loss {format_value(rows[0][1], digits=4)} misread, {ssim_right:.3f} and "
                f"{format_value(rows[1][1], digits=4)} rightly read (epoch {epoch})"
            )
            fits.append(round(ssim_misread, 3) >= tables.SSIM > round(ssim_right, 3))
    if not found:
        why = "pass --runs A B: one recipe on 8-bit depth, with data.encoding=uint8_10m and with paper_literal"
        return not_measured("units_of_runs", claim, says, why=why, how=how)
    paper = [
        "the paper",
        "",
        f"{tables.EPOCHS_TABLE_1}",
        f"{tables.SSIM}",
        f"{tables.LOSS_VAL}",
        f"{tables.PROPOSED.abs_rel} (test)",
    ]
    header = ("run", "depth read", "epoch", "validation SSIM", "validation loss", "validation ARE")
    return Row(
        "units_of_runs",
        claim,
        says,
        "; ".join(found) + (". The paper's SSIM appears with misread depth only" if any(fits) else ""),
        how,
        "contradicted" if any(fits) else "measured",
        {"found": found, "only_misread_reaches_ssim": any(fits)},
        [Sheet("One recipe, depth read rightly and as millimetres", header, [*cells, paper])],
    )


def epochs_row(runs: Sequence[Run]) -> Row:
    """What the epochs from 30 to 100 bring."""
    claim, few, many = "Number of epochs", tables.EPOCHS_SECTION_4, tables.EPOCHS_TABLE_1
    says = f"{few} (section 4), {many} (table 1 and the text on figure 5)"
    how = f"The lowest validation abs_rel in metrics.csv up to epoch {few} and up to epoch {many}, of one run."
    longest = max((run.last_epoch for run in runs), default=0)
    found, values = [], []
    for run in runs:
        upto = {
            n: [row["val/abs_rel"] for row in run.history if row["epoch"] <= n and "val/abs_rel" in row]
            for n in (few, many)
        }
        if run.last_epoch >= many and upto[few]:
            at_few, at_many = min(upto[few]), min(upto[many])
            values.append({"run": run.name, "few": at_few, "many": at_many})
            found.append(
                f"{run.name}: ARE {at_few:.4f} by epoch {few}, {at_many:.4f} by {many} ({at_many / at_few - 1:+.1%})"
            )
    if not found:
        seen = f"; the longest passed has {longest}" if longest else ""
        return not_measured("epochs", claim, says, why=f"pass --runs <a run of {many} epochs>{seen}", how=how)
    return Row("epochs", claim, says, "; ".join(found), how, "measured", {"runs": values})


def edges_row(runs: Sequence[Run]) -> Row:
    """Whether the loss sharpens edges."""
    claim = "Sharper edges"
    says = "The loss 'provides sharper edges' (abstract); no measure of edges is given, and no other loss is compared"
    how = (
        "Boundary measures in the metrics.json files, under protocols that score them; runs whose configurations "
        "differ in the loss alone are compared, the first measure with its intervals."
    )
    cells = [
        [run.name, run.loss, protocol, *(format_value(run.metric(protocol, name)) for name in EDGES)]
        for run in runs
        for protocol in run.tests
        if any(run.metric(protocol, name) is not None for name in EDGES)
    ]
    if not cells:
        why = "run hudepth-test with a protocol that scores edges, on runs that differ in the loss; pass --runs A B"
        return not_measured("edges", claim, says, why=why, how=how)
    compared = [line for a, b in pairs(runs, "loss._target_", "loss") for line in _edges_of_pair(a, b)]
    verdicts = [verdict for _, verdict in compared]
    alone = f"Edges of {len({row[0] for row in cells})} runs were measured, but no two runs differ in the loss alone"
    return Row(
        "edges",
        claim,
        says,
        "; ".join(line for line, _ in compared) or alone,
        how,
        "measured" if not verdicts or len(set(verdicts)) > 1 else verdicts[0],
        {"runs": cells},
        [Sheet("Measures of depth edges", ("run", "loss", "protocol", *EDGES), cells)],
    )


def _edges_of_pair(a: Run, b: Run) -> list[tuple[str, str]]:
    """Compare the paper's loss with another by the first measure; nothing if neither or both are the paper's."""
    if (a.loss == "BADCL") == (b.loss == "BADCL"):
        return []
    paper, other = (a, b) if a.loss == "BADCL" else (b, a)
    lines = []
    for protocol in [p for p in paper.tests if p in other.tests]:
        own, theirs = paper.metric(protocol, EDGES[0]), other.metric(protocol, EDGES[0])
        if own is None or theirs is None:
            continue
        ends = paper.interval(protocol, EDGES[0]), other.interval(protocol, EDGES[0])
        verdict = "measured"
        if ends[0] and ends[1]:
            verdict = "holds" if ends[0][0] > ends[1][1] else "contradicted" if ends[0][1] < ends[1][0] else "measured"
        lines.append(
            (f"{EDGES[0]} {own:.3f} with BADCL, {theirs:.3f} with {other.loss} (protocol {protocol})", verdict)
        )
    return lines
