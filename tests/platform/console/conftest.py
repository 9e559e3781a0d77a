"""The page on a fake robot, in a browser."""

import pytest
from tests.platform.console import browsing


@pytest.fixture(scope="module")
def browser(chromium):
    with browsing.browser(chromium) as made:
        yield made


@pytest.fixture(scope="module")
def shared():
    """A fake robot that drives round the arena; modules may override it."""
    with browsing.robot("--tour") as made:
        yield made


@pytest.fixture
def robot(shared):
    shared.ask("reset")
    return shared
