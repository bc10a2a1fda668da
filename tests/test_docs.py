"""Every block of the README and of docs/ is executed; their figures must be those of the committed runs."""

from __future__ import annotations

import csv
import json
import re
import runpy
import shlex
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from hudepth import cli
from hudepth.base.verbs import conf_folder
from hudepth.data.sources import nyu

ROOT = Path(__file__).parents[1]
FILES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")))
PAGES = {path: path.read_text(encoding="utf-8") for path in FILES}
README = PAGES[ROOT / "README.md"]
TEXT = "\n".join(text for path, text in PAGES.items() if path.stem != "extending")  # tests/test_extending.py
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", TEXT, re.DOTALL)
COMMANDS = list(
    dict.fromkeys(line for language, block in BLOCKS if language == "bash" for line in block.strip().splitlines())
)
ORDER = ("train", "test", "export", "predict", "data", "report", "bench", "demo")
"""Of the commands, so that each finds what it needs."""

SMALL = [
    "data.size=[32,64]", "trainer.max_epochs=1", "trainer.accelerator=cpu", "data.batch_size=2", "callbacks.panels=0",
    "logger=none", "trainer.limit_train_batches=1", "trainer.limit_val_batches=1", "data.fractions=[0.6,0.2,0.2]",
]  # fmt: skip
"""Appended to training commands: the same commands, in seconds."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that has what the README's commands name: nyu with index.csv, mine with images and depths."""
    folder = tmp_path_factory.mktemp("readme")
    rng = np.random.default_rng(0)
    for kind in ("nyu", "mine/images", "mine/depths", "midas"):
        (folder / kind).mkdir(parents=True)
    rows = ["index,image,depth,scene,category,split,depth_scale_m,depth_offset"]
    for i in range(20):
        image, depth = rng.integers(0, 255, (48, 64, 3), np.uint8), rng.integers(100, 255, (48, 64), np.uint8)
        cv2.imwrite(str(folder / f"nyu/{i:05d}.jpg"), image)
        cv2.imwrite(str(folder / f"nyu/{i:05d}.png"), depth)
        np.save(folder / f"midas/{i:05d}.npy", 1 / (depth + 0.5).astype(np.float32))
        rows.append(f"{i},{i:05d}.jpg,{i:05d}.png,room_{i},room,{'train' if i < 12 else 'test'},0.01,0.5")
        cv2.imwrite(str(folder / f"mine/images/{i}.png"), image)
        cv2.imwrite(str(folder / f"mine/depths/{i}.png"), depth.astype(np.uint16) * 10)
    (folder / "nyu/index.csv").write_text("\n".join(rows) + "\n")
    write_mat(folder / "nyu/nyu_depth_v2_labeled.mat", rng)
    (folder / "photos").mkdir()
    for name in "abcdef":
        cv2.imwrite(str(folder / f"photos/{name}.jpg"), rng.integers(0, 255, (60, 90, 3), np.uint8))
    cv2.imwrite(str(folder / "photo.jpg"), rng.integers(0, 255, (200, 250, 3), np.uint8))
    film = cv2.VideoWriter(str(folder / "walk.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, (64, 48))
    for value in (20, 120, 220):
        film.write(np.full((48, 64, 3), value, np.uint8))
    film.release()
    return folder


def write_mat(path: Path, rng: np.random.Generator) -> None:
    """Write 20 pairs as NYU's labelled set has them."""
    with h5py.File(path, "w", userblock_size=512) as file:
        file["images"] = rng.integers(0, 255, (20, 3, 64, 48), np.uint8)
        file["depths"] = rng.uniform(1, 4, (20, 64, 48)).astype(np.float32)
        table = file.create_dataset("scenes", (1, 20), dtype=h5py.ref_dtype)
        for i in range(20):
            file[f"#refs#/{i}"] = np.frombuffer(f"room_{i:04d}".encode("utf-16-le"), np.uint16)[:, None]
            table[0, i] = file[f"#refs#/{i}"].ref


def shortened(command: str) -> list[str]:
    """Return the command with what makes it run in seconds and without a network."""
    words = command.split()
    if words[0] == "hudepth-bench":
        return [*words, "backends=[default]", "batches=[1]", "repeats=1", "seconds=0"]
    if words[0] == "hudepth-export":  # tests/export/test_command.py makes all formats
        return [word.replace("onnx,onnx_any_size,torch_export,openvino,int8", "onnx") for word in words]
    if words[0] != "hudepth-train" or {"--help", "--cfg"} & set(words) or "resume=" in command:
        return words
    rooms = [] if "data=" in command else ["data.source.scenes=6", "data.source.size=[48,64]"]
    weights = ["model.weights=none"] if re.search("experiment=(badcl|strong|pretrain|lite)", command) else []
    small = [word for word in SMALL if word != "logger=none" or "logger=" not in command]
    words = [word for word in words if not word.startswith("trainer.max_epochs")]
    if "+sweep=loss_terms" in words:  # a smaller one
        words = [word.replace("paper,l1,silog", "paper,l1").replace("1,2,3", "1,2") for word in words]
        small += ["protocol=eigen", "baselines=false"]
    elif "experiment=badcl" not in command:  # of which runs are compared
        small += ["test=false"]
    return words + small + rooms + weights


def check_demo(words: list[str], folder: Path) -> None:
    """Start the page, which goes on until it is ended, and end it."""
    command = [str(Path(sys.executable).parent / words[0]), *words[1:], "port=0"]
    with subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True) as page:
        assert page.stderr
        assert any("open http://127.0.0.1:" in line for line in page.stderr)
        page.send_signal(signal.SIGINT)
        page.stderr.read()
    assert page.returncode in (0, 130)


@pytest.mark.parametrize("command", [each for each in COMMANDS if each.startswith("hudepth-")])
def test_every_command_composes(command: str) -> None:
    script, *words = shlex.split(command)
    task = script.removeprefix("hudepth-")
    if not {"--help", "--cfg", "-m"} & set(words) and "resume=" not in command:
        GlobalHydra.instance().clear()
        with initialize_config_dir(str(conf_folder()), version_base="1.3"):
            first = [re.sub(r"^([\w.]+=[^\[{,]*),.*", r"\1", word) for word in words]  # of the values of a sweep
            assert compose(task, overrides=cli.rewrite(task, first))


def place(command: str) -> tuple[bool, int]:
    """Return when to run a command: last if it needs what another one of its page makes."""
    needs = any(word in command for word in ("resume=", "depths=photos_depth", "distill.teacher=taught"))
    return needs, next((i for i, task in enumerate(ORDER) if f"hudepth-{task}" in command), 9)


@pytest.mark.slow
def test_every_command_runs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("HUDEPTH_CACHE", str(folder / "cache"))
    monkeypatch.setattr(nyu, "COUNT", 20)
    monkeypatch.setattr(nyu, "official_test", lambda: frozenset(range(12, 20)))
    for command in sorted(COMMANDS, key=place):
        words = shortened(command)
        if not words or words[0] in ("source", "eval"):
            continue  # the tests run inside the environment; tests/test_cli.py completes in a real shell
        if words[0] == "make":
            subprocess.run(["make", "--dry-run", "--directory", str(ROOT), *words[1:]], check=True, capture_output=True)
            continue
        if "download" in words:
            continue  # 3 GB; tests/data/download has a server for it
        if words[0] == "hudepth-demo":
            check_demo(words, folder)
            continue
        if words[1].startswith("resume="):
            (run,) = (folder / "runs" / "badcl").iterdir()
            words = [words[0], f"resume={run}", "trainer.max_epochs=2"]
        if "compare" in words or "table" in words:
            tested = sorted(path.parents[2] for path in folder.glob("runs/*/*/test/eigen/metrics.json"))[:1]
            words = [re.sub(r"runs/badcl/[\d_-]+", str(tested[0]), word) for word in words]
            if "table" in words:  # which takes each run once
                words = [word.replace(f"{tested[0]},", "") for word in words]
        GlobalHydra.instance().clear()
        monkeypatch.setattr(sys, "argv", words)
        assert getattr(cli, words[0].removeprefix("hudepth-"))() == 0, command
    jobs = list(folder.glob("terms/*/status.json"))
    assert len(jobs) == 4
    assert all(json.loads(job.read_text())["state"] == "finished" for job in jobs)


@pytest.mark.slow
def test_the_python_of_the_pages(folder: Path) -> None:
    if not (folder / "export/model.onnx").exists():  # made by the commands of the pages
        export = Path(sys.executable).parent / "hudepth-export"
        subprocess.run([export, "checkpoint=nyu", "images=photos", "compared=1"], cwd=folder, check=True)
    code = "\n".join(block for language, block in BLOCKS if language == "python")
    code += "\nassert abs(hudepth.load('export/model.onnx').predict('photo.jpg').metres - depth_m).max() < 1e-5\n"
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, text=True, capture_output=True, check=True)
    *predicted, trained = done.stdout.splitlines()
    assert all(re.fullmatch(r"\(200, 250\) [\d.]+", line) for line in predicted)
    assert (folder / "points.ply").stat().st_size > 200 * 250 * 14
    assert re.fullmatch(r"\{'boundary': [\d.]+, 'smoothness': [\d.]+, 'scaling': [\d.]+\}", trained)


def test_all_blocks_are_of_a_kind_that_is_tested() -> None:
    assert {language for language, _ in BLOCKS} == {"bash", "python"}


def test_links_lead_somewhere() -> None:
    for page, text in PAGES.items():
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
            assert target.startswith("https://") or (page.parent / target).exists(), f"{page}: {target}"


def test_the_readme_fits_into_a_minute() -> None:
    assert README.count("\n") <= 135
    for page in (*(ROOT / "docs").glob("*.md"), *(ROOT / "docs").glob("*.ipynb")):
        assert f"(docs/{page.name})" in README


def test_the_results_are_those_of_the_run() -> None:
    run_folder = ROOT / "experiments" / "strong_official"
    metrics = json.loads((run_folder / "test" / "eigen" / "metrics.json").read_text())["metrics"]
    for name, values in metrics.items():
        row = re.search(rf"^\| {name.replace('_', ' ')} \|(.*)\|$", README, re.MULTILINE)
        assert row, name
        shown = [cell.strip() for cell in row[1].split("|")]
        assert shown == [f"{values[key]:.3f}" for key in ("abs_rel", "rmse", "log10", "delta1", "delta2", "delta3")]


def test_what_is_said_of_the_network_for_cpus_was_measured() -> None:
    studies = ROOT / "experiments"
    values = json.loads((studies / "lite_official" / "test" / "eigen" / "metrics.json").read_text())["metrics"]["model"]
    said = ", ".join(f"{name} {values[name]:.3f}" for name in ("abs_rel", "rmse", "delta1"))
    page = (studies / "speed" / "lite" / "bench.md").read_text()
    faster = re.search(r"lite is ([\d.]+) \(.*\) times as fast as HybridUNet in openvino", page)
    assert faster
    assert f"has {said}, and {faster[1]} times the speed in OpenVINO" in README


def test_the_speeds_are_those_of_the_benchmark() -> None:
    speed = ROOT / "experiments" / "speed"
    table = runpy.run_path(str(speed / "inference_table.py"))["table"]
    with (speed / "inference" / "bench.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert TEXT.split("<!-- speed -->\n")[1].strip() == table(rows)


def test_what_a_random_split_is_worth_is_what_the_study_found() -> None:
    rows = json.loads((ROOT / "experiments" / "split_leakage" / "rooms.json").read_text())["rows"]
    (same,) = [row["abs_rel"] for row in rows if row["what"] == "the same images"]
    said = re.search(r"abs_rel ([\d.]+) after a random split and ([\d.]+) after a split by scene", README)
    assert said
    assert said.groups() == tuple(f"{same[side][0]:.3f}" for side in ("random", "disjoint"))


@pytest.mark.parametrize("group", ["data", "protocol", "logger", "+sweep"])
def test_a_table_lists_every_choice(group: str) -> None:
    (table,) = re.findall(rf"^\| `{re.escape(group)}=` \|.*\n\|(?:---\|)+\n((?:\|.*\n)+)", TEXT, re.MULTILINE)
    listed = set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE))
    assert listed == {path.stem for path in (ROOT / "conf" / group.lstrip("+")).glob("*.yaml")} - {"base"}


def test_a_table_lists_every_extra() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(re.findall(r"^\| `(\w+)` \|", PAGES[ROOT / "docs" / "install.md"], re.MULTILINE)) == set(extras)


def test_make_help_lists_every_target() -> None:
    done = subprocess.run(["make", "help"], cwd=ROOT, text=True, capture_output=True, check=True)
    for target in ("help", "install", "demo", "test", "test-all", "lint", "docs", "ledger", "format", "lock", "clean"):
        assert re.search(rf"^{target}\s+\w", done.stdout, re.MULTILINE)


def test_the_version_is_said_once_everywhere() -> None:
    from hudepth import __version__

    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == __version__
