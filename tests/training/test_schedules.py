"""Schedules of the learning rate: values by hand, and that a checkpoint goes on exactly."""

from __future__ import annotations

import io
import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.optim import SGD

from hudepth.base.errors import ConfigError
from hudepth.training.schedules import StepSchedule, WarmupCosine


class Falling(StepSchedule):
    """From 1 to 0 along a line."""

    def factor(self, done: float) -> float:
        return 1 - done


def optimizer(*rates: float) -> SGD:
    return SGD([{"params": [nn.Parameter(torch.zeros(()))], "lr": rate} for rate in rates])


def rates_of(schedule: StepSchedule, steps: int) -> list[float]:
    """Return the factor that each step is taken with."""
    found = []
    for _ in range(steps):
        found.append(schedule.optimizer.param_groups[0]["lr"])
        schedule.optimizer.step()
        schedule.step()
    return found


def test_warm_up_by_hand() -> None:
    """Of 10 steps, 4 rise evenly up to 1; the other 6 are sixths of what follows."""
    rates = rates_of(Falling(optimizer(1.0), total_steps=10, warmup=0.4), 10)
    assert rates == pytest.approx([0.25, 0.5, 0.75, 1.0, 5 / 6, 4 / 6, 3 / 6, 2 / 6, 1 / 6, 0], abs=1e-12)


def test_without_a_warm_up() -> None:
    rates = rates_of(Falling(optimizer(1.0), total_steps=4), 4)
    assert rates == pytest.approx([0.75, 0.5, 0.25, 0])


def test_cosine_by_hand() -> None:
    schedule = WarmupCosine(optimizer(2.0), total_steps=10, warmup=0.2, final=0.1)
    wave = [math.cos(math.pi * k / 8) for k in range(9)]
    expected = [0.5, *(0.1 + 0.9 * (1 + x) / 2 for x in wave)]
    assert rates_of(schedule, 10) == pytest.approx([2 * x for x in expected])
    assert expected[1] == 1
    assert expected[5] == pytest.approx(0.55)  # half-way down
    assert expected[9] == pytest.approx(0.1)


def test_defaults_begin_low_and_end_at_a_hundredth() -> None:
    rates = rates_of(WarmupCosine(optimizer(1.0), total_steps=100), 100)
    assert rates[:5] == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    assert rates[-1] == pytest.approx(0.01)


@given(total=st.integers(1, 60), warmup=st.floats(0, 0.99), final=st.floats(0, 1))
def test_rates_rise_then_fall_and_stay_at_the_end(total: int, warmup: float, final: float) -> None:
    schedule = WarmupCosine(optimizer(1.0), total_steps=total, warmup=warmup, final=final)
    rates = rates_of(schedule, total + 5)
    peak = rates.index(max(rates))
    assert rates[: peak + 1] == sorted(rates[: peak + 1])
    assert rates[peak:] == sorted(rates[peak:], reverse=True)
    assert peak <= warmup * total + 1e-6
    assert all(0 <= rate <= 1 for rate in rates)
    assert rates[max(0, total - 1) :] == pytest.approx([final] * (len(rates) - max(0, total - 1)))


def test_groups_keep_their_proportion() -> None:
    opt = optimizer(1.0, 0.3)
    schedule = WarmupCosine(opt, total_steps=20, warmup=0.25)
    for _ in range(20):
        first, second = (group["lr"] for group in opt.param_groups)
        assert second == pytest.approx(0.3 * first)
        opt.step()
        schedule.step()


def plain(value: Any) -> bool:
    if isinstance(value, dict):
        return all(isinstance(key, str) and plain(item) for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return all(plain(item) for item in value)
    return value is None or type(value) in (bool, int, float, str)


@given(before=st.integers(0, 30), warmup=st.floats(0, 0.9))
def test_a_checkpoint_goes_on_exactly(before: int, warmup: float) -> None:
    whole, broken = (WarmupCosine(optimizer(1.0, 0.5), total_steps=30, warmup=warmup) for _ in range(2))
    expected = rates_of(whole, 35)
    assert rates_of(broken, before) == expected[:before]
    assert plain(broken.state_dict())
    file = io.BytesIO()
    torch.save({"schedule": broken.state_dict(), "optimizer": broken.optimizer.state_dict()}, file)
    file.seek(0)
    saved = torch.load(file, weights_only=True)
    again = WarmupCosine(optimizer(1.0, 0.5), total_steps=30, warmup=warmup)
    again.optimizer.load_state_dict(saved["optimizer"])
    again.load_state_dict(saved["schedule"])
    assert rates_of(again, 35 - before) == expected[before:]
    assert again.get_last_lr() == whole.get_last_lr()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"warmup": 1.0}, "schedule.warmup: 1.0 is not a share of the training, in [0, 1)."),
        ({"warmup": -0.1}, "schedule.warmup: -0.1 is not a share of the training, in [0, 1)."),
        ({"warmup": math.nan}, "schedule.warmup: nan is not a share of the training, in [0, 1)."),
        ({"final": 1.5}, "schedule.final: 1.5 is not in [0, 1]."),
        ({"final": -0.5}, "schedule.final: -0.5 is not in [0, 1]."),
        ({"final": math.nan}, "schedule.final: nan is not in [0, 1]."),
    ],
)
def test_bad_shares_say_what_to_do(options: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        WarmupCosine(optimizer(1.0), total_steps=10, **options)
    assert str(caught.value) == message
