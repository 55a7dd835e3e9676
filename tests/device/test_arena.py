"""Blocks of short-lived arrays are used again."""

import pytest

from clsplat.device.array import MOST_SPARE, Arena, block_bytes


@pytest.mark.parametrize(
    "size, again", [(1000, True), (1000 // MOST_SPARE, True), (1000 // MOST_SPARE - 1, False), (1001, False)]
)
def test_a_free_block_serves_an_array_that_is_not_much_smaller(size, again):
    arena = Arena(bytearray)
    first = arena.allocate(1000, exact=True)
    buffer = first.buffer
    del first
    assert (arena.allocate(size, exact=True).buffer is buffer) == again
    assert arena.managed_bytes == 1000 + size * (not again)


def test_the_smallest_block_that_fits_is_taken():
    arena = Arena(bytearray)
    blocks = [arena.allocate(size, exact=True) for size in (1400, 1000, 1200)]
    del blocks
    assert len(arena.allocate(900, exact=True).buffer) == 1000


def test_sizes_that_change_are_rounded_up_and_equal_blocks_are_used_again():
    arena = Arena(bytearray)
    size = block_bytes(1000)
    assert len(arena.allocate(1000).buffer) == size > 1000
    assert arena.allocate(size - 1).buffer is not None and arena.managed_bytes == size
    arena.allocate(size // 2)
    assert arena.managed_bytes == size + block_bytes(size // 2)
    arena.free_held()
    assert arena.managed_bytes == 0
