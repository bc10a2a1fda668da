from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from hudepth.base.errors import HudepthError
from hudepth.report.ablation.cost import Cost, draw_cost, find_costs
from hudepth.report.ablation.estimates import Estimate, Interval
from tests.report.ablation.conftest import worked_out
from tests.report.ablation.synthetic import make_sweep


def test_four_times_the_pixels_cost_four_times_the_operations(tmp_path: Path) -> None:
    report = worked_out(make_sweep(tmp_path / "sweep", {"small": {}, "large": {"data.size": [64, 96]}}, seeds=1))
    small, large = find_costs(report, metric="abs_rel")
    assert (small.label, large.label) == ("small", "large")
    assert small.parameters == large.parameters > 0
    assert large.mult_adds == 4 * small.mult_adds
    assert large.estimate is report.rows[1].estimates["abs_rel"]


def test_networks_that_cost_the_same_are_not_compared(tmp_path: Path) -> None:
    report = worked_out(make_sweep(tmp_path / "sweep", {"a": {}, "b": {"optim.lr": 1}}, seeds=1))
    assert find_costs(report, metric="abs_rel") == []


def test_an_untrusted_network_is_not_built(tmp_path: Path) -> None:
    models = {"a": {}, "b": {"model": {"_target_": "os.system"}}}
    with pytest.raises(HudepthError, match=r"os\.system"):
        find_costs(worked_out(make_sweep(tmp_path / "sweep", models, seeds=1)), metric="abs_rel")


def test_cost_has_a_point_a_row_and_keeps_those_far_out_in_sight() -> None:
    def cost(label: str, mean: float) -> Cost:
        return Cost(
            label, 2_000_000, 3_000_000_000, Estimate({"1": mean}, mean, Interval(mean - 0.01, mean + 0.01), Interval())
        )

    figure = draw_cost([cost("a", 0.2), cost("b", 0.21), cost("c", 0.22), cost("d", 4.0)])
    FigureCanvasAgg(figure).draw()
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "b", "c", "d"]
    assert [text.get_text() for text in figure.axes[0].texts] == ["4.000"]
    assert [axis.get_xlabel() for axis in figure.axes] == [
        "parameters [millions]",
        "multiply-adds per image [billions]",
    ]
