"""The commands of `imp`."""

from __future__ import annotations

COMMANDS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "demo": (
        "demo:demo",
        "Simulate a drive through a small arena, map it, and score the map.",
        ("", "--seed 3 -o demo", "-c thesis-both"),
    ),
    "inspect": (
        "inspect:inspect",
        "Print the contents of a log and any problems with it.",
        ("drive.mcap", "drive.mcap -c myrobot.toml"),
    ),
    "run": (
        "run:run",
        "Map a log and write the path, landmarks, grid and report to a folder.",
        (
            "monday.mcap -o monday",
            "drive.bag -c myrobot.toml --topic scan=/front/scan",
            "tuesday.mcap --map monday/map.imp --frozen -o tuesday",
        ),
    ),
    "evaluate": (
        "evaluate:evaluate",
        "Score runs against ground truth or measured relations.",
        ("first second -o compare.png", "first --truth truth.tum --json first.json"),
    ),
    "calibrate": (
        "calibrate:calibrate",
        "Calibrate a robot's wheels, lidar pose, latency and noise from its logs.",
        ("drive.mcap -o mine.toml", "one.bag two.bag -c myrobot.toml --keep track -o mine.toml"),
    ),
    "map": (
        "map:app",
        "Inspect, straighten, compare, merge and export maps, and localise scans in them.",
        ("info office.imp", "merge one.imp two.imp -o all.imp"),
    ),
    "robot": (
        "robot:app",
        "Serve a web page to drive the robot, record and map.",
        ("--virtual", "-c robot.toml --record --map"),
    ),
    "simulate": (
        "simulate:simulate",
        "Simulate a drive through a world and write its log and ground truth.",
        ("office -o office.mcap", "hall.toml -o hall.mcap --seed 1 --set lidar.range_max=10"),
    ),
    "sweep": (
        "sweep:sweep",
        "Run all combinations of logs, configs, settings and seeds, and tabulate the errors.",
        ("monday.log tuesday.log -c default -c mine.toml -o sweep", "arena --seeds 20 -o arena"),
    ),
    "tune": (
        "tune:tune",
        "Tune noise and gates over many runs and write a config.",
        (
            "monday.log -c mine.toml --score likelihood -o tune",
            "monday.log --holdout tuesday.log --search association.gate=0.9,0.99,0.999",
        ),
    ),
    "track": (
        "track:track",
        "Extract the robot's true path from an overhead camera's video.",
        ("overhead.mp4 -o truth.tum", "overhead.mp4 --setup camera.toml -o truth.tum"),
    ),
    "reproduce": (
        "reproduce:reproduce",
        "Reproduce the experiments of the thesis, with tables and figures.",
        ("points --seeds 1", "corridor --full -o corridor"),
    ),
    "list": (
        "list:list_components",
        "List the components of each role and their parameters.",
        ("presets", "filter"),
    ),
    "config": (
        "config:config",
        "Print all parameters of a preset or config file as TOML.",
        ("imp", "myrobot.toml --set filter.kind=ekf"),
    ),
    "--install-completion": (
        "completion:install_completion",
        "Install completion of commands and options for your shell.",
        ("", "--shell zsh"),
    ),
}
"""Each command's module and function (imported only when called, so that `imp --help` is quick), its
summary, and examples of its arguments, in the order in which a user with a log needs them."""

USAGES = {
    name: f"Usage: imp {name} [OPTIONS] {several}...\n"
    for name, several in (
        ("evaluate", "RUNS"),
        ("calibrate", "LOGS"),
        ("sweep", "LOGS"),
        ("tune", "LOGS"),
    )
}
"""Usage of the commands that need one or more runs or logs; cyclopts would call these optional."""
