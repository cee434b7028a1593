"""A raw Zenoh session that knows docs/wire.md and nothing of ours is a host like any other."""

import socket
import struct
from contextlib import closing

from communicator import Advert, Peer, SampleHeader, ZenohChannel
from communicator.recorder import Recorder

HAND = Peer("hand", "00000000deadbeef")
IMU = Advert("imu", 2, "px4_msgs/msg/Imu", "RIHS01_" + "ab" * 32, 12, 4, 75, False)


def test_a_host_written_by_hand_from_the_document_speaks_and_is_understood() -> None:
    import zenoh

    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    channel, handler = ZenohChannel(listen=[endpoint]), Recorder()
    channel.register_handler(handler)
    channel.start("uav1", "ours")
    channel.topic_advertised(Advert("gps", 0, "px4_msgs/msg/Gps", "RIHS01_" + "cd" * 32, 8, 1, 50, True))
    us = channel.own.instance_id
    config = zenoh.Config.from_json5(
        '{mode: "peer", listen: {endpoints: []}, scouting: {multicast: {enabled: false}, delay: 0},'
        f'connect: {{endpoints: ["{endpoint}"]}}}}'
    )
    with zenoh.open(config) as raw:
        inbox = [
            raw.declare_subscriber(f"uorb/uav1/{c}/{HAND.instance_id}", zenoh.handlers.RingChannel(9)) for c in "csb"
        ]
        adverts = raw.liveliness().declare_subscriber("uorb/uav1/@adv/ours/**", history=True)
        wishes = raw.liveliness().declare_subscriber(f"uorb/uav1/@sub/{HAND.instance_id}/**", history=True)
        assert str(adverts.recv().key_expr) == (
            f"uorb/uav1/@adv/ours/{us}/0/gps/0/px4_msgs%2Fmsg%2FGps/RIHS01_{'cd' * 32}/8/1/50/s"
        )
        tokens = [
            raw.liveliness().declare_token(f"uorb/uav1/{tail}")
            for tail in (
                f"@adv/hand/{HAND.instance_id}/5/imu/2/px4_msgs%2Fmsg%2FImu/RIHS01_{'ab' * 32}/12/4/75/o",
                f"@sub/{us}/hand/{HAND.instance_id}/0/gps/0/20000",
                f"@host/hand/{HAND.instance_id}/1",
            )
        ]
        assert len(tokens) == 3
        assert handler.wait(lambda events: len(events) == 3)
        assert handler.events[0] == ("peer", HAND, True)
        assert ("remote_topic", HAND, IMU, True) in handler.events
        assert ("add_subscription", HAND, "gps", 0, 20000) in handler.events

        channel.add_subscription(HAND, "imu", 2, 1000)
        wish = f"uorb/uav1/@sub/{HAND.instance_id}/ours/{us}/5/imu/2/1000"
        assert str(wishes.recv().key_expr) == wish
        sample = struct.pack("<BBHIQQI", 1, 1, 5, 12, 7, 400, 3) + b"twelve bytes"
        control = struct.pack("<BBHI", 2, 0, 0, 5) + b"hello"
        frame = struct.pack("<4s8sQ", b"uOR\x01", bytes.fromhex(HAND.instance_id), 1000) + sample + control
        raw.put(f"uorb/uav1/c/{us}", frame)
        header = SampleHeader(7, 400, age_us=600, withheld=3, latched=True)
        assert handler.wait_for("received_message", HAND, "imu", 2, header, b"twelve bytes")
        assert handler.wait_for("control", HAND, b"hello")

        channel.send_message(HAND, "gps", 0, SampleHeader(9, 1), b"8 bytes!")
        channel.flush()
        data = inbox[1].recv().payload.to_bytes()  # queue length 1, small: class s
        assert struct.unpack_from("<4s8s", data) == (b"uOR\x01", bytes.fromhex(us))
        assert struct.unpack_from("<BBHIQQI", data, 20) == (1, 0, 0, 8, 9, 1, 0)
        assert data[48:] == b"8 bytes!"
    assert handler.wait_for("peer", HAND, False)
    assert channel.counters()["malformed"] == channel.counters()["unknown"] == 0
    channel.stop()
