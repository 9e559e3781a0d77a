"""Reads lines of numbers as tables, fast and with exactly the results of `float`.

A mantissa of at most 53 bits times a power of ten of at most 22 is correctly rounded by one product or
quotient, since both are exact (Clinger 1990, "How to read floating point numbers accurately"). Other
words (nan, inf, more digits) are left to `float`.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import numpy.typing as npt

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask

Bytes = npt.NDArray[np.uint8]

_POWERS = np.array([float(f"1e{k}") for k in range(23)])  # all exact powers of ten
_MAX_EXACT = 2**53  # float64 represents all integers up to it; 18 digits fit into an int64
_NOT_PLAIN = 1_000_000  # an exponent that is out of bounds with any mantissa
_MAX_WORD = 32  # bytes; a stamp is shorter
_MAX_ODD = 1024  # words that a call leaves to `float`; lines with more are not read here


class Lines:
    """The lines of a text.

    Parameters
    ----------
    text : lines; the last one need not have a line end
    """

    def __init__(self, text: bytes) -> None:
        self._text = np.frombuffer(text, np.uint8)
        breaks = np.flatnonzero(self._text == ord("\n"))
        is_open = len(text) > 0 and text[-1:] != b"\n"
        self.ends = np.append(breaks, len(text)) if is_open else breaks
        self.begins = np.append(0, breaks + 1)[: len(self.ends)]

    def __len__(self) -> int:
        return len(self.ends)

    def line(self, k: int) -> bytes:
        """Return a line without its end."""
        return self._text[self.begins[k] : self.ends[k]].tobytes()

    def word(self, k: int) -> bytes:
        """Return the first word of a line, truncated to 32 bytes."""
        return b"".join(self._text[self.begins[k] :][:_MAX_WORD].tobytes().split(None, 1)[:1])

    def starting(self, prefix: bytes) -> Mask:
        """Return (m,) which lines start with some bytes."""
        found = np.empty(len(self), np.bool_)
        _starting(self._text, self.begins, self.ends, np.frombuffer(prefix, np.uint8), found)
        return found

    def table(self, lines: Ints, skip: int, width: int, rest: int) -> tuple[Array, Mask]:
        """Read lines of equal numbers of words.

        Parameters
        ----------
        lines : (k,) indices of the lines
        skip : number of bytes to skip at the start of each
        width : number of words that are numbers
        rest : number of words that follow

        Returns
        -------
        values : (k, width)
        good : (k,) false for lines with other words, or more or fewer of them
        """
        values, good = np.zeros((len(lines), width)), np.ones(len(lines), np.bool_)
        odd = np.empty((_MAX_ODD, 4), np.int64)
        begins, ends = self.begins[lines] + skip, self.ends[lines]
        count = _table(self._text, begins, ends, rest, values, good, odd)
        for k, column, begin, end in odd[:count].tolist():
            values[k, column] = np.nan
            is_number = False
            with suppress(ValueError):
                values[k, column] = float(self._text[begin:end].tobytes())
                is_number = True
            good[k] &= is_number
        return values, good


@kernel
def _starting(text: Bytes, begins: Ints, ends: Ints, prefix: Bytes, found: Mask) -> None:
    """Set which lines start with a prefix."""
    n = len(prefix)
    for k in range(len(begins)):
        found[k] = ends[k] - begins[k] >= n
        for j in range(n):
            if not found[k] or text[begins[k] + j] != prefix[j]:
                found[k] = False
                break


@kernel
def _is_blank(c: int) -> bool:
    """Return whether a byte separates words, as for `bytes.split`."""
    return c == 32 or 9 <= c <= 13


@kernel
def _skip_blanks(text: Bytes, i: int, end: int) -> int:
    while i < end and _is_blank(text[i]):
        i += 1
    return i


@kernel
def _skip_word(text: Bytes, i: int, end: int) -> int:
    while i < end and not _is_blank(text[i]):
        i += 1
    return i


@kernel
def _number(text: Bytes, i: int, end: int) -> tuple[float, int, bool]:
    """Return the number at index i, the end of its word, and whether it is plain."""
    is_negative = text[i] == 45  # -
    if is_negative or text[i] == 43:  # +
        i += 1
    begin = i
    mantissa = 0
    while i < end and 48 <= text[i] <= 57:
        mantissa = 10 * mantissa + (int(text[i]) - 48)
        i += 1
    digits, power = i - begin, 0
    if i < end and text[i] == 46:  # .
        i += 1
        begin = i
        while i < end and 48 <= text[i] <= 57:
            mantissa = 10 * mantissa + (int(text[i]) - 48)
            i += 1
        power = begin - i
        digits -= power
    if digits > 0 and i < end and (text[i] == 101 or text[i] == 69):  # e E
        exponent, i = _exponent(text, i + 1, end)
        power += exponent
    is_plain = 0 < digits <= 18 and mantissa <= _MAX_EXACT and -22 <= power <= 22
    if not is_plain or (i < end and not _is_blank(text[i])):
        return 0.0, _skip_word(text, i, end), False
    value = float(mantissa)
    if power < 0:
        value /= _POWERS[-power]
    elif power > 0:
        value *= _POWERS[power]
    return -value if is_negative else value, i, True


@kernel
def _exponent(text: Bytes, i: int, end: int) -> tuple[int, int]:
    """Return the exponent at index i and its end; `_NOT_PLAIN` if it has no or too many digits."""
    is_negative = i < end and text[i] == 45
    if i < end and (text[i] == 45 or text[i] == 43):
        i += 1
    begin, value = i, 0
    while i < end and 48 <= text[i] <= 57:
        value = 10 * value + (int(text[i]) - 48)
        i += 1
    if not 0 < i - begin <= 4:
        return _NOT_PLAIN, i
    return -value if is_negative else value, i


@kernel
def _table(
    text: Bytes, begins: Ints, ends: Ints, rest: int, values: Array, good: Mask, odd: Ints
) -> int:
    """Fill a table; return the number of words left to `float`, whose places are in `odd`."""
    count = 0
    for k in range(len(begins)):
        i, end = begins[k], ends[k]
        for c in range(values.shape[1]):
            i = _skip_blanks(text, i, end)
            begin = i
            if i == end or (count == len(odd)):
                good[k] = False
                break
            values[k, c], i, plain = _number(text, i, end)
            if not plain:
                odd[count, 0], odd[count, 1], odd[count, 2], odd[count, 3] = k, c, begin, i
                count += 1
        for _ in range(rest):
            i = _skip_blanks(text, i, end)
            if i == end:
                good[k] = False
            i = _skip_word(text, i, end)
        if _skip_blanks(text, i, end) < end:
            good[k] = False
    return count
