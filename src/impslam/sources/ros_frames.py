"""Finds the mounts of lasers, and odometry, in the transforms (TF) of a ROS log.

The names of frames follow REP 105: odometry is the pose of base_footprint or base_link in odom.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rosbags.interfaces import Connection

from impslam.errors import MessageError
from impslam.sources.base import Mount, Problems
from impslam.sources.folders import piece
from impslam.sources.mount_watch import MountWatch
from impslam.sources.ros_messages import read_transform
from impslam.sources.ros_storage import Bag, RosMessage
from impslam.sources.ros_topics import ODOMETRY_TYPE, TF_TYPES, TYPES, is_truth, namespace
from impslam.sources.static_links import StaticLinks
from impslam.sources.transforms import FrameTransform, FrameTree, flattened
from impslam.types import Array

STATIC = "tf_static"
BASES = ("base_footprint", "base_link", "base")
WORLDS = ("map", "world", "earth")
MAX_MOUNT_DISTANCE = 100.0  # m from base to a laser, more than on any robot
FIRST_PIECE = " (of a split bag, the first piece has it: give the folder with all pieces)"
FIRST_SCANS = 200
"""Scans in which a frame that the user names must occur."""
LOOK_AHEAD = 30 * 10**9
"""Time after the first scan, ns, in which each transform of a robot is published many times."""


class Edge(NamedTuple):
    """A transform of a topic, with the frame names as written there."""

    topic: str
    parent: str
    child: str

    def pick(self, message: RosMessage) -> RosMessage | None:
        """Return this transform from a message, the last if there are several, or None."""
        index = self.find(message)
        return None if index is None else message.transforms[index]

    def find(self, message: RosMessage) -> int | None:
        """Return the index of this transform in a message, or None."""
        names = [(t.header.frame_id, t.child_frame_id) for t in message.transforms]
        found = [k for k, name in enumerate(names) if name == self[1:]]
        return found[-1] if found else None

    def is_in(self, data: bytes) -> bool:
        """Return whether a serialised message contains both frame names, and so maybe the transform."""
        return self.parent.encode() in data and self.child.encode() in data


class Frames:
    """The frames of a log at its first scan.

    Several robots in one log may have equal names of frames, in topics of their own. Here the names begin
    with the namespace of these topics then.

    Attributes
    ----------
    lasers, receivers : frame of each topic of scans, and of each topic of GNSS fixes
    written : frame of each topic of scans as its messages name it
    """

    def __init__(self, path: Path, bag: Bag, problems: Problems, scan_frame: str = "") -> None:
        self.lasers: dict[str, str] = {}
        self.written: dict[str, str] = {}
        self.receivers: dict[str, str] = {}
        self._path, self._problems = path, problems
        self._robots = _robots(bag.connections)
        self._tree, self._sources = FrameTree(), dict[frozenset[str], str]()
        self._static, self._bad = StaticLinks(), dict[str, str]()
        self._edges: dict[Edge, None] = {}
        self._children: dict[str, str] = {}
        self._end = ""  # where reading of transforms ended early, for messages
        begin = self._read_sensors(bag, _plain(scan_frame))
        self._tree = FrameTree({*self.lasers.values(), *self.receivers.values()})
        publishers = [c for c in bag.connections if c.msgtype in TF_TYPES and c.msgcount]
        self._read(bag, publishers, begin)

    # ------------------------------------------------------------------ reading

    def _read_sensors(self, bag: Bag, scan_frame: str) -> int:
        """Read the frames of sensors and odometry; return the log time of the first scan, ns."""
        for connection in bag.connections:
            if connection.msgtype == ODOMETRY_TYPE and not is_truth(connection.topic):
                for message, _ in first_message(bag, connection):
                    self._children[connection.topic] = self._name(
                        connection.topic, message.child_frame_id
                    )
            elif connection.msgtype in TYPES["fix"]:
                for message, _ in first_message(bag, connection):
                    self.receivers[connection.topic] = self._name(
                        connection.topic, message.header.frame_id
                    )
        return self._read_scans(bag, scan_frame)

    def _read(self, bag: Bag, publishers: Sequence[Connection], begin: int) -> None:
        """Read the transforms."""
        static = [c for c in publishers if _is_static(c)]
        moving = [c for c in publishers if not _is_static(c)]
        for connection, time, message in _decoded(bag, static):
            self._learn(connection.topic, message, time <= begin)
        for connection, time, message in _decoded(bag, moving):
            if time > begin + LOOK_AHEAD:
                self._end = f" in the first {LOOK_AHEAD // 10**9} s of {connection.topic}"
                break
            if time > begin and self._is_complete():
                break
            self._learn(connection.topic, message, time <= begin)
        self._report_reversed()

    def _read_scans(self, bag: Bag, chosen: str) -> int:
        """Read the frames of the scans; return the log time of the first scan, ns.

        The frame of a topic is that of its first scan, or the one that is chosen if it has scans in it.
        """
        times, scans = [], [c for c in bag.connections if c.msgtype in TYPES["scan"]]
        for connection in scans:
            for message, time in first_message(bag, connection):
                self.written.setdefault(connection.topic, message.header.frame_id)
                times.append(time)
        if chosen:
            for connection, _, message in islice(_decoded(bag, scans), FIRST_SCANS):
                if _plain(message.header.frame_id) == chosen:
                    self.written[connection.topic] = message.header.frame_id
        self.lasers = {topic: self._name(topic, frame) for topic, frame in self.written.items()}
        return min(times, default=0)

    def _learn(self, topic: str, message: RosMessage, is_before: bool) -> None:
        """Add the transforms of a message; of each, the last one before the first scan counts."""
        for transform in message.transforms:
            edge = Edge(topic, transform.header.frame_id, transform.child_frame_id)
            self._edges[edge] = None
            parent, child = self._ends(edge)
            counts = is_before or self._tree.lacks(parent, child)
            if not counts and not topic.endswith(STATIC):
                continue
            try:
                link = FrameTransform(parent, child, read_transform(transform))
            except MessageError as error:
                self._bad.setdefault(
                    child, f"the transform {parent} -> {child} is not valid: {error}"
                )
                continue
            if topic.endswith(STATIC):
                self._static.add(link)
            if counts:
                self._set(topic, link)

    def _set(self, topic: str, link: FrameTransform) -> None:
        """Set a link of the tree; report a child that has another parent already."""
        if self._tree.add(link):
            self._sources[link.pair] = topic
        else:
            self._problems.add(
                "frame with two parents",
                f"{self._path}: {topic}: {link.child} has another parent than {link.parent}; the "
                "first one is used: let only one program publish its transform",
            )

    def _report_reversed(self) -> None:
        """Report the links that the tree contains in reverse."""
        published = {self._ends(edge): edge.topic for edge in self._edges}
        for (parent, child), topic in published.items():
            link = self._tree.get(parent)
            if link is not None and link.parent == child and (child, parent) not in published:
                self._problems.add(
                    "reversed transform",
                    f"{self._path}: {topic}: {parent} is published as the parent of {child}, which "
                    "has another parent; it is inverted; ROS needs it the other way round",
                )

    def _is_complete(self) -> bool:
        """Return whether the mounts of all lasers are known, and odometry if no topic contains it."""
        known = all(self._base(frame) for frame in self.lasers.values())
        return known and bool(self._children or all(map(self.odometry, self.lasers)))

    @property
    def merged(self) -> set[str]:
        """Topics of scans in the frame of a base: they are merged from several lidars, unless alone."""
        return {topic for topic, frame in self.lasers.items() if _last(frame) in BASES}

    def odometry(self, scan: str) -> Edge | None:
        """Return the transform from odom to an ancestor of a topic's laser frame, or else to base."""
        found = [
            edge
            for edge in self._edges
            if "odom" in _last(edge.parent) and not edge.topic.endswith(STATIC)
        ]
        ancestors, robot = {frame := self.lasers.get(scan, "")}, self._robot(scan)
        with suppress(MessageError):
            ancestors |= {link.parent for link in self._tree.up(frame)}
        ranked = [
            (
                self._ends(e)[1] not in ancestors,
                _last(e.child) not in BASES or self._robot(e.topic) != robot,
                k,
            )
            for k, e in enumerate(found)
        ]
        best = min(ranked, default=None)
        return None if best is None or (best[0] and best[1]) else found[best[2]]

    # ------------------------------------------------------------------ names

    def _robot(self, topic: str) -> str:
        """Return the namespace of the robot that a topic is from; "" unless the log has several robots."""
        own = namespace(topic)
        return own if own in self._robots else ""

    def _name(self, topic: str, frame: str) -> str:
        """Return the name of a frame, which begins with the namespace of its robot if there are several."""
        robot, frame = self._robot(topic).lstrip("/"), _plain(frame)
        is_whole = not frame or not robot or frame.startswith(f"{robot}/")
        return frame if is_whole else f"{robot}/{frame}"

    def _ends(self, edge: Edge) -> tuple[str, str]:
        """Return the names of the parent and the child of a transform."""
        return self._name(edge.topic, edge.parent), self._name(edge.topic, edge.child)

    def links(self, bag: Bag, connection: Connection, data: bytes) -> Iterator[FrameTransform]:
        """Yield the valid links of a serialised message."""
        with suppress(Exception):  # rosbags may raise anything on damaged data
            for transform in bag.decoder(connection)(data).transforms:
                edge = Edge(connection.topic, transform.header.frame_id, transform.child_frame_id)
                with suppress(MessageError):
                    yield FrameTransform(*self._ends(edge), read_transform(transform))

    # ------------------------------------------------------------------ mounts

    def mounts(self, odometry: str, edge: Edge | None) -> dict[str, Mount]:
        """Return the mount of the laser of each topic of scans.

        base is the child frame of odometry, which is the topic `odometry` or its transform `edge`.
        """
        return self._mounts_of(self.lasers, odometry, edge)

    def antennas(self, odometry: str, edge: Edge | None) -> dict[str, Mount]:
        """Return the mount of the antenna of each topic of fixes; see `mounts`."""
        return self._mounts_of(self.receivers, odometry, edge)

    def _mounts_of(
        self, frames: Mapping[str, str], odometry: str, edge: Edge | None
    ) -> dict[str, Mount]:
        base = self._children.get(odometry, "")
        if edge is not None and odometry == edge.topic:
            base = self._ends(edge)[1]
        mounts = {topic: self._mount(frame, base) for topic, frame in frames.items()}
        if self._edges:
            return mounts
        return {topic: mount for topic, mount in mounts.items() if mount.pose is not None}

    def watch(self, mounts: Mapping[str, Mount], topics: Collection[str]) -> MountWatch:
        """Return a watch of the mounts of these topics of scans."""
        known = {topic: mounts[topic].base for topic in topics if mounts[topic].pose is not None}
        return MountWatch(self._tree, {t: (base, self.lasers[t]) for t, base in known.items()})

    def publishers(self, bag: Bag, pairs: Collection[frozenset[str]]) -> list[Connection]:
        """Return the connections that may move some links: those that publish them, except static ones."""
        topics = {self._sources[pair] for pair in pairs}
        found = [c for c in bag.connections if c.msgtype in TF_TYPES]
        return [c for c in found if c.topic in topics and not _is_static(c)]

    def _mount(self, frame: str, base: str) -> Mount:
        try:
            base = self._base(frame, base)
            if not base:
                return Mount(None, origin=self._unknown(frame))
            T, links = self._chain(base, frame)
        except MessageError as error:
            return Mount(None, origin=str(error))
        if not np.abs(T).max() < MAX_MOUNT_DISTANCE:
            return Mount(None, origin=f"according to the transforms, {frame} is far from {base}")
        planar = flattened(T)
        topics = ", ".join(dict.fromkeys(self._sources[link.pair] for link in links))
        origin = f"{topics + ': ' if topics else ''}{base} -> {frame}"
        rivals = tuple(
            Mount(*rival, f"{link.parent} -> {link.child}", base)
            for link, rival in self._static.rivals(self._tree, base, frame)
        )
        return Mount(*planar, origin, base, rivals)

    def _chain(self, base: str, frame: str) -> tuple[Array, list[FrameTransform]]:
        """Return `T_base_frame` and its links; raise `MessageError` if there is none on the robot."""
        with np.errstate(all="ignore"):  # a damaged log may have links of 1e300 m
            T, links = self._tree.chain(base, frame)
        if any("odom" in _last(link.parent) or _last(link.parent) in WORLDS for link in links):
            raise MessageError(f"{base} and {frame} are not on the same robot")
        return T, links

    def _base(self, frame: str, base: str = "") -> str:
        """Return the given base if it is linked to a frame, or else a linked frame with a base's name."""
        own = frame if _last(frame) in BASES else ""
        for candidate in (base, *self._named(BASES), own):
            with suppress(MessageError):
                if candidate and (candidate == frame or self._chain(candidate, frame)):
                    return candidate
        return ""

    def _named(self, names: Sequence[str]) -> list[str]:
        known = dict.fromkeys([name for edge in self._edges for name in self._ends(edge)])
        return [frame for name in names for frame in known if _last(frame) == name]

    def _unknown(self, frame: str) -> str:
        """Return why the mount of a laser is unknown."""
        links = self._tree.up(frame)  # raises if they form a loop
        top = links[-1].parent if links else frame
        if top in self._bad:
            return self._bad[top]
        bases = self._named(BASES)
        if not frame:
            return "its messages have no frame"
        if not links:
            own = piece(self._path) if self._path.is_file() else None
            hint = FIRST_PIECE if own is not None and own[1] > 0 else ""
            return f"there is no transform to {frame}{self._end}{hint}"
        base = bases[0] if bases else "base_link"
        return f"{frame} leads up to {top}, not to {base}{self._end}"


def _robots(connections: Sequence[Connection]) -> set[str]:
    """Return the namespaces of robots, which have scans and transforms; none of a single robot."""
    recorded = [connection for connection in connections if connection.msgcount]
    scans = {namespace(c.topic) for c in recorded if c.msgtype in TYPES["scan"]}
    found = scans & {namespace(c.topic) for c in recorded if c.msgtype in TF_TYPES}
    return found if len(found) > 1 else set()


def _is_static(connection: Connection) -> bool:
    return connection.topic.endswith(STATIC)


def first_message(bag: Bag, connection: Connection) -> Iterator[tuple[RosMessage, int]]:
    """Yield the first message of a connection and its log time; nothing if it cannot be read."""
    for _, time, message in _decoded(bag, [connection]):
        yield message, time
        return


def _decoded(
    bag: Bag, connections: Sequence[Connection]
) -> Iterator[tuple[Connection, int, RosMessage]]:
    """Yield the messages that can be read; the run reports the others."""
    records = bag.messages(connections) if connections else iter(())
    with suppress(Exception):  # rosbags may raise anything on damaged data
        for connection, time, data in records:
            message = None
            with suppress(Exception):
                message = bag.decoder(connection)(data)
            if message is not None:
                yield connection, time, message


def _plain(frame: str) -> str:
    """Return the name of a frame without the leading slash of tf in ROS 1."""
    return frame.lstrip("/")


def _last(frame: str) -> str:
    """Return the name of a frame without its namespace."""
    return frame.rsplit("/", 1)[-1]
