from __future__ import annotations

import socket

import pytest

from hudepth.base.errors import ConfigError
from hudepth.demo.server import free_port


def test_a_port_that_is_taken_is_an_error_with_a_fix() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"port: 127\.0\.0\.1:{port} .*in use.*port=0"):
            free_port("127.0.0.1", port)


def test_zero_is_any_port() -> None:
    assert free_port("127.0.0.1", 0) > 0


def test_a_host_must_be_an_address_of_this_machine() -> None:
    with pytest.raises(ConfigError, match=r"port: 192\.0\.2\.1:80"):  # an address that nobody has
        free_port("192.0.2.1", 80)
