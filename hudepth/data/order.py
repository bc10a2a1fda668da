"""The order in which pairs are read: whole, in shards, shuffled in blocks, or new ones each epoch."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from torch.utils.data import Sampler


def epoch_seed(purpose: str, seed: int, epoch: int, rank: int) -> int:
    """Return a seed that depends on these alone, so that a resumed run draws what it would have drawn."""
    return int.from_bytes(hashlib.sha256(f"{purpose} {seed} {epoch} {rank}".encode()).digest()[:7])


class ShardSampler(Sampler[int]):
    """Every ``world_size``-th position, in order and without the repetitions of torch's DistributedSampler."""

    def __init__(self, length: int, *, rank: int, world_size: int) -> None:
        self._positions = range(rank, length, world_size)

    def __len__(self) -> int:
        return len(self._positions)

    def __iter__(self) -> Iterator[int]:
        return iter(self._positions)


class BlockShuffle(Sampler[int]):
    """Shuffles training pairs so that they are read from the disk in large pieces.

    A store larger than memory is read from the disk each epoch, and scattered reads are slow. So blocks of neighbouring
    pairs are shuffled, then the pairs within each group of a few blocks. The order depends only on seed and epoch. Each
    process gets every ``world_size``-th pair; if that does not divide evenly, the first pairs are repeated, so that
    all processes take equally many steps.

    Args:
        rows: position of each pair in the store.
        block: number of neighbouring pairs that are read together.
        group: number of blocks whose pairs are mixed; they are in memory at once.
        read_ahead: called with the first and last row of each block before its pairs are read.
    """

    def __init__(
        self, rows: Sequence[int], *, block: int, seed: int, rank: int = 0, world_size: int = 1, group: int = 16,
        read_ahead: Callable[[int, int], None] | None = None,
    ) -> None:  # fmt: skip
        self.rows = np.asarray(rows)
        self.block, self.seed, self.rank, self.world_size, self.group = block, seed, rank, world_size, group
        self.read_ahead, self.epoch = read_ahead, 0

    def set_epoch(self, epoch: int) -> None:
        """Take another order; Lightning calls this."""
        self.epoch = epoch

    def __len__(self) -> int:
        return -(-len(self.rows) // self.world_size)

    def __iter__(self) -> Iterator[int]:
        random = np.random.default_rng((self.seed, self.epoch))
        sorted_positions = np.argsort(self.rows, kind="stable")
        blocks = [sorted_positions[i : i + self.block] for i in range(0, len(self.rows), self.block)]
        blocks = [blocks[i] for i in random.permutation(len(blocks))]
        groups = [blocks[i : i + self.group] for i in range(0, len(blocks), self.group)]
        orders = [random.permutation(np.concatenate(group)) for group in groups]
        starts = dict(zip(np.cumsum([0, *map(len, orders)]).tolist(), groups, strict=False))
        order = np.resize(np.concatenate(orders), len(self) * self.world_size).tolist()
        for place, position in enumerate(order):
            if self.read_ahead and place in starts:
                for block in starts[place]:
                    self.read_ahead(int(self.rows[block[0]]), int(self.rows[block[-1]]))
            if place % self.world_size == self.rank:
                yield position


class NewEachEpoch(BlockShuffle):
    """As :class:`BlockShuffle`, over numbers that no earlier epoch had: epoch 0 has 0 to count - 1, and so on.

    Args:
        count: numbers per epoch.
        block, seed, rank, world_size, group: as for :class:`BlockShuffle`.
    """

    def __init__(
        self, count: int, *, block: int, seed: int, rank: int = 0, world_size: int = 1, group: int = 16
    ) -> None:
        super().__init__(range(count), block=block, seed=seed, rank=rank, world_size=world_size, group=group)

    def __iter__(self) -> Iterator[int]:
        first = self.epoch * len(self.rows)
        for position in super().__iter__():
            yield first + position
