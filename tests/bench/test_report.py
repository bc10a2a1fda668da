from __future__ import annotations

import csv
import io
from dataclasses import asdict

from hudepth.bench.report import bench_table, to_csv, to_page
from tests.bench.test_rows import rows_of

MACHINE = {
    "processor": "P", "cores": 4, "usable_cores": 2, "memory_gb": 8.2, "instruction_sets": ["avx2"],
    "system": "Linux", "python": "3.11", "packages": {"torch": "2.6", "openvino": None},
}  # fmt: skip


def test_csv_has_every_column() -> None:
    rows = rows_of(eager=0.1, default=0.08)
    for read, row in zip(csv.DictReader(io.StringIO(to_csv(rows))), rows, strict=True):
        assert read == {key: "" if value is None else str(value) for key, value in asdict(row).items()}


def test_the_page_has_machine_table_and_notes() -> None:
    table = bench_table(rows_of(eager=0.1, default=0.00081), "T")
    page = to_page(table, machine=MACHINE, lines=["A.", "n"])
    assert page.startswith("# T\n")
    assert "On P, 4 cores of which 2 may be used, 8 GB, avx2; Linux, Python 3.11, torch 2.6." in page
    assert "On NVIDIA H200; P, 4 cores" in to_page(table, machine={**MACHINE, "gpu": "NVIDIA H200"}, lines=[])
    lines = [line for line in page.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in lines}) == 1
    assert "| 1 | default | 0.81 | 1235 |" in page
    assert page.endswith("- A.\n- n\n")
