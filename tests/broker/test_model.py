"""Random programs on one bus against a model of a few lines: every answer must be the model's."""

import os
import shutil
import tempfile
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, consumes, invariant, multiple, precondition, rule

import uorb_net as uorb
from uorb_net.broker import growth, members
from uorb_net.msg import OrbTest

INSTANCES = 10
TOPIC = "orb_multitest"
BROKERS = 3


class Node:
    """What the semantics say of a node; a reader's position is kept with the reader."""

    def __init__(self) -> None:
        self.written: list[int] = []
        self.floor = 0
        self.depth = 1
        self.publishers = 0
        self.subscribers = 0
        self.priority = 75
        self.lost = 0

    @property
    def readable(self) -> bool:
        """Whether the present advertisement has data."""
        return self.publishers > 0 and len(self.written) > self.floor

    def advertise(self, depth: int | None, priority: int) -> None:
        """Count a publisher in."""
        fresh = not self.publishers
        if fresh or (depth is not None and not self.readable):
            self.depth = depth or 1
        if fresh:
            self.floor = len(self.written)
            self.priority = priority
        self.publishers += 1


class Reader:
    """A subscription and where the model has it."""

    def __init__(self, real: uorb.Subscription[OrbTest], node: Node, start: str) -> None:
        self.real = real
        self.node = node
        self.lost = 0
        newest = len(node.written)
        self.position = newest
        if start != "new" and node.publishers:
            self.position = max(newest - (1 if start == "latest" else node.depth), node.floor)

    @property
    def pending(self) -> int:
        """Unread samples that can be read one by one."""
        node = self.node
        unread = len(node.written) - max(self.position, node.floor)
        return min(unread, node.depth) if node.publishers else 0

    def copy(self) -> int:
        """Deliver a sample as the semantics say; returns its number from 0."""
        node = self.node
        newest = len(node.written)
        if node.depth == 1 or self.position >= newest:
            number = newest - 1
        else:
            number = max(self.position, newest - node.depth, node.floor)
        if number >= self.position:
            lost = number - max(self.position, node.floor)
            self.lost += lost
            node.lost += lost
            self.position = number + 1
        return number


class Bus(RuleBasedStateMachine):
    """Several brokers on one bus; `make` opens one."""

    publications = Bundle("publications")
    readers = Bundle("readers")

    def __init__(self) -> None:
        super().__init__()
        self.brokers: list[uorb.Broker | None] = [self.make() for _ in range(BROKERS)]
        self.nodes: dict[int, Node] = {}
        self.open: dict[int, list[Any]] = {index: [] for index in range(BROKERS)}  # users by broker
        self.count = 0

    def make(self) -> uorb.Broker:
        """Open a broker on the bus."""
        raise NotImplementedError

    def node(self, instance: int) -> Node:
        """Return a node of the model, made when first named."""
        return self.nodes.setdefault(instance, Node())

    def broker(self, index: int) -> uorb.Broker:
        """Return a broker, opened anew if it was closed."""
        broker = self.brokers[index]
        if broker is None:
            broker = self.brokers[index] = self.make()
        return broker

    @rule(
        target=publications,
        broker=st.integers(0, BROKERS - 1),
        depth=st.none() | st.integers(1, 6) | st.just(255),
        multi=st.booleans(),
        priority=st.integers(1, 255),
    )
    def advertise(self, broker: int, depth: int | None, multi: bool, priority: int) -> Any:
        """Instance 0 for `advertise`; the lowest that is not advertised for `advertise_multi`."""
        instance = 0
        if multi:
            free = [n for n in range(INSTANCES) if not self.node(n).publishers] if self.nodes else [0]
            if not free:
                with pytest.raises(uorb.InstanceError):
                    self.broker(broker).advertise_multi(TOPIC)
                return multiple()
            instance = free[0]
            real = self.broker(broker).advertise_multi(TOPIC, priority=priority, queue_length=depth)
        else:
            priority = 75
            real = self.broker(broker).advertise(TOPIC, queue_length=depth)
        assert (real.instance, real.priority) == (instance, priority)
        node = self.node(instance)
        node.advertise(depth, priority)
        assert real.queue_length == node.depth
        self.open[broker].append((real, node))
        return real, node

    @rule(publication=publications, times=st.integers(1, 9))
    def publish(self, publication: tuple[Any, Node], times: int) -> None:
        """A spent publication raises, another writes."""
        real, node = publication
        for _ in range(times):
            self.count += 1
            if not self.is_open(publication):
                with pytest.raises(uorb.ClosedError):
                    real.publish(OrbTest(val=self.count))
                return
            real.publish(OrbTest(val=self.count))
            node.written.append(self.count)

    @rule(publication=publications)
    def unadvertise(self, publication: tuple[Any, Node]) -> None:
        """Counted, and idempotent."""
        real, _ = publication
        real.unadvertise()
        self.left(publication)

    @rule(
        target=readers,
        broker=st.integers(0, BROKERS - 1),
        instance=st.integers(0, 3) | st.integers(0, INSTANCES - 1),
        start=st.sampled_from(["latest", "new", "oldest"]),
    )
    def subscribe(self, broker: int, instance: int, start: str) -> Reader:
        """Works with and without a publisher."""
        node = self.node(instance)
        real = self.broker(broker).subscribe(TOPIC, instance, start=start)
        reader = Reader(real, node, start)
        node.subscribers += 1
        self.open[broker].append(reader)
        return reader

    @rule(reader=readers, times=st.integers(1, 4), informed=st.booleans())
    def copy(self, reader: Reader, times: int, informed: bool) -> None:
        """Delivers what the arithmetic says, or raises."""
        for _ in range(times):
            if not self.is_open(reader):
                with pytest.raises(uorb.ClosedError):
                    reader.real.copy()
            elif not reader.node.readable:
                with pytest.raises(uorb.NoDataError):
                    reader.real.copy()
            elif informed:
                number = reader.copy()
                message, info = reader.real.copy_with_info()
                assert (message.val, info.generation) == (reader.node.written[number], number + 1)
            else:
                assert reader.real.copy().val == reader.node.written[reader.copy()]

    @rule(reader=readers)
    def drain(self, reader: Reader) -> None:
        """Updates until there are none."""
        if self.is_open(reader):
            while reader.pending:
                assert uorb.poll([reader.real], 0) == [reader.real]
                message = reader.real.update()
                assert message is not None
                assert message.val == reader.node.written[reader.copy()]
            assert reader.real.update() is None
            assert not reader.real.wait(0)

    @rule(reader=consumes(readers))
    def unsubscribe(self, reader: Reader) -> None:
        """A closed subscription is closed."""
        reader.real.close()
        self.left(reader)
        with pytest.raises(uorb.ClosedError):
            reader.real.check()

    @rule(reader=readers, retained=st.sampled_from([0, 5, 40, 300]))
    def replace(self, reader: Reader, retained: int) -> None:
        """Replace the node's buffer under everybody: nothing may change."""
        if self.is_open(reader):
            node = reader.real._node
            with node.directory.hold():
                members._follow(node)
                growth.replace(node, node.mapping.queue_length, retained)

    @precondition(lambda self: any(self.open.values()))
    @rule(broker=st.integers(0, BROKERS - 1))
    def close(self, broker: int) -> None:
        """Closing a broker closes what was opened through it, and nothing else."""
        real = self.brokers[broker]
        if real is not None:
            real.close()
            for user in list(self.open[broker]):
                self.left(user)
            self.brokers[broker] = None

    def is_open(self, user: object) -> bool:
        """Tell whether a publication or reader has not been closed."""
        return any(user in users for users in self.open.values())

    def left(self, user: Any) -> None:
        """Take a user out of the model."""
        for users in self.open.values():
            if user in users:
                users.remove(user)
                if isinstance(user, Reader):
                    user.node.subscribers -= 1
                else:
                    user[1].publishers -= 1

    @invariant()
    def readers_agree(self) -> None:
        """Every reader tells what the model tells of it, without a side effect."""
        for users in self.open.values():
            for reader in users:
                if isinstance(reader, Reader):
                    real, node = reader.real, reader.node
                    assert real.check() == (reader.pending > 0)
                    assert real.pending == reader.pending
                    assert real.lost == reader.lost
                    assert real.generation == reader.position
                    assert real.advertised == (node.publishers > 0)
                    assert real.queue_length == node.depth
                    assert real.priority == node.priority
                    assert (real.stat() > 0) == bool(node.written)

    @invariant()
    def the_bus_agrees(self) -> None:
        """`exists`, `group_count` and `topics` tell what the model tells."""
        broker = next((broker for broker in self.brokers if broker is not None), None)
        if broker is None:
            return
        assert broker.group_count(TOPIC) == sum(node.publishers > 0 for node in self.nodes.values())
        for status in broker.topics():
            node = self.nodes[status.instance]
            assert status.advertised == (node.publishers > 0) == broker.exists(TOPIC, status.instance)
            assert (status.publishers, status.subscribers) == (node.publishers, node.subscribers)
            assert status.generation == len(node.written)
            assert (status.queue_length, status.lost) == (node.depth, node.lost)

    def teardown(self) -> None:
        """Close what is open."""
        for broker in self.brokers:
            if broker is not None:
                broker.close()


class PrivateBus(Bus):
    """Everything through one private broker, under several names."""

    def __init__(self) -> None:
        self._one = uorb.Broker.private()
        super().__init__()

    def make(self) -> uorb.Broker:
        """Open another broker on the same memory."""
        broker = uorb.Broker.__new__(uorb.Broker)
        broker.vehicle = "default"
        broker._open(self._one._directory)
        return broker

    def teardown(self) -> None:
        """Close all."""
        super().teardown()
        self._one.close()


class SharedBus(Bus):
    """Brokers on one folder, of which one always stays open so that the bus lives on."""

    def __init__(self) -> None:
        self._folder = tempfile.mkdtemp(prefix="uorb-test-", dir="/dev/shm" if os.path.isdir("/dev/shm") else None)
        self._one = self.make()
        super().__init__()

    def make(self) -> uorb.Broker:
        """Open a broker on the folder."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("UORB_RUNTIME_DIR", self._folder)
            return uorb.Broker("model")

    def teardown(self) -> None:
        """Close all and remove the folder."""
        super().teardown()
        self._one.close()
        shutil.rmtree(self._folder, ignore_errors=True)


EXAMPLES = settings(max_examples=60, stateful_step_count=40, deadline=None, suppress_health_check=list(HealthCheck))
TestPrivateBus = PrivateBus.TestCase
TestPrivateBus.settings = EXAMPLES
TestSharedBus = SharedBus.TestCase
TestSharedBus.settings = EXAMPLES
