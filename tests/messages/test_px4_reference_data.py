"""PX4's own types: hashes, sizes and bytes from the reference data kept beside the repository."""

import json
from pathlib import Path
from typing import Any

import pytest

from uorb_net import messages
from uorb_net.messages.registry import Registry

REFERENCE = Path(__file__).parents[3] / "shared" / "px4"

pytestmark = pytest.mark.skipif(
    not (REFERENCE / "msg").is_dir(),
    reason=f"no PX4 reference data in {REFERENCE.name} beside the repository",
)


@pytest.fixture(scope="module")
def registry() -> Registry:
    """The definitions of the reference data, and no others."""
    return Registry(str(REFERENCE / "msg"))


def read(name: str) -> Any:
    """Return one of the reference files."""
    return json.loads((REFERENCE / name).read_text())


def test_every_definition_loads(registry: Registry) -> None:
    """All of them, as they are."""
    assert len(registry.names()) == len(list((REFERENCE / "msg").glob("*.msg"))) > 40
    for name in registry.names():
        assert registry.load(name)() == registry.load(name)()


def test_hashes_are_those_of_the_ros_2_generator(registry: Registry) -> None:
    """Every type whose definition is here has the hash ROS 2 gave it."""
    hashes = read("type_hashes.json")["releases"]["main"]["hashes"]
    known = {name: registry.type_hash(name) for name in registry.names() if name in hashes}
    assert known == {name: hashes[name] for name in known}
    assert len(known) > 10


def test_default_topics_have_the_right_type_hash_and_size(registry: Registry) -> None:
    """The topic tables of PX4's zenoh module agree with what is loaded for each topic."""
    tables = read("topics.json")
    for row in (*tables["publications"], *tables["subscriptions"]):
        kind = registry.type_for_topic(row["uorb"]).__uorb__
        found = (f"px4_msgs/msg/{kind.name}", kind.type_hash, kind.payload_length)
        assert found == (row["type"], row["hash"], row["exact_payload"]), row["topic"]


def test_encodings_are_byte_for_byte_the_recorded_ones(registry: Registry) -> None:
    """Given values give the recorded bytes, and back; PX4's padded form decodes too."""
    for case in read("encodings.json")["cdr"]:
        cls = registry.load(case["type"].rpartition("/")[2])
        message = cls(**{name: _numbers(value) for name, value in case["values"].items()})
        data = messages.encode(message)
        assert data.hex() == case["cdr_hex"]
        assert messages.encode(messages.decode(cls, data + b"\xaa" * (case["px4_len"] - len(data)))) == data


def _numbers(value: Any) -> Any:
    """Return a value of the file with its nulls as NaN."""
    if isinstance(value, list):
        return [_numbers(element) for element in value]
    return float("nan") if value is None else value
