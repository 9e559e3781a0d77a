"""Imported by the process from which tests fork commands: import and load what mapping a log needs."""

import tempfile
from pathlib import Path

from impslam.cli import main

with tempfile.TemporaryDirectory() as folder:
    log = str(Path(folder) / "room.mcap")
    main(["simulate", "room", "-o", log, "--quiet"])
    main(["run", log, "-o", str(Path(folder) / "run"), "--quiet"])
