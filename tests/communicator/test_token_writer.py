"""A slot's new token is declared before its old one goes, and only the last wish counts."""

from threading import Event, Thread

from communicator.token_writer import TokenWriter


class Network:
    """Takes down what is declared (+) and undeclared (-)."""

    def __init__(self) -> None:
        self.log: list[str] = []
        self.errors: list[Exception] = []
        self.writer = TokenWriter(self.errors.append)

    def declare(self, key: str) -> "_Token":
        if key == "bad":
            raise ValueError(key)
        self.log.append("+" + key)
        return _Token(self, key)


class _Token:
    def __init__(self, network: Network, key: str) -> None:
        self.network = network
        self.key = key

    def undeclare(self) -> None:
        self.network.log.append("-" + self.key)


def test_what_was_wanted_before_the_session_opened_is_declared_then() -> None:
    network = Network()
    network.writer.set("host", "H")
    network.writer.set("topic", "old")
    network.writer.set("topic", "T")
    network.writer.set("gone", "G")
    network.writer.set("gone", None)
    network.writer.attach(network.declare)
    assert network.log == ["+H", "+T"]


def test_a_change_declares_the_new_before_it_drops_the_old() -> None:
    network = Network()
    network.writer.attach(network.declare)
    for key in ("1000", "1000", "0", None, None):
        network.writer.set("sub", key)
    assert network.log == ["+1000", "+0", "-1000", "-0"]


def test_clear_drops_the_chosen_slots_only() -> None:
    network = Network()
    network.writer.attach(network.declare)
    for slot in ("a1", "a2", "b1"):
        network.writer.set(slot, slot.upper())
    network.writer.clear(lambda slot: str(slot).startswith("a"))
    assert network.log[3:] == ["-A1", "-A2"]


def test_a_refused_token_is_reported_and_holds_up_nothing() -> None:
    network = Network()
    network.writer.attach(network.declare)
    network.writer.set("x", "bad")
    network.writer.set("y", "Y")
    assert [str(error) for error in network.errors] == ["bad"]
    assert network.log == ["+Y"]


def test_a_second_thread_leaves_its_wish_and_returns() -> None:
    network = Network()
    entered, go_on = Event(), Event()

    def slow(key: str) -> _Token:
        entered.set()
        assert go_on.wait(5)
        return network.declare(key)

    network.writer.attach(slow)
    first = Thread(target=network.writer.set, args=("sub", "1"))
    first.start()
    assert entered.wait(5)
    network.writer.set("sub", "2")
    network.writer.set("sub", "3")
    go_on.set()
    first.join(5)
    assert network.log == ["+1", "+3", "-1"]
