"""Numbers in text are those that `float` gives, to the bit; lines that differ are left out."""

import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impslam.sources.tables import Lines

WORDS = st.one_of(
    st.floats().map(repr),
    st.floats(-1e9, 1e9).map(lambda x: f"{x:.6f}"),
    st.floats(allow_nan=False).map(lambda x: f"{x:.3e}"),
    st.integers().map(str),
    st.from_regex(r"[+-]?[0-9]{0,20}\.?[0-9]{0,20}([eE][+-]?[0-9]{0,6})?", fullmatch=True),
    st.sampled_from(["nan", "-inf", "1_0", "9007199254740993", "1e22", "1e23", "-0", "0x1", "1e"]),
)


def value(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


@given(
    st.lists(WORDS.filter(bool), min_size=1, max_size=20), st.sampled_from(["\n", "\r\n", "\t\n"])
)
def test_numbers_are_those_of_float_to_the_bit(words: list[str], end: str) -> None:
    lines = Lines("".join(word + end for word in words).encode())
    found, good = lines.table(np.arange(len(words)), 0, 1, 0)
    expected = [value(word) for word in words]
    assert good.tolist() == [x is not None for x in expected]
    for x, y in zip(found[:, 0], expected, strict=True):
        if y is not None:
            assert np.float64(x).tobytes() == np.float64(y).tobytes()


def test_a_million_numbers_as_logs_have_them() -> None:
    rng = random.Random(0)
    words = [
        f"{rng.gauss(0, 10 ** rng.randint(-8, 9)):.{rng.randint(0, 9)}f}" for _ in range(10**5)
    ]
    lines = Lines("\n".join(words).encode())
    for k in np.array_split(np.arange(len(words)), 1000):
        found, good = lines.table(k, 0, 1, 0)
        assert good.all()
        assert found[:, 0].tobytes() == np.array([float(words[i]) for i in k]).tobytes()


@pytest.mark.parametrize(
    ("line", "good"),
    [
        ("A 1 2 3 x y", True),
        ("A  1\t2 3  x y  \r", True),
        ("A 1 2 3 x", False),
        ("A 1 2 3 x y z", False),
        ("A 1 2", False),
        ("A", False),
        ("A 1 two 3 x y", False),
        ("A 1 nan 3 x y", True),
        ("A 1 2e 3 x y", False),
    ],
)
def test_lines_with_other_words_are_not_good(line: str, good: bool) -> None:
    lines = Lines(f"{line}\nB 1\nA 1 2 3 x y".encode())
    found, sound = lines.table(np.array([0, 2]), 1, 3, 2)
    assert sound.tolist() == [good, True]
    np.testing.assert_array_equal(found[1], [1.0, 2.0, 3.0])


def test_a_line_with_more_odd_words_than_are_kept_is_not_read() -> None:
    lines = Lines(b"1 2\n" + b"nan nan\n" * 1000 + b"3 4")
    _, sound = lines.table(np.arange(1002), 0, 2, 0)
    assert sound[:500].all()
    assert not sound[600:1001].any()


def test_the_bounds_of_lines() -> None:
    lines = Lines(b"ab\n\nabc")
    assert [lines.line(k) for k in range(len(lines))] == [b"ab", b"", b"abc"]
    assert lines.starting(b"abc").tolist() == [False, False, True]
    assert len(Lines(b"a\n")) == 1
    assert not len(Lines(b""))
