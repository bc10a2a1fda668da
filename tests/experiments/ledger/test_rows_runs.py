from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from experiments.ledger.rows_runs import accuracy_row, edges_row, epochs_row, split_effect_row, units_of_runs_row
from experiments.ledger.runs import read_run

MakeRun = Callable[..., Path]


@pytest.mark.parametrize("row", [accuracy_row, edges_row, epochs_row, split_effect_row, units_of_runs_row])
def test_without_runs_nothing_is_measured(row: Callable[..., object]) -> None:
    made = row([])
    assert made.verdict == "not measured"  # type: ignore[attr-defined]
    assert "--runs" in made.measured  # type: ignore[attr-defined]


def test_the_best_of_each_split_and_protocol_counts(make_run: MakeRun) -> None:
    runs = [
        read_run(make_run("a", tests={"eigen": {"abs_rel": 0.25, "delta1": 0.6}})),
        read_run(make_run("b", tests={"eigen": {"abs_rel": 0.22, "delta1": 0.62}}, config={"seed": 1})),
        read_run(make_run("c", tests={"eigen": {"abs_rel": 0.1, "delta1": 0.9}}, config={"data.split": "random"})),
        read_run(make_run("d", tests={"eigen": {"abs_rel": 0.01}}, config={"data.encoding": "paper_literal"})),
    ]
    row = accuracy_row(runs)
    assert row.verdict == "not reached"
    assert [(b["split"], b["abs_rel"]) for b in row.values["best"]] == [("official", 0.22), ("random", 0.1)]
    assert "0.220 and 0.620 (official split of nyu_labeled, protocol eigen); 0.100 and 0.900 (random" in row.measured
    assert [cells[2] for cells in row.sheets[0].cells] == ["0.220", "0.100"]


def test_accuracy_names_one_protocol_of_each_split_and_no_other_set(make_run: MakeRun) -> None:
    tests = {"paper": {"abs_rel": 0.2, "delta1": 0.7}, "eigen": {"abs_rel": 0.3, "delta1": 0.6}}
    row = accuracy_row(
        [
            read_run(make_run("a", tests=tests)),
            read_run(make_run("b", tests={"eigen": {"abs_rel": 0.01}}, source="rooms")),
        ]
    )
    assert row.measured == "Best ARE and delta1 on NYU: 0.300 and 0.600 (official split of nyu_labeled, protocol eigen)"
    assert len(row.sheets[0].cells) == 3


@pytest.mark.parametrize(
    ("source", "delta1", "verdict"),
    [("nyu_labeled", 0.982, "holds"), ("nyu_labeled", 0.981, "not reached"), ("rooms", 0.99, "not reached")],
)
def test_accuracy_is_reached_on_nyu_by_both_figures(
    make_run: MakeRun, source: str, delta1: float, verdict: str
) -> None:
    run = read_run(make_run("a", tests={"eigen": {"abs_rel": 0.0634, "delta1": delta1}}, source=source))
    assert accuracy_row([run]).verdict == verdict


@pytest.mark.parametrize(
    ("intervals", "verdict", "said"),
    [
        (([0.09, 0.11], [0.19, 0.21]), "contradicted", "lower, intervals apart"),
        (([0.09, 0.2], [0.19, 0.21]), "measured", "intervals not apart"),
        ((None, [0.19, 0.21]), "measured", "no intervals"),
    ],
)
def test_random_against_official(
    make_run: MakeRun, intervals: tuple[list[float] | None, list[float]], verdict: str, said: str
) -> None:
    random, official = (
        read_run(
            make_run(
                kind,
                config={"data.split": kind},
                tests={"eigen": {"abs_rel": value}},
                intervals=ends and {"abs_rel": ends},
            )
        )
        for kind, value, ends in (("random", 0.1, intervals[0]), ("official", 0.2, intervals[1]))
    )
    for runs in ([random, official], [official, random]):
        row = split_effect_row(runs)
        assert row.verdict == verdict
        assert row.measured == f"On nyu_labeled ARE 0.100 random, 0.200 official (protocol eigen): {said}"
        assert [cells[0] for cells in row.sheets[0].cells] == ["badcl (random)", "badcl (official)"]


def test_splits_are_compared_within_one_recipe_and_protocol(make_run: MakeRun) -> None:
    random = read_run(make_run("random", config={"data.split": "random"}, tests={"eigen": {"abs_rel": 0.1}}))
    other = read_run(make_run("other", config={"seed": 1}, tests={"eigen": {"abs_rel": 0.2}}))
    elsewhere = read_run(make_run("elsewhere", tests={"paper": {"abs_rel": 0.2}}))
    scene = read_run(make_run("scene", config={"data.split": "scene"}, tests={"paper": {"abs_rel": 0.2}}))
    assert split_effect_row([random, other]).verdict == "not measured"
    assert split_effect_row([random, elsewhere]).verdict == "not measured"
    assert split_effect_row([scene, elsewhere]).verdict == "not measured"


@pytest.mark.parametrize(("ssim", "verdict"), [(0.9, "contradicted"), (0.9981, "measured")])
def test_misread_units_are_told_by_ssim(make_run: MakeRun, ssim: float, verdict: str) -> None:
    def history(last: int, value: float) -> list[dict[str, float]]:
        return [
            {"epoch": e, "val/ssim": value, "val/loss/total": 0.1 / e, "val/abs_rel": 0.2} for e in range(1, last + 1)
        ]

    right = read_run(make_run("right", history=history(4, ssim)))
    misread = read_run(make_run("misread", config={"data.encoding": "paper_literal"}, history=history(2, 0.9977)))
    row = units_of_runs_row([right, misread])
    assert row.verdict == verdict
    assert row.measured.startswith(f"SSIM 0.998 and loss 0.0500 misread, {ssim:.3f} and 0.0500 rightly read (epoch 2)")
    assert [cells[1] for cells in row.sheets[0].cells] == ["as millimetres", "rightly", ""]


def test_two_right_encodings_are_no_such_pair(make_run: MakeRun) -> None:
    runs = [read_run(make_run(name, config={"data.encoding": name})) for name in ("auto", "uint8_10m")]
    assert units_of_runs_row(runs).verdict == "not measured"


def test_epochs_are_compared_in_a_run_that_is_long_enough(make_run: MakeRun) -> None:
    long = [{"epoch": e, "val/abs_rel": 1 / e} for e in range(1, 101)]
    row = epochs_row([read_run(make_run("long", history=long)), read_run(make_run("short", history=long[:40]))])
    assert row.verdict == "measured"
    assert row.measured == "badcl (long): ARE 0.0333 by epoch 30, 0.0100 by 100 (-70.0%)"
    row = epochs_row([read_run(make_run("shorter", history=long[:99]))])
    assert row.measured == "not measured: pass --runs <a run of 100 epochs>; the longest passed has 99"


@pytest.mark.parametrize(
    ("ends", "verdict"),
    [
        (([0.4, 0.5], [0.2, 0.3]), "holds"),
        (([0.1, 0.15], [0.2, 0.3]), "contradicted"),
        (([0.25, 0.5], [0.2, 0.3]), "measured"),
    ],
)
def test_edges_under_badcl_and_another_loss(
    make_run: MakeRun, ends: tuple[list[float], list[float]], verdict: str
) -> None:
    losses = {"badcl": {}, "l1": {"loss._target_": "hudepth.losses.baselines.L1", "loss.boundary": None}}
    runs = [
        read_run(
            make_run(
                name,
                config=config,
                tests={"edges": {"edge_f1_0.25": sum(interval) / 2}},
                intervals={"edge_f1_0.25": interval},
            )
        )
        for (name, config), interval in zip(losses.items(), ends, strict=True)
    ]
    assert edges_row(runs).verdict == verdict
    assert edges_row(runs[::-1]).verdict == verdict
    single = edges_row(runs[:1])
    assert single.verdict == "measured"
    assert single.measured == "Edges of 1 runs were measured, but no two runs differ in the loss alone"
    assert single.sheets[0].cells[0][:4] == ["badcl", "BADCL", "edges", f"{sum(ends[0]) / 2:.3f}"]
