from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from hudepth.bench.images import COUNT, images_file
from hudepth.bench.torch_runners import MATRIX, ReplayedRunner, TorchRunner, network, product
from hudepth.bench.worker import Spec
from hudepth.models.cost import counted_flops, image_flops
from hudepth.models.hybrid_unet import HybridUNet
from hudepth.models.inference import inference_form
from tests.devices import with_graphs


@pytest.fixture(scope="module")
def net() -> nn.Module:
    torch.manual_seed(0)
    return HybridUNet().eval()


@pytest.fixture(scope="module")
def spec(net: nn.Module, tmp_path_factory: pytest.TempPathFactory) -> Spec:
    folder = tmp_path_factory.mktemp("bench")
    torch.save(net.state_dict(), folder / "state.pt")
    model = {"_target_": "hudepth.models.hybrid_unet.HybridUNet"}
    options = {"model": model, "trust": [], "state": str(folder / "state.pt"), "size": (64, 64), "device": "cpu"}
    return Spec("any", "", images_file(folder, (64, 64)), 1, options)


@pytest.mark.slow
def test_all_forms_give_what_the_network_gives(spec: Spec, net: nn.Module) -> None:
    images = np.load(spec.images)
    assert images.shape == (COUNT, 3, 64, 64)
    assert np.abs(images).max() < 3
    with torch.inference_mode():
        expected = net(torch.from_numpy(images[:2])).numpy()
    forms = [{}, {"channels_last": True}, {"merged": True, "channels_last": True}]
    runners: list[TorchRunner] = [network(replace(spec, options={**spec.options, **form})) for form in forms]
    for runner in runners:
        runner.load(images[:2])
        runner.run()
        np.testing.assert_allclose(runner.result(), expected, atol=1e-5)
        assert runner.describe() == {}
        assert runner.peak_mb() > 20
    assert [runner.images.is_contiguous() for runner in runners] == [True, False, False]


def test_operations_are_those_of_the_counter_in_any_form(net: nn.Module) -> None:
    plain = image_flops(net, (64, 64))
    assert plain == counted_flops(net, torch.rand(1, 3, 64, 64))
    frozen = HybridUNet().eval().requires_grad_(requires_grad=False)  # as inference forms are
    assert image_flops(frozen, (64, 64)) == plain
    assert 0.7 * plain < image_flops(inference_form(net, size=(64, 64)), (64, 64)) < 0.9 * plain
    assert next(net.parameters()).device.type == "cpu"


def test_the_machine_is_measured(spec: Spec, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(MATRIX, "cpu", 256)  # a CPU that does not compute in bfloat16 takes minutes for a large one
    for precision in ("float32", "tf32", "bfloat16"):
        assert 0.1 < product(spec).matmul_gflop_per_s(precision) < 1e6


def test_replayed_passes_are_the_usual_ones(spec: Spec) -> None:
    images = np.load(spec.images)
    merged = {"merged": True, "channels_last": True}
    with with_graphs():
        for precision, most in (("float32", 0), ("tf32", 0), ("float16", 2**-10), ("bfloat16", 2**-7)):
            usual = network(replace(spec, options={**spec.options, **merged}))
            replayed = network(
                replace(spec, options={**spec.options, **merged, "replayed": True, "precision": precision})
            )
            assert isinstance(replayed, ReplayedRunner)
            for batch in (images[:2], images[2:5], images[:2]):
                for runner in (usual, replayed):
                    runner.load(batch)
                    runner.run()
                assert np.abs(replayed.result() - usual.result()).max() <= most


def test_images_are_written_once(tmp_path: Path) -> None:
    first = images_file(tmp_path, (32, 48))
    stamp = first.stat().st_mtime_ns
    assert images_file(tmp_path, (32, 48)).stat().st_mtime_ns == stamp
    assert np.load(first).shape == (COUNT, 3, 32, 48)
    assert len(np.unique(np.load(first).reshape(COUNT, -1).mean(axis=1))) == COUNT
