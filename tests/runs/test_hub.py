"""Publishing to, and loading from, a hub on this machine."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from huggingface_hub import ModelCard, constants

import hudepth
from hudepth.base.errors import CheckpointError, ConfigError
from hudepth.export.bundle import write_bundle
from hudepth.inference.model_info import ModelInfo
from hudepth.runs import bundles
from hudepth.runs.checkpoint import load_checkpoint
from hudepth.runs.hub import check_login, push
from tests.commands import script
from tests.hub import TOKEN, Hub, serve
from tests.networks import write_tiny_checkpoint

IMAGE = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    checkpoint = load_checkpoint(str(write_tiny_checkpoint(tmp_path_factory.mktemp("tiny") / "tiny.ckpt")))
    folder = tmp_path_factory.mktemp("bundle") / "tiny"
    info = ModelInfo.of_checkpoint(checkpoint, parameters=1)
    write_bundle(folder, checkpoint, info=info, onnx=None, card="# tiny\n", results={}, samples=[])
    return folder


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    with serve() as running:
        use(running.url, tmp_path / "cache", monkeypatch)
        yield running


def use(url: str, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Point huggingface_hub to another endpoint, with an empty cache and nobody logged in."""
    monkeypatch.setattr(constants, "ENDPOINT", url)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", url + "/{repo_id}/resolve/{revision}/{filename}")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(cache))
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(cache / "token"))
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.delenv("HF_TOKEN", raising=False)


def test_what_was_published_predicts_the_same(hub: Hub, bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    check_login("owner/depth")
    assert push(bundle, "owner/depth", private=True) == f"{hub.url}/owner/depth"
    assert set(hub.files["owner/depth"]) == {"README.md", "config.json", "model.safetensors"}
    assert hub.private == {"owner/depth": True}
    expected = hudepth.load(bundle, threads=1).predict(IMAGE)
    loaded = hudepth.load("hf:owner/depth", threads=1)
    assert loaded.predict(IMAGE) == expected
    commit = hub.commit_of("owner/depth")
    assert hudepth.load(f"hf:owner/depth@{commit}", threads=1).predict(IMAGE) == expected


def test_only_the_two_files_of_a_model_are_downloaded(hub: Hub, bundle: Path, tmp_path: Path) -> None:
    hub.files["owner/depth"] = {file.name: file.read_bytes() for file in bundle.glob("*.*")}
    hub.files["owner/depth"]["evil.py"] = b"raise SystemExit"
    hudepth.load("hf:owner/depth", threads=1)
    assert {path.name for path in tmp_path.rglob("snapshots/*/*")} == {"config.json", "model.safetensors"}


def test_without_a_network_the_cache_serves(
    hub: Hub, bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub.files["owner/depth"] = {file.name: file.read_bytes() for file in bundle.glob("*.*")}
    expected = hudepth.load("hf:owner/depth", threads=1).predict(IMAGE)
    use("http://127.0.0.1:1", tmp_path / "cache", monkeypatch)
    assert hudepth.load("hf:owner/depth", threads=1).predict(IMAGE) == expected
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    assert hudepth.load("hf:owner/depth", threads=1).predict(IMAGE) == expected


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("hf:owner/nothing", "checkpoint: 'hf:owner/nothing': .* no such model, or it is private.* HF_TOKEN"),
        ("hf:owner/secret", "checkpoint: 'hf:owner/secret': .* private.* hf auth login"),
        ("hf:owner/depth@v9", "checkpoint: 'hf:owner/depth@v9': .* no such revision"),
        ("hf:owner/other", "checkpoint: 'hf:owner/other' is not a bundle of hudepth.* config.json"),
        ("hf:owner/large", "checkpoint: 'hf:owner/large' is refused: its config.json is larger than 4 MiB"),
        ("hf:a b", "checkpoint: 'hf:a b' is no name of the Hub. Write hf:owner/name"),
        ("hf:../../etc", "checkpoint: 'hf:../../etc' is no name of the Hub"),
    ],
)
def test_a_model_that_cannot_be_had_is_one_line(hub: Hub, bundle: Path, spec: str, words: str) -> None:
    whole = {file.name: file.read_bytes() for file in bundle.glob("*.*")}
    hub.files |= {"owner/depth": whole, "owner/secret": whole, "owner/other": {"pytorch_model.bin": b""}}
    hub.files["owner/large"] = {**whole, "config.json": bytes(bundles.MAX_CONFIG_BYTES + 1)}
    hub.private["owner/secret"] = True
    with pytest.raises(CheckpointError) as error:
        hudepth.load(spec)
    assert re.match(words, str(error.value))
    assert "\n" not in str(error.value)


def test_the_option_that_names_the_model_is_said(hub: Hub) -> None:
    with pytest.raises(CheckpointError, match=r"^init: 'hf:owner/nothing': the Hub has no such model"):
        load_checkpoint("hf:owner/nothing", key="init")


def test_a_damaged_model_is_refused_like_any_file(hub: Hub, bundle: Path) -> None:
    config = (bundle / "config.json").read_bytes()
    hub.files["owner/depth"] = {"config.json": config, "model.safetensors": b"not tensors"}
    with pytest.raises(CheckpointError, match=r"model\.safetensors is damaged"):
        hudepth.load("hf:owner/depth")


def test_no_network_and_nothing_in_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use("http://127.0.0.1:1", tmp_path, monkeypatch)
    with pytest.raises(CheckpointError, match=r"'hf:owner/depth': the Hub does not answer \(.*refused\)\. Go online"):
        hudepth.load("hf:owner/depth")
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    with pytest.raises(ConfigError, match="push: 'owner/depth': the Hub does not answer"):
        check_login("owner/depth")


def test_who_may_publish(hub: Hub, bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"push: 'owner/depth': nobody is logged in .* HF_TOKEN"):
        check_login("owner/depth")
    monkeypatch.setenv("HF_TOKEN", "hf_of_a_stranger")
    with pytest.raises(ConfigError, match=r"push: 'owner/depth': the Hub refuses it \(401\)"):
        check_login("owner/depth")
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    with pytest.raises(ConfigError, match=r"push: 'stranger/depth': the Hub refuses it \(403\)"):
        push(bundle, "stranger/depth", private=False)
    with pytest.raises(ConfigError, match=r"push: 'depth' is no name of the Hub\. Write push=owner/name"):
        check_login("depth")


def test_without_huggingface_hub(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ConfigError, match=r"checkpoint: 'hf:owner/depth' needs huggingface_hub.*hudepth\[hub\]"):
        hudepth.load("hf:owner/depth")


@pytest.mark.slow
def test_publish_and_predict_from_the_command_line(tmp_path: Path) -> None:
    write_tiny_checkpoint(tmp_path / "tiny.ckpt")
    with serve() as hub:
        own = {"HF_ENDPOINT": hub.url, "HF_HOME": str(tmp_path / "hf"), "HF_TOKEN": TOKEN, "HF_HUB_DISABLE_XET": "1"}

        def run(task: str, *arguments: str, **changes: str) -> subprocess.CompletedProcess[str]:
            call = {**script(task, *arguments, cwd=tmp_path, cache=tmp_path / "cache"), "check": False}  # type: ignore[dict-item]
            call["env"] = {**os.environ, "OMP_NUM_THREADS": "1", **own, **changes}
            return subprocess.run(**call)  # type: ignore[call-overload,no-any-return]

        bundled = ("checkpoint=tiny.ckpt", "format=bundle", "half=true", "compared=3")
        refused = run("export", *bundled, "push=owner/tiny", HF_TOKEN="")
        assert refused.returncode == 1
        assert "hudepth-export: push: 'owner/tiny': nobody is logged in" in refused.stdout.splitlines()[-1]
        zipped = run("export", *bundled, "push=owner/tiny", "zip=true")
        assert zipped.stdout.splitlines()[-1].startswith("hudepth-export: push: the Hub takes a bundle's folder.")
        done = run("export", *bundled, "push=owner/tiny")
        assert done.returncode == 0, done.stdout
        assert f"published: {hub.url}/owner/tiny; use it as checkpoint=hf:owner/tiny" in done.stdout
        assert (
            json.loads((tmp_path / "export/export.json").read_text())["bundle"]["published"] == f"{hub.url}/owner/tiny"
        )
        card = ModelCard(hub.files["owner/tiny"]["README.md"].decode())
        assert card.data.library_name == "hudepth"
        assert "checkpoint=hf:owner/tiny" in card.content
        (tmp_path / "photos").mkdir()
        (tmp_path / "photos" / "0.jpg").write_bytes(hub.files["owner/tiny"]["samples/0.jpg"])
        predicted = run("predict", "checkpoint=hf:owner/tiny", "input=photos")
        assert predicted.returncode == 0, predicted.stdout
        assert [file.stem for file in (tmp_path / "predictions").glob("0*.npy")], predicted.stdout
