from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from experiments.ledger.rows_table2 import (
    best_row,
    bounds_row,
    deltas_row,
    describe_test,
    protocol_row,
    table_2_with_runs,
)
from experiments.ledger.runs import read_run
from experiments.ledger.tables import PROPOSED, TABLE_2

MakeRun = Callable[..., Path]


def test_the_proposed_row_is_not_the_best_of_every_column() -> None:
    row = best_row()
    assert row.verdict == "contradicted"
    assert row.values["beaten"] == {"rmse": ["Das et al. (Enc-Dec-IRv2) 0.228"]}
    without_das = [other for other in TABLE_2 if "Das" not in other.method]
    assert best_row(without_das).verdict == "holds"


def test_one_row_of_deltas_falls() -> None:
    row = deltas_row()
    assert (row.verdict, row.values) == ("cannot be", {"rows": ["Mancini et al."]})
    assert deltas_row(TABLE_2[1:]).verdict == "holds"


def test_one_row_does_not_fit_indoors() -> None:
    row = bounds_row()
    assert row.verdict == "cannot be"
    assert row.values["tested"] == len(TABLE_2) - 1
    assert len(row.values["broken"]) == 1
    assert row.values["broken"][0].startswith("Guizilini et al. [45]: RMSE 2.727 where at most 1.55")
    assert [cells[-1] for cells in row.sheets[0].cells].count("possible") == 11
    assert bounds_row([PROPOSED, replace(PROPOSED, log10=None)]).verdict == "holds"


def test_protocols_of_one_run_are_put_side_by_side(make_run: MakeRun) -> None:
    near = read_run(make_run("near", tests={"eigen": {"abs_rel": 0.2}, "paper": {"abs_rel": 0.202}}))
    far = read_run(make_run("far", tests={"eigen": {"abs_rel": 0.25}, "paper": {"abs_rel": 0.2}}))
    row = protocol_row([near, far])
    assert row.verdict == "measured"
    assert row.measured.endswith("badcl (far): ARE 0.200 (paper), 0.250 (eigen)")
    assert row.values["largest_change_of_abs_rel"] == 0.25
    assert [cells[:2] for cells in row.sheets[0].cells] == [
        ["badcl (near)", "eigen"], ["badcl (near)", "paper"], ["badcl (far)", "eigen"], ["badcl (far)", "paper"],
    ]  # fmt: skip


def test_one_protocol_is_not_enough(make_run: MakeRun) -> None:
    run = read_run(make_run("one", tests={"eigen": {"abs_rel": 0.2}}))
    assert protocol_row([run]).verdict == "not measured"
    assert protocol_row([]).measured == "not measured: pass --runs <a run tested under two protocols>"


def test_table_2_gains_a_row_for_each_test(make_run: MakeRun) -> None:
    run = read_run(
        make_run(
            "one",
            config={"data.encoding": "paper_literal", "data.split": "random"},
            tests={"eigen": {"abs_rel": 0.2, "delta1": 0.61}},
        )
    )
    sheet = table_2_with_runs([run])
    assert len(sheet.cells) == len(TABLE_2) + 1
    assert sheet.cells[-1] == [
        "badcl (one)", "measured", "nyu_labeled, depth misread, random split, 654 images, protocol eigen",
        "0.200", "", "", "0.610", "", "",
    ]  # fmt: skip
    assert sheet.cells[7][3:6] == ["0.131", "0.538", ""]  # Lee: no log10 in the paper


def test_a_result_that_states_nothing() -> None:
    assert describe_test({}, "eigen") == "?, ? split, ? images, protocol eigen"
