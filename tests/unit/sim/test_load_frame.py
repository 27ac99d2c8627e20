"""The simulated load frame: what it answers, and how its specimen follows."""

from __future__ import annotations

import socket
import time

import pytest

from stereorig.sim.load_frame import LoadFrame


def test_the_specimen_follows_less_than_the_actuator_and_all_of_it_once_it_yields() -> None:
    frame = LoadFrame(lambda _: None, compliance=0.4, yields_at=0.003)
    assert frame.strain_at(0.002) == pytest.approx(0.0012)
    assert frame.strain_at(0.005) == pytest.approx(0.003)
    assert frame.strain_at(0.006) == pytest.approx(0.004)
    frame._server.server_close()


def test_it_moves_by_lines_and_refuses_what_is_none() -> None:
    seen: list[float] = []
    with LoadFrame(seen.append) as frame, socket.create_connection(("127.0.0.1", frame.port), timeout=10.0) as link:
        lines = link.makefile("rw", newline="\n")

        def ask(text: str) -> str:
            lines.write(text + "\n")
            lines.flush()
            return lines.readline().strip()

        assert ask("*IDN?") == "stereorig,simulated load frame"
        assert ask("RATE nan").startswith("ERR")
        assert ask("RATE fast").startswith("ERR")
        assert ask("JUMP").startswith("ERR")
        assert ask("RATE 0.01") == "OK"
        time.sleep(0.3)
        assert ask("HOLD") == "OK"
        position = float(ask("POS?"))
        assert position > 0.0
        assert float(ask("FORCE?")) > 0.0
        time.sleep(0.1)
        assert float(ask("POS?")) == position
        lines.close()
    assert seen == sorted(seen)
    assert seen[-1] == pytest.approx(frame.strain_at(position))
