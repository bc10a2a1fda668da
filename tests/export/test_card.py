from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from huggingface_hub import ModelCard

from hudepth.export.card import model_card
from hudepth.inference.model_info import ModelInfo
from hudepth.runs.checkpoint import load_checkpoint


def test_a_card_of_an_untested_model_says_so(tiny: Path) -> None:
    checkpoint = load_checkpoint(str(tiny))
    card = model_card(
        checkpoint, ModelInfo.of_checkpoint(checkpoint, parameters=1), name="x", results={}, parity="the same"
    )
    assert "`hudepth-test`" in card
    assert "## Samples" not in card


def test_a_card_names_what_came_before_and_each_loss_of_a_mixture(tiny: Path) -> None:
    checkpoint = load_checkpoint(str(tiny))
    checkpoint = replace(
        checkpoint,
        data={**checkpoint.data, "before": [{"source": "rooms", "pairs": 8000}]},
        config={
            **checkpoint.config,
            "loss": {
                "_target_": "hudepth.losses.mixture.Mixture",
                "losses": {name: {"_target_": f"hudepth.losses.{name}"} for name in ("SILog", "BADCL", "BerHu")},
                "weights": {"SILog": 1.0, "BADCL": 0.3, "BerHu": 0},
            },
        },
    )
    card = model_card(
        checkpoint, ModelInfo.of_checkpoint(checkpoint, parameters=1), name="x", results={}, parity="", half=True
    )
    assert "| trained before on | rooms, 8000 pairs |" in card
    assert "| loss | 1 SILog + 0.3 BADCL |" in card
    assert "- onnx" not in card


def test_a_card_has_each_metric_with_its_unit_and_interval(tiny: Path) -> None:
    checkpoint = load_checkpoint(str(tiny))
    result = {
        "images": 7,
        "metrics": {"model": {"abs_rel": 0.1234, "rmse": 0.5, "delta1": 0.9}},
        "intervals": {"model": {"abs_rel": [0.1, 0.2], "rmse": [None, None]}},
    }
    info = ModelInfo.of_checkpoint(checkpoint, parameters=1)
    card = model_card(checkpoint, info, name="x", results={"eigen": result}, parity="", samples=2, origin="rooms")
    assert "| protocol | images | abs_rel | rmse [m] | delta1 |" in card
    assert "| eigen | 7 | 0.123 [0.100, 0.200] | 0.500 | 0.900 |" in card
    assert card.count("](samples/") == 2


def test_the_hub_reads_the_results_of_a_card(tiny: Path) -> None:
    checkpoint = load_checkpoint(str(tiny))
    result = {"images": 7, "metrics": {"model": {"abs_rel": 0.1234, "rmse": 0.5, "delta1": 0.9, "log10": None}}}
    info = ModelInfo.of_checkpoint(checkpoint, parameters=1)
    text = model_card(
        checkpoint, info, name="x", results={"eigen": result}, parity="", address="hf:owner/x",
    )  # fmt: skip
    data = ModelCard(text).data
    assert (data.library_name, data.pipeline_tag, data.model_name) == ("hudepth", "depth-estimation", "x")
    assert data.tags == ["depth-estimation", "monocular-depth", "hudepth"]
    found = {each.metric_type: each for each in data.eval_results}
    assert {name: each.metric_value for name, each in found.items()} == {"abs_rel": 0.1234, "rmse": 0.5, "delta1": 0.9}
    assert found["rmse"].metric_name == "rmse [m]"
    assert found["rmse"].dataset_name == f"{checkpoint.data['source']}, protocol eigen"
    assert 'hudepth.load("hf:owner/x")' in text
