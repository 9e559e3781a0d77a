"""The study of the wheels' speed says what its picture shows."""

from impslam.studies.speed_control import speed_control
from impslam.sweeps.job import Job


def test_control_makes_up_for_a_load_and_anti_windup_for_a_stall():
    section = speed_control(Job())
    rise, _, settled, error = section.numbers["load, told only"]
    assert (round(rise, 2), round(error, 3)) == (0.22, -0.06)  # 2.2 T, and 20 % of 0.3 m/s
    controlled = section.numbers["load, controlled"]
    assert controlled[0] < 0.6 * rise
    assert abs(controlled[3]) < 0.02
    assert settled > controlled[2]
    overshoot = [
        section.numbers[f"stall, {kind}"][1] for kind in ("controlled", "without anti-windup")
    ]
    assert overshoot[0] < 0.6 * overshoot[1]
    assert b"<svg" in section.pictures[0].content
