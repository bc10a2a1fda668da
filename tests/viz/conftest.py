"""The report that the pictures and the page are made of."""

from tests.lab.conftest import report, sweep, sweep_folder  # noqa: F401
