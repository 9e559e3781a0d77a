"""Step responses of the virtual robot's wheels, with and without speed control (thesis 3.3.1)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from impslam.evaluation.colours import INK, ODOMETRY, PATH
from impslam.evaluation.plots import TIGHT, as_svg, new_figure, quiet
from impslam.platform.virtual.wheel_encoders import AbsoluteEncoder, Accumulator
from impslam.platform.virtual.wheel_speed import SpeedControl, SpeedController
from impslam.simulation.body import STEP, Body
from impslam.simulation.world import load_world
from impslam.studies.report import Picture, ResultTable, Section, load_text
from impslam.sweeps.job import Job
from impslam.types import Array

BEGIN, EVENT, RELEASED, END = 0.2, 1.0, 1.5, 3.0  # s
SPEED, TURN, LOAD = 0.3, 0.15, 0.2  # m/s, m/s, 1
SETTLED = 0.1  # share of the step by which a settled speed may be off


class SpeedCase(NamedTuple):
    """Commanded speeds of the wheels, and the disturbance at `EVENT`."""

    name: str
    commanded: tuple[float, float]
    load: float = 0.0
    stalls: bool = False


CASES = (
    SpeedCase("step", (SPEED, SPEED)),
    SpeedCase("turn", (SPEED - TURN, SPEED + TURN)),
    SpeedCase("load", (SPEED, SPEED), load=LOAD),
    SpeedCase("stall", (SPEED, SPEED), stalls=True),
)
KINDS = {"none": INK, "without anti-windup": ODOMETRY, "control": PATH}


def speed_control(job: Job) -> Section:
    """Show the speeds of the driven wheels in all cases; `job.seeds` is ignored."""
    text = load_text("speed_control")
    combinations = [(case, kind) for case in CASES for kind in KINDS]
    found = replace(job, processes=1).map(_speeds, combinations, "speeds")
    speeds = dict(zip(combinations, found, strict=True))
    rows = [
        [case.name, text["kinds"][kind], *_figures(case, speeds[case, kind]).values()]
        for case, kind in combinations
    ]
    cells = [[a, b, *(f"{value:.3f}" for value in rest)] for a, b, *rest in rows]
    table = ResultTable(text["table"], text["header"], cells, 2, text["note"])
    picture = Picture("speed-control", _picture(text, speeds), text["caption"], "svg")
    numbers = {f"{a}, {b}": rest for a, b, *rest in rows}
    words = text["text"].format(**_settings())
    return Section("wheels", text["title"], words, [table], [picture], numbers)


def _settings() -> dict[str, str]:
    known = SpeedControl()
    values = {"T": known.time_constant, "F": known.feedback, "D": known.dead_time}
    values |= {"L": known.closed, "K": known.gain, "T_i": known.integral_time}
    return {name: f"{value:.3g}" for name, value in values.items()}


def _speeds(combination: tuple[SpeedCase, str]) -> Array:
    """Return the speeds (n, 2) m/s of the driven wheels, every ms."""
    case, kind = combination
    body, rng = Body(load_world("room"), seed=1), np.random.default_rng(1)
    encoders, counters = [AbsoluteEncoder(r) for r in rng.spawn(2)], (Accumulator(), Accumulator())
    control = None if kind == "none" else SpeedController(anti_windup=kind == "control")
    every = round(SpeedControl().period / STEP)
    speeds = np.zeros((round(END / STEP), 2))
    for k in range(len(speeds)):
        time = k * STEP
        body.advance(time)
        for angle, encoder, counter in zip(body.wheel_angles(), encoders, counters, strict=True):
            counter.add(encoder.read(angle, time), time)
        _disturb(body, case, time)
        commanded = np.array(case.commanded) * (time >= BEGIN)
        if control is None:
            body.drive(*commanded.tolist())
        elif k % every == 0:
            control.commanded = commanded
            body.drive(*control.step((counters[0].count, counters[1].count)).tolist())
        speeds[k] = body.motors
    return speeds


def _disturb(body: Body, case: SpeedCase, time: float) -> None:
    """Load or block the wheels."""
    body.load = case.load * (time >= EVENT)
    for side in ("left", "right"):
        body.stall(side, case.stalls and EVENT <= time < RELEASED)


def _figures(case: SpeedCase, speeds: Array) -> dict[str, float]:
    """Return rise time, overshoot, settling time and final error of the right wheels, in s and m/s."""
    y, wanted = speeds[:, 1], case.commanded[1]
    begin, event = round(BEGIN / STEP), round(EVENT / STEP)
    first = y[begin:event]
    rise = STEP * float(np.argmax(first >= 0.9 * wanted) - np.argmax(first >= 0.1 * wanted))
    since = {"load": event, "stall": round(RELEASED / STEP)}.get(case.name, begin)
    off = np.flatnonzero(np.abs(y[since:] - wanted) > SETTLED * wanted)
    settled = STEP * float(off[-1] + 1) if len(off) else 0.0
    return {
        "rise": rise,
        "overshoot": max(float(y[since:].max() - wanted), 0.0),
        "settled": settled if since * STEP + settled < END - STEP else math.inf,
        "error": float(np.mean(y[-round(0.5 / STEP) :]) - wanted),
    }


def _picture(text: Mapping[str, Any], speeds: Mapping[tuple[SpeedCase, str], Array]) -> bytes:
    """Draw a panel for each case."""
    figure = new_figure(9.0, 5.6)
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    times = STEP * np.arange(round(END / STEP))
    for axes, case in zip(panels.flat, CASES, strict=True):
        for side in (0, 1)[case.commanded[0] == case.commanded[1] :]:
            axes.plot(times, case.commanded[side] * (times >= BEGIN), "--", color=INK, lw=0.8)
            for kind, colour in KINDS.items():
                label = text["kinds"][kind] if side == 1 else None
                axes.plot(times, speeds[case, kind][:, side], color=colour, lw=1.1, label=label)
        axes.set_title(text["cases"][case.name], fontsize=10, color=INK)
        quiet(axes)
    panels[0, 0].legend(fontsize=8, frameon=False, loc="lower right")
    for axes in panels[1]:
        axes.set_xlabel("time in s")
    for axes in panels[:, 0]:
        axes.set_ylabel("driven wheels in m/s")
    return as_svg(figure, **TIGHT)
