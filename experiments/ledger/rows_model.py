"""Rows on the network: its parameters, layers and cost, and its speed."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from experiments.ledger import tables
from experiments.ledger.architecture import compare_with_table_a1, meta_network, variants_of_text
from experiments.ledger.cost import mult_adds_by_hand, mult_adds_by_torchinfo_rule
from experiments.ledger.row import Row, Sheet, not_measured
from experiments.ledger.speed import Speed, inconsistencies, measure_speed
from hudepth.models.cost import counted_flops, parameters
from hudepth.models.hybrid_unet import HybridUNet


def parameters_row() -> Row:
    """Total number of parameters."""
    count = parameters(meta_network())
    return Row(
        "parameters",
        "Number of parameters",
        f"{tables.PARAMETERS:,}, all trainable (table A1); 4.6 million (section 4)",
        f"{count:,}, all trainable",
        "Sum of the sizes of all parameters of hudepth.models.hybrid_unet.HybridUNet() with its default options.",
        "holds" if count == tables.PARAMETERS else "contradicted",
        {"parameters": count},
    )


def table_a1_row() -> Row:
    """Every layer of table A1."""
    compared = compare_with_table_a1(meta_network())
    matching = sum(c.matches for c in compared)
    stated = sum(c.row.parameters or 0 for c in compared)
    cells = [
        [
            c.row.layer,
            f"`{c.row.module or 'HybridUNet'}`",
            _by(c.row.shape),
            ", ".join(map(_by, c.shapes)),
            "" if c.row.parameters is None else f"{c.row.parameters:,}",
            f"{c.parameters:,}",
            "yes" if c.matches else "**no**",
        ]
        for c in compared
    ]
    header = ("layer", "module here", "output, paper", "output, here", "parameters, paper", "here", "agree")
    return Row(
        "table_a1",
        "Layers of table A1",
        f"{len(compared)} rows with output shapes for a batch of {tables.TABLE_A1_BATCH}, most with parameters",
        f"{matching} of {len(compared)} rows agree in output shape and, where printed, parameters; "
        f"the printed parameters add up to {stated:,}",
        "A batch of the table's size goes through the network while hooks note what each module returns. Of a module "
        "that returns several maps (the encoder) the table prints one, which must be among them. Where the table "
        "leaves parameters blank, only the shape counts.",
        "holds" if matching == len(compared) and stated == tables.PARAMETERS else "contradicted",
        {"rows": len(compared), "matching": matching, "sum_of_printed_parameters": stated},
        [Sheet("Table A1, row by row", header, cells)],
    )


def text_row() -> Row:
    """Section 3.1 against table A1."""
    variant = variants_of_text()
    deep = variant["encoder to 7 x 7"] + variant["four transformer layers on it"]
    flat = variant["four layers on 14 x 14"]
    stated = sum(row.parameters or 0 for row in tables.TABLE_A1)
    fits = tables.PARAMETERS in (deep, flat)
    return Row(
        "text_against_table_a1",
        "Depth of the encoder, number of transformer layers",
        f"Section 3.1: five ResNet blocks down to {tables.TEXT_DEEPEST_PX} x {tables.TEXT_DEEPEST_PX}, then "
        f"{tables.TEXT_TRANSFORMER_LAYERS} transformer layers on the deepest features. Table A1: down to 14 x 14, two "
        "transformer blocks, one of them on a skip",
        f"The text's encoder and attention alone have {deep:,} parameters; four layers on table A1's 14 x 14 map give "
        f"{flat:,} in all. Both miss the stated {tables.PARAMETERS:,}, which table A1's rows add up to ({stated:,})",
        "Parameters of modules built for it: ResNet-18's layer4 behind the encoder, TransformerBlock(512) four times; "
        "and HybridUNet(attention=none) with TransformerBlock(256) four times. Table A1 is what hudepth builds.",
        "holds" if fits else "contradicted",
        {**variant, "text_without_decoder": deep, "sum_of_table_a1": stated},
    )


def cost_row() -> Row:
    """What one frame costs."""
    network = meta_network()
    image = torch.empty(1, 3, tables.SIDE_PX, tables.SIDE_PX, device="meta")
    flops, by_hand = counted_flops(network, image), mult_adds_by_hand()
    hand = sum(by_hand.values())
    ratio = tables.GFLOPS * 1e9 / flops
    fastest = max(row.images_per_s for row in tables.TABLE_3)
    stated_tflops, counted_tflops = tables.GFLOPS * fastest / 1000, flops * fastest / 1e12
    agree = abs(flops / 1e9 - tables.GFLOPS) < 0.005
    cells = [[name, f"{cost / 1e6:,.1f}"] for name, cost in by_hand.items()]
    return Row(
        "cost_of_a_frame",
        "Cost of one frame",
        f"{tables.MULT_ADDS_G} G multiply-adds, {tables.GFLOPS} GFLOPs for one 224 x 224 frame (section 4)",
        f"{flops / 1e9:.2f} GFLOPs by PyTorch's counter, {2 * hand / 1e9:.2f} by hand ({hand / 1e9:.2f} G "
        f"multiply-adds): the paper's figure is {ratio:.1f} times too high. At table 3's {fastest:.0f} images/s it "
        f"would mean {stated_tflops:.0f} TFLOP/s, on a card whose float32 peak is {tables.RTX_4090_TFLOPS}; "
        f"{flops / 1e9:.2f} mean {counted_tflops:.1f}",
        "torch.utils.flop_counter.FlopCounterMode around one forward pass, with gradients on and attention's plain "
        "backend, since the counter does not see the fused paths. By hand from table A1's sizes alone: weights times "
        "pixels for convolutions, 12 c^2 n + 2 n^2 c for a transformer block of n tokens of width c. The card's peak "
        "is its maker's figure.",
        "holds" if agree else "contradicted",
        {
            "flops_pytorch": flops,
            "flops_by_hand": 2 * hand,
            "stated_over_counted": ratio,
            "implied_tflops_per_s": {"stated": stated_tflops, "counted": counted_tflops},
        },
        [Sheet("Multiply-adds of one frame by hand, in millions", ("layer", "multiply-adds"), cells)],
    )


def torchinfo_row() -> Row:
    """Where the paper's figure comes from."""
    batch = tables.TABLE_A1_BATCH
    image = torch.empty(batch, 3, tables.SIDE_PX, tables.SIDE_PX, device="meta")
    costs = mult_adds_by_torchinfo_rule(meta_network(), image)
    total, transposed = sum(costs.values()), costs["ConvTranspose2d"]
    agrees = f"{total / 1e9:.2f}" == f"{tables.MULT_ADDS_G:.2f}"
    cells = [[kind, f"{cost / 1e6:,.3f}"] for kind, cost in costs.items()]
    return Row(
        "total_mult_adds",
        "Where 43.02 G comes from",
        f"Total mult-adds (G): {tables.MULT_ADDS_G} (table A1, whose shapes begin with {batch})",
        f"The rule of the torchinfo package gives {total / 1e9:.2f} G for a batch of {batch}, or "
        f"{total / 1e9 / batch:.2f} G a frame. {transposed / total:.0%} of it is the transposed convolution, which "
        "the rule counts 4 times too much; multi-head attention it does not count",
        "A re-implementation of torchinfo's rule: every module without children costs its parameters times batch, and "
        "convolutions times output pixels as well. So the table's figure is right for what it is, the total of a "
        "batch, and section 4 quotes it as the cost of one frame.",
        "holds" if agrees else "contradicted",
        {"mult_adds_of_batch": total, "by_kind": costs, "batch": batch},
        [Sheet(f"Multiply-adds of a batch of {batch} by torchinfo's rule, in millions", ("kind", "mult-adds"), cells)],
    )


def table_3_row() -> Row:
    """Whether table 3 agrees with itself and with the text."""
    found = inconsistencies()
    text_holds = all(row.ms_per_image < 1 for row in tables.TABLE_3 if row.batch >= 4)
    lines = f"No disagreement in {len(tables.TABLE_3)} rows" if not found else "; ".join(found)
    return Row(
        "table_3_arithmetic",
        "Arithmetic of table 3",
        "Images/s, batches/s and ms/image at batch 1 to 32; under 1 ms for all batches of 4 or more (section 4)",
        f"{lines} beyond rounding; 'under 1 ms' {'agrees' if text_holds else 'disagrees'} with the table",
        "images/s = batch x batches/s and ms/image = 1000 / images/s, within what the printed digits round away.",
        "holds" if not found and text_holds else "contradicted",
        {"inconsistencies": found},
    )


def speed_row(*, batches: Sequence[int], seconds: float, device_name: str) -> Row:
    """Images per second on this device next to table 3.

    Args:
        batches: batch sizes; empty to leave it out.
        seconds: for each of them.
        device_name: of the device, for the reader.
    """
    claim, rows = "Images per second", {row.batch: row for row in tables.TABLE_3}
    first, last = tables.TABLE_3[0], tables.TABLE_3[-1]
    says = (
        f"{first.images_per_s:.0f} at batch {first.batch} to {last.images_per_s:.0f} at batch {last.batch} on one "
        "RTX 4090 (table 3)"
    )
    how = (
        "Float32, eval and inference mode, random images of 224 x 224 already on the device; one pass to warm up, then "
        "the median over the repeats; whatever else the device does at the time slows it. The paper does not state its "
        "precision, nor whether copying images counts."
    )
    if not batches:
        return not_measured("throughput", claim, says, why="left out by --no-throughput", how=how)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network = HybridUNet().eval().to(device)
    speeds = [measure_speed(network, batch=batch, seconds=seconds, device=device) for batch in batches]
    threads = "" if device.type == "cuda" else f", {torch.get_num_threads()} threads"
    cells = [_speed_cells(speed, rows.get(speed.batch)) for speed in speeds]
    header = ("batch", "images/s", "ms/image", "repeats", "paper, images/s", "paper, ms/image")
    paired = [(speed, rows[speed.batch]) for speed in speeds if speed.batch in rows]
    return Row(
        "throughput",
        claim,
        says,
        f"{', '.join(f'{s.images_per_s:.3g} at batch {s.batch}' for s in speeds)} on {device_name}{threads}",
        how,
        _speed_verdict(paired, device_name),
        {
            "device": device_name,
            "speeds": [
                {"batch": s.batch, "images_per_s": s.images_per_s, "ms_per_image": s.ms_per_image, "repeats": s.repeats}
                for s in speeds
            ],
        },
        [Sheet(f"Inference on {device_name}{threads}, next to table 3 (one RTX 4090)", header, cells)],
    )


def _speed_verdict(paired: Sequence[tuple[Speed, tables.SpeedRow]], device_name: str) -> str:
    if "4090" not in device_name or not paired:
        return "another device"
    # one card of a kind differs from another by clocks and driver
    return "holds" if all(s.images_per_s >= 0.8 * row.images_per_s for s, row in paired) else "contradicted"


def _speed_cells(speed: Speed, row: tables.SpeedRow | None) -> list[str]:
    own = [str(speed.batch), f"{speed.images_per_s:.2f}", f"{speed.ms_per_image:.3f}", str(speed.repeats)]
    return [*own, *(["", ""] if row is None else [f"{row.images_per_s:.2f}", f"{row.ms_per_image:.3f}"])]


def _by(shape: Sequence[int]) -> str:
    return " x ".join(map(str, shape))
