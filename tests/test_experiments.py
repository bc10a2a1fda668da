"""What the studies' pages say is what their files hold."""

from __future__ import annotations

import csv
import importlib.util
import json
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from experiments.studies import TEXTS
from hudepth.inference.image_fit import FOCAL_POWERS
from hudepth.runs.history import read_history
from hudepth.runs.results import MODEL, find_result

STUDIES = Path(__file__).parents[1] / "experiments"
LIMIT_BYTES = 24_000_000
"""What the studies may take on disk, the bundled models included."""


def read_metrics(study: Path, protocol: str, predictor: str = MODEL) -> dict[str, float]:
    """Read the test metrics of a predictor."""
    document = json.loads((study / "test" / protocol / "metrics.json").read_text())
    return dict(document["metrics"][predictor])


@pytest.mark.parametrize(
    ("label", "key", "best"),
    [
        ("validation abs_rel", "val/abs_rel", min),
        (r"validation rmse \[m\]", "val/rmse", min),
        ("validation delta1", "val/delta1", max),
        ("validation loss", "val/loss/total", min),
        ("training loss", "train/loss/total", min),
    ],
)
def test_epochs(label: str, key: str, best: object) -> None:
    history = read_history(STUDIES / "epochs" / "nyu_100_epochs" / "metrics.csv")
    values = [row[key] for row in history]
    assert len(values) == 100
    row = re.search(rf"^\| {label} \|(.*)\|$", (STUDIES / "epochs" / "README.md").read_text(), re.MULTILINE)
    assert row
    said = [cell.strip() for cell in row[1].split("|")]
    for text, part in zip(said, (values[:30], values), strict=False):
        top = best(part)  # type: ignore[operator]
        assert text == f"{top:.3f} (epoch {values.index(top) + 1})"
    assert said[2:] == [f"{values[29]:.3f}", f"{values[99]:.3f}"]


def test_split_leakage() -> None:
    text = " ".join((STUDIES / "split_leakage" / "README.md").read_text().split())
    rooms, nyu = (
        json.loads((STUDIES / "split_leakage" / f"{name}.json").read_text())["rows"] for name in ("rooms", "nyu")
    )
    same, every = rooms[1]["abs_rel"], rooms[0]["abs_rel"]
    assert f"abs_rel is {same['random'][0]:.3f} for" in text
    assert f"and {same['disjoint'][0]:.3f} for the one that never saw the rooms" in text
    assert f"better than the honest network's {every['disjoint'][0]:.3f}" in text
    assert f"finds a gap of {nyu[1]['abs_rel']['gap'][0]:.3f} on the same images" in text
    nearest = read_metrics(STUDIES / "split_leakage" / "rooms_video_random", "eigen", "nearest_frame")["abs_rel"]
    assert f"comes to {nearest:.3f} under the random split" in text


def test_units() -> None:
    text = " ".join((STUDIES / "units" / "README.md").read_text().split())
    right, literal = (read_metrics(STUDIES / "units" / f"units_{name}", "paper") for name in ("right", "paper_literal"))
    mean = read_metrics(STUDIES / "units" / "units_paper_literal", "paper", "mean_depth")
    last = read_history(STUDIES / "units" / "units_paper_literal" / "metrics.csv")[-1]
    assert f"has SSIM {literal['ssim']:.3f} and a validation loss of {last['val/loss/total']:.4f}" in text
    assert f"has SSIM {mean['ssim']:.3f}. Read rightly" in text
    assert f"abs_rel {literal['abs_rel']:.3f} against {right['abs_rel']:.3f}" in text
    assert f"rmse came to {literal['rmse']:.3f}" in text


def test_field_of_view() -> None:
    """What is said of cameras is in the table, and the powers that hudepth applies are those that were fitted."""
    page = (STUDIES / "field_of_view" / "README.md").read_text()
    _, results, said = page.split("<!-- results -->")
    fitted = [float(value) for value in re.findall(r"0\.\d+", results.splitlines()[1])]
    assert np.abs(np.subtract(FOCAL_POWERS, fitted)).max() < 0.02
    rows = {cells[1].strip(): [float(x) for x in re.findall(r"(0\.\d+) \(", row)]
            for row in results.splitlines() if len(cells := row.split("|")) > 5}  # fmt: skip
    (whole,) = rows["all of the image"]
    same, without, ratio, _, camera, two = rows["half"]
    for value in (whole, same, without, ratio, camera, two, rows["portrait 3:4"][2], rows["portrait 3:4"][1]):
        assert f"{value:.3f}" in said
    assert f"**{100 * (camera / same - 1):.0f} % above it for half**" in said
    well = ("four fifths of the field of view", "portrait 3:4", "square", "wide 16:9")
    assert all(rows[name][4] < 1.15 * rows[name][0] for name in well)
    text = " ".join((STUDIES.parent / "docs" / "deployment.md").read_text().split())
    near = rows["four fifths of the field of view"]
    assert f"is {near[4]:.3f} at four fifths of the field of view ({near[1]:.3f} without)" in text
    assert f"{camera:.3f} at half ({without:.3f} without) and {whole:.3f} on whole images" in text


def test_every_result_of_a_study_can_be_read() -> None:
    files = sorted(STUDIES.glob("**/test/*/metrics.json"))
    assert len(files) > 15
    for file in files:
        assert read_metrics(file.parents[2], file.parent.name)["abs_rel"] > 0
        if (file.parent / "per_image.csv").exists():  # then it belongs to the metrics
            find_result(file.parent, file.parent.name)


def test_the_studies_stay_small() -> None:
    assert sum(file.stat().st_size for file in STUDIES.rglob("*") if file.is_file()) < LIMIT_BYTES


def test_links_of_the_studies_lead_somewhere() -> None:
    for page in STUDIES.rglob("*.md"):
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text()):
            assert target.startswith("https://") or (page.parent / target).exists(), f"{page}: {target}"


def load(script: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(script.stem, script)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_tables_of_sweeps() -> None:
    publish = load(STUDIES / "publish.py")
    documents = sorted(STUDIES.glob(f"*/*/{publish.REPORT}"))
    assert {file.parent.name for file in documents} >= {"loss_terms", "badcl_reading", "attention"}
    for file in documents:
        _, table, _ = (file.parents[1] / "README.md").read_text().split(f"<!-- {file.parent.name} -->\n")
        assert table.strip() == publish.table(json.loads(file.read_text()))


def test_no_study_names_folders_of_the_machine_it_ran_on() -> None:
    suffixes = TEXTS
    for file in STUDIES.rglob("*"):
        if file.suffix in suffixes:
            assert not re.search(r"/(root|work|home)/", file.read_text()), file


def test_time_to_accuracy() -> None:
    study = STUDIES / "time_to_accuracy"
    table = load(study / "table.py").table()
    assert (study / "README.md").read_text().split("<!-- table -->\n")[1].strip() == table
    share = float(table.splitlines()[-1].split("|")[-2])
    assert 0 < share < 0.5


def test_what_paid_is_what_the_studies_say() -> None:
    study = STUDIES / "what_paid"
    text = (study / "README.md").read_text()
    assert text.split("<!-- table -->\n")[1].strip() == load(study / "table.py").table()
    assert "3.6 % off" in text
    assert "took 3.6 % off" in (STUDIES / "strong_official" / "README.md").read_text()
    flipped, plain = (read_metrics(STUDIES / "protocols", name)["abs_rel"] for name in ("eigen_flip", "eigen"))
    assert f"[abs_rel {flipped:.3f} instead of {plain:.3f}]" in text


def test_equal_budget() -> None:
    study = STUDIES / "equal_budget"
    document = json.loads((study / "compare" / "compare.json").read_text())
    assert (study / "README.md").read_text().split("<!-- table -->\n")[1].strip() == load(study / "table.py").table(
        document
    )
    seen = {}
    for name in ("badcl", "strong"):
        with (study / name / "times.csv").open() as file:
            seen[name] = int(list(csv.DictReader(file))[-1]["images"])
    with (STUDIES / "strong_official" / "pretrain" / "times.csv").open() as file:
        seen["strong"] += int(list(csv.DictReader(file))[-1]["images"])
    assert seen == {"badcl": 41_880, "strong": 41_886}


def test_what_the_readme_says_of_the_recipes() -> None:
    readme = (STUDIES.parent / "README.md").read_text()
    document = json.loads((STUDIES / "equal_budget" / "compare" / "compare.json").read_text())
    row = document["metrics"]["abs_rel"]
    assert f"test abs_rel is {-100 * row['difference'] / row['a']:.1f} % lower" in readme
    assert document["metrics"]["edge_f1_0.25"]["verdict"] == "b better"
    paper = read_metrics(STUDIES / "badcl_official", "eigen")
    assert f"reaches abs_rel {paper['abs_rel']:.3f} and delta1 {paper['delta1']:.3f}" in " ".join(readme.split())


def test_the_model_that_comes_along_is_the_run_of_its_study() -> None:
    study = STUDIES / "strong_official"
    said = json.loads((study / "nyu" / "metrics" / "eigen.json").read_text())
    assert (
        said["metrics"]["model"]
        == json.loads((study / "test" / "eigen" / "metrics.json").read_text())["metrics"]["model"]
    )
    assert len(json.loads((study / "scored.json").read_text())) == 1  # its test images were looked at once
    assert (study / "nyu" / "model.safetensors").stat().st_size < 10_000_000


def test_what_the_study_of_the_model_that_comes_along_says_of_its_trainings() -> None:
    study = STUDIES / "strong_official"
    text = " ".join((study / "README.md").read_text().split())
    first, second = (read_history(study / name / "metrics.csv") for name in ("first", "second"))
    # only epochs at full size can be best: those after the 39th of the first, and all of the second
    best = [min(rows, key=lambda row: row["val/abs_rel"]) for rows in (first[39:], second)]
    for row in best:
        assert f"| {row['val/abs_rel']:.4f} | {row['val/delta1']:.3f} |" in text
    gained = 1 - best[1]["val/abs_rel"] / best[0]["val/abs_rel"]
    assert f"again took {100 * gained:.1f} % off its abs_rel" in text
    assert f"was at validation delta1 {first[38]['val/delta1']:.3f} (epoch 39)" in text
    assert f"to {best[0]['val/delta1']:.3f} at the best abs_rel and to {first[59]['val/delta1']:.3f} after" in text
    half = read_history(study / "encoder_rate" / "half.csv")
    faster, slower = (min(row["val/abs_rel"] for row in rows[: len(half)]) for rows in (half, first))
    assert f"was at validation abs_rel {faster:.3f} at best when it was stopped after {len(half)}" in text
    assert f"the first training at {slower:.3f} by then" in text
    fifth, last = second[4], second[-1]
    assert f"falls from {fifth['val/abs_rel']:.3f} to {last['val/abs_rel']:.3f}" in text
    assert f"training loss by {100 * (1 - last['train/loss/total'] / fifth['train/loss/total']):.0f} %" in text
    before, third, now = (read_metrics(study / name, "eigen") for name in ("first", "third", "."))
    for each in (before, third):
        assert f"abs_rel {each['abs_rel']:.3f}, delta1 {each['delta1']:.3f})" in text
    edges = (
        "F1 at 0.25 was {:.3f} after the first training and {:.3f} after the third. - **A loss of depth edges did.** "
        "In the last training it raised that to {:.3f}, and rmse is lower"
    )
    assert edges.format(*(each["edge_f1_0.25"] for each in (before, third, now))) in text
    compared = json.loads((study / "compare" / "compare.json").read_text())["metrics"]
    assert {compared[name]["verdict"] for name in ("rmse", "edge_f1_0.25")} == {"b better"}
    longer = read_history(STUDIES / "edge_loss" / "before" / "metrics.csv")
    reached = [min(row["val/abs_rel"] for row in rows) for rows in (longer, second)]
    assert f"{len(longer)} epochs from the same weights reached [validation abs_rel {reached[0]:.3f}]" in text
    assert f"{len(second)} epochs {reached[1]:.3f}." in text
    paper = read_metrics(STUDIES / "badcl_official", "eigen")
    assert f"Abs_rel is {100 * (1 - now['abs_rel'] / paper['abs_rel']):.0f} % lower" in text
    chosen = json.loads((study / "nyu" / "config.json").read_text())["epoch"]
    for folder, beyond in ((study / "third", 1), (study, 0)):
        losses = [row["train/loss/total"] for row in read_history(folder / "metrics.csv")]
        assert losses.index(min(losses)) + 1 == len(losses) - beyond
    assert chosen == len(losses)


def test_what_the_study_of_the_network_for_cpus_says() -> None:
    study = STUDIES / "lite_official"
    text = " ".join((study / "README.md").read_text().split())
    now, flipped, before = (
        read_metrics(study / folder, protocol)
        for folder, protocol in ((".", "eigen"), (".", "eigen_flip"), ("fourth", "eigen"))
    )
    said = ", ".join(f"{name} {flipped[name]:.3f}" for name in ("abs_rel", "rmse", "delta1"))
    assert f"[with the flip](test/eigen_flip/metrics.json): {said})" in text
    assert f"rmse of all pixels at once is {now['rmse_pooled']:.3f} m" in text
    paper = read_metrics(STUDIES / "strong_official", "eigen")
    assert f"(abs_rel {paper['abs_rel']:.3f}, delta1 {paper['delta1']:.3f})" in text
    edges = [each["edge_f1_0.25"] for each in (now, paper, before)]
    assert "F1 at 0.25 is {:.3f}, that network's {:.3f}, and that of the fourth training {:.3f}".format(*edges) in text
    compared = json.loads((study / "compare_edges" / "compare.json").read_text())["metrics"]
    assert {compared[name]["verdict"] for name in ("rmse", "delta1", "edge_f1_0.25")} == {"b better"}
    scratch = read_history(study / "from_scratch" / "metrics.csv")
    best = min(row["val/abs_rel"] for row in scratch)
    assert f"was at validation abs_rel {best:.3f} after {len(scratch)} of 52 epochs" in text
    for folder, said in (("fourth", "the fourth's are of epoch {} of {}"), (".", "the last's of epoch {} of {}")):
        losses = [row["train/loss/total"] for row in read_history(study / folder / "metrics.csv")]
        assert said.format(losses.index(min(losses)) + 1, len(losses)) in text
    said_again = json.loads((study / "nyu_lite" / "metrics" / "eigen.json").read_text())["metrics"]["model"]
    assert said_again["abs_rel"] == now["abs_rel"]
    assert len(json.loads((study / "scored.json").read_text())) == 1


def test_no_further_option_helps_beyond_scenes() -> None:
    page = (STUDIES / "lite_options" / "README.md").read_text()
    for marker, count in (("short", 9), ("late", 2)):
        rows = page.split(f"<!-- {marker} -->\n")[1].splitlines()
        changes = [line.split("|")[-3:-1] for line in rows if re.match(r"\| \w+ \| 0\.", line)][1:]
        assert len(changes) == count
        for cell in (cell for pair in changes for cell in pair):
            low, high = (float(end) for end in re.findall(r"[+-]\d\.\d+", cell)[1:])
            assert low <= 0 <= high


def test_what_the_study_of_the_loss_of_edges_says() -> None:
    page = (STUDIES / "edge_loss" / "README.md").read_text()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("| ")]
    head, table = rows[0], {row[0]: row for row in rows[1:]}
    before, after = (float(table[name][head.index("edge_f1_0.25")].split()[0]) for name in ("base", "edges"))
    assert f"at 0.25 rises by {100 * (after / before - 1):.0f} %" in page
    ends = {
        name: tuple(float(end) for end in re.findall(r"[+-]\d\.\d+", table["edges"][head.index(f"change of {name}")]))
        for name in ("abs_rel", "delta1", "dbe_acc_px", "edge_f1_0.25")
    }
    assert f"abs_rel rises by {ends['abs_rel'][0]:.3f}" in page
    assert ends["delta1"][1] <= 0 <= ends["delta1"][2]
    assert ends["dbe_acc_px"][2] < 0 < ends["edge_f1_0.25"][1]


def test_the_estimate_of_long_trainings_follows_from_what_was_measured() -> None:
    page = (STUDIES.parent / "docs" / "scale.md").read_text()
    assert page.split("<!-- estimate -->\n")[1].strip() == load(STUDIES / "speed" / "scale_estimate.py").estimate()
