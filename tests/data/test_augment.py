"""Augmentation: what moves pixels moves image and depth alike, and what zooms brings everything nearer."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from hudepth.base.errors import ConfigError
from hudepth.data.augment import Augmentation
from hudepth.data.transforms.colours import MAX_BLUR, blur, change_colours, cut_depth
from hudepth.data.transforms.warp import Geometry, _at_most_twice, resize, warp

EVERYTHING: dict[str, Any] = {
    "flip": 0.5, "zoom": (1.0, 2.0), "rotate_deg": 20.0, "border": 0.05, "gamma": (0.5, 2.0), "brightness": (0.5, 1.5),
    "contrast": (0.5, 1.5), "saturation": (0.0, 2.0), "tint": 0.2, "grey": 0.2, "noise": 0.2, "blur": 2.0,
    "cut_depth": 0.5,
}  # fmt: skip


def geometry(
    count: int = 1,
    *,
    zoom: float = 1.0,
    centre: tuple[float, float] = (0.0, 0.0),
    angle: float = 0.0,
    flip: bool = False,
) -> Geometry:
    return Geometry(
        zoom=torch.full((count,), zoom),
        centre=torch.tensor([centre] * count),
        angle=torch.full((count,), angle),
        flip=torch.full((count,), flip),
    )


def pair(seed: int = 0, *, count: int = 2, size: tuple[int, int] = (6, 8), depths: int = 1) -> tuple[Tensor, Tensor]:
    """Return an image and depths with holes."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(count, 3, *size, generator=generator)
    depth = 0.05 + torch.rand(count, depths, *size, generator=generator)
    return image, torch.where(torch.rand(depth.shape, generator=generator) < 0.2, 0.0, depth)


def axes(size: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return x and y of the pixels' centres, each from -1 to 1 between the image's edges."""
    y, x = (2 * (np.arange(side) + 0.5) / side - 1 for side in size)
    return np.meshgrid(x, y)


def looked_at(
    size: tuple[int, int], *, aspect: float, zoom: float, centre: tuple[float, float], angle: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where each pixel of a rolled, zoomed camera looks: x, y in the first picture, by rotating scene coordinates."""
    x, y = axes(size)
    rays = (aspect * x + 1j * y) / zoom * np.exp(1j * angle)  # y points down: a positive angle turns clockwise
    return rays.real / aspect + centre[0], rays.imag + centre[1]


def run(augmentation: Augmentation, image: Tensor, depth: Tensor, *, seed: int = 0, **options: Any) -> Any:
    options = {"size": tuple(image.shape[-2:]), "aspect": image.shape[-1] / image.shape[-2], **options}
    return augmentation(image, depth, generator=torch.Generator().manual_seed(seed), **options)


# --- moving pixels ----------------------------------------------------------------------------------------------


def test_no_change_is_the_input() -> None:
    image, depth = pair()
    moved, moved_depth = warp(image, depth, geometry(2), size=(6, 8), aspect=4 / 3)
    torch.testing.assert_close(moved, image, rtol=0, atol=1e-6)
    assert moved_depth.equal(depth)


def test_a_flip_mirrors_image_and_depth() -> None:
    image, depth = pair()
    one, two = warp(image, depth, geometry(2, flip=True), size=(6, 8), aspect=4 / 3)
    torch.testing.assert_close(one, image.flip(-1), rtol=0, atol=1e-6)
    assert two.equal(depth.flip(-1))
    one, two = warp(one, two, geometry(2, flip=True), size=(6, 8), aspect=4 / 3)
    torch.testing.assert_close(one, image, rtol=0, atol=1e-6)
    assert two.equal(depth)


def test_a_flip_comes_after_all_other_moves() -> None:
    image, depth = pair(size=(12, 16))
    move: dict[str, Any] = {"zoom": 1.7, "centre": (0.2, -0.1), "angle": 0.3}
    plain = warp(image, depth, geometry(2, **move), size=(9, 11), aspect=1.5)
    flipped = warp(image, depth, geometry(2, **move, flip=True), size=(9, 11), aspect=1.5)
    torch.testing.assert_close(flipped[0], plain[0].flip(-1), rtol=0, atol=1e-5)
    assert flipped[1].equal(plain[1].flip(-1))


def test_each_image_has_its_own_geometry() -> None:
    image, depth = pair(count=2, size=(8, 8))
    both = Geometry(
        torch.tensor([1.0, 2.0]), torch.tensor([[0, 0], [0.5, -0.5]]), torch.tensor([0.1, 0.0]),
        torch.tensor([True, False]),
    )  # fmt: skip
    together = warp(image, depth, both, size=(8, 8), aspect=1.0)
    for i in range(2):
        one = Geometry(both.zoom[i : i + 1], both.centre[i : i + 1], both.angle[i : i + 1], both.flip[i : i + 1])
        alone = warp(image[i : i + 1], depth[i : i + 1], one, size=(8, 8), aspect=1.0)
        assert all(a.equal(b[i : i + 1]) for a, b in zip(alone, together, strict=True))


@st.composite
def crops(draw: st.DrawFn) -> tuple[int, int, int, int, int]:
    """Return a zoom, a crop's height and width, and where it begins in an image that is as many times as large."""
    zoom, height, width = draw(st.sampled_from([2, 3])), draw(st.integers(2, 5)), draw(st.integers(2, 5))
    return zoom, height, width, draw(st.integers(0, (zoom - 1) * height)), draw(st.integers(0, (zoom - 1) * width))


@given(crop=crops(), seed=st.integers(0, 100))
def test_depth_is_the_crop_with_repeated_pixels_and_all_as_much_nearer(
    crop: tuple[int, int, int, int, int], seed: int
) -> None:
    zoom, height, width, top, left = crop
    size = (zoom * height, zoom * width)
    image, depth = pair(seed, count=1, size=size, depths=2)
    centre = ((2 * left + width) / size[1] - 1, (2 * top + height) / size[0] - 1)
    moved, found = warp(image, depth, geometry(zoom=float(zoom), centre=centre), size=size, aspect=2.0)
    part = depth[:, :, top : top + height, left : left + width].numpy()
    np.testing.assert_array_equal(found.numpy(), part.repeat(zoom, axis=2).repeat(zoom, axis=3) / np.float32(zoom))
    if top > 0 and left > 0 and top + height < size[0] and left + width < size[1]:  # cv2 repeats the crop's own edge
        around = image[0, :, top - 1 : top + height + 1, left - 1 : left + width + 1].permute(1, 2, 0).numpy()
        large = cv2.resize(around, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_LINEAR)[zoom:-zoom, zoom:-zoom]
        np.testing.assert_allclose(moved[0].permute(1, 2, 0), large, atol=1e-5)


def render(size: tuple[int, int], *, distance: float, aspect: float, focal: float) -> Tensor:
    """Photograph a painted wall that stands ``distance`` before a pinhole camera, at right angles to its axis."""
    x, y = axes(size)
    wall_x, wall_y = distance * aspect * x / focal, distance * y / focal
    colours = [np.sin(2 * wall_x + wall_y), np.cos(1.5 * wall_y), np.sin(wall_x * wall_y + 1)]
    return torch.from_numpy(0.5 + 0.4 * np.stack(colours)).float()[None]


@pytest.mark.parametrize("zoom", [1.0, 1.3, 2.0])
def test_a_zoom_is_what_the_same_camera_sees_of_a_nearer_wall(zoom: float) -> None:
    size, aspect, distance = (96, 128), 4 / 3, 2.0
    far = render(size, distance=distance, aspect=aspect, focal=1.2)
    near = render(size, distance=distance / zoom, aspect=aspect, focal=1.2)
    depth = torch.full((1, 1, *size), distance)
    moved, moved_depth = warp(far, depth, geometry(zoom=zoom), size=size, aspect=aspect)
    torch.testing.assert_close(moved, near, rtol=0, atol=2e-3)
    torch.testing.assert_close(moved_depth, torch.full_like(depth, distance / zoom))
    if zoom > 1:
        assert (moved - far).abs().max() > 0.1  # so that the wall's paint would show a zoom that is wrong


@given(
    zoom=st.floats(1.0, 3.0), angle=st.floats(-0.7, 0.7), x=st.floats(-0.4, 0.4), y=st.floats(-0.4, 0.4),
    aspect=st.sampled_from([0.5, 1.0, 4 / 3, 2.0]),
)  # fmt: skip
def test_a_roll_is_a_rotation_in_the_scene_even_where_images_are_stretched(
    zoom: float, angle: float, x: float, y: float, aspect: float
) -> None:
    """Pictures of coordinates, which linear interpolation hands on exactly: they tell where each pixel looks."""
    size, out = (24, 32), (20, 20)
    at_x, at_y = axes(size)
    picture = torch.from_numpy(np.stack([at_x, at_y, np.ones(size)])).float()[None]
    places = picture[:, :2] + 3  # as depth, which 0 would make unmeasured
    move = geometry(zoom=zoom, centre=(x, y), angle=angle)
    image, depth = (t[0].double().numpy() for t in warp(picture, places, move, size=out, aspect=aspect))
    want = np.stack(looked_at(out, aspect=aspect, zoom=zoom, centre=(x, y), angle=angle))
    edge = 1 - 1 / np.array([size[1], size[0]]).reshape(2, 1, 1)  # centre of the outermost pixels
    np.testing.assert_allclose(image[:2], want.clip(-edge, edge), atol=1e-5)  # beyond it, colours go on
    np.testing.assert_allclose(image[2], 1, atol=1e-5)
    margin = 1 - np.abs(want).max(axis=0)
    assert not depth[:, margin < -1e-5].any()  # beyond it, depth is unmeasured
    seen = margin > 1e-5
    nearest = np.abs(depth[:, seen] * zoom - 3 - want[:, seen])
    assert (nearest <= 1 / np.array([size[1], size[0]]).reshape(2, 1) + 1e-5).all()  # half a pixel away at most


@pytest.mark.parametrize("degrees", [-12.0, 5.0, 30.0])
def test_a_camera_rolled_clockwise_sees_the_scene_turned_counter_clockwise(degrees: float) -> None:
    size = (40, 60)
    y, x = np.mgrid[:40, :60]
    picture = np.stack([np.sin(x / 7), np.cos(y / 5), np.sin((x + 2 * y) / 9)], axis=2).astype(np.float32)
    turn = cv2.getRotationMatrix2D((29.5, 19.5), degrees, 1.0)  # positive is counter-clockwise
    expected = cv2.warpAffine(picture, turn, (60, 40), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    image = torch.from_numpy(picture.transpose(2, 0, 1))[None]
    move = geometry(angle=math.radians(degrees))
    moved, _ = warp(image, torch.ones(1, 1, *size), move, size=size, aspect=60 / 40)
    np.testing.assert_allclose(moved[0].permute(1, 2, 0), expected, atol=0.02)  # cv2 rounds to 1/32 of a pixel


@given(seed=st.integers(0, 1000))
def test_depths_are_never_mixed_and_holes_stay_holes(seed: int) -> None:
    image, depth = pair(seed, count=3, size=(12, 16))
    places = torch.where(depth > 0, torch.arange(1.0, 193.0).reshape(12, 16), 0.0)  # each pixel has its number
    augmentation = Augmentation(flip=0.5, zoom=(1, 3), zoom_depth=False, rotate_deg=30)
    _, moved = run(augmentation, image, places, seed=seed, size=(9, 10))
    for before, after in zip(places, moved, strict=True):
        numbers = after[after > 0]
        torch.testing.assert_close(numbers, numbers.round(), rtol=1e-5, atol=0)
        assert set(numbers.round().int().tolist()) <= set(before.int().unique().tolist())
    for hole in (torch.zeros_like(depth), torch.ones_like(depth)):
        _, moved = run(Augmentation(flip=0.5, zoom=(1, 3)), image, hole, seed=seed)
        assert (moved > 0).equal(hole > 0)


@given(seed=st.integers(0, 1000))
def test_image_and_depth_move_together(seed: int) -> None:
    size = (32, 48)
    x, y = (torch.from_numpy(axis).float() for axis in axes(size))
    image = torch.stack([(x + 1) / 2, (y + 1) / 2, torch.ones(size)])[None].repeat(4, 1, 1, 1)
    depth = image[:, :2] + 1
    augmentation = Augmentation(flip=0.5, zoom=(1, 2.5), zoom_depth=False, rotate_deg=40)
    moved, moved_depth = run(augmentation, image, depth, seed=seed)
    seen = (moved_depth > 0).all(dim=1)
    assert seen.float().mean() > 0.5
    apart = (moved_depth - 1 - moved[:, :2]).abs().permute(0, 2, 3, 1)[seen]
    assert (apart <= torch.tensor([0.5 / 48, 0.5 / 32]) + 1e-4).all()


# --- resizing ---------------------------------------------------------------------------------------------------


@given(
    factor=st.integers(2, 5), other=st.integers(1, 5), height=st.integers(1, 4), width=st.integers(1, 4),
    seed=st.integers(0, 100),
)  # fmt: skip
def test_resizing_means_blocks_of_the_image_and_picks_depths(
    factor: int, other: int, height: int, width: int, seed: int
) -> None:
    image, depth = pair(seed, size=(factor * height, other * width))
    small, small_depth = resize(image, depth, size=(height, width))
    blocks = image.double().numpy().reshape(2, 3, height, factor, width, other)
    np.testing.assert_allclose(small, blocks.mean(axis=(3, 5)), rtol=1e-5)
    np.testing.assert_array_equal(small_depth, depth[:, :, factor // 2 :: factor, other // 2 :: other])


def test_resizing_to_the_same_size_returns_what_it_got() -> None:
    image, depth = pair()
    same = resize(image, depth, size=(6, 8))
    assert same[0] is image
    assert same[1] is depth


@pytest.mark.parametrize("through", ["warp", "resize"])
def test_a_fine_checkerboard_turns_grey(through: str) -> None:
    """Linear interpolation alone would see black squares here and white ones there, as large as pixels."""
    board = (torch.arange(30)[:, None] + torch.arange(30)) % 2
    image, depth = board.float().expand(1, 3, 30, 30), torch.ones(1, 1, 30, 30)
    if through == "warp":
        small, _ = warp(image, depth, geometry(), size=(10, 10), aspect=1.0)
    else:
        small, _ = resize(image, depth, size=(10, 10))
    assert (small - 0.5).abs().max() < 0.5 / 9 + 1e-6  # of 9 squares, 4 or 5 are white
    assert small.mean().item() == pytest.approx(0.5, abs=1e-6)


def test_a_shrunk_image_skips_no_pixels() -> None:
    board = (torch.arange(40)[:, None] + torch.arange(40)) % 2
    image, depth = board.float().expand(1, 3, 40, 40), torch.ones(1, 1, 40, 40)
    small, _ = Augmentation(zoom=(0.5, 0.5))(
        image, depth, size=(20, 20), aspect=1.0, generator=torch.Generator().manual_seed(0)
    )
    torch.testing.assert_close(small, torch.full_like(small, 0.5))


def test_only_what_is_more_than_twice_as_large_is_shrunk_first() -> None:
    image, _ = pair(size=(12, 24))
    assert _at_most_twice(image, (6, 12), zoom=1.0) is image
    assert _at_most_twice(image, (6, 12), zoom=0.5).shape[-2:] == (6, 12)
    shrunk = _at_most_twice(image, (6, 4), zoom=1.0)
    np.testing.assert_allclose(shrunk, image.reshape(2, 3, 12, 8, 3).mean(dim=4), rtol=1e-5)


# --- colours ----------------------------------------------------------------------------------------------------


def colours(count: int, **factors: Any) -> dict[str, Tensor]:
    neutral = {name: torch.ones(count) for name in ("gamma", "brightness", "contrast", "saturation")}
    return {**neutral, "tint": torch.ones(count, 3), **factors}


def colour_oracle(image: NDArray[np.float64], i: int, factors: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """The documented order of steps for one image [3, h, w], in float64."""
    weights = np.array([0.299, 0.587, 0.114])
    x = np.clip(image, 1e-4, 1) ** factors["gamma"][i] * factors["brightness"][i]
    x = x * factors["tint"][i][:, None, None]
    mean = np.tensordot(weights, x, 1).mean()
    x = mean + factors["contrast"][i] * (x - mean)
    grey = np.tensordot(weights, x, 1)
    result: NDArray[np.float64] = np.clip(grey + factors["saturation"][i] * (x - grey), 0, 1)
    return result


@given(seed=st.integers(0, 1000))
def test_colours_agree_with_the_formula(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    image, _ = pair(seed, count=3)
    image[0, 0, 0] = torch.tensor([0.0, 1.0] * 4)
    factors = {name: 0.3 + 1.4 * torch.rand(3, generator=generator) for name in colours(3)}
    factors["tint"] = 0.6 + 0.8 * torch.rand(3, 3, generator=generator)
    found = change_colours(image, **factors)
    exact = {name: factor.double().numpy() for name, factor in factors.items()}
    for i in range(3):
        np.testing.assert_allclose(found[i], colour_oracle(image[i].double().numpy(), i, exact), atol=2e-6)


def test_neutral_factors_leave_colours_as_they_are() -> None:
    image, _ = pair()
    image[0, :, 0] = 0  # black becomes the least value that has a power
    torch.testing.assert_close(change_colours(image, **colours(2)), image.clamp_min(1e-4), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("factors", "expected"),
    [
        ({"gamma": torch.tensor([2.0])}, [0.25, 0.04, 0.64]),
        ({"brightness": torch.tensor([1.5])}, [0.75, 0.3, 1.0]),
        ({"tint": torch.tensor([[0.5, 1.0, 1.1]])}, [0.25, 0.2, 0.88]),
        ({"saturation": torch.tensor([0.0])}, [0.3581] * 3),  # 0.299 * 0.5 + 0.587 * 0.2 + 0.114 * 0.8
        ({"contrast": torch.tensor([0.0])}, [0.3581] * 3),
        ({"contrast": torch.tensor([2.0])}, [0.6419, 0.0419, 1.0]),
        ({"saturation": torch.tensor([3.0])}, [0.7838, 0.0, 1.0]),
    ],
    ids=["gamma", "brightness", "tint", "grey", "flat", "contrast", "saturation"],
)
def test_each_factor_by_hand(factors: dict[str, Tensor], expected: list[float]) -> None:
    image = torch.tensor([0.5, 0.2, 0.8]).reshape(1, 3, 1, 1)
    found = change_colours(image, **colours(1, **factors))
    assert found.flatten().tolist() == pytest.approx(expected, abs=1e-6)


# --- blur -------------------------------------------------------------------------------------------------------


@given(
    sigmas=st.lists(st.floats(0.06, 5.0), min_size=2, max_size=3), height=st.integers(1, 12), seed=st.integers(0, 100)
)
def test_blur_is_a_gaussian_of_each_images_own_width(sigmas: list[float], height: int, seed: int) -> None:
    image = torch.rand(len(sigmas), 3, height, 9, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    found = blur(image, torch.tensor(sigmas, dtype=torch.float64))
    for i, sigma in enumerate(sigmas):
        options = {"sigma": min(sigma, MAX_BLUR), "mode": "nearest", "radius": 6}
        expected = ndimage.gaussian_filter1d(image[i].numpy(), axis=2, **options)
        expected = ndimage.gaussian_filter1d(expected, axis=1, **options)
        np.testing.assert_allclose(found[i], expected, rtol=1e-10)


def test_no_blur_is_the_input() -> None:
    image, _ = pair()
    assert blur(image, torch.zeros(2)).equal(image)


@given(sigma=st.floats(0.0, MAX_BLUR))
def test_blur_keeps_means(sigma: float) -> None:
    image, _ = pair(count=1, size=(4, 5))
    alone = torch.nn.functional.pad(image, (12, 12, 12, 12))  # far from the edges, nothing is lost
    blurred = blur(alone, torch.tensor([sigma]))
    torch.testing.assert_close(blurred.mean(dim=(2, 3)), alone.mean(dim=(2, 3)), rtol=1e-5, atol=0)
    torch.testing.assert_close(blur(torch.full_like(image, 0.3), torch.tensor([sigma])), torch.full_like(image, 0.3))


# --- the truth in a box -----------------------------------------------------------------------------------------


@given(sides=st.lists(st.floats(0, 1), min_size=8, max_size=8), seed=st.integers(0, 100))
def test_the_box_shows_the_truth_where_there_is_one(sides: list[float], seed: int) -> None:
    image, depth = pair(seed)
    boxes = np.array(sides, np.float32).reshape(2, 4)
    found = cut_depth(image, depth, torch.from_numpy(boxes)).numpy()
    for i, (left, top, right, bottom) in enumerate(boxes):
        for row in range(6):
            for column in range(8):
                inside = left <= np.float32(column + 0.5) / 8 < right and top <= np.float32(row + 0.5) / 6 < bottom
                truth = depth[i, 0, row, column].item()
                expected = [truth] * 3 if inside and truth > 0 else image[i, :, row, column].tolist()
                assert found[i, :, row, column].tolist() == expected


def test_an_empty_box_changes_nothing() -> None:
    image, depth = pair()
    assert cut_depth(image, depth, torch.tensor([[0.3, 0.3, 0.3, 0.9], [0.5, 0.6, 0.4, 0.2]])).equal(image)


# --- all of it, at random ---------------------------------------------------------------------------------------


def test_nothing_on_changes_nothing() -> None:
    image, depth = pair(depths=2)
    moved = run(Augmentation(), image, depth)
    assert moved[0].equal(image)
    assert moved[1].equal(depth)


@pytest.mark.parametrize("options", [{}, {"flip": 1.0}, {"blur": 1.0, "noise": 0.1}, EVERYTHING])
@pytest.mark.parametrize("size", [(6, 8), (3, 4), (12, 7)])
def test_the_result_has_the_size_asked_for(options: dict[str, Any], size: tuple[int, int]) -> None:
    image, depth = run(Augmentation(**options), *pair(depths=2), size=size)
    assert image.shape == (2, 3, *size)
    assert depth.shape == (2, 2, *size)


@given(seed=st.integers(0, 10_000))
def test_values_stay_in_range_and_the_input_as_it_is(seed: int) -> None:
    image, depth = pair(seed, count=3, depths=2)
    depth = depth * 3  # beyond 1, as depth before it is clipped
    before = image.clone(), depth.clone()
    moved, moved_depth = run(Augmentation(**EVERYTHING), image, depth, seed=seed)
    assert moved.min() >= 0
    assert moved.max() <= 1
    assert moved_depth.min() >= 0
    assert moved_depth.max() <= depth.max()
    assert image.equal(before[0])
    assert depth.equal(before[1])


def test_the_same_seed_draws_the_same_and_another_something_else() -> None:
    image, depth = pair(size=(12, 16))
    one, again, other = (run(Augmentation(**EVERYTHING), image, depth, seed=seed) for seed in (1, 1, 2))
    assert one[0].equal(again[0])
    assert one[1].equal(again[1])
    assert not one[0].equal(other[0])
    assert not one[1].equal(other[1])


def test_a_generator_goes_on_from_batch_to_batch() -> None:
    image, depth = pair(size=(12, 16))
    generator = torch.Generator().manual_seed(0)
    options: dict[str, Any] = {"size": (12, 16), "aspect": 4 / 3, "generator": generator}
    first, second = (Augmentation(**EVERYTHING)(image, depth, **options)[0] for _ in range(2))
    assert not first.equal(second)


def test_noise_is_another_in_every_batch() -> None:
    image, depth = torch.full((4, 3, 32, 32), 0.5), torch.ones(4, 1, 32, 32)
    generator = torch.Generator().manual_seed(0)
    options: dict[str, Any] = {"size": (32, 32), "aspect": 1.0, "generator": generator}
    batches = [Augmentation(noise=0.1)(image, depth, **options)[0] for _ in range(2)]
    rows = torch.cat(batches).flatten(1)
    alike = torch.corrcoef(rows) - torch.eye(8)
    assert alike.abs().max() < 0.1  # five standard errors, of 3072 values


def test_images_of_a_batch_are_drawn_for_each_alone() -> None:
    image, depth = pair(count=1, size=(12, 16))
    moved, _ = run(Augmentation(**EVERYTHING), image.expand(4, -1, -1, -1), depth.expand(4, -1, -1, -1))
    assert all(not moved[i].equal(moved[j]) for i in range(4) for j in range(i))


@given(seed=st.integers(0, 1000))
def test_what_comes_with_the_truth_is_moved_as_it_is(seed: int) -> None:
    image, depth = pair(seed)
    _, moved = run(Augmentation(**EVERYTHING), image, torch.cat([depth, depth / 2], dim=1), seed=seed)
    assert (moved[:, 0] / 2).equal(moved[:, 1])


@given(seed=st.integers(0, 1000), zoom=st.floats(0.5, 0.95))
def test_below_1_the_whole_image_is_shown_smaller_and_farther_away(seed: int, zoom: float) -> None:
    size = (48, 64)
    moved, depth = run(Augmentation(zoom=(zoom, zoom)), coordinates(1, size), torch.ones(1, 1, *size), seed=seed)
    seen = depth[0, 0] > 0
    assert seen.float().mean().item() == pytest.approx(zoom**2, abs=0.05)
    torch.testing.assert_close(depth[0, 0][seen], torch.full_like(depth[0, 0][seen], 1 / zoom))
    inside = moved[0, :2][:, seen]  # where each pixel comes from: all of the image
    assert inside.min().item() < -0.95
    assert inside.max().item() > 0.95
    step = moved[0, 0].diff(dim=1)[seen[:, 1:] & seen[:, :-1]].median().item()
    assert step == pytest.approx(2 / (zoom * size[1]), rel=1e-3)


@given(seed=st.integers(0, 1000), low=st.floats(1.0, 2.0), more=st.floats(1.0, 2.0))
def test_depth_is_divided_by_the_zoom_unless_it_shall_not_be(seed: int, low: float, more: float) -> None:
    image, depth = pair(seed, count=1)
    flat = torch.ones_like(depth)
    options: dict[str, Any] = {"zoom": (low, low * more)}
    near = run(Augmentation(**options), image, flat, seed=seed)
    kept = run(Augmentation(**options, zoom_depth=False), image, flat, seed=seed)
    assert near[0].equal(kept[0])
    torch.testing.assert_close(kept[1], flat)
    assert near[1].unique().numel() == 1
    zoom = 1 / near[1][0, 0, 0, 0].item()
    assert low * (1 - 1e-5) <= zoom <= low * more * (1 + 1e-5)
    if options["zoom"][0] > 1.01:
        assert not near[1].equal(kept[1])


def coordinates(count: int, size: tuple[int, int] = (32, 32)) -> Tensor:
    x, y = (torch.from_numpy(axis).float() for axis in axes(size))
    return torch.stack([x, y, torch.ones(size)]).expand(count, -1, -1, -1)


def corners(picture: Tensor) -> tuple[Tensor, Tensor]:
    """Return where the crop's left and right edge, or top and bottom, lie in a picture of coordinates."""
    low, high = picture[..., 3], picture[..., -4]  # the outermost pixels may repeat what lies at the edge
    step = (high - low) / (picture.shape[-1] - 7)
    return low - 3.5 * step, high + 3.5 * step


def test_crops_lie_anywhere_within_what_the_border_leaves() -> None:
    image = coordinates(400)
    moved, depth = run(Augmentation(zoom=(1, 4), border=0.125), image, torch.ones(400, 1, 32, 32))
    zoom = 1 / depth[:, 0, 0, 0]
    left, right = corners(moved[:, 0, 16])
    top, bottom = corners(moved[:, 1, :, 16])
    for low, high in ((left, right), (top, bottom)):
        assert low.min() >= -0.75 - 1e-4
        assert high.max() <= 0.75 + 1e-4
        torch.testing.assert_close(high - low, 1.5 / zoom, rtol=1e-3, atol=1e-3)
        place = (low + 0.75) / (1.5 - (high - low))  # 0 is one side of the room, 1 the other
        place = place[zoom > 1.2]
        assert place.min() < 0.02
        assert place.max() > 0.98
        assert place.mean().item() == pytest.approx(0.5, abs=0.06)  # four standard errors
    assert torch.corrcoef(torch.stack([left + right, top + bottom]))[0, 1].abs() < 0.2


def test_zooms_are_uniform_in_their_logarithm() -> None:
    _, depth = run(Augmentation(zoom=(1, 4)), coordinates(1000, (4, 4)), torch.ones(1000, 1, 4, 4))
    share = (-depth[:, 0, 0, 0].log() / math.log(4)).sort().values
    uniform = (torch.arange(1000) + 0.5) / 1000
    assert (share - uniform).abs().max() < 0.06  # Kolmogorov's distance; 0.062 is exceeded once in a thousand


def test_rolls_go_either_way_up_to_the_angle_given() -> None:
    moved, _ = run(Augmentation(rotate_deg=20), coordinates(400), torch.ones(400, 1, 32, 32))
    along = moved[:, :2, 16, 20] - moved[:, :2, 16, 12]
    degrees = torch.atan2(along[:, 1], along[:, 0]).rad2deg()
    assert -20.01 < degrees.min() < -19
    assert 19 < degrees.max() < 20.01
    assert degrees.mean().abs() < 2.4  # four standard errors


def test_as_many_images_are_flipped_and_grey_as_their_probabilities_say() -> None:
    image = torch.rand(1000, 3, 1, 2, generator=torch.Generator().manual_seed(0))
    image[:, 0, 0, 0], image[:, 0, 0, 1] = 0.1, 0.9
    depth = torch.ones(1000, 1, 1, 2)
    flipped = run(Augmentation(flip=0.3), image, depth)[0]
    assert (flipped[:, 0, 0, 0] > 0.5).float().mean().item() == pytest.approx(0.3, abs=0.06)
    grey = run(Augmentation(grey=0.2), image, depth)[0]
    assert (grey.amax(dim=1) - grey.amin(dim=1) < 1e-6).all(dim=(1, 2)).float().mean().item() == pytest.approx(
        0.2, abs=0.06
    )


def test_noise_is_gaussian_of_a_random_width() -> None:
    image = torch.full((200, 3, 24, 24), 0.5)
    noise = run(Augmentation(noise=0.1), image, torch.ones(200, 1, 24, 24))[0] - 0.5
    sigma = noise.std(dim=(1, 2, 3))
    assert sigma.max() < 0.105
    assert sigma.min() < 0.005
    assert sigma.mean().item() == pytest.approx(0.05, abs=0.01)
    assert (noise.mean(dim=(1, 2, 3)).abs() < 5 * sigma / math.sqrt(3 * 24 * 24)).all()
    kurtosis = ((noise / sigma[:, None, None, None]) ** 4).mean()
    assert kurtosis.item() == pytest.approx(3, abs=0.1)


def test_half_of_the_images_stay_sharp() -> None:
    image = torch.zeros(400, 3, 9, 9)
    image[:, :, 4, 4] = 1
    sharp = run(Augmentation(blur=2.0), image, torch.ones(400, 1, 9, 9))[0][:, 0, 4, 4]
    assert (sharp == 1).float().mean().item() == pytest.approx(0.5, abs=0.1)
    centre = ndimage.gaussian_filter1d(np.eye(1, 13, 6)[0], 2.0, radius=6)[6] ** 2  # of the widest blur
    assert centre - 1e-6 <= sharp.min() < 1.1 * centre


@pytest.mark.parametrize("largest", [0.0, 0.5, 1.0])
def test_boxes_of_truth_are_as_many_and_as_large_as_asked_for(largest: float) -> None:
    image, depth = torch.zeros(400, 3, 40, 40), torch.ones(400, 1, 40, 40)
    moved = run(Augmentation(cut_depth=0.5, cut_depth_size=largest), image, depth)[0]
    shown = moved[:, 0] > 0
    if not largest:
        assert not shown.any()
        return
    assert 0.35 < shown.any(dim=(1, 2)).float().mean() < 0.55  # some boxes hold no pixel
    for box in shown:
        for line in (box.any(dim=0), box.any(dim=1)):
            if line.any():
                first, length = int(line.int().argmax()), int(line.sum())
                assert length <= largest * (40 - first) + 1
    assert moved.amax().item() == 1


def test_a_depth_beyond_the_unit_is_shown_as_white() -> None:
    image, depth = torch.zeros(50, 3, 8, 8), torch.full((50, 1, 8, 8), 2.5)
    moved, same = run(Augmentation(cut_depth=1.0), image, depth)
    assert moved.unique().tolist() == [0, 1]
    assert same.equal(depth)


def test_it_is_the_truth_that_is_shown_not_what_comes_with_it() -> None:
    image, depth = torch.zeros(50, 3, 8, 8), torch.full((50, 1, 8, 8), 0.5)
    moved, _ = run(Augmentation(cut_depth=1.0), image, torch.cat([depth, depth + 0.2], dim=1))
    assert moved.unique().tolist() == [0, 0.5]


@pytest.mark.parametrize("out", [(50, 50), (25, 25), (100, 40), (10, 7)])
@pytest.mark.parametrize("border", [0.04, 0.031], ids=["the frame's pixels", "a part of the second pixel"])
@pytest.mark.parametrize("options", [{}, {"zoom": (1, 4)}, {"flip": 0.5, "zoom": (1, 1.5)}, {"rotate_deg": 10}])
def test_a_frame_within_the_border_is_never_seen(options: dict[str, Any], border: float, out: tuple[int, int]) -> None:
    image, depth = torch.zeros(100, 3, 50, 50), torch.ones(100, 1, 50, 50)
    frame = torch.ones(50, 50, dtype=torch.bool)
    frame[2:-2, 2:-2] = False
    image[:, :, frame], depth[:, :, frame] = 1.0, 100.0
    moved, moved_depth = run(Augmentation(border=border, **options), image, depth, size=out)
    assert moved.max() == 0
    assert moved_depth.max() <= 1


def test_what_is_within_the_border_is_all_seen() -> None:
    image, depth = pair(size=(50, 40))
    moved, moved_depth = run(Augmentation(border=0.1), image, depth, size=(40, 32))
    torch.testing.assert_close(moved, image[..., 5:-5, 4:-4])
    assert moved_depth.equal(depth[..., 5:-5, 4:-4])


# --- what cannot be -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {"flip": 1.5}, {"flip": -0.1}, {"grey": math.nan}, {"cut_depth": 2}, {"cut_depth_size": 1.01}, {"tint": 0.6},
        {"noise": math.inf}, {"blur": 3.5}, {"rotate_deg": 90}, {"border": 0.45}, {"zoom": [0.4, 2.0]},
        {"zoom": [1.0, 9.0]}, {"gamma": (2.0, 1.0)}, {"brightness": [-1.0, 1.0]}, {"contrast": [1.0]},
        {"saturation": [math.nan, 1.0]},
    ],
)  # fmt: skip
def test_bad_options_are_refused(options: dict[str, Any]) -> None:
    (key,) = options
    with pytest.raises(ConfigError, match=rf"^augment\.{key}: .* is not "):
        Augmentation(**options)


def test_some_images_are_not_zoomed_at_all() -> None:
    image, depth = torch.rand(200, 3, 8, 8), torch.ones(200, 1, 8, 8)
    augment = Augmentation(zoom=(2.0, 4.0), zoom_chance=0.3)
    seen, moved = augment(image, depth, size=(8, 8), aspect=1.0, generator=torch.Generator().manual_seed(0))
    whole = moved[:, 0, 0, 0] == 1
    assert 0.6 < whole.float().mean() < 0.8
    torch.testing.assert_close(seen[whole], image[whole])
    assert (moved[~whole] <= 0.5).all()
