"""Every way to a controller, and what lines do to bytes: terminal servers, noise, a move that is sent once."""

from __future__ import annotations

import contextlib
import math
import random
import threading
import time
from collections.abc import Iterator

import pytest

from stereorig.core.errors import StageError
from stereorig.drivers.registry import STAGE_DRIVERS
from stereorig.drivers.stages.protocol import AxisOptions, AxisState
from stereorig.sim.controllers.registry import make_controller
from stereorig.sim.controllers.server import ControllerServer
from tests.support.patience import within
from tests.support.rfc2217_server import Rfc2217Server
from tests.support.stage_bench import CONTROLLERS, FAKES, Bench, bench, in_thread, wait_until


@contextlib.contextmanager
def behind_terminal_server(driver: str, **controller_options: float) -> Iterator[tuple[Bench, Rfc2217Server]]:
    controller = make_controller(driver, (1, 2), **{"time_scale": 50.0, "start_mm": 3.0, **controller_options})  # type: ignore[arg-type]
    with ControllerServer(controller, "pty") as server, Rfc2217Server(server.url) as terminal:
        stage = STAGE_DRIVERS[driver](terminal.url, {1: AxisOptions(), 2: AxisOptions()}, timeout_s=0.5)
        stage.open()
        made = Bench(driver, controller, server, stage)
        try:
            yield made, terminal
        finally:
            made.stage.close()


@pytest.mark.parametrize("driver", CONTROLLERS)
def test_a_controller_behind_a_terminal_server(driver: str) -> None:
    with behind_terminal_server(driver) as (stand, terminal):
        assert terminal.baudrates[-1] == (57600 if driver == "smc100" else 921600)
        stand.ready(1, 2)
        assert stand.stage.move_to(1, 5.25).position_mm == pytest.approx(5.25, abs=1e-4)
        assert stand.controller.true_position_mm(1) == pytest.approx(5.25, abs=1e-6)
        with pytest.raises(StageError) as caught:
            stand.stage.move_to(1, 60.0)
        assert caught.value.code == "out_of_limits"
        stand.controller.line_faults.lose_replies = 1
        assert stand.stage.position(1) == pytest.approx(5.25, abs=1e-4)


def test_a_stop_passes_a_terminal_server_at_once() -> None:
    def stopped_after_s() -> float:
        with behind_terminal_server("esp301", time_scale=1.0, start_mm=0.0) as (stand, _):
            stand.ready(1)
            thread, errors = in_thread(lambda: stand.stage.move_to(1, 40.0))
            wait_until(lambda: stand.axis(1).moving)
            asked = time.monotonic()
            stand.stage.stop()
            thread.join(5.0)
            assert [error.code for error in errors] == ["stage_stopped"]
            arrived = next(entry.at_s for entry in stand.controller.received if entry.text == "ST")
            return arrived - asked if stand.controller.true_position_mm(1) < 20.0 else math.inf

    within(0.5, stopped_after_s)


def test_a_terminal_server_that_hangs_up_is_a_lost_stage_and_can_be_opened_again() -> None:
    with behind_terminal_server("esp301") as (stand, terminal):
        stand.ready(1)
        terminal.hang_up()
        with pytest.raises(StageError) as caught:
            stand.stage.position(1)
        assert caught.value.code == "stage_lost"
        stand.stage.close()
        stand.stage.open()
        assert stand.stage.position(1) == pytest.approx(0.0, abs=1e-4)
        assert stand.stage.state(1).state is AxisState.NOT_HOMED


@pytest.mark.parametrize("url", ["rfc2217://127.0.0.1:1", "rfc2217://", "socket://", "socket://127.0.0.1:none", "loop"])
def test_a_url_that_leads_nowhere_is_a_lost_stage_that_names_it(url: str) -> None:
    stage = STAGE_DRIVERS["esp301"](url, {1: AxisOptions()}, timeout_s=0.1)
    with pytest.raises(StageError) as caught:
        stage.open()
    assert caught.value.code == "stage_lost"
    assert url in caught.value.cause


# pyserial's own, in the thread that reads from a terminal server
pytestmark = pytest.mark.filterwarnings(r"ignore:set(Daemon|Name)\(\):DeprecationWarning")
FAULTS = ("lose_replies", "halve_replies", "garble_replies")
STRAY = (
    b"\0",
    b"\0\0\0",
    b"\xff\xfe\0",
    b"7\r\n",
    b"0, 1, NO ERROR DETECTED\r\n",
    b"1TP9.0000\r\n",
    b"garbage",
    b"\r\n\r\n",
)


@pytest.mark.fault(25)
@pytest.mark.parametrize("driver", [*CONTROLLERS, *FAKES])
@pytest.mark.parametrize("seed", range(2))
def test_whatever_happens_to_replies_a_move_is_sent_once_and_its_outcome_is_true(driver: str, seed: int) -> None:
    """Random faults at random moments: a move is on the wire at most once, and a position that is reported is true."""
    dice = random.Random(1000 + seed)
    with bench(driver, "socket", start_mm=0.0, options={1: AxisOptions(assume_homed=True)}) as stand:
        stand.ready(1)
        lies = reports = lost = 0
        codes: set[str] = set()
        for _ in range(10):
            target = round(dice.uniform(-20.0, 20.0), 3)
            before = len(stand.sent("move"))
            for _ in range(dice.randrange(3)):
                setattr(stand.controller.line_faults, dice.choice(FAULTS), dice.randrange(1, 4))
            if dice.random() < 0.5:
                stand.controller.line_faults.stray = dice.choice(STRAY)
            silence = threading.Timer(dice.uniform(0.0, 0.1), setattr, (stand.controller.line_faults, "silent", True))
            if dice.random() < 0.3:
                silence.start()
            try:
                result = stand.stage.move_to(1, target)
            except StageError as error:
                codes.add(error.code)
                lost += 1
            else:
                reports += 1
                lies += abs(result.position_mm - stand.controller.true_position_mm(1)) > 1e-3
            silence.cancel()
            if silence.ident is not None:
                silence.join()
            sent = stand.sent("move")[before:]
            # without backlash a move is one command
            assert len(sent) <= 1
            faults = stand.controller.line_faults
            faults.silent, faults.stray = False, b""
            faults.lose_replies = faults.halve_replies = faults.garble_replies = 0
            if not stand.stage.state(1).homed:
                stand.stage.home(1)
        assert lost + reports == 10
        assert codes <= {"stage_lost", "not_homed", "stage_refused", "motion_fault", "units_changed"}
        assert lies == 0
