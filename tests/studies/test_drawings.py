"""The drawings are vector pictures, the same each time, and say what they show."""

from xml.etree import ElementTree as ET

import pytest

from impslam.studies.drawings import DRAWINGS, drawings
from impslam.studies.report import load_text
from impslam.sweeps.job import Job

SAID = {
    "fig04-system": {"autopilot", "browser: map, joystick"},
    "fig09-motion": {"α", "R", "w", "l", "r"},
    "fig20-normal-form": {"D", "r", "α", "map"},
    "fig21-frames": {"P1", "P2", "base_link", "map"},
    "fig23-arena": {"cylinder 1", "cylinder 2", "cylinder 3"},
    "fig28-obstacles": {"box"},
}


@pytest.fixture(scope="module")
def section():
    return drawings(Job())


def test_each_is_vector_graphics_with_its_words(section):
    assert {picture.name for picture in section.pictures} == set(DRAWINGS)
    for picture in section.pictures:
        assert picture.file == f"{picture.name}.svg"
        root = ET.fromstring(picture.content)
        words = {part.strip() for e in root.iter() for part in [*e.itertext()] if part.strip()}
        assert SAID.get(picture.name, set()) <= words
        assert b"<image" not in picture.content


def test_they_are_the_same_bytes_again(section):
    again = drawings(Job(processes=2))
    assert [p.content for p in again.pictures] == [p.content for p in section.pictures]


def test_each_has_a_caption():
    assert set(load_text("drawings")["captions"]) == set(DRAWINGS)
