"""``uorb_net.msg`` and ``uorb_net.messages`` as a user types them."""

import importlib
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from uorb_net import messages, msg
from uorb_net.errors import DefinitionError, UnknownTopicError


@pytest.fixture(scope="module")
def definitions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory on the process's search path."""
    directory = tmp_path_factory.mktemp("definitions")
    (directory / "ModuleSample.msg").write_text("uint8 LIMIT = 3\nfloat32[3] x\n")
    (directory / "ModuleBroken.msg").write_text("\nnonsense\n")
    messages.add_path(directory)
    return directory


@pytest.mark.usefixtures("definitions")
def test_any_message_is_imported_by_name() -> None:
    """The import gives the class that ``load`` gives."""
    from uorb_net.msg import ModuleSample

    assert ModuleSample(x=[1, 2, 3]).x == (1, 2, 3)
    assert ModuleSample.LIMIT == 3
    assert ModuleSample is messages.load("ModuleSample")


@pytest.mark.usefixtures("definitions")
def test_an_unknown_name_is_an_import_error() -> None:
    """As for any module, with what may have been meant where it is an attribute."""
    with pytest.raises(ImportError):
        from uorb_net.msg import NoSuchMessage  # noqa: F401
    with pytest.raises(AttributeError, match="did you mean ModuleSample"):
        _ = msg.ModuleSampel
    with pytest.raises(AttributeError):
        _ = msg.module_sample


@pytest.mark.usefixtures("definitions")
def test_a_broken_definition_says_where() -> None:
    """Importing it raises what is wrong with it."""
    with pytest.raises(DefinitionError, match=r"ModuleBroken\.msg:2"):
        from uorb_net.msg import ModuleBroken  # noqa: F401


@pytest.mark.usefixtures("definitions")
def test_listing_and_star_import() -> None:
    """``dir`` lists all names; a star import leaves out what does not load."""
    assert {"ModuleSample", "ModuleBroken"} <= set(dir(msg))
    assert "ModuleSample" in msg.__all__
    assert "ModuleBroken" not in msg.__all__
    scope: dict[str, Any] = {}
    exec("from uorb_net.msg import *", scope)
    assert scope["ModuleSample"] is messages.load("ModuleSample")


@pytest.mark.usefixtures("definitions")
def test_the_functions_of_the_package() -> None:
    """load, names, definition, type_hash, encode and decode work by name."""
    cls = messages.load("ModuleSample")
    assert "ModuleSample" in messages.names()
    assert "module_sample" in messages.topics()
    assert messages.type_for_topic("module_sample") is cls
    assert messages.definition("ModuleSample") == "uint8 LIMIT = 3\nfloat32[3] x\n"
    assert messages.type_hash("ModuleSample").startswith("RIHS01_")
    assert len(messages.type_hash("ModuleSample")) == 7 + 64
    assert messages.decode(cls, messages.encode(cls(timestamp=4))) == cls(timestamp=4)
    with pytest.raises(UnknownTopicError):
        messages.load("NoSuchMessage")


def test_a_strict_type_checker_takes_the_import_as_a_type(tmp_path: Path) -> None:
    """``mypy --strict`` accepts the class as annotation, as call and as argument."""
    program = tmp_path / "program.py"
    program.write_text(
        "from uorb_net import messages\n"
        "from uorb_net.msg import SensorCombined\n\n"
        "def double(m: SensorCombined) -> SensorCombined:\n"
        "    return SensorCombined(timestamp=2 * m.timestamp)\n\n"
        "class Known(messages.Message, frozen=True):\n"
        "    x: int = 0\n\n"
        "reveal_type(messages.decode(Known, b''))\n"
        "reveal_type(messages.encode(Known()))\n"
        "reveal_type(messages.load('Known'))\n"
    )
    root = str(Path(__file__).parents[2])
    options = ["--strict", "--follow-imports=silent", "--config-file=", "--cache-dir", str(tmp_path)]
    command = [sys.executable, "-m", "mypy", *options, str(program)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root, check=False)
    text = done.stdout
    assert done.returncode == 0, text + done.stderr
    assert 'Revealed type is "program.Known"' in text
    assert 'Revealed type is "bytes"' in text or 'Revealed type is "builtins.bytes"' in text
    assert "type[uorb_net.messages.types.Message]" in text


def test_importing_stays_lean() -> None:
    """The package brings in no network, no asyncio and no parser beyond what msgspec imports anyway."""
    code = (
        "import sys, msgspec; before = set(sys.modules); import uorb_net.messages, uorb_net.msg; "
        "print(*sorted(m for m in set(sys.modules) - before if not m.startswith('uorb_net')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) <= {"_struct", "struct", "errno", "threading", "_weakrefset", "weakref"}


def test_the_module_is_the_pickling_home_of_messages() -> None:
    """``__module__`` of a message class leads back to it."""
    assert importlib.import_module(messages.from_text("Homed", "uint8 x\n").__module__) is msg
