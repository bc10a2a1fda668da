from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hudepth.base.errors import ConfigError, DataError
from hudepth.report.ablation.report import Report, make_report
from hudepth.report.ablation.rows import sort_runs, sort_seeds
from hudepth.runs.results import find_result
from hudepth.runs.sweeps import read_sweep
from tests.report.ablation.synthetic import image_table, make_run, make_sweep, write_sweep, write_test

VARIANTS: dict[str, dict[str, Any]] = {
    "paper": {},
    "boundary": {"loss.smoothness": 0, "loss.scaling": 0},
    "silog": {"loss": {"_target_": "hudepth.losses.baselines.SILog", "factor": 10.0}},
}


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    return make_sweep(tmp_path / "sweep", VARIANTS, seeds=3)


@pytest.fixture(scope="module")
def fixed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Not to be written to."""
    return make_sweep(tmp_path_factory.mktemp("fixed") / "sweep", VARIANTS, seeds=2)


def report(folder: Path, **options: Any) -> Report:
    return make_report(sort_runs(read_sweep(folder), "eigen"), protocol="eigen", **{"repeats": 200, **options})


def labels(found: Report) -> list[str]:
    return [row.label for row in found.rows]


def test_rows_are_variants_in_the_order_of_the_sweep(fixed: Path) -> None:
    found = report(fixed)
    assert labels(found) == ["paper", "boundary", "silog"]
    assert {factor.name: factor.shown for factor in found.factors} == {
        "loss": ["BADCL", "BADCL", "SILog"],
        "smoothness": ["1", "0", "-"],
        "scaling": ["1", "0", "-"],
    }
    assert [row.counted for row in found.rows] == ["2", "2", "2"]
    assert found.reference.label == "paper"
    assert found.metrics == [
        "abs_rel", "rmse", "log10", "ssim", "delta1", "delta2", "delta3", "edge_f1_0.25", "edge_f1_0.5",
    ]  # fmt: skip
    assert found.warnings == []
    assert found.troubles == []


def test_means_and_differences_are_those_of_the_files(fixed: Path) -> None:
    found = report(fixed)
    stated = {
        name: np.array([find_result(fixed / f"{name}_s{s}", "eigen").metrics["rmse"] for s in (1, 2)])
        for name in VARIANTS
    }
    for row in found.rows:
        assert row.estimates["rmse"].mean == pytest.approx(stated[row.label].mean())
        if row.is_reference:
            assert row.contrasts == {}
        else:
            assert row.contrasts["rmse"].value == pytest.approx((stated[row.label] - stated["paper"]).mean())
            assert row.contrasts["rmse"].paired == ["1", "2"]
    assert found.rows[0].best == {"abs_rel", "rmse", "log10"}
    assert found.rows[2].best == set(found.metrics) - found.rows[0].best


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=8)
@given(order=st.permutations(range(6)))
def test_the_order_of_runs_changes_no_number(fixed: Path, order: list[int]) -> None:
    sweep = read_sweep(fixed)
    shuffled = replace(sweep, runs=[sweep.runs[i] for i in order])
    options: dict[str, Any] = {"protocol": "eigen", "reference": "boundary", "repeats": 100}
    a = {row.label: row for row in make_report(sort_runs(sweep, "eigen"), **options).rows}
    b = {row.label: row for row in make_report(sort_runs(shuffled, "eigen"), **options).rows}
    for name, row in a.items():
        assert row.estimates == b[name].estimates
        assert row.contrasts == b[name].contrasts
        assert row.best == b[name].best


def test_without_names_rows_are_called_by_their_factors(tmp_path: Path) -> None:
    for seed in (1, 2):
        for lr in (1e-4, 1e-3):
            make_run(tmp_path / f"{lr}_{seed}", seed=seed, changes={"optim.lr": lr}, table=image_table(seed=seed))
    assert labels(report(tmp_path)) == ["lr=0.0001", "lr=0.001"]
    assert report(tmp_path, reference="lr=0.001").reference.label == "lr=0.001"


def test_a_name_that_stands_for_two_rows_takes_their_factors(tmp_path: Path) -> None:
    jobs = []
    for lr in (1e-4, 1e-3):
        make_run(tmp_path / str(lr), changes={"optim.lr": lr}, table=image_table())
        jobs.append({"labels": {"variant": "l1", "optim.lr": str(lr)}, "run": str(lr)})
    write_sweep(tmp_path, jobs)
    assert labels(report(tmp_path)) == ["l1, lr=0.0001", "l1, lr=0.001"]
    with pytest.raises(ConfigError, match=r"reference: 'l1' is 2 rows\. Pass one, as in reference="):
        report(tmp_path, reference="l1")


def test_one_configuration_is_one_row(tmp_path: Path) -> None:
    make_run(tmp_path / "a", table=image_table())
    assert labels(report(tmp_path)) == ["all runs"]


def test_unknown_references_are_suggested(fixed: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        report(fixed, reference="boundry")
    assert str(caught.value) == (
        "reference: no row 'boundry'. Did you mean 'boundary'? There are 'paper', 'boundary', 'silog'."
    )


def test_what_did_not_finish_is_counted_and_listed_but_in_no_mean(sweep: Path) -> None:
    before = report(sweep)
    jobs = [{"labels": {"variant": "silog", "seed": "9"}, "error": "loss: no\n'slog'."}]
    for seed, state, error in (
        (4, "failed", "loss is nan"),
        (5, "pruned", None),
        (6, "interrupted", None),
        (7, "finished", None),
    ):
        name = f"boundary_s{seed}"
        table = None if state == "finished" else image_table(shift=5)
        make_run(sweep / name, seed=seed, changes=VARIANTS["boundary"], state=state, error=error, table=table)
        jobs.append({"labels": {"variant": "boundary", "seed": str(seed)}, "run": name})
    write_sweep(sweep, [*_jobs(), *jobs])
    after = report(sweep)
    assert [row.counted for row in after.rows] == ["3", "3 of 7", "3 of 4"]
    assert [row.estimates for row in after.rows] == [row.estimates for row in before.rows]
    assert [(t.run, t.row, t.seed, t.state) for t in after.troubles] == [
        ("boundary_s4", "boundary", "4", "failed"),
        ("boundary_s5", "boundary", "5", "pruned"),
        ("boundary_s6", "boundary", "6", "interrupted"),
        ("boundary_s7", "boundary", "7", "no result"),
        ("", "silog", "9", "not composed"),
    ]
    assert [t.why for t in after.troubles] == [
        "loss is nan",
        "",
        "",
        f"'{sweep}/boundary_s7' holds no test result of protocol 'eigen'. "
        f"Run hudepth-test checkpoint={sweep}/boundary_s7 protocol=eigen.",
        "loss: no 'slog'.",
    ]


def _jobs() -> list[dict[str, Any]]:
    return [
        {"labels": {"variant": name, "seed": str(seed)}, "run": f"{name}_s{seed}"}
        for name in VARIANTS
        for seed in (1, 2, 3)
    ]


def test_a_damaged_result_is_listed_with_the_reason(sweep: Path) -> None:
    (sweep / "paper_s2" / "test" / "eigen" / "per_image.csv").unlink()
    found = report(sweep)
    assert found.rows[0].counted == "2 of 3"
    assert found.troubles[0].why == (
        f"'{sweep}/paper_s2/test/eigen' has a metrics.json but no per_image.csv. Run hudepth-test again."
    )
    assert found.warnings == [
        "'boundary' and the reference are paired by seed 1, 3 only",
        "'silog' and the reference are paired by seed 1, 3 only",
    ]


def test_a_run_and_its_repetition_count_once(sweep: Path) -> None:
    make_run(sweep / "zz_again", seed=1, table=image_table(seed=77))
    found = report(sweep)
    assert found.rows[0].runs["1"].run.path.name == "zz_again"
    assert [(t.run, t.state, t.why) for t in found.troubles] == [
        ("paper_s1", "repeated", "same configuration and seed as 'zz_again', which counts")
    ]


def test_a_row_without_a_result_is_kept_and_is_no_reference(tmp_path: Path) -> None:
    make_run(tmp_path / "a", changes={"optim.lr": 1}, state="failed", error="nan")
    make_run(tmp_path / "b", changes={"optim.lr": 2}, table=image_table())
    found = report(tmp_path)
    assert [row.counted for row in found.rows] == ["0 of 1", "1"]
    assert found.rows[0].estimates == {}
    assert found.reference.label == "lr=2"
    assert found.warnings == ["'lr=1' has no result, so 'lr=2' is the reference"]
    with pytest.raises(ConfigError) as caught:
        report(tmp_path, reference="lr=1")
    assert str(caught.value) == (
        "reference: 'lr=1' has no finished run with a test result of protocol 'eigen'. "
        "Pass another, as in reference='\"lr=2\"'."
    )


def test_no_result_at_all(tmp_path: Path) -> None:
    make_run(tmp_path / "a")
    with pytest.raises(DataError) as caught:
        report(tmp_path)
    assert str(caught.value) == (
        "no run of the sweep has finished with a test result of protocol 'eigen'. "
        "Wait for one, or pass protocol=<name>."
    )


def test_other_stamps_are_marked_and_not_paired(sweep: Path) -> None:
    for seed in (1, 2, 3):
        folder = sweep / f"silog_s{seed}" / "test" / "eigen"
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()
        write_test(
            folder, image_table(seed=seed, shift=-0.05), changes={"protocol.crop": None, "split.sha256": "b" * 64}
        )
    found = report(sweep)
    row = found.rows[2]
    assert row.differs == ["protocol.crop: [45,471,41,601] against none", f"split.sha256: {'a' * 8} against {'b' * 8}"]
    assert row.contrasts == {}
    assert row.best == set()
    assert row.estimates["rmse"].scenes.known
    assert found.warnings == [f"'silog' and the reference do not compare: {'; '.join(row.differs)}"]
    assert found.rows[1].contrasts


def test_a_reference_whose_seeds_differ_pairs_with_none(sweep: Path) -> None:
    folder = sweep / "paper_s3" / "test" / "eigen"
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()
    write_test(folder, image_table(images=16), changes={"data.fingerprint": "e" * 64})
    found = report(sweep)
    assert all(not row.contrasts for row in found.rows)
    assert found.warnings == [
        f"the seeds of the reference do not compare: data.fingerprint: {'f' * 8} against {'e' * 8}"
    ]
    assert not found.rows[0].estimates["rmse"].scenes.known
    assert found.rows[0].estimates["rmse"].seeds.known


def test_other_images_under_the_same_stamp_are_not_paired(sweep: Path) -> None:
    folder = sweep / "silog_s1" / "test" / "eigen"
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()
    write_test(folder, image_table(images=16))
    found = report(sweep)
    assert "were tested on different images" in found.rows[2].differs[0]


def test_other_versions_are_one_line(sweep: Path) -> None:
    for seed in (4, 5, 6, 7):
        make_run(sweep / f"z{seed}", seed=seed, version="0.2.0", table=image_table(seed=seed))
    assert report(sweep).warnings[-1] == (
        "not all runs are of hudepth 0.1.0, the reference's: 0.2.0: z4, z5, z6 and 1 more"
    )
    (sweep / "silog_s1" / "environment.json").write_text("[")
    assert "unknown: silog_s1" in report(sweep).warnings[-1]


def test_an_undefined_metric_is_said(sweep: Path) -> None:
    table = image_table()
    table.values["rmse"][3] = math.nan
    make_run(sweep / "nan", seed=8, table=table)
    found = report(sweep)
    assert math.isnan(found.rows[0].estimates["rmse"].mean)
    assert "'paper' has no rmse: undefined for seed 8" in found.warnings
    assert found.rows[1].best >= {"rmse"}


def test_seeds_are_in_the_order_of_numbers() -> None:
    assert sort_seeds(["10", "9", "x", "2/1", "2", "9"]) == ["2", "2/1", "9", "10", "x"]
