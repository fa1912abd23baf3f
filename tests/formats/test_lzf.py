"""LZF: what a compressor writes is read back, and damaged data ends in a ValueError."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from point_samples import compress_lzf

from ciassd_jax.formats.pcd import decompress_lzf


@pytest.mark.parametrize(
    ("packed", "raw"),
    [
        (b"", b""),
        (b"\x02abc", b"abc"),
        # A copy of 3 bytes from 3 back; of 10 bytes from 1 back, which repeats its own output.
        (b"\x02abc\x20\x02", b"abcabc"),
        (b"\x00a\xe0\x01\x00", b"a" + b"a" * 10),
        (b"\x01ab\x60\x01", b"ab" + b"ababa"),
    ],
)
def test_known_answers(packed, raw):
    assert decompress_lzf(packed, len(raw)) == raw


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.binary(min_size=1, max_size=9), st.integers(1, 400)), max_size=8))
def test_round_trip(pieces):
    raw = b"".join(piece * times for piece, times in pieces)
    assert decompress_lzf(compress_lzf(raw), len(raw)) == raw


def test_a_match_of_the_greatest_distance():
    rng = np.random.default_rng(0)
    raw = b"first words" + rng.integers(0, 256, 8000, np.uint8).tobytes() + b"first words"
    packed = compress_lzf(raw)
    assert len(packed) < 8000 * 33 / 32 + 30
    assert decompress_lzf(packed, len(raw)) == raw


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=60), st.integers(0, 300))
def test_any_bytes_give_the_size_or_an_error(data, size):
    with suppress(ValueError):
        assert len(decompress_lzf(data, size)) == size
