"""replay://: the firmware core with a logged run's samples in place of the plant."""

import numpy as np
import pytest

from station.device.client import Client
from station.device.framing import encode
from station.device.port import open_port
from station.device.protocol import MESSAGES
from station.errors import WorkError

SAMPLE, COMMAND = MESSAGES["sample"], MESSAGES["command"]

LOG = """# rig = "sflr"
# controller = {"kind": "p", "gain": 2.0}
# command_row = -1
t,reference,command,encoder,accel
"""


def write_log(path, rows, gap=False):
    lines = [f"{i / 500},{50 if i > 10 else 0},{min(2 * i, 200)},{i},{-i}" for i in range(rows)]
    path.write_text(LOG + "\n".join(lines) + "\n")
    return path


def session_of(port, rows):
    client = Client(port)
    identity = client.identify()
    client.configure(500.0, identity.command_limit)
    client.arm()
    client.start()
    got = []
    for i in range(rows):
        (body,) = client.decoder.feed(port.read(SAMPLE.wire_size))
        got.append(SAMPLE.unpack(body))
        port.write(encode(COMMAND.pack(index=i + 1, command=7), client.session))
    client.halt()
    return identity, got


def test_each_session_reads_the_log_from_its_first_row_to_its_last(tmp_path):
    path = write_log(tmp_path / "run.csv", 30)
    with open_port(f"replay://{path}") as port:
        for _ in range(2):
            identity, got = session_of(port, 40)
            expected = np.minimum(np.arange(40), 29)
            assert [sample.encoder for sample in got] == expected.tolist()
            assert [sample.accel for sample in got] == (-expected).tolist()
            assert [sample.command for sample in got] == [0] + [7] * 39
    assert identity.command_limit == 200
    assert identity.virtual_time
    assert identity.board == "replay"


def test_in_real_time_too(tmp_path):
    path = write_log(tmp_path / "run.csv", 30)
    with open_port(f"replay://{path}?speed=1") as port:
        client = Client(port)
        assert not client.identify().virtual_time


def test_a_log_with_lost_ticks_is_refused(tmp_path):
    lines = [f"{n / 500},0,0,0,0,{n}" for n in (0, 1, 2, 5, 6)]
    path = tmp_path / "run.csv"
    path.write_text("t,reference,command,encoder,accel,n\n" + "\n".join(lines) + "\n")
    with pytest.raises(WorkError, match="samples lost"):
        open_port(f"replay://{path}")
