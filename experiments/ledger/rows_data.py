"""Rows on data and loss: split, leakage, units, eps."""

from __future__ import annotations

from torch import Tensor

from experiments.ledger import tables
from experiments.ledger.bounds import largest_mean_depth_m, largest_rmse_m
from experiments.ledger.leakage import expected_share, share_next_to_training, split_frames
from experiments.ledger.row import Row, Sheet
from experiments.ledger.units import ERRORS, READINGS, Rooms, Score, scaling_at_eps
from hudepth.data.sources.plausible import INDOOR_MEDIAN_M
from hudepth.data.splits import Split

RIGHT, MISREAD = READINGS


def split_row() -> Row:
    """Sizes of the subsets."""
    counts = _split("random").summary()["counts"]
    found = (counts["train"], counts["val"], counts["test"])
    return Row(
        "split_counts",
        "Sizes of the random split",
        f"{' / '.join(f'{n:,}' for n in tables.SPLIT_COUNTS)} frames at 70 / 10 / 20 % (section 2.3)",
        f"{' / '.join(f'{n:,}' for n in found)} of {sum(found):,} frames",
        "hudepth.data.splits.make_split(kind=random) on that many names: int(0.7 n), int(0.1 n), the rest. The sum is "
        "also the number of training frames in the DenseDepth release of NYU Depth V2.",
        "holds" if found == tables.SPLIT_COUNTS else "contradicted",
        {"train": found[0], "val": found[1], "test": found[2]},
    )


def leakage_row(*, frames_per_scene: int = 128) -> Row:
    """Test frames whose neighbours in the video were trained on.

    Args:
        frames_per_scene: of the scene split it is compared with.
    """
    n, cells, values = tables.FRAMES, [], {}
    by_frame, by_scene = _split("random"), _split("scene", frames_per_scene=frames_per_scene)
    for within in (1, 2):
        expected = expected_share(tables.FRACTIONS[0], within=within)
        counted = share_next_to_training(by_frame, n=n, within=within)
        apart = share_next_to_training(by_scene, n=n, within=within, frames_per_scene=frames_per_scene)
        values[f"within_{within}"] = {"expected": expected, "counted": counted, "scene_split": apart}
        cells.append([str(within), f"{expected:.2%}", f"{counted:.2%}", f"{apart:.2%}"])
    one, two = values["within_1"], values["within_2"]
    header = ("within frames", "expected: 1 - 0.3^(2 within)", "counted, random split", "counted, scene split")
    return Row(
        "leakage",
        "Test frames are new to the network",
        "'A random split is used to separate the data' (section 2.3), whose frames are from continuous video; its test "
        "part stands for new images",
        f"{one['counted']:.1%} of the test frames have a training frame right before or after them, "
        f"{two['counted']:.1%} one at most two frames away (expected {one['expected']:.1%} and "
        f"{two['expected']:.1%}). Split by scene: {two['scene_split']:.0%}",
        f"The paper's split of {n:,} frame names in video order, seed {tables.SPLIT_SEED}, and a split by scenes of "
        f"{frames_per_scene} frames. A frame has two neighbours, each in training with chance 0.7. How alike such "
        "neighbours are depends on how the video was thinned: hudepth-data audit on your files says.",
        "contradicted" if one["counted"] > 0.5 else "holds",
        values,
        [Sheet("Test frames with a training frame of their scene close by", header, cells)],
    )


def ssim_and_loss_row(rooms: Rooms, scores: list[Score]) -> Row:
    """SSIM 0.998 and loss 0.0005 next to ARE 0.063."""
    paper, mean_depth_m = tables.PROPOSED, tables.MAX_DEPTH_M * float(rooms.unit_depth.mean())
    largest_m = {
        reading: largest_mean_depth_m(
            tables.LOSS_VAL,
            abs_rel=paper.abs_rel,
            boundary=tables.LOSS_WEIGHTS["boundary"],
            max_depth_m=tables.MAX_DEPTH_M / factor,  # in metres of true depth
        )
        for reading, factor in READINGS.items()
    }
    impossible = largest_m[RIGHT] < INDOOR_MEDIAN_M[0]
    lowest_loss = min(s.loss for s in scores if s.reading == RIGHT and s.prediction in ERRORS)
    return Row(
        "ssim_and_loss",
        "SSIM 0.998 and loss 0.0005 next to ARE 0.063",
        f"SSIM {tables.SSIM}, total loss {tables.LOSS_TRAIN} in training and {tables.LOSS_VAL} in validation "
        f"(section 4, figure 5), ARE {paper.abs_rel} (table 2); data range and window of SSIM not stated",
        f"On depth / 10 m, that validation loss and that ARE go together only at a mean depth below "
        f"{100 * largest_m[RIGHT]:.1f} cm; with 8-bit depth read as millimetres, below {largest_m[MISREAD]:.2f} m. "
        f"Predictions with that ARE on built-in rooms: {_in_words(scores, RIGHT)} rightly read, "
        f"{_in_words(scores, MISREAD)} misread",
        "The bound: loss >= 3 x mean absolute error, since the boundary weights are at least 1, and that error is ARE "
        f"times the error-weighted mean depth. The predictions: {len(rooms.unit_depth)} rendered rooms of "
        f"{rooms.unit_depth.shape[-2]} x {rooms.unit_depth.shape[-1]}, mean depth {mean_depth_m:.2f} m, whose "
        "statistics are not NYU's; truth x (1 + e), with e of three kinds scaled to the paper's ARE; BADCL with the "
        "paper's weights; SSIM with data range 1 and a Gaussian window of 11. The ARE is the test part's, the loss "
        "that of the validation part of the same random split. If figure 5 plots something else than the formula of "
        "section 3.3, none of this binds it.",
        "cannot be" if impossible else "contradicted" if lowest_loss > tables.LOSS_VAL else "holds",
        {
            "largest_mean_depth_m": largest_m,
            "rooms": {"frames": len(rooms.unit_depth), "mean_depth_m": mean_depth_m},
            "scores": [vars(score) for score in scores],
        },
        [_scores_sheet(scores)],
    )


def _in_words(scores: list[Score], reading: str) -> str:
    same_error = {s.prediction: s for s in scores if s.reading == reading and s.prediction in ERRORS}
    losses = [s.loss for s in same_error.values()]
    reached = [name for name, s in same_error.items() if round(s.ssim, 3) >= tables.SSIM]
    ssim = [s.ssim for s in same_error.values()]
    return (
        f"loss {min(losses):.4f} to {max(losses):.4f} ({min(losses) / tables.LOSS_VAL:.1f} times the paper's or more) "
        f"and SSIM {min(ssim):.3f} to {max(ssim):.3f} ({len(reached)} of {len(same_error)} kinds of error reach "
        f"{tables.SSIM}{': ' + ', '.join(reached) if 0 < len(reached) < len(same_error) else ''})"
    )


def _scores_sheet(scores: list[Score]) -> Sheet:
    paper = tables.PROPOSED
    cells = [
        [s.reading, s.prediction, f"{s.abs_rel:.3f}", f"{s.rmse_m:.4f}", f"{s.ssim:.4f}", f"{s.loss:.5f}"]
        for s in scores
    ]
    cells.append(
        [
            "the paper",
            "proposed",
            f"{paper.abs_rel}",
            f"{paper.rmse}",
            f"{tables.SSIM}",
            f"{tables.LOSS_TRAIN} to {tables.LOSS_VAL}",
        ]
    )
    header = ("depth read as", "prediction", "ARE", "RMSE [m as read]", "SSIM", "total loss")
    return Sheet("Predictions on built-in rooms under both readings of the depth files", header, cells)


def rmse_row(scores: list[Score]) -> Row:
    """RMSE 0.237 next to ARE 0.063."""
    paper, at = tables.PROPOSED, {(s.reading, s.prediction): s for s in scores}
    bounds = {
        reading: largest_rmse_m(paper.abs_rel, paper.deltas, max_depth_m=tables.MAX_DEPTH_M * factor)
        for reading, factor in READINGS.items()
    }
    right, misread = (at[reading, "smooth error"].rmse_m for reading in READINGS)
    fits_right, fits_misread = (paper.rmse <= bounds[reading] for reading in READINGS)
    metres = (
        "So RMSE is in true metres, whatever units the loss saw"
        if fits_right and not fits_misread
        else "So the pair does not tell one reading from the other"
    )
    return Row(
        "rmse_and_are",
        "RMSE 0.237 next to ARE 0.063",
        f"ARE {paper.abs_rel}, RMSE {paper.rmse}, delta1 {paper.delta1} (table 2), the unit of RMSE not stated",
        f"In metres the pair is plausible: a prediction on built-in rooms with that ARE has RMSE {right:.3f} m, and "
        f"{bounds[RIGHT]:.2f} m is possible. On misread depth, at most {tables.MAX_DEPTH_M * READINGS[MISREAD]:.3f} m, "
        f"it has {misread:.4f}, and more than {bounds[MISREAD]:.3f} is impossible. {metres}",
        "The largest RMSE that any data allow, given ARE, deltas and the largest depth (derived in "
        "bounds.py); and the RMSE of the prediction with smooth error of the row before, which depends "
        "on the rooms' depths.",
        "holds" if fits_right else "cannot be",
        {"largest_rmse_m": bounds, "rmse_on_rooms_m": {RIGHT: right, MISREAD: misread}},
    )


def eps_row(rooms: Rooms, prediction: Tensor) -> Row:
    """The constant of the scaling factor."""
    small, large = 1e-8, 1e8
    (s_small, term_small), (s_large, term_large) = (scaling_at_eps(rooms, prediction, eps=e) for e in (small, large))
    off = term_large < 0.01 * term_small
    return Row(
        "eps",
        "eps of the scaling factor",
        "'1 x 10 8' (section 4); the text at hand has lost its minus signs, the learning rate reads '1 x 10 4'",
        f"Taken as 1e8, s is {s_large:.2g} and the scaling term {term_large:.2g}: switched off. With 1e-8 they are "
        f"{s_small:.3f} and {term_small:.3f}, and the constant only prevents division by 0, as section "
        "3.2.3 says: the former is a misprint or a lost sign",
        "hudepth.losses.badcl.scaling_factor and scaling_loss on the built-in rooms, for a prediction of the paper's "
        "ARE.",
        "contradicted" if off else "holds",
        {"1e8": {"s": s_large, "term": term_large}, "1e-8": {"s": s_small, "term": term_small}},
    )


def _split(kind: str, *, frames_per_scene: int | None = None) -> Split:
    return split_frames(
        tables.FRAMES, kind=kind, fractions=tables.FRACTIONS, seed=tables.SPLIT_SEED, frames_per_scene=frames_per_scene
    )
