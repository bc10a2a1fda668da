from __future__ import annotations

from pathlib import Path

import pytest

from tests.networks import write_tiny_checkpoint


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkpoint of a tiny network with random weights."""
    return write_tiny_checkpoint(tmp_path_factory.mktemp("tiny") / "tiny.ckpt")
