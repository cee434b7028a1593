"""The set that comes with the package."""

import pytest

from uorb_net import messages
from uorb_net.messages.registry import Registry


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> Registry:
    """The shipped set alone."""
    monkeypatch.delenv("UORB_MSG_PATH", raising=False)
    return Registry()


def test_every_shipped_definition_loads_and_round_trips(registry: Registry) -> None:
    """No shipped file is broken, and zero messages survive the encoding."""
    assert registry.names()
    for name in registry.names():
        cls = registry.load(name)
        assert messages.decode(cls, messages.encode(cls())) == cls()


def test_every_shipped_topic_leads_to_a_message_that_has_it(registry: Registry) -> None:
    """Topics and messages agree."""
    for topic in registry.topics():
        assert topic in registry.type_for_topic(topic).__uorb__.topics
