"""The real page, with a watcher's socket that sends events of any content to its elements."""

import gc
import itertools
import json
import time

import pytest
from nicegui import Client
from tests.platform.console.fake_station import FakePlayer, FakeStation
from tests.platform.console.serving import WATCH, serving
from tests.platform.console.test_security import opened, soon

from impslam.platform.console import page
from impslam.platform.console.connection import MESSAGE_BURST
from impslam.platform.console.model import Model
from impslam.platform.console.refusals import FIRST, Refusals
from impslam.platform.console.session_store import Sessions

ARGUMENTS = [
    [], ["null"], ["5"], ["-1e999"], ['"x"'], ["{}"], ["[]"], ["[1,2]"], ["[1,2,3]"], ["true"],
    ['{"value":{}}'], ["1e308", "{}"], ['"' + "x" * 3000 + '"'], [None], ["9" * 60], ["-1"],
    ['[{}, [], "x"]'], ['[99999999999999999999, true]'], ["[null,null,null]"],
]  # fmt: skip


@pytest.mark.parametrize("replay", [False, True])
def test_no_message_of_a_watcher_raises_an_error(tmp_path, replay, caplog):
    caplog.set_level("INFO")
    station = FakeStation(tmp_path, tour=False)
    model = Model(
        "IMP", station.view, None if replay else station, FakePlayer() if replay else None
    )
    with serving(tmp_path, build=lambda _: page.build(model)) as served:
        with served.logged_in(WATCH) as client:
            name = client.get("/").text.partition("'client_id': '")[2].partition("'")[0]
            with opened(served, client, page=name) as line:
                line.recv(timeout=5)
                time.sleep(0.5)  # the lists have been filled
                found = Client.instances[name].elements.values()
                listeners = [(one.id, key) for one in list(found) for key in one._event_listeners]
                assert len(listeners) >= (6 if replay else 3)
                sent = list(itertools.product(listeners, ARGUMENTS))
                assert len(sent) < MESSAGE_BURST  # else the socket would be cut
                for (ident, key), args in sent:
                    event = {"id": ident, "client_id": name, "listener_id": key, "args": args}
                    line.send("42" + json.dumps(["event", event]))
                last = "42" + json.dumps(["log", {"client_id": name}])
                line.send(last)
                soon(lambda: "a message of another kind" in caplog.text)
        gc.collect()  # a task that failed is told when it is collected
        records = list(
            caplog.records
        )  # nicegui complains at the end of a server that is not the first
    assert not [one for one in records if one.name in {"nicegui", "asyncio"} or one.exc_info], (
        records
    )


def test_refused_commands_of_a_watcher_do_not_fill_the_log(caplog):
    caplog.set_level("INFO")
    refusals = Refusals()
    sessions = Sessions(report=refusals.record)
    _, session = sessions.begin("watch", "10.0.0.9")
    for _ in range(1000):
        session.refused("log in with the drive password\nimp: warning: forged")
    refusals.flush(everything=True)
    assert len(caplog.records) <= FIRST + 1
    assert (
        "refused 10.0.0.9: a command of watcher 1 (log in with the drive password\\x0a"
        in caplog.text
    )
