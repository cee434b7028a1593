"""The grammar: what a definition may hold, and what is refused with file and line."""

import pytest

from uorb_net.errors import DefinitionError
from uorb_net.messages.grammar import camel_case, parse, snake_case, topics_in

PRIMITIVE_NAMES = (
    "int8 uint8 char int16 uint16 int32 uint32 int64 uint64 float32 float64 bool".split()  # noqa: SIM905
)


@pytest.mark.parametrize("kind", PRIMITIVE_NAMES)
def test_every_primitive_is_a_field_and_an_array(kind: str) -> None:
    """Scalars and fixed arrays of all twelve types are fields."""
    definition = parse("Sample", f"uint64 timestamp\n{kind} a\n{kind}[7] b\n")
    assert [(f.name, f.type, f.length) for f in definition.fields[1:]] == [("a", kind, None), ("b", kind, 7)]


def test_comments_blanks_tabs_and_crlf_are_no_matter() -> None:
    """Comments may hold UTF-8 and odd line separators; lines may end in CRLF."""
    text = "# température °C \u2028 not a line\r\n\r\n\tuint64\t timestamp\t# µs\r\n  float32 x#close\r\n"
    assert [(f.name, f.line) for f in parse("Sample", text).fields] == [("timestamp", 3), ("x", 4)]


def test_constants_between_fields_with_and_without_blanks() -> None:
    """Constants stand anywhere, with or without blanks around ``=``."""
    text = "uint8 A=203\nuint64 timestamp\nint8 B =-3\nfloat32 C= 0.5\nfloat64 D=-1e3\nbool E=true\nbool F=0"
    constants = parse("Sample", text).constants
    assert {c.name: c.value for c in constants} == {
        "A": 203,
        "B": -3,
        "C": 0.5,
        "D": -1e3,
        "E": True,
        "F": False,
    }
    assert [type(c.value) for c in constants] == [int, int, float, float, bool, bool]


def test_a_missing_timestamp_becomes_the_first_field() -> None:
    """Without ``timestamp`` a ``uint64 timestamp`` is put first."""
    fields = parse("Sample", "float32 x\n").fields
    assert [(f.name, f.type) for f in fields] == [("timestamp", "uint64"), ("x", "float32")]


def test_a_declared_timestamp_stays_where_it_is() -> None:
    """A declared ``timestamp`` is left alone."""
    assert [f.name for f in parse("Sample", "float32 x\nuint64 timestamp\n").fields] == ["x", "timestamp"]


def test_an_empty_definition_has_its_timestamp() -> None:
    """A file of comments is a message with a timestamp."""
    assert [f.name for f in parse("Sample", "# nothing\n").fields] == ["timestamp"]


def test_topics_lines_add_up_in_order() -> None:
    """Several ``# TOPICS`` lines add up, each topic once, at the start of a line only."""
    text = "# TOPICS b a\nuint64 timestamp # TOPICS not\n # TOPICS nor\n# TOPICSX nor\n# TOPICS\ta c\r\n"
    assert parse("Sample", text).topics == ("b", "a", "c")
    assert topics_in(text) == ["b", "a", "c"]


def test_without_topics_the_name_in_snake_case_is_the_topic() -> None:
    """The default topic is the snake_case name, or what the file's name says."""
    assert parse("GpsRTCM", "uint8 x\n").topics == ("gps_r_t_c_m",)
    assert parse("Flow2d", "uint8 x\n", topic="flow_2d").topics == ("flow_2d",)


def test_queue_length_is_taken_from_the_constant() -> None:
    """``ORB_QUEUE_LENGTH`` is a constant that also sets the queue length."""
    definition = parse("Sample", "uint8 ORB_QUEUE_LENGTH = 16\n")
    assert definition.queue_length == 16
    assert definition.constants[0].value == 16
    assert parse("Sample", "").queue_length is None


@pytest.mark.parametrize("written", ["Other", "px4_msgs/Other", "px4_msgs/msg/Other", "other"])
def test_nested_messages_may_be_written_in_four_ways(written: str) -> None:
    """PX4's CamelCase, ROS's package forms, and the snake_case of old PX4 trees name one message."""
    assert parse("Sample", f"{written}[2] x\n").fields[1].type == "Other"


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("string x", "unknown type string"),
        ("time x", "unknown type time"),
        ("std_msgs/Header x", "unknown type 'std_msgs/Header'"),
        ("float-32 x", "unknown type"),
        ("__class x", "unknown type"),
        ("float32[] x", "one dimension of fixed length"),
        ("float32[<=3] x", "arrays of fixed length"),
        ("float32[2][2] x", "one dimension of fixed length"),
        ("float32[-1] x", "one dimension of fixed length"),
        ("float32[N] x", "one dimension of fixed length"),
        ("float32[3 x", "one dimension of fixed length"),
        ("float32[9999999999999] x", "one dimension of fixed length"),
        ("float32[0] x", "at least 1"),
        ("float32 x[3]", "belongs to its type: float32[N]"),
        ("float32 1x", "no identifier"),
        ("float32 x-y", "no identifier"),
        ("float32 größe", "no identifier"),
        ("float32 __init__", "no identifier"),
        ("float32 first", "duplicate 'first', first on line 1"),
        ("uint8 first = 1", "duplicate 'first', first on line 1"),
        ("uint8 x 5", "neither a field"),
        ("uint8", "neither a field"),
        ("uint8 x, y", "neither a field"),
        ("---", "neither a field"),
        ("= 3", "neither a field"),
        ("uint8[2] X = 1", "cannot be of type uint8[2]"),
        ("Other X = 1", "cannot be of type Other"),
        ("uint8 X =", "not an integer 0..255"),
        ("uint8 X = 256", "not an integer 0..255"),
        ("uint8 X = -1", "not an integer 0..255"),
        ("int8 X = 128", "not an integer -128..127"),
        ("uint8 X = 1.0", "not an integer"),
        ("uint8 X = 0x10", "not an integer"),
        ("uint8 X = 1_0", "not an integer"),
        ("uint8 X = one", "not an integer"),
        ("float32 X = 1e39", "not a number"),
        ("float64 X = 1e999", "not a number"),
        ("float32 X = nan", "not a number"),
        ("float32 X = 1.2.3", "not a number"),
        ("float32 X = ", "not a number"),
        ("bool X = 2", "not True or False"),
        ("bool X = yes", "not True or False"),
        ("uint8 ORB_QUEUE_LENGTH = 0", "outside 1..255"),
        ("uint16 ORB_QUEUE_LENGTH = 256", "outside 1..255"),
        ("float32 ORB_QUEUE_LENGTH = 2", "outside 1..255"),
        ("# TOPICS good no-good", "'no-good' is no topic name"),
    ],
)
def test_refusals_name_file_line_and_reason(line: str, reason: str) -> None:
    """Each breach raises ``DefinitionError`` with file and line, and says what is wrong."""
    with pytest.raises(DefinitionError) as caught:
        parse("Sample", f"float32 first\n\n{line}\n", file="/some/Sample.msg")
    assert (caught.value.file, caught.value.line) == ("/some/Sample.msg", 3)
    assert str(caught.value).startswith("/some/Sample.msg:3: ")
    assert reason in caught.value.reason


def test_a_constant_named_timestamp_is_refused() -> None:
    """The implicit field's name is taken."""
    with pytest.raises(DefinitionError, match=r":1: .*timestamp"):
        parse("Sample", "uint8 timestamp = 3\n")


@pytest.mark.parametrize(
    ("camel", "snake"),
    [
        ("SensorCombined", "sensor_combined"),
        ("GpsRTCM", "gps_r_t_c_m"),
        ("Ekf2Timestamps", "ekf2_timestamps"),
    ],
)
def test_names_in_both_cases(camel: str, snake: str) -> None:
    """CamelCase and snake_case names turn into each other."""
    assert snake_case(camel) == snake
    assert camel_case(snake) == camel
    assert camel_case(camel) == camel
