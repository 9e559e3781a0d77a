"""Pools of processes: all items are done, in any order; a process that dies loses only its own item."""

import os
import signal

import pytest

from impslam.errors import ImpError
from impslam.sweeps.job import Job
from impslam.sweeps.pool import ProcessDied, Processes, ThisProcess


def square(x):
    return x * x


def die_at_three(x):
    if x == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return x


def refuse(x):
    raise ArithmeticError(f"no {x}")


@pytest.mark.parametrize("count", [1, 2])
def test_every_item_is_done_once(count):
    assert sorted(Processes(count).each(square, range(5))) == [(k, k * k) for k in range(5)]


def test_a_killed_process_loses_one_item():
    results = dict(Processes(2).each(die_at_three, range(6)))
    assert isinstance(results.pop(3), ProcessDied)
    assert results == {k: k for k in range(6) if k != 3}


def test_no_work_runs_in_the_process_of_a_pool():
    """Work in native code may lose, or not survive, the exception of a signal."""
    assert isinstance(dict(Processes(1).each(die_at_three, [3]))[0], ProcessDied)
    assert dict(ThisProcess().each(lambda _: os.getpid(), [0])) == {0: os.getpid()}


def test_a_job_needs_all_its_results():
    with pytest.raises(ImpError, match="counting: its process was killed"):
        Job(processes=2).map(die_at_three, range(4), "counting")


@pytest.mark.parametrize("count", [1, 2])
def test_exceptions_of_the_work_propagate(count):
    with pytest.raises(ArithmeticError, match="no 1"):
        Job(processes=count).map(refuse, [1, 1], "refusing")
