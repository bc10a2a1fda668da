"""Hashes against a plain cosine transform and Python's own bit counts; duplicates against hand-made sets."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hudepth.data.audit.duplicates import (
    NEAR_BITS,
    count_bits,
    digest_pixels,
    find_duplicates,
    find_nearest_hashes,
    hash_images,
)
from hudepth.data.splits import Split

HASHES = st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=12)


def scenes(n: int, *, seed: int = 0, size: tuple[int, int] = (96, 128)) -> NDArray[np.uint8]:
    """Smooth images that have nothing in common."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(40, 216, (n, 6, 8, 3), dtype=np.uint8)
    return np.stack([cv2.resize(image, size[::-1], interpolation=cv2.INTER_CUBIC) for image in coarse])


def bits_apart(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> list[int]:
    pairs = zip(hash_images(one).tolist(), hash_images(other).tolist(), strict=True)
    return [(a ^ b).bit_count() for a, b in pairs]


def split_of(train: list[int], test: list[int]) -> Split:
    return Split("random", 0, (0.7, 0.1, 0.2), train, [], test, "")


def test_the_hash_is_the_sign_of_low_frequencies() -> None:
    images = scenes(5)
    k, x = np.arange(8)[:, None], np.arange(32)[None]
    basis = np.cos(np.pi * (2 * x + 1) * k / 64) * np.where(k == 0, np.sqrt(1 / 32), np.sqrt(2 / 32))
    for image, found in zip(images, hash_images(images).tolist(), strict=True):
        grey = np.rint(image @ [0.299, 0.587, 0.114])  # 8 bits
        thumbnail = grey.reshape(32, 3, 32, 4).mean(axis=(1, 3))
        low = (basis @ thumbnail @ basis.T).ravel()
        median = np.median(low[1:])
        clear = np.abs(low - median) > 0.5  # bits that rounding to 8-bit grey cannot turn
        assert clear.sum() > 50
        expected = low > median
        assert [bool(found >> (63 - i) & 1) for i in np.flatnonzero(clear).tolist()] == expected[clear].tolist()


def test_brightness_contrast_and_compression_hardly_matter() -> None:
    images = scenes(6)
    assert max(bits_apart(images, (images * 0.8 + 12).astype(np.uint8))) <= 2
    jpegs = [cv2.imdecode(cv2.imencode(".jpg", i, [cv2.IMWRITE_JPEG_QUALITY, 60])[1], 1) for i in images]
    assert max(bits_apart(images, np.stack(jpegs))) <= NEAR_BITS
    smaller = np.stack([cv2.resize(image, (64, 48), interpolation=cv2.INTER_AREA) for image in images])
    assert max(bits_apart(images, smaller)) <= 2


def test_unrelated_and_mirrored_images_are_far() -> None:
    images = scenes(12)
    assert min(bits_apart(images[:6], images[6:])) > 2 * NEAR_BITS
    assert min(bits_apart(images, images[:, :, ::-1])) > 2 * NEAR_BITS


def test_images_of_one_colour_have_one_hash() -> None:
    flat = np.stack([np.full((20, 30, 3), value, np.uint8) for value in (1, 90, 255)])
    assert len(set(hash_images(flat).tolist())) == 1


def test_digests_are_equal_for_equal_pixels_alone() -> None:
    images = np.concatenate([scenes(3), scenes(3)])
    images[5, 0, 0, 0] ^= 1
    first, second = digest_pixels(images)[:3], digest_pixels(images)[3:]
    assert [a == b for a, b in zip(first, second, strict=True)] == [True, True, False]
    assert len(set(first)) == 3
    assert digest_pixels(images[:, ::2]) == digest_pixels(np.ascontiguousarray(images[:, ::2]))


@pytest.mark.parametrize("numpy", [1, 2])
@given(values=HASHES)
def test_bits_are_counted_as_python_does(numpy: int, values: list[int]) -> None:
    array = np.array(values, np.uint64)
    expected = [value.bit_count() for value in values]
    with pytest.MonkeyPatch.context() as patch:
        if numpy == 1:  # counts by table
            patch.delattr(np, "bitwise_count", raising=False)
        assert count_bits(array).tolist() == expected
        assert count_bits(array[None, ::-1]).tolist() == [expected[::-1]]


@given(queries=HASHES, hashes=HASHES, block=st.integers(1, 40))
def test_the_nearest_is_found_whatever_the_block(queries: list[int], hashes: list[int], block: int) -> None:
    position, bits = find_nearest_hashes(np.array(queries, np.uint64), np.array(hashes, np.uint64), block=block)
    for query, at, differing in zip(queries, position.tolist(), bits.tolist(), strict=True):
        distances = [(query ^ other).bit_count() for other in hashes]
        assert differing == min(distances)
        assert at == distances.index(differing)


def test_duplicates_of_a_hand_made_set() -> None:
    #                 0     1     2        3     4      5 (test: 3, 4, 5)
    hashes = np.array([0x0, 0xFF, 0xFF00, 0xFF, 0xFF01, 2**64 - 1], np.uint64)
    digests = [b"a", b"x", b"b", b"c", b"d", b"e"]
    found = find_duplicates(split_of([2, 0, 1], [3, 4, 5]), hashes, digests)
    assert found.nearest.tolist() == [1, 2, 2]
    assert found.bits.tolist() == [0, 1, 56]
    assert (found.exact, found.near) == (0, pytest.approx(2 / 3))
    assert not found.equal.any()


def test_the_copy_is_named_rather_than_another_image_of_its_hash() -> None:
    hashes = np.zeros(4, np.uint64)
    found = find_duplicates(split_of([0, 1, 2], [3]), hashes, [b"a", b"b", b"c", b"b"])
    assert found.nearest.tolist() == [1]
    assert found.equal.tolist() == [True]
    assert (found.exact, found.near) == (1, 1)


def test_only_training_is_searched_and_the_limit_counts() -> None:
    hashes = np.array([0b111, 0, 0, 2**64 - 1], np.uint64)
    split = Split("random", 0, (0.7, 0.1, 0.2), [0, 3], [1], [2], "")
    assert find_duplicates(split, hashes, [b"a", b"b", b"b", b"c"], near_bits=3).near == 1
    strict = find_duplicates(split, hashes, [b"a", b"b", b"b", b"c"], near_bits=2)
    assert (strict.exact, strict.near) == (0, 0)


def test_real_rooms_of_other_scenes_are_no_near_duplicates(nyu_root: Path) -> None:
    with (nyu_root / "index.csv").open(encoding="utf-8", newline="") as file:
        rows = list({row["scene"]: row for row in csv.DictReader(file)}.values())[::12]
    images = np.stack([cv2.resize(cv2.imread(str(nyu_root / row["image"])), (224, 224)) for row in rows])
    hashes = hash_images(images)
    apart = count_bits(hashes[:, None] ^ hashes)[np.triu_indices(len(rows), 1)]
    assert apart.min() > NEAR_BITS
    assert np.median(apart) == pytest.approx(32, abs=2)
    shifted = np.stack([np.roll(image, 2, axis=1) for image in images])  # 1 % of the width
    assert np.median(bits_apart(images, shifted)) <= NEAR_BITS
