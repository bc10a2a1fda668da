from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from experiments.ledger import __main__ as ledger_main
from hudepth.base.errors import ConfigError

STUDY = Path(__file__).parents[3] / "experiments" / "badcl_official"


@pytest.fixture(autouse=True)
def few_small_rooms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ledger_main, "ROOMS", 3)
    monkeypatch.setattr(ledger_main, "ROOM_SIDE_PX", 48)


@pytest.mark.slow
def test_a_fresh_checkout_gives_the_whole_ledger(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ledger_main.main(["--no-throughput", "--output", str(tmp_path / "led")])
    ledger = json.loads((tmp_path / "led" / "ledger.json").read_text())
    verdicts = {row["key"]: row["verdict"] for row in ledger["rows"]}
    assert verdicts == {
        "parameters": "holds",
        "table_a1": "holds",
        "text_against_table_a1": "contradicted",
        "cost_of_a_frame": "contradicted",
        "total_mult_adds": "holds",
        "throughput": "not measured",
        "table_3_arithmetic": "holds",
        "split_counts": "holds",
        "leakage": "contradicted",
        "random_against_scene": "not measured",
        "ssim_and_loss": "cannot be",
        "rmse_and_are": "holds",
        "eps": "contradicted",
        "units_of_runs": "not measured",
        "epochs": "not measured",
        "accuracy": "not measured",
        "edges": "not measured",
        "best_of_table_2": "contradicted",
        "falling_deltas": "cannot be",
        "figures_of_one_row": "cannot be",
        "protocol": "not measured",
    }
    assert ledger["environment"]["packages"]["torch"]
    page = (tmp_path / "led" / "ledger.md").read_text()
    assert all(row["claim"] in page for row in ledger["rows"])
    out = capsys.readouterr().out
    assert "cannot be" in out
    assert max(map(len, out.splitlines()[:-1])) <= 120


@pytest.mark.slow
def test_a_study_serves_as_evidence_and_damage_spoils_its_own_rows_only(tmp_path: Path) -> None:
    study = tmp_path / "study"
    shutil.copytree(STUDY, study)
    (study / "test" / "eigen" / "metrics.json").write_text("{")
    ledger_main.main(["--no-throughput", "--runs", str(study), "--output", str(tmp_path)])
    ledger = json.loads((tmp_path / "ledger.json").read_text())
    rows = {row["key"]: row for row in ledger["rows"]}
    assert rows["accuracy"]["verdict"] == "not reached"
    assert [best["protocol"] for best in rows["accuracy"]["values"]["best"]] == ["paper"]
    stated = json.loads((study / "test" / "paper" / "metrics.json").read_text())["metrics"]["model"]["abs_rel"]
    assert rows["accuracy"]["values"]["best"][0]["abs_rel"] == stated
    assert rows["epochs"]["measured"].endswith("the longest passed has 14")
    assert "eigen/metrics.json' cannot be read" in ledger["runs"][0]["problems"][0]
    assert ledger["table_2"]["cells"][-1][0] == "badcl_official (study)"


@pytest.mark.slow
def test_speed_is_measured_when_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from experiments.ledger import rows_model
    from experiments.ledger.speed import Speed

    asked = []

    def measured(_network: object, *, batch: int, seconds: float, **_: object) -> Speed:
        asked.append((batch, seconds))
        return Speed(batch, 10.0, 1)

    monkeypatch.setattr(rows_model, "measure_speed", measured)
    ledger_main.main(["--batches", "2", "3", "--seconds", "0.5", "--output", str(tmp_path)])
    assert asked == [(2, 0.5), (3, 0.5)]


@pytest.mark.parametrize(("option", "value"), [("--batches", "0"), ("--seconds", "-1"), ("--runs", "nowhere")])
def test_bad_options_are_found_before_any_work(tmp_path: Path, option: str, value: str) -> None:
    with pytest.raises(ConfigError, match=f"^{option.strip('-')}|^{option}"):
        ledger_main.main([option, value, "--output", str(tmp_path / "led")])
    assert not (tmp_path / "led").exists()


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"^--output: cannot write to '.*/file'"):
        ledger_main.main(["--output", str(tmp_path / "file")])
