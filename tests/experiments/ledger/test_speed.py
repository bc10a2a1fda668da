from __future__ import annotations

import math

import torch
from torch import nn

from experiments.ledger.speed import Speed, inconsistencies, measure_speed
from experiments.ledger.tables import SpeedRow


def test_at_least_one_pass_is_timed_after_the_warm_up() -> None:
    seen = []
    network = nn.Identity()
    network.register_forward_hook(lambda _m, inputs, _o: seen.append(inputs[0].shape))
    speed = measure_speed(network, batch=3, seconds=0, device=torch.device("cpu"), side_px=16)
    assert seen == [(3, 3, 16, 16)] * 2
    assert (speed.batch, speed.repeats) == (3, 1)
    assert speed.ms_per_image > 0


def test_no_gradients_are_kept() -> None:
    inference = []
    network = nn.Conv2d(3, 1, 1)
    network.register_forward_hook(lambda *_: inference.append(torch.is_inference_mode_enabled()))
    measure_speed(network, batch=1, seconds=0, device=torch.device("cpu"), side_px=16)
    assert inference == [True, True]


def test_rate_from_time() -> None:
    assert math.isclose(Speed(batch=4, ms_per_image=4.0, repeats=1).images_per_s, 250.0)


def test_table_3_agrees_with_itself() -> None:
    assert inconsistencies() == []


def test_disagreements_are_found() -> None:
    rows = [SpeedRow(4, 1011.47, 252.87, 0.989), SpeedRow(8, 1087.35, 136.92, 0.920), SpeedRow(1, 250.0, 250.0, 4.01)]
    assert inconsistencies(rows) == [
        "batch 8: 136.92 batches/s are 1095.36 images/s",
        "batch 1: 250.0 images/s are 4.000 ms/image",
    ]
