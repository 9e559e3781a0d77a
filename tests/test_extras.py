"""The command that installs what an optional part needs."""

import shlex
from importlib.metadata import PackageNotFoundError

from impslam import extras


def test_it_names_packages_since_impslam_may_be_on_no_index(monkeypatch):
    needed = [
        "numpy>=2",
        'nicegui<4,>=3.18; extra == "web"',
        "cobs>=1.2; extra == 'robot'",
        'x; extra == "webs"',
    ]
    monkeypatch.setattr(extras, "requires", lambda name: needed)
    words = shlex.split(extras.install("robot", "web"))
    assert words == ["pip", "install", "nicegui<4,>=3.18", "cobs>=1.2"]


def test_without_metadata_it_names_the_extra(monkeypatch):
    def unknown(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(extras, "requires", unknown)
    assert shlex.split(extras.install("view")) == ["pip", "install", "impslam[view]"]
