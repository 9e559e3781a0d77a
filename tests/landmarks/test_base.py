"""What of an observation's attributes its landmark has, too."""

from impslam.landmarks.base import average


def test_means_move_by_a_share_and_leave_out_what_depends_on_the_robot():
    means = {"radius": 1.0}
    average(means, {"radius": 2.0, "angle": 1.5, "heading": 3.0, "course": -3.0}, 0.25)
    assert means == {"radius": 1.25, "angle": 1.5}
