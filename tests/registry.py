"""Register components for the length of a test only."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from impslam import component


@contextmanager
def own_registry() -> Iterator[None]:
    """Put the registry back as it was, so that no test sees what another one registered."""
    for role in component.roles():
        component.components(role)
    roles = {role: dict(known) for role, known in component._ROLES.items()}
    try:
        yield
    finally:
        component._ROLES.clear()
        component._ROLES.update(roles)
        for name in [n for n in sys.modules if n.startswith(("impslam_plugin_", "tests.toys"))]:
            del sys.modules[name]
