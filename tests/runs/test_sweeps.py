from __future__ import annotations

import string
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.errors import DataError
from hudepth.runs.status import write_status
from hudepth.runs.sweeps import folder_name, read_jobs, read_sweep, write_jobs

CONFIG = {"seed": 1, "data": {}, "model": {}, "loss": {}}


@given(st.dictionaries(st.text(string.printable, max_size=20), st.text(max_size=200), max_size=4))
def test_a_folder_is_one_plain_word(labels: dict[str, str]) -> None:
    name = folder_name(labels, "0123456789")
    assert name.endswith("0123456789")
    assert len(name) <= 91
    assert not set(name) & set("/\\ ,='\"$*?[](){}<>|;&\n\0")
    assert name[0] not in ".-"


def test_a_folder_says_what_was_varied() -> None:
    assert folder_name({"variant": "l1", "seed": "1"}, "k") == "l1_seed-1-k"
    assert folder_name({"loss.boundary": "3.0", "model": "tiny"}, "k") == "boundary-3.0_model-tiny-k"
    assert folder_name({}, "k") == "k"


def make_run(folder: Path, name: str, *, state: str | None = "finished", error: str = "") -> Path:
    run = folder / name
    run.mkdir(parents=True)
    (run / "config.yaml").write_text(yaml.safe_dump(CONFIG))
    if state:
        write_status(run, state, **({"error": error} if error else {}))
    return run


def test_a_sweep_is_read_in_its_order_and_what_is_no_run_is_noted(tmp_path: Path) -> None:
    for name, state, error in (
        ("b", "finished", ""),
        ("a", "failed", "no memory"),
        ("new", "running", ""),
        ("none", None, ""),
    ):
        make_run(tmp_path, name, state=state, error=error)
    (tmp_path / "foreign").mkdir()
    (tmp_path / "half").mkdir()
    (tmp_path / "half" / "config.yaml").write_text("data: {")
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd" / "config.yaml").write_text("a: 1")
    (tmp_path / ".hidden").mkdir()
    (tmp_path / "notes.txt").touch()
    jobs = [{"labels": {"v": name}, "run": name} for name in ("b", "gone", "a")]
    write_jobs(tmp_path, "x", [*jobs, {"labels": {"v": "bad"}, "error": "no key"}])
    sweep = read_sweep(tmp_path)
    assert [(run.path.name, run.state, run.error, run.labels) for run in sweep.runs] == [
        ("b", "finished", "", {"v": "b"}),
        ("a", "failed", "no memory", {"v": "a"}),
        ("new", "interrupted", "", {}),  # nobody holds it: it was killed
        ("none", "interrupted", "", {}),
    ]
    assert sweep.uncomposed == [({"v": "bad"}, "no key")]
    for name in ("foreign", "half", "odd"):
        assert next(n for n in sweep.notes if f"/{name}'" in n).startswith(f"skipped: '{tmp_path}/{name}' is not a run")
    assert len([note for note in sweep.notes if "'gone'" in note]) == 1


def test_one_of_several_sweeps_in_a_folder(tmp_path: Path) -> None:
    for name in "abc":
        make_run(tmp_path, name)
    write_jobs(tmp_path, "x", [{"labels": {"v": "1"}, "run": "a"}, {"labels": {"v": "2"}, "run": "b"}])
    write_jobs(tmp_path, "y", [{"labels": {"v": "paper"}, "run": "b"}, {"labels": {"v": "3"}, "run": "c"}])
    assert [run.labels["v"] for run in read_sweep(tmp_path, name="y").runs] == ["paper", "3"]
    assert [run.labels["v"] for run in read_sweep(tmp_path).runs] == ["1", "2", "3"]  # each run once, as first called
    with pytest.raises(DataError, match=r"^name: .*'z'.* x, y"):
        read_sweep(tmp_path, name="z")


def test_any_folder_of_runs_will_do(tmp_path: Path) -> None:
    make_run(tmp_path, "a")
    sweep = read_sweep(tmp_path)
    assert [run.labels for run in sweep.runs] == [{}]
    assert sweep.notes == []


@pytest.mark.parametrize(
    "text", ["{", "- 1", "sweeps: 3", "sweeps: {x: [{}]}", "sweeps: {x: [{labels: {}, run: ../a}]}"]
)
def test_a_damaged_list_costs_labels_and_not_runs(text: str, tmp_path: Path) -> None:
    make_run(tmp_path, "a")
    (tmp_path / "sweep.yaml").write_text(text)
    sweep = read_sweep(tmp_path)
    assert [run.path.name for run in sweep.runs] == ["a"]
    assert sweep.notes[0].startswith(f"'{tmp_path}/sweep.yaml' cannot be read (")
    write_jobs(tmp_path, "x", [{"labels": {}, "run": "a"}])
    assert (tmp_path / "sweep.yaml.damaged").read_text() == text
    assert read_jobs(tmp_path) == {"x": [{"labels": {}, "run": "a"}]}


def test_jobs_are_added_and_none_is_lost(tmp_path: Path) -> None:
    bad = {"labels": {"v": "2"}, "error": "no key"}
    write_jobs(tmp_path, "x", [{"labels": {"v": "1"}, "run": "a"}, bad])
    write_jobs(tmp_path, "x", [{"labels": {"v": "3"}, "run": "c"}, {"labels": {"v": "1"}, "run": "a"}])
    assert [job["labels"]["v"] for job in read_jobs(tmp_path)["x"]] == ["1", "2", "3"]
    write_jobs(tmp_path, "x", [{"labels": {"v": "2"}, "run": "b"}])
    assert [job.get("run") for job in read_jobs(tmp_path)["x"]] == ["a", "c", "b"]


@pytest.mark.parametrize(("made", "message"), [(False, "no folder"), (True, "holds no run")])
def test_an_empty_sweep_gives_one_line(made: bool, message: str, tmp_path: Path) -> None:
    folder = tmp_path / "s"
    if made:
        (folder / "foreign").mkdir(parents=True)
    with pytest.raises(DataError, match=rf"^dir: .*{message}.* Pass dir=<folder of a sweep>") as caught:
        read_sweep(folder)
    assert ("(1 other folders lie in it)" in str(caught.value)) == made
