"""Perceptual hashes, 64 bits an image, few of which change when the image hardly does; duplicates found with them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hudepth.data.splits import Split

NEAR_BITS = 6
"""Images whose hashes differ in at most so many of 64 bits count as near duplicates.

Chosen on the 1,449 images of NYU's labelled set. No two images of different scenes come so near, of 1.05 million such
pairs; the first false pair differs in 8 bits. An image cut out anew 2 % of its width to the side and saved as JPEG once
more differs in 6 bits from what it was (median), 4 % to the side in 10: the camera has to have nearly stood still.
"""

_THUMBNAIL, _KEPT = 32, 8  # sides of the thumbnail, and of the block of its lowest frequencies
_ROUNDING = 0.01  # an image of one colour has no frequencies but those of rounding errors, which must not fill its hash


def perceptual_hashes(images: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Hash images by the signs of their lowest frequencies (the pHash of Zauner, 2010).

    A grey 32 x 32 thumbnail, averaged over areas, goes through a two-dimensional DCT; of its 8 x 8 lowest frequencies
    each bit says whether one lies above their median. The constant term is left out of the median.

    Args:
        images: [n, h, w, 3] RGB.

    Returns:
        [n] 64-bit hashes. Brightness and contrast leave them as they are, small changes flip a few bits.
    """
    hashes = np.empty(len(images), np.uint64)
    for row, image in enumerate(images):
        thumbnail = cv2.resize(
            cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32),
            (_THUMBNAIL, _THUMBNAIL),
            interpolation=cv2.INTER_AREA,
        )
        low = cv2.dct(thumbnail)[:_KEPT, :_KEPT].ravel()
        above = low - np.median(low[1:]) > _ROUNDING
        hashes[row] = np.packbits(above).view(">u8")[0]
    return hashes


def pixel_digests(images: NDArray[np.uint8]) -> list[bytes]:
    """Return 16 bytes an image that are equal for equal pixels, and in practice for no others.

    Args:
        images: [n, h, w, 3].
    """
    return [hashlib.blake2b(image.tobytes(), digest_size=16).digest() for image in images]


def nearest_hashes(
    queries: NDArray[np.uint64], hashes: NDArray[np.uint64], *, block: int = 1 << 22
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find for each query the hash that differs in fewest bits, by comparing all pairs.

    Args:
        queries: [n].
        hashes: [m], at least one.
        block: pairs compared at a time, which bounds the memory (16 bytes a pair).

    Returns:
        [n] positions in ``hashes`` (the first of equals), and [n] differing bits, 0 to 64.
    """
    position = np.empty(len(queries), np.int64)
    bits = np.empty(len(queries), np.int64)
    step = max(1, block // len(hashes))
    for start in range(0, len(queries), step):
        differing = count_bits(queries[start : start + step, None] ^ hashes)
        position[start : start + step] = differing.argmin(axis=1)
        bits[start : start + step] = differing.min(axis=1)
    return position, bits


@dataclass(frozen=True)
class Duplicates:
    """Test images that are in training too, or hardly differ from an image there."""

    exact: float
    """Share of test images whose pixels equal those of a training image."""
    near: float
    """Share of test images with a near duplicate in training, exact ones included."""
    nearest: NDArray[np.int64]
    """[n] position in the store of the training image most like each test image, in the order of the split."""
    bits: NDArray[np.int64]
    """[n] bits in which the hashes of the two differ, 0 to 64."""
    equal: NDArray[np.bool_]
    """[n] whether the pixels of the two are equal."""


def find_duplicates(
    split: Split, hashes: NDArray[np.uint64], digests: Sequence[bytes], *, near_bits: int = NEAR_BITS
) -> Duplicates:
    """Look for each test image in training, among all training images of all scenes.

    Args:
        split: positions in a store.
        hashes: [n] of all its images.
        digests: of all its images, as :func:`pixel_digests` gives them.
        near_bits: hashes that differ in at most so many bits are those of near duplicates.
    """
    train = np.asarray(split.train, np.int64)
    position, bits = nearest_hashes(hashes[split.test], hashes[train])
    nearest = train[position]
    first: dict[bytes, int] = {}
    for index in split.train:
        first.setdefault(digests[index], index)
    twin = np.array([first.get(digests[index], -1) for index in split.test], np.int64)
    equal = twin >= 0
    return Duplicates(
        exact=float(equal.mean()),
        near=float((bits <= near_bits).mean()),
        nearest=np.where(equal, twin, nearest),  # other images may have the same hash
        bits=bits,
        equal=equal,
    )


def count_bits(values: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """Count the bits that are 1.

    Args:
        values: [...] of any shape.

    Returns:
        [...] counts, 0 to 64.
    """
    if hasattr(np, "bitwise_count"):  # numpy 2
        return np.asarray(np.bitwise_count(values), np.uint8)
    return count_bits_by_table(values)


def count_bits_by_table(values: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """Count as :func:`count_bits`, by looking up 16 bits at a time: for numpy 1."""
    parts = np.ascontiguousarray(values)[..., None].view(np.uint16)
    counts: NDArray[np.uint8] = _TABLE[parts].sum(axis=-1, dtype=np.uint8)
    return counts


_TABLE = np.unpackbits(np.arange(1 << 16, dtype=np.uint16).view(np.uint8).reshape(-1, 2), axis=1).sum(1, dtype=np.uint8)
