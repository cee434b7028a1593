"""What the documents show runs as it stands."""

import re
from pathlib import Path
from typing import Any

import pytest

import uorb_net as uorb
from uorb_net.msg import SensorCombined
from uorb_net.orb import set_default_broker

ROOT = Path(__file__).parents[2]


def snippets(document: str) -> list[str]:
    """Return a document's Python blocks in order."""
    return re.findall(r"^```python\n(.*?)^```", (ROOT / document).read_text(), re.DOTALL | re.MULTILINE)


def test_the_classic_functions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """docs/classic.md, with a folder for its message and a sensor that publishes."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_messages").mkdir()
    (tmp_path / "my_messages" / "random_integer.msg").write_text("int32 r\n")
    scope: dict[str, Any] = {}
    with uorb.Broker.private() as broker:
        set_default_broker(broker)
        for code in snippets("docs/classic.md"):
            exec(compile(code, "docs/classic.md", "exec"), scope)
        assert capsys.readouterr().out.startswith("Random integer is now ")
        sensor = broker.advertise(SensorCombined, SensorCombined(accelerometer_m_s2=(1.0, 2.0, -9.8125)))
        subscription = broker.subscribe("vehicle_attitude", start="new")
        scope["republish"](0)
        interrupt = broker.subscribe(SensorCombined, start="new")
        from threading import Timer

        Timer(0.05, lambda: sensor.publish(SensorCombined(accelerometer_m_s2=(1.0, 2.0, -9.8125)))).start()
        scope["px4_simple_app"](1)
        assert "1.0000\t  2.0000\t -9.8125" in capsys.readouterr().out
        Timer(0.05, lambda: sensor.publish(SensorCombined(accelerometer_m_s2=(1.0, 2.0, 3.0)))).start()
        scope["republish"](1)
        assert interrupt.check()
        assert subscription.copy().q == (1.0, 2.0, 3.0, 0.0)


def test_the_readme(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The README's publisher and subscriber, the latter cut short by its own loop's timeout."""
    monkeypatch.setenv("UORB_RUNTIME_DIR", str(tmp_path))
    publisher, subscriber = snippets("README.md")[:2]
    scope: dict[str, Any] = {}
    exec(compile(publisher, "README.md", "exec"), scope)
    exec(compile(subscriber.replace("timeout=1.0", "timeout=0.05"), "README.md", "exec"), scope)
    assert scope["message"].q == (1.0, 0.0, 0.0, 0.0)
    scope["broker"].close()
