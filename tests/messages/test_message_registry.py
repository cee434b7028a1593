"""The search path and what is found on it: names, topics, precedence, bad files, publishers' texts."""

import gc
from pathlib import Path

import pytest

from uorb_net.errors import DefinitionError, UnknownTopicError
from uorb_net.messages.registry import Registry

RULE = "=" * 80


def write(directory: Path, **texts: str) -> Path:
    """Write definition files and return their directory."""
    directory.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (directory / f"{name}.msg").write_text(text, encoding="utf-8")
    return directory


@pytest.fixture
def shipped(tmp_path: Path) -> Path:
    """A small shipped set."""
    return write(
        tmp_path / "shipped",
        SensorAccel="float32 x\n",
        VehicleOdometry="# TOPICS vehicle_odometry estimator_odometry\nfloat32[4] q\n",
        Status="uint8 ORB_QUEUE_LENGTH = 8\nCell cell\n",
        Cell="float32 voltage\n",
    )


@pytest.fixture
def registry(shipped: Path, monkeypatch: pytest.MonkeyPatch) -> Registry:
    """A registry of the small set, without the environment's directories."""
    monkeypatch.delenv("UORB_MSG_PATH", raising=False)
    return Registry(str(shipped))


def test_a_name_is_loaded_once(registry: Registry) -> None:
    """The same class comes back, by message or by topic."""
    cls = registry.load("SensorAccel")
    assert registry.load("SensorAccel") is cls
    assert registry.load("sensor_accel") is cls
    assert registry.type_for_topic("sensor_accel") is cls
    assert (cls.__name__, cls.__module__) == ("SensorAccel", "uorb_net.msg")


def test_nested_types_are_the_registered_ones(registry: Registry) -> None:
    """A message nests the very class that ``load`` gives."""
    status = registry.load("Status")
    assert status.__uorb__.nested["Cell"] is registry.load("Cell")


def test_topics_lines_give_one_message_several_topics(registry: Registry) -> None:
    """Each listed topic leads to the message, and only those."""
    cls = registry.type_for_topic("estimator_odometry")
    assert cls.__name__ == "VehicleOdometry"
    assert registry.topics() == ["cell", "estimator_odometry", "sensor_accel", "status", "vehicle_odometry"]


def test_a_file_name_is_no_topic_where_others_are_listed(registry: Registry, shipped: Path) -> None:
    """With a ``# TOPICS`` line the own name counts only if listed."""
    write(shipped, SensorGps="# TOPICS vehicle_gps_position\nfloat64 lat\n")
    assert registry.type_for_topic("vehicle_gps_position").__name__ == "SensorGps"
    with pytest.raises(UnknownTopicError):
        registry.type_for_topic("sensor_gps")


@pytest.mark.parametrize("stem", ["SensorBaro", "sensor_baro"])
def test_files_may_have_either_case_and_lie_below(registry: Registry, tmp_path: Path, stem: str) -> None:
    """Sub-directories are searched; snake_case and CamelCase names are the same message."""
    write(tmp_path / "more" / "versioned" / "deep", **{stem: "float32 pressure\n"})
    registry.add_path(tmp_path / "more")
    assert registry.load("SensorBaro") is registry.type_for_topic("sensor_baro")
    assert "SensorBaro" in registry.names()


def test_a_snake_case_file_name_is_the_topic_as_it_stands(registry: Registry, tmp_path: Path) -> None:
    """``flow_2d.msg`` has the topic ``flow_2d``."""
    registry.add_path(write(tmp_path / "more", flow_2d="float32 x\n"))
    assert registry.load("Flow2d").__uorb__.topics == ("flow_2d",)
    assert registry.type_for_topic("flow_2d") is registry.load("Flow2d")


def test_first_added_wins_then_the_environment_then_the_shipped_set(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Precedence: ``add_path`` in order, ``$UORB_MSG_PATH`` in order, the shipped set."""
    places = {}
    for place in ("first", "second", "third", "fourth"):
        places[place] = write(tmp_path / place, **{f"Only{place.title()}": "uint8 x\n"})
    for place, names in {"first": "A", "second": "AB", "third": "ABC", "fourth": "ABCD"}.items():
        write(places[place], **{f"Type{name}": f"uint8 {place}\n" for name in names})
    write(places["fourth"], SensorAccel="uint8 fourth\n")
    registry.add_path(places["first"])
    registry.add_path(str(places["second"]))
    monkeypatch.setenv("UORB_MSG_PATH", f"{places['third']}:/nonexistent::{places['fourth']}")
    found = {name: registry.load(name).__struct_fields__[1] for name in ("TypeA", "TypeB", "TypeC", "TypeD")}
    assert found == {"TypeA": "first", "TypeB": "second", "TypeC": "third", "TypeD": "fourth"}
    assert registry.load("SensorAccel").__struct_fields__[1] == "fourth"


def test_a_path_added_later_changes_only_names_not_loaded(registry: Registry, tmp_path: Path) -> None:
    """What is loaded stays; what is not is found in the new place."""
    loaded = registry.load("SensorAccel")
    registry.add_path(write(tmp_path / "more", SensorAccel="uint8 y\n", Cell="uint8 y\n"))
    assert registry.load("SensorAccel") is loaded
    assert registry.definition("SensorAccel") == "float32 x\n"
    assert registry.load("Cell").__struct_fields__ == ("timestamp", "y")


def test_a_directory_that_is_none_is_refused(registry: Registry, tmp_path: Path) -> None:
    """``add_path`` of nothing is a mistake worth an error."""
    with pytest.raises(NotADirectoryError, match="nowhere"):
        registry.add_path(tmp_path / "nowhere")


def test_a_file_written_after_the_first_look_is_found(registry: Registry, shipped: Path) -> None:
    """Files may come while the program runs."""
    with pytest.raises(UnknownTopicError):
        registry.load("Late")
    with pytest.raises(UnknownTopicError):
        registry.type_for_topic("late_too")
    write(shipped, Late="# TOPICS late late_too\nuint8 x\n")
    assert registry.type_for_topic("late_too") is registry.load("Late")


def test_in_an_earlier_directory_another_message_may_take_a_topic(registry: Registry, tmp_path: Path) -> None:
    """Precedence holds for ``# TOPICS`` lines too."""
    registry.add_path(write(tmp_path / "more", Mine="# TOPICS sensor_accel\nuint8 x\n"))
    assert registry.type_for_topic("sensor_accel").__name__ == "Mine"


def test_an_unknown_name_is_named_with_its_likes(registry: Registry) -> None:
    """The error says what may have been meant."""
    with pytest.raises(UnknownTopicError, match="no topic 'sensor_acel' is defined; did you mean sensor_accel"):
        registry.type_for_topic("sensor_acel")
    with pytest.raises(UnknownTopicError, match="no message 'SensorAcel' is defined; did you mean SensorAccel"):
        registry.load("SensorAcel")
    for call in (registry.load, registry.definition, registry.type_hash, registry.type_for_topic):
        for name in ("", "Nothing", "nothing", "../Cell", "Cell.msg", "None"):
            with pytest.raises(UnknownTopicError):
                call(name)


def test_a_bad_file_hurts_only_itself_and_those_that_nest_it(registry: Registry, shipped: Path) -> None:
    """Other names load, are listed and have their topics."""
    write(shipped, Cell="float32 voltage\nfloat99 x\n", Other="# TOPICS more\nstring x\n")
    assert registry.load("SensorAccel")
    assert {"Cell", "Other", "SensorAccel", "Status"} <= set(registry.names())
    assert registry.type_for_topic("estimator_odometry").__name__ == "VehicleOdometry"
    for name in ("Cell", "Status", "cell"):
        with pytest.raises(DefinitionError) as caught:
            registry.load(name)
        assert (caught.value.file, caught.value.line) == (str(shipped / "Cell.msg"), 2)
    with pytest.raises(DefinitionError, match=r"Other\.msg:2: "):
        registry.type_for_topic("more")
    assert registry.definition("Cell") == "float32 voltage\nfloat99 x\n"


def test_a_corrected_file_loads(registry: Registry, shipped: Path) -> None:
    """A refusal is not remembered."""
    write(shipped, Cell="nonsense\n")
    with pytest.raises(DefinitionError):
        registry.load("Status")
    write(shipped, Cell="float32 voltage\n")
    assert registry.load("Status").__uorb__.payload_length == 24


@pytest.mark.parametrize(
    ("texts", "line", "reason"),
    [
        ({"A": "uint8 x\nNowhere y\n"}, 2, "unknown type 'Nowhere'"),
        ({"A": "flaot32 y\n"}, 1, "unknown type 'flaot32'"),
        ({"A": "A y\n"}, 1, "recursive message A -> A"),
        ({"A": "B y\n", "B": "\nC y\n", "C": "uint8 x\n\nA y\n"}, 3, "recursive message A -> B -> C -> A"),
        ({"A": "uint8[80000000] x\n"}, 1, "larger than"),
        ({"A": "B[60000] x\n", "B": "float64[60000] x\n"}, 1, "larger than"),
        ({"A": "B[900000] x\n", "B": "uint8 timestamp\n"}, 1, "larger than"),
        ({f"T{i}": f"T{i + 1} x\n" for i in range(40)} | {"A": "T0 x\n"}, 1, "nested more than"),
    ],
)
def test_definitions_that_do_not_join_up_are_refused(
    tmp_path: Path, texts: dict[str, str], line: int, reason: str
) -> None:
    """Unknown, recursive and oversized nested messages are refused with file and line."""
    with pytest.raises(DefinitionError) as caught:
        Registry(str(write(tmp_path / "bad", **texts))).load("A")
    assert caught.value.line == line
    assert caught.value.file.endswith(".msg")
    assert reason in caught.value.reason


def test_a_file_that_is_not_utf_8_loads(registry: Registry, shipped: Path) -> None:
    """Only comments hold such bytes; a byte order mark is no part of the text."""
    (shipped / "Old.msg").write_bytes(b"\xef\xbb\xbf# 20 \xb0C\r\nuint8 x\r\n")
    assert registry.load("Old").__struct_fields__ == ("timestamp", "x")


def test_a_text_gives_the_registered_class_where_the_hashes_are_equal(registry: Registry) -> None:
    """Comments make no difference, and the nested class is the registered one too."""
    text = f"# hello\nCell cell\n{RULE}\nMSG: px4_msgs/Cell\nfloat32 voltage # V\n"
    cls = registry.from_text("Status", text)
    assert cls is registry.load("Status")
    assert cls.__uorb__.nested["Cell"] is registry.load("Cell")


def test_a_text_of_another_hash_gives_another_class(registry: Registry) -> None:
    """It is not registered, and one per hash."""
    first = registry.from_text("SensorAccel", "float64 x\n")
    assert first is registry.from_text("SensorAccel", "float64 x # again\n")
    assert first is not registry.load("SensorAccel")
    assert first.__uorb__.type_hash != registry.type_hash("SensorAccel")
    assert registry.from_text("NotInstalled", "uint8 x\n").__name__ == "NotInstalled"
    assert "NotInstalled" not in registry.names()


def test_a_text_does_not_bind_a_name_of_the_search_path(registry: Registry, tmp_path: Path) -> None:
    """Looking for an equal definition loads nothing that is not equal."""
    registry.from_text("SensorAccel", "float64 x\n")
    registry.add_path(write(tmp_path / "more", SensorAccel="uint8 y\n"))
    assert registry.load("SensorAccel").__struct_fields__ == ("timestamp", "y")


def test_the_full_text_makes_the_same_type_elsewhere(registry: Registry, tmp_path: Path) -> None:
    """Text, hash and bytes survive the way through a publisher's text."""
    kind = registry.load("Status").__uorb__
    twin = Registry(str(tmp_path / "nothing")).from_text("Status", kind.full_definition).__uorb__
    assert twin.cls is not kind.cls
    for attribute in (
        "type_hash",
        "topics",
        "queue_length",
        "payload_length",
        "definition",
        "full_definition",
    ):
        assert getattr(twin, attribute) == getattr(kind, attribute)


def test_types_of_texts_go_when_nobody_uses_them(registry: Registry) -> None:
    """A peer that sends texts without end does not fill the memory."""
    for index in range(20):
        registry.from_text(f"Passing{index}", "uint8 x\n")
    gc.collect()
    assert len(registry._foreign) == len(registry._texts) == 0


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("", "uint8 x\n"),
        ("no-name", "uint8 x\n"),
        ("Status", "Missing cell\n"),
        ("Status", f"Cell cell\n{RULE}\nMSG: px4_msgs/Cell\nnonsense\n"),
        ("Status", "\0\0\0"),
    ],
)
def test_a_bad_text_is_a_definition_error(registry: Registry, name: str, text: str) -> None:
    """Whatever a peer sends, the error is ours."""
    with pytest.raises(DefinitionError):
        registry.from_text(name, text)
