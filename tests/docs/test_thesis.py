"""docs/thesis.md leaves out nothing of the thesis, and what it names is there."""

import re
from itertools import pairwise
from pathlib import Path

import pytest

from impslam.cli.reproduce import EXPERIMENTS
from impslam.config import presets

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "thesis.md").read_text("utf-8")
ROWS = [line.split("|")[1:-1] for line in PAGE.splitlines() if line.startswith("| ")]
FIRST = [row[0].strip() for row in ROWS if row[0].strip() != "Thesis"]

COUNTS = {2: 29, 3: 19, 4: 22}
"""Equations of each chapter."""
EQUATIONS = {f"{chapter}.{k}" for chapter, n in COUNTS.items() for k in range(1, n + 1)}
SECTIONS = re.findall(
    r"\S+",
    """
    1.1 1.2 1.3
    2.1 2.1.1 2.1.2 2.1.3 2.1.4 2.2 2.2.1 2.2.2 2.3
    3.1 3.2 3.3 3.3.1 3.4 3.5.1 3.5.2
    4.1.1 4.1.2 4.1.3 4.1.4 4.2.1 4.2.2 4.2.3 4.2.4 4.2.5 4.2.6
    5.1 5.2 5.2.1 5.2.2 5.2.3 5.2.4
    """,
)
LIST = re.compile(r"(Eq\.|Fig\.|Tables?|Algorithm) ((?:[\d.]*\d)(?:(?:, | to )[\d.]*\d)*)")


def numbered(kind):
    """Return the numbers that first cells give after a word; "2.1 to 2.10" are ten."""
    found = set()
    for cell in FIRST:
        for word, listed in LIST.findall(cell):
            if word.rstrip("s") == kind:
                found |= expanded(listed)
    return found


def expanded(listed):
    out = set()
    for part in listed.split(", "):
        ends = part.split(" to ")
        head, _, begin = ends[0].rpartition(".")
        last = int(ends[-1].rpartition(".")[2])
        out |= {f"{head}.{k}".lstrip(".") for k in range(int(begin), last + 1)}
    return out


@pytest.mark.parametrize(
    ("kind", "all_of_them"),
    [
        ("Eq.", EQUATIONS),
        ("Fig.", {str(k) for k in range(1, 30)}),
        ("Table", {"1", "2", "3"}),
        ("Algorithm", {"1", "2"}),
    ],
)
def test_everything_numbered_has_a_row(kind, all_of_them):
    assert numbered(kind) == all_of_them


def test_every_section_has_a_row_and_they_are_in_order():
    named = [match[0] for cell in FIRST if (match := re.match(r"[1-5](\.\d)+", cell))]
    assert set(named) == set(SECTIONS)
    places = [SECTIONS.index(name) for name in named]
    assert all(
        a <= b or name == "5.2.1" for (a, b), name in zip(pairwise(places), named[1:], strict=True)
    )


def test_rows_are_whole():
    assert {len(row) for row in ROWS} == {4}
    assert len(FIRST) > 100


def test_what_is_named_exists():
    named = set(re.findall(r"`([\w/.-]+)`", PAGE))
    files = {name for name in named if "/" in name or name.endswith((".py", ".toml"))}
    missing = {
        name
        for name in files
        if not any((root / name).exists() for root in (ROOT, ROOT / "src/impslam"))
    }
    assert missing <= {"src/impslam/"}
    experiments = set(re.findall(r"`imp reproduce (\w+)`", PAGE))
    assert experiments <= set(EXPERIMENTS)
    of_thesis = {name for name in named if name.startswith("thesis-") and not name.endswith("*")}
    assert of_thesis <= set(presets())
