from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from hudepth import cli
from hudepth.base import verbs, wording
from hudepth.base.errors import ConfigError
from hudepth.base.verbs import commands, conf_folder
from hudepth.help import help_text
from tests.commands import Command, script
from tests.terminal import assert_fits

BIN = Path(sys.executable).parent


def run(task: str, *arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(BIN / f"hudepth-{task}"), *arguments], cwd=cwd, text=True, capture_output=True, check=False
    )


@pytest.mark.parametrize(
    ("task", "arguments", "message"),
    [
        ("train", ["model.attention_headz=3"], "no key 'model.attention_headz'. Did you mean 'model.attention_heads'?"),
        ("train", ["trainer.max_epoch=3"], "no key 'trainer.max_epoch'. Did you mean 'trainer.max_epochs'? See"),
        ("train", ["loss=silog", "loss.variance_focuss=1"], "no key 'loss.variance_focuss'. Did you mean "),
        ("test", ["checkpoint=x", "model=hybrid_unet"], "no key 'model'. See hudepth-test --cfg job for all keys."),
        ("report", ["figures", "data=rooms"], "no key 'data'. See hudepth-report --cfg job for"),
        ("predict", ["--input=x"], "unrecognized arguments: --input=x. Pass input=x, without dashes."),
        ("predict", ["--input", "x"], "unrecognized arguments: --input. Pass input=x, without dashes."),
        ("predict", ["--batch-size", "4"], "unrecognized arguments: --batch-size. Pass batch_size=4, without"),
        ("predict", ["photos"], "'photos': its key is missing. Pass input=photos."),
        ("predict", ["checkpoint=nuy"], "checkpoint: no file or run directory 'nuy'. Did you mean 'nyu'? Pass"),
        ("predict", [], "input is not set. Pass input=<image | folder | video | camera>."),
        ("export", ["--checkpoint", "last"], "unrecognized arguments: --checkpoint. Pass checkpoint=last, without"),
        ("export", ["checkpoint=lsat"], "checkpoint: no file or run directory 'lsat'. Did you mean 'last'? Pass"),
        ("bench", ["--model=tiny"], "unrecognized arguments: --model=tiny. Pass model=tiny, without dashes."),
        ("bench", ["checkpoint=nuy"], "checkpoint: no file or run directory 'nuy'. Did you mean 'nyu'? Pass"),
        ("demo", ["--port", "8000"], "unrecognized arguments: --port. Pass port=8000, without dashes."),
        ("data", ["info", "--data", "rooms"], "unrecognized arguments: --data rooms. Pass data=rooms, without"),
        ("data", ["calibrate", "camera=fof=62"], "camera: 'fof=62' is not a camera. Pass camera=auto,"),
        ("report", ["table", "--runs", "a"], "unrecognized arguments: --runs a. Pass runs=a, without dashes."),
        ("train", ["--epochs", "3"], "unrecognized arguments: --epochs. Pass trainer.max_epochs=3, without dashes."),
        ("train", ["-m", "--lr=1,2"], "unrecognized arguments: --lr=1,2. Pass optim.lr=1,2, without dashes."),
        ("train", ["--nonsense"], "unrecognized arguments: --nonsense. Write key=value, after flags such as"),
        ("test", ["last"], "'last': its key is missing. Pass checkpoint=last."),
        ("test", ["checkpoint=x", "protocol=[eigenn]"], "protocol: no 'eigenn'. Did you mean 'eigen'? Pass one of"),
        ("test", ["checkpoint=nuy"], "checkpoint: no file or run directory 'nuy'. Did you mean 'nyu'? Pass"),
        ("train", ["-x", "seed=1"], "unrecognized arguments: -x"),
        ("data", ["info", "-c"], "argument --cfg/-c: expected one argument. Write key=value"),
        ("test", ["-sc"], "--shell-completion: what is missing. Pass -sc install=bash"),
        ("report", ["-sc", "table"], "--shell-completion: what is missing."),
        ("data", ["info", "~data=1e308"], "data: no '1e308'. Pass one of densedepth,"),
        ("train", ["lss=l1"], "no key 'lss'. Did you mean 'loss'? See"),
        ("train", ["data=nyu_labelled"], "data: no 'nyu_labelled'. Did you mean 'nyu_labeled'? Pass one of de"),
        ("train", ["experiment=badcll"], "experiment: no 'badcll'. Did you mean 'badcl'? Pass one of badcl, demo,"),
        ("train", ["+experiment=demoo"], "experiment: no 'demoo'. Did you mean 'demo'? Pass one of badcl, demo,"),
        ("train", ["-m", "loss=l3,l4"], "loss: no 'l3'. Pass one of badcl, berhu, edges, gradient, image_scale, l1,"),
        ("train", ["just words"], "cannot read 'just words': write key=value, and quote values with"),
        ("test", [], "checkpoint is not set. Pass checkpoint=<file | run directory | last>, or predictions=<folder"),
        ("test", ["checkpoint=nowhere.ckpt"], "checkpoint: no file or run directory 'nowhere.ckpt'. Pass a "),
        ("test", ["checkpoint=last"], "checkpoint=last: no run with a checkpoint below 'runs'. Train one with"),
        ("data", [], "a verb is missing. Type hudepth-data followed by prepare or info or audit or download or "),
        ("data", ["inf"], "no verb 'inf'. Did you mean 'info'? Type hudepth-data followed by prepare or "),
        ("data", ["prepare", "data=nyu_labeled"], "data.root is not set. Pass data.root=<"),
    ],
)  # fmt: skip
def test_a_mistake_gives_one_line_and_exit_code_1(
    task: str, arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    GlobalHydra.instance().clear()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [f"hudepth-{task}", *arguments])
    assert getattr(cli, task)() == 1
    captured = capfd.readouterr()
    lines = [line for line in captured.err.splitlines() if line]
    assert len(lines) == 1, captured.err
    assert lines[0].startswith(f"hudepth-{task}: {message}")
    assert "Traceback" not in captured.err + captured.out
    assert list(tmp_path.rglob("*")) == []  # a mistake leaves nothing behind


@pytest.mark.slow
def test_debug_shows_the_traceback(tmp_path: Path) -> None:
    done = run("test", "checkpoint=nowhere.ckpt", "debug=true", cwd=tmp_path)
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert "CheckpointError: checkpoint: no file" in done.stderr


@pytest.mark.parametrize("task", ["train", "test", "data"])
def test_help_is_our_own_and_loads_no_torch(task: str, tmp_path: Path) -> None:
    code = (
        f"import sys; from hudepth import cli; sys.argv[1:] = ['--help']; cli.{task}(); "
        "print('torch' in sys.modules, 'hydra' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, text=True, capture_output=True, check=True)
    assert done.stdout.splitlines()[-1] == "False False"
    assert f"hudepth-{task}" in done.stdout
    assert done.stdout.count("  hudepth-") >= 6  # the usage and five examples
    assert "nyu_labeled" in done.stdout


HIDDEN = {"verb"}
"""Keys that --help leaves out: the verb is the first word."""


@pytest.mark.parametrize("task", commands())
def test_help_lists_every_key_and_group(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = help_text(task)
    assert_fits(text, 80)
    text = text.partition("\nFlags\n")[0]
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(conf_folder()), version_base="1.3"):
        config = OmegaConf.to_container(compose(task))
    assert isinstance(config, dict)
    listed = set(re.findall(r"^  (\w+)(?:[.=]| {2,})", text, re.MULTILINE))
    assert set(config) - listed <= HIDDEN
    for key in set(re.findall(r"^  (\w+)=", text, re.MULTILINE)):
        assert key in config  # what is listed exists
        assert re.search(rf"^  {key}=\S*\s+[^\s=]", text, re.MULTILINE)  # and is explained
    for group in (each for each in options_of_groups(task) if each in listed):
        assert all(name in text for name in verbs.options_of(group))


def options_of_groups(task: str) -> list[str]:
    text = (conf_folder() / f"{task}.yaml").read_text(encoding="utf-8")
    return re.findall(r"^  - (\w+): ", text.partition("defaults:")[2], re.MULTILINE)


@pytest.mark.parametrize("flag", [("--cfg", "job"), ("-c", "job"), ("--info", "config"), ("--info",)])
@pytest.mark.parametrize("task", ["data", "report"])
def test_a_configuration_is_shown_without_a_verb(task: str, flag: tuple[str, ...], command: Command) -> None:
    done = command(task, *flag)
    assert done.code == 0, done.err
    assert "verb: ???" in done.out
    assert ("pairs: 200" if task == "data" else "repeats: 2000") in done.out
    assert command(task, "info" if task == "data" else "table", *flag).code == 0


def test_cfg_prints_the_configuration_without_torch(tmp_path: Path) -> None:
    code = (
        "import sys; from hudepth import cli; sys.argv[1:] = ['experiment=badcl', '--cfg', 'job']; cli.train(); "
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, text=True, capture_output=True, check=True)
    assert done.stdout.splitlines()[-1] == "False"
    assert "max_epochs: 100" in done.stdout
    assert list(tmp_path.iterdir()) == []


def completed(line: str, cwd: Path) -> list[str]:
    """Return what bash offers for a line once completion is installed as --help says; the cursor is at its end."""
    script = f"""
    PATH={BIN}:$PATH
    eval "$({line.split()[0]} -sc install=bash)"
    complete -p {line.split()[0]} | grep -q hydra_bash_completion || exit 3
    COMP_LINE={shlex.quote(line)} COMP_POINT={len(line)} COMP_CWORD={len(line.split(" ")) - 1}
    hydra_bash_completion
    printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    done = subprocess.run(["bash", "-c", script], cwd=cwd, text=True, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    return done.stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
@pytest.mark.parametrize(
    ("line", "offers"),
    [
        ("hudepth-train los", {"loss=", "loss."}),
        ("hudepth-train loss=", {"loss=badcl", "loss=silog"}),
        ("hudepth-train loss=silog loss.var", {"loss.variance_focus="}),
        ("hudepth-train -m init=2011_09_26 debug=true trainer.max", {"trainer.max_epochs="}),
        ("hudepth-test checkpoint=last protocol=kit", {"protocol=kitti_eigen"}),
        ("hudepth-predict checkpoint=(x sm", {"smoothing="}),
        ("hudepth-export form", {"format="}),
        ("hudepth-bench model=ti", {"model=tiny"}),
        ("hudepth-demo po", {"port="}),
        ("hudepth-data pre", {"prepare"}),
        ("hudepth-data ", {"audit", "data=", "pairs="}),
        ("hudepth-data audit data=nyu_l", {"data=nyu_labeled", "data=nyu_labeled_mat"}),
        ("hudepth-report com", {"compare"}),
        ("hudepth-report compare repe", {"repeats="}),
    ],
)
def test_tab_completion(line: str, offers: set[str], tmp_path: Path) -> None:
    found = completed(line, tmp_path)
    assert offers <= set(found)
    assert all(each.startswith(line.split(" ")[-1]) for each in found)


def test_a_verb_is_not_offered_twice(tmp_path: Path) -> None:
    assert "prepare" not in completed("hudepth-data audit p", tmp_path)


@pytest.mark.parametrize(
    ("task", "typed", "rewritten"),
    [
        ("train", ["experiment=x", "a.b=1"], ["+experiment=x", "a.b=1"]),
        ("train", ["+experiment=x", "sweep=y"], ["+experiment=x", "+sweep=y"]),
        ("train", ["loss=l1,l2", "-m", "seed=1"], ["-m", "loss=l1,l2", "seed=1"]),
        ("train", ["resume=x", "trainer.max_epochs=5"], ["resume=x", "++trainer.max_epochs=5"]),
        ("data", ["prepare", "data=rooms"], ["verb=prepare", "data=rooms"]),
        ("data", ["data=rooms", "info"], ["data=rooms", "verb=info"]),
        ("test", ["checkpoint=x", "data.root=y"], ["checkpoint=x", "++data.root=y"]),
        ("test", ["checkpoint=x", "data=rooms", "data.seed=1"], ["checkpoint=x", "data=rooms", "data.seed=1"]),
    ],
)
def test_rewrite(task: str, typed: list[str], rewritten: list[str]) -> None:
    assert cli.rewrite(task, typed) == rewritten


@pytest.mark.parametrize(
    "path",
    [
        "2011_09_26", "20240501_123456", "0", "1e5", "nan", "a=b", "a,b", "x (1)", "it's", "back\\", "a\\'b", "{x}",
        "x:y", "ü/é", "~/x", "*.png", "C:\\new",
    ],
)  # fmt: skip
def test_a_path_is_taken_as_it_is_typed(path: str) -> None:
    (rewritten,) = cli.rewrite("predict", [f"input={path}"])
    (override,) = OverridesParser.create().parse_overrides([rewritten])
    assert override.value() == path
    assert cli.rewrite("predict", ["threads=2", "scale_m=[0,5]"]) == ["threads=2", "scale_m=[0,5]"]


def test_lists_quotes_interpolations_and_sweeps_of_paths_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    typed = ["runs=[a,b]", "output='x'", "dir=${name}", "output=null", "images=true"]
    assert [cli.rewrite("data", ["verb=info", each])[1] for each in typed] == typed
    assert cli.rewrite("train", ["-m", "data.root=a,b"]) == ["-m", "data.root=a,b"]
    (tmp_path / "[1]").mkdir()
    assert cli.rewrite("predict", ["input=[1]"]) == ["input='[1]'"]


def test_several_choices_of_a_group_are_refused(command: Command) -> None:
    assert "hudepth-train: loss: takes one choice" in command("train", "loss=[l1,silog]").err


@pytest.mark.parametrize("value", ["-1.5", "null", "true", "[[1]]", "[null]", "{a:1}", "nan", "x" * 5000])
@pytest.mark.parametrize("group", ["model", "+optim", "protocol", "paths"])
def test_what_is_no_name_is_no_choice_of_a_group(group: str, value: str, command: Command) -> None:
    done = command("test", "checkpoint=nyu", f"{group}={value}")
    assert done.code == 1
    assert re.match(rf"hudepth-test: {group.lstrip('+')}: no '", done.err.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("paths.runs=[null]", "paths"),
        ("protocol.paper=-1", "protocol.paper"),
        ("distill._target_=x", "distill.teacher"),
        ("data.num_workers=100000", "data.num_workers"),
        ("data.source.scenes=1000000000", "data.source.scenes"),
        ("data.batch_size=99999999999999999999", "data.batch_size"),
    ],
)
def test_values_beyond_reason_are_refused_by_their_key(override: str, key: str, command: Command) -> None:
    done = command("train", override)
    assert done.code == 1
    assert done.err.splitlines()[-1].startswith(f"hudepth-train: {key}")
    assert "debug=true" not in done.err


def test_rewrite_refuses_an_unknown_verb() -> None:
    with pytest.raises(ConfigError, match=r"^no verb 'prepar'\. Did you mean 'prepare'\?"):
        cli.rewrite("data", ["prepar"])


def test_an_unforeseen_error_is_one_line_too() -> None:
    assert wording.one_line(KeyError("x"), "train") == "KeyError: 'x' (debug=true shows the traceback)"


@pytest.mark.parametrize("arguments", [["--help"], ["--cfg", "job"]])
def test_a_reader_that_leaves_early_is_no_error(arguments: list[str], tmp_path: Path) -> None:
    call: dict[str, Any] = dict(script("predict", *arguments, cwd=tmp_path, cache=tmp_path))
    with subprocess.Popen(**{**call, "stderr": subprocess.PIPE}) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141
