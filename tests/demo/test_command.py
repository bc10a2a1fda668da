from __future__ import annotations

import importlib.util
import re
import socket
from pathlib import Path
from typing import Any

import pytest

from tests.commands import Command


@pytest.mark.slow
@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("port=70000", "port: 70000 .* 65535"),
        ("port=x", "port: 'x' .* number"),
        ("max_upload_mb=0", "max_upload_mb: 0 .* above 0"),
        ("max_pixels=0", "max_pixels: 0 .* 40000000"),
        ("max_pixels=200000000", "max_pixels: 200000000 .* 100000000"),
        ("camera=[1,2]", r"camera: \[1,2\] .*fx,fy,cx,cy"),
        ("camera=[0,1,2,3]", "camera: .* camera"),
        ("fit=streched", "fit: 'streched' .* 'stretch'"),
        ("max_kept_mb=0", "max_kept_mb: 0 .* above 0"),
        ("allowed_hosts=[http://a.b/]", "allowed_hosts: 'http://a.b/' .* name"),
        ("allowed_hosts=['*']", "allowed_hosts: .* name"),
        ("prot=1", "'prot'.* 'port'"),
    ],
)
def test_mistakes_are_answered_in_a_line(command: Command, argument: str, words: str) -> None:
    pytest.importorskip("gradio", reason="gradio is not installed")
    result = command("demo", "checkpoint=model.ckpt", *(["port=0"] if "port" not in argument else []), argument)
    assert result.code == 1
    assert re.match(f"hudepth-demo: .*{words}", result.err)
    assert result.err.count("\n") == 1


def test_without_gradio_it_says_how_to_get_it(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    find: Any = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "gradio" else find(name))
    result = command("demo", "checkpoint=model.ckpt")
    assert result.code == 1
    assert result.err == "hudepth-demo: gradio is not installed. Run pip install 'hudepth[demo]'.\n"


def test_a_port_that_is_taken_is_said_before_anything_is_loaded(command: Command) -> None:
    pytest.importorskip("gradio", reason="gradio is not installed")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        result = command("demo", "checkpoint=model.ckpt", f"port={port}")
    assert result.code == 1
    assert result.err.startswith(f"hudepth-demo: port: 127.0.0.1:{port} is not available (")
    assert "port=0" in result.err


def test_a_checkpoint_must_be_there(command: Command, tmp_path: Path) -> None:
    pytest.importorskip("gradio", reason="gradio is not installed")
    assert "none.ckpt" in command("demo", "checkpoint=none.ckpt", "port=0").err


def test_help_needs_no_model(command: Command) -> None:
    result = command("demo", "--help")
    assert result.code == 0
    assert "hudepth-demo checkpoint=last" in result.out
