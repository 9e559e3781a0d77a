"""A local Dask cluster, started as documented; one of two workers is killed."""

import math
import re
import signal
import subprocess
import sys
import time

import pytest

from impslam.errors import ConfigError, ImpError
from impslam.sweeps.cluster import Cluster

pytest.importorskip("distributed")
DASK = (sys.executable, "-m", "dask")


@pytest.fixture
def processes(tmp_path):
    begun = []

    def begin(*words):
        process = subprocess.Popen([*DASK, *words], cwd=tmp_path, stderr=subprocess.PIPE, text=True)
        begun.append(process)
        return process

    yield begin
    for process in begun:
        process.kill()
        process.communicate()


@pytest.fixture
def cluster(processes):
    scheduler = processes("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
    for line in scheduler.stderr:
        if found := re.search(r"tcp://127\.0\.0\.1:\d+", line):
            return found.group()
    raise AssertionError("the scheduler told no address")


def test_no_result_is_lost_with_a_killed_worker(processes, cluster):
    words = ("worker", cluster, "--nthreads", "1", "--no-dashboard", "--no-nanny")
    workers = [processes(*words) for _ in "ab"]
    results = {}
    for index, result in Cluster(cluster).each(time.sleep, [0.2] * 12):
        results[index] = result
        if len(results) == 3:
            workers[0].send_signal(signal.SIGKILL)
    assert results == dict.fromkeys(range(12))
    with pytest.raises(ValueError, match="math domain error"):
        list(Cluster(cluster).each(math.sqrt, [-1.0]))
    with pytest.raises(ImpError, match="a worker cannot run the jobs; install the same"):
        list(Cluster(cluster).each(unknown_to_workers, [1]))


def unknown_to_workers(x):
    return x


def test_errors_without_a_scheduler_or_a_worker(cluster, monkeypatch):
    monkeypatch.setattr("impslam.sweeps.cluster.CONNECT_TIMEOUT", 0.5)
    with pytest.raises(ConfigError, match="no scheduler answers"):
        list(Cluster("tcp://127.0.0.1:1").each(math.sqrt, [1]))
    with pytest.raises(ConfigError, match="has no worker; start some with 'dask worker tcp:"):
        list(Cluster(cluster).each(math.sqrt, [1]))
