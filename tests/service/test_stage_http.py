"""The stage over HTTP, with the controller outside the service: faults, and the commands on the wire then."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import httpx
import pytest

from stereorig.core.errors import StageError
from stereorig.drivers.stages.controllers import Controllers
from tests.support.stage_service import API, StageService, stage_service, wait_until


@pytest.fixture(scope="module", params=["esp301", "smc100"])
def stand(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[StageService]:
    with stage_service(tmp_path_factory.mktemp("stage") / "data", request.param) as made:
        yield made


@pytest.fixture
def homed(stand: StageService) -> StageService:
    for number in (1, 2):
        faults = stand.axis(number).faults
        faults.jam_mm = faults.limit_switches_mm = None
    stand.home()
    return stand


def problem(answer: httpx.Response, status: int, code: str) -> dict[str, object]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    body: dict[str, object] = answer.json()
    assert body["code"] == code
    assert body["detail"]
    assert body["remedy"]
    return body


@pytest.mark.fault(23)
def test_nothing_moves_before_homing_nor_without_power(tmp_path_factory: pytest.TempPathFactory) -> None:
    for driver in ("esp301", "smc100"):
        with stage_service(tmp_path_factory.mktemp("cold") / "data", driver) as stand:
            off = driver == "esp301"  # its motors are off at power-on; the SMC100 has states of its own
            for path, body in (("/stage/moves", {"positions_mm": {"1": 1.0}}), ("/calibrations", {})):
                problem(stand.post(path, **body), 409, "motor_off" if off else "not_homed")
            assert stand.client.post(f"{API}/stage:enable").status_code == 200
            problem(stand.post("/stage/moves", positions_mm={"1": 1.0}), 409, "not_homed")
            assert not stand.controller.commands("PA")
            stand.home()
            answer = stand.client.post(f"{API}/stage:disable", json={"axes": [1]})
            assert [axis["motor_on"] for axis in answer.json()["axes"]] == [False, True]
            problem(stand.post("/stage/moves", positions_mm={"1": 1.0}), 409, "motor_off")
            assert not [text for text in stand.actions() if "PA" in text]
            stand.post("/stage:enable", axes=[1])
            assert stand.done(stand.job("/stage/moves", positions_mm={"1": 1.0}))["state"] == "succeeded"


@pytest.mark.fault(26)
@pytest.mark.parametrize("kind", ["move", "home"])
def test_a_stop_between_a_job_s_last_look_and_its_motion_refuses_it(homed: StageService, kind: str) -> None:
    rig = homed.service.rig
    known = len(homed.actions())
    # the stop comes after the look has found none
    motion = {"move": lambda: rig.move({1: 1.0, 2: 1.0}, rig.stop), "home": lambda: rig.home((1, 2), rig.stop)}[kind]
    with pytest.raises(StageError, match="A stop ended the motion") as caught:
        motion()
    assert caught.value.code == "stage_stopped"
    assert {text.lstrip("12") for text in homed.actions()[known:]} <= {"ST"}


@pytest.mark.fault(26)
def test_an_abort_while_motors_are_switched_on_leaves_the_next_one_off(
    homed: StageService, monkeypatch: pytest.MonkeyPatch
) -> None:
    controls = homed.service.rig.controls
    controls.switch((1, 2), on=False)
    enable = Controllers.enable

    def aborted(stage: Controllers, axis: int, *, since: int | None = None) -> None:
        enable(stage, axis, since=since)
        controls.abort()

    monkeypatch.setattr(Controllers, "enable", aborted)
    with pytest.raises(StageError, match="A stop ended the motion"):
        controls.switch((1, 2), on=True)
    assert [axis["motor_on"] for axis in homed.client.get(f"{API}/stage").json()["axes"]] == [False, False]


@pytest.mark.fault(22)
@pytest.mark.parametrize(
    ("body", "code"),
    [
        ('{"positions_mm": {"1": 6.5}}', "out_of_limits"),
        ('{"positions_mm": {"1": 0.0, "2": -6.5}}', "out_of_limits"),
        ('{"dz_mm": {"cam2": 7}}', "out_of_limits"),
        ('{"positions_mm": {"3": 1}}', "invalid_axis"),
        ('{"by_mm": {"3": 1}}', "invalid_axis"),
        ('{"positions_mm": {"1": NaN}}', "invalid_request"),
        ('{"by_mm": {"1": NaN}}', "invalid_request"),
        ('{"positions_mm": {"1": -Infinity}}', "invalid_request"),
        ('{"positions_mm": {"1": 1e308}}', "invalid_request"),
        ('{"positions_mm": {"1": "far"}}', "invalid_request"),
        ('{"positions_mm": {"1": "1.0"}}', "invalid_request"),
        ('{"positions_mm": {"1": null}}', "invalid_request"),
        ('{"positions_mm": {"1": true}}', "invalid_request"),
        ('{"positions_mm": {"1": [1]}}', "invalid_request"),
        ('{"positions_mm": {"x": 1}}', "invalid_request"),
        ('{"positions_mm": {"1": 1}, "by_mm": {"1": 1}}', "invalid_request"),
        ("{}", "invalid_request"),
        ('{"positions_mm": ', "invalid_request"),
    ],
)
def test_an_invalid_target_sends_nothing(homed: StageService, body: str, code: str) -> None:
    wire = list(homed.controller.received)
    answer = homed.client.post(f"{API}/stage/moves", content=body, headers={"Content-Type": "application/json"})
    problem(answer, 422, code)
    assert homed.controller.received == wire


@pytest.mark.fault(22)
@pytest.mark.parametrize("body", [{"by_mm": {"1": -50}}, {"positions_mm": {"1": -6.0}}, {"by_mm": {"2": 6.01}}])
def test_a_target_that_only_the_position_shows_to_be_wrong_brings_questions_alone(
    homed: StageService, body: dict[str, dict[str, float]]
) -> None:
    before = homed.actions()
    problem(homed.post("/stage/moves", **body), 422, "out_of_limits")
    assert homed.actions() == before


@pytest.mark.fault(24)
@pytest.mark.parametrize("trouble", ["following_error", "not_reached", "limit_switch"])
def test_a_motion_that_goes_wrong_is_stopped_and_no_calibration_comes_of_it(
    homed: StageService, trouble: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the tiny rig's pixels do not show its grid's lines, and the target is looked for before anything moves
    monkeypatch.setattr("stereorig.server.workflows.calibration.sequence.look_first", lambda *_: None)

    def break_it() -> None:
        faults = homed.axis(1).faults
        if trouble == "limit_switch":
            faults.limit_switches_mm = (-3.0, 3.0)
        else:
            faults.jam_mm = (-3.0, 3.0)
            faults.jam_kind = "following_error" if trouble == "following_error" else "silent"

    break_it()
    homed.controller.received.clear()
    failed = homed.done(homed.job("/stage/moves", positions_mm={"1": 5.0}))
    assert failed["state"] == "failed"
    assert failed["problem"]["code"] == "motion_fault"
    assert failed["result"] is None
    sent = [entry.text for entry in homed.controller.received]
    moves = [at for at, text in enumerate(sent) if "PA" in text]
    assert len(moves) == 1
    assert "1ST" in sent[moves[0] :]
    assert homed.controller.true_position_mm(1) <= 3.0 + 1e-9
    messages = homed.client.get(f"{API}/stage/messages").json()["messages"]
    if trouble != "not_reached":  # there the controller believes that all went well
        words = {"following_error": "following error", "limit_switch": "positive"}[trouble]
        assert words in messages[-1]["text"].lower()
        assert messages[-1]["axis"] == 1
        assert homed.client.get(f"{API}/stage/messages").json()["messages"] == messages  # reading loses none
    homed.axis(1).faults.jam_mm = homed.axis(1).faults.limit_switches_mm = None
    homed.home()
    break_it()
    answer = homed.post("/calibrations", positions_mm=[0.0, 5.0], held_out_mm=[], frames=1)
    assert answer.status_code == 202, answer.text
    assert homed.done(answer.json()["job"])["problem"]["code"] == "motion_fault"
    calibration = homed.client.get(f"{API}/calibrations/{answer.json()['calibration_id']}").json()
    assert calibration["state"] == "failed"
    assert calibration["problem"]["code"] == "motion_fault"


@pytest.mark.fault(25)
def test_a_controller_that_falls_silent_is_lost_and_found_again(homed: StageService) -> None:
    homed.axis(1).velocity_mm_s = 0.2
    job = homed.job("/stage/moves", positions_mm={"1": 5.0})
    wait_until(lambda: [text for text in homed.actions() if text.startswith("1PA")][-1:] and homed.axis(1).moving)
    before = len(homed.controller.commands("1PA"))
    homed.controller.line_faults.deaf = True
    try:
        failed = homed.done(job)
        assert failed["problem"]["code"] == "stage_lost"
        problem(homed.client.get(f"{API}/stage"), 503, "stage_lost")
        shown = homed.client.get(f"{API}/rig").json()  # the cameras are still there
        assert shown["stage"]["fault"]["code"] == "stage_lost"
        assert shown["cameras"]["cam1"]["fault"] is None
    finally:
        homed.controller.line_faults.deaf = False
    assert len(homed.controller.commands("1PA")) == before
    problem(homed.post("/stage/moves", positions_mm={"3": 1.0}), 422, "invalid_axis")
    homed.post("/stage:stop")
    wait_until(lambda: not homed.axis(1).moving)
    homed.axis(1).velocity_mm_s = 10.0
    assert homed.done(homed.job("/rig:reconnect"))["state"] == "succeeded"
    homed.home()


@pytest.mark.fault(27)
def test_a_move_whose_job_is_cancelled_is_stopped(homed: StageService) -> None:
    homed.axis(1).velocity_mm_s = 0.2
    try:
        job = homed.job("/stage/moves", positions_mm={"1": 5.0})
        wait_until(lambda: homed.axis(1).moving)
        assert homed.post(f"/jobs/{job['id']}:cancel").status_code == 202
        wait_until(lambda: not homed.axis(1).moving)
        assert homed.done(job)["state"] == "cancelled"
        assert homed.controller.true_position_mm(1) < 4.0
        # the position is read back, since the controller has it: nothing is unknown
        axis = homed.stage()["axes"][0]
        assert axis["position_mm"] == pytest.approx(homed.controller.true_position_mm(1), abs=2e-4)
    finally:
        homed.axis(1).velocity_mm_s = 10.0


def test_who_sees_that_a_job_has_ended_may_move_at_once(homed: StageService) -> None:
    seen: dict[str, object] = {}

    def note_holder(name: str, data: dict[str, object]) -> None:
        if name == "job" and data["state"] in ("cancelled", "succeeded"):
            seen[str(data["id"])] = homed.service.hardware.holder

    homed.service.hub.listen(note_holder)
    homed.axis(1).velocity_mm_s = 0.2
    try:
        stopped = homed.job("/stage/moves", positions_mm={"1": 5.0})
        wait_until(lambda: homed.axis(1).moving)
        homed.post("/stage:stop")
        assert homed.done(stopped)["state"] == "cancelled"
        homed.axis(1).velocity_mm_s = 10.0
        back = homed.job("/stage/moves", positions_mm={"1": 0.0})  # refused, if the hardware were still held
        assert homed.done(back)["state"] == "succeeded"
        assert [seen[job["id"]] for job in (stopped, back)] == [None, None]
    finally:
        homed.axis(1).velocity_mm_s = 10.0
        homed.service.hub._listeners.remove(note_holder)


@pytest.mark.fault(27)
@pytest.mark.parametrize("path", ["/stage/moves", "/stage:home"])
def test_a_client_that_goes_away_lets_go_of_the_handle_that_it_held(homed: StageService, path: str) -> None:
    homed.done(homed.job("/stage/moves", positions_mm={"1": 5.0}))
    if homed.service.config.stage.driver == "smc100" and path.endswith("home"):
        homed.controller.take_line(b"1RS")  # only without a reference does it search
    homed.axis(1).velocity_mm_s = 0.2
    try:
        body = {"positions_mm": {"1": 0.0}} if path == "/stage/moves" else {"axes": [1]}
        with httpx.Client(base_url=homed.client.base_url, trust_env=False) as other, pytest.raises(httpx.ReadTimeout):
            other.post(f"{API}{path}?attached=true", json=body, timeout=0.5)
        wait_until(lambda: not homed.axis(1).moving, 3.0)
        assert homed.controller.true_position_mm(1) > 0.5
        job = homed.client.get(f"{API}/jobs").json()["jobs"][0]
        assert homed.done(job)["state"] == "cancelled"
    finally:
        homed.axis(1).velocity_mm_s = 10.0


def test_an_attached_move_answers_when_it_has_ended(homed: StageService) -> None:
    answer = homed.client.post(f"{API}/stage/moves?attached=true", json={"positions_mm": {"1": 2.0}})
    assert answer.status_code == 202
    job = answer.json()["job"]
    assert job["state"] == "succeeded"
    assert job["result"]["axes"]["1"]["position_mm"] == pytest.approx(2.0, abs=2e-4)
    answer = homed.client.post(f"{API}/stage/moves?attached=perhaps", json={"positions_mm": {"1": 2.0}})
    problem(answer, 422, "invalid_request")


@pytest.mark.fault(28)
def test_a_second_client_learns_who_has_the_stage_and_may_stop_it(homed: StageService) -> None:
    homed.axis(1).velocity_mm_s = 0.2
    try:
        job = homed.job("/stage/moves", positions_mm={"1": 5.0})
        wait_until(lambda: homed.axis(1).moving)
        before = [text for text in homed.actions() if not text.endswith("ST")]
        for method, path, body in (
            ("POST", "/stage/moves", {"positions_mm": {"2": 1.0}}),
            ("POST", "/stage:home", {"axes": [2]}),
            ("POST", "/stage:enable", {"axes": [2]}),
            ("POST", "/stage:disable", {"axes": [1]}),
            ("PATCH", "/stage/axes/1", {"velocity_mm_s": 1.0}),
            ("POST", "/stage/axes/1:leave-configuration", {"write_flash": True}),
            ("POST", "/calibrations", {}),
            ("POST", "/rig:reconnect", None),
        ):
            busy = problem(homed.client.request(method, f"{API}{path}", json=body), 409, "hardware_busy")
            assert busy["holder"]["job_id"] == job["id"]  # type: ignore[index]
        assert [text for text in homed.actions() if not text.endswith("ST")] == before
        assert homed.axis(1).moving
        stopped = homed.post("/stage:stop").json()
        assert stopped["cancelled_job"] == job["id"]
        wait_until(lambda: not homed.axis(1).moving)
        assert homed.done(job)["state"] == "cancelled"
    finally:
        homed.axis(1).velocity_mm_s = 10.0


def test_many_clients_at_once_start_one_move(homed: StageService) -> None:
    homed.axis(1).velocity_mm_s = 0.5
    before = len(homed.controller.commands("1PA"))
    statuses: list[int] = []

    def ask() -> None:
        statuses.append(homed.post("/stage/moves", positions_mm={"1": 4.0}).status_code)

    try:
        threads = [threading.Thread(target=ask) for _ in range(12)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(statuses) == [202, *[409] * 11]
        wait_until(lambda: len(homed.controller.commands("1PA")) > before)
        homed.post("/stage:stop")
        wait_until(lambda: homed.service.hardware.holder is None)
        assert len(homed.controller.commands("1PA")) == before + 1
    finally:
        homed.axis(1).velocity_mm_s = 10.0


def test_velocities_are_set_and_read_back_and_outlast_a_reconnection(homed: StageService) -> None:
    patch = lambda **body: homed.client.patch(f"{API}/stage/axes/1", json=body)  # noqa: E731
    answer = patch(velocity_mm_s=2.5)
    assert answer.status_code == 200, answer.text
    assert answer.json()["velocity_mm_s"] == pytest.approx(2.5)
    assert patch(acceleration_mm_s2=20.0).json()["acceleration_mm_s2"] == pytest.approx(20.0)
    assert homed.axis(1).velocity_mm_s == pytest.approx(2.5)
    assert homed.stage()["axes"][0]["dynamics"]["velocity_mm_s"] == pytest.approx(2.5)
    assert homed.done(homed.job("/rig:reconnect"))["state"] == "succeeded"
    assert homed.stage()["axes"][0]["dynamics"]["velocity_mm_s"] == pytest.approx(2.5)
    homed.home()
    assert homed.axis(1).acceleration_mm_s2 == pytest.approx(20.0)
    wire = list(homed.controller.received)
    for wrong in (0, -1, "fast", True, None, 1e300):
        problem(patch(velocity_mm_s=wrong), 422, "invalid_request")
    problem(homed.client.patch(f"{API}/stage/axes/1", json={}), 422, "invalid_request")
    problem(homed.client.patch(f"{API}/stage/axes/3", json={"velocity_mm_s": 1.0}), 422, "invalid_axis")
    assert homed.controller.received == wire
    problem(patch(velocity_mm_s=41.0), 422, "out_of_range")  # the simulated controllers do 40 mm/s
    assert homed.axis(1).velocity_mm_s == pytest.approx(2.5)
    patch(velocity_mm_s=10.0, acceleration_mm_s2=40.0)


def test_abort_switches_the_motors_off_in_mid_move(homed: StageService) -> None:
    homed.axis(1).velocity_mm_s = 0.2
    try:
        job = homed.job("/stage/moves", positions_mm={"1": 5.0})
        wait_until(lambda: homed.axis(1).moving)
        answer = homed.post("/stage:abort")
        assert answer.status_code == 200, answer.text
        assert answer.json()["cancelled_job"] == job["id"]
        assert homed.done(job)["state"] == "cancelled"
        assert [axis["state"] for axis in homed.stage()["axes"]] == ["motor_off", "motor_off"]
        assert homed.controller.true_position_mm(1) < 4.0
        problem(homed.post("/stage/moves", positions_mm={"1": 1.0}), 409, "motor_off")
    finally:
        homed.axis(1).velocity_mm_s = 10.0


def test_an_axis_in_configuration_state_is_left_with_consent_only(tmp_path_factory: pytest.TempPathFactory) -> None:
    with stage_service(tmp_path_factory.mktemp("stuck") / "data", "smc100") as stand:
        stand.controller.take_line(b"1PW1")
        axis = stand.stage()["axes"][0]
        assert axis["state"] == "configuration"
        assert "PW0" in axis["detail"]
        for path, body in (("/stage/moves", {"positions_mm": {"1": 1.0}}), ("/stage:home", {}), ("/calibrations", {})):
            shown = problem(stand.post(path, **body), 409, "configuration_state")
            assert "flash" in str(shown["remedy"])
        leave = "/stage/axes/1:leave-configuration"
        for body in ({}, {"write_flash": False}, {"write_flash": "true"}, {"write_flash": 1}):
            problem(stand.post(leave, **body), 422, "invalid_request")
        assert stand.controller.flash_writes(1) == 0
        assert not stand.controller.commands("PW0")
        assert stand.done(stand.job(leave, write_flash=True))["state"] == "succeeded"
        assert stand.controller.flash_writes(1) == 1
        assert stand.done(stand.job(leave, write_flash=True))["problem"]["code"] == "not_in_configuration"
        assert stand.controller.flash_writes(1) == 1
        stand.home()
        assert [axis["state"] for axis in stand.stage()["axes"]] == ["ready", "ready"]


def test_a_rig_with_a_stuck_axis_opens_and_homes_the_other(tmp_path_factory: pytest.TempPathFactory) -> None:
    from stereorig.server.jobs.hardware import HardwareHold
    from stereorig.server.rig.rig import Rig
    from stereorig.sim.controllers.registry import make_controller
    from stereorig.sim.controllers.server import ControllerServer
    from tests.support.stage_service import rig

    controller = make_controller("smc100", (1, 2), time_scale=50.0)
    controller.take_line(b"2PW1")
    with ControllerServer(controller) as server:
        opened = Rig(rig(driver='"smc100"', url=f'"{server.url}"', home_at_start="true"), HardwareHold())
        opened.open()
        try:
            assert opened.fault is None
            assert [axis.state for axis in opened.describe_stage().axes] == ["ready", "configuration"]
            assert controller.flash_writes(2) == 0
        finally:
            opened.close()
            opened.hardware.close()


@pytest.mark.fault(26)
def test_a_stop_while_the_rig_homes_at_its_start_leaves_it_open(tmp_path_factory: pytest.TempPathFactory) -> None:
    own = {"home_at_start": "true"}
    with stage_service(tmp_path_factory.mktemp("homing") / "data", "esp301", stage=own, time_scale=2.0) as stand:
        wait_until(lambda: all(axis["state"] == "ready" for axis in stand.stage()["axes"]))
        moved = stand.done(stand.job("/stage/moves", positions_mm={"1": 5.0, "2": 5.0}))
        assert moved["state"] == "succeeded"
        job = stand.job("/rig:reconnect")
        # between the old line's end and the new one's beginning there is no stage to ask
        wait_until(lambda: any(axis["moving"] for axis in stand.client.get(f"{API}/stage").json().get("axes", ())))
        assert stand.client.post(f"{API}/stage:stop").status_code == 200
        assert stand.done(job)["state"] == "cancelled"
        shown = stand.client.get(f"{API}/rig").json()
        assert shown["connected"] is True
        assert shown["fault"] is None
        assert {axis["state"] for axis in shown["stage"]["axes"]} <= {"not_homed", "motor_off"}
        problem(stand.post("/stage/moves", positions_mm={"1": 1.0}), 409, "not_homed")
        assert stand.client.get(f"{API}/cameras/cam1/frame").status_code == 200
        stand.home()


def test_a_stage_that_is_not_there_says_so_everywhere(tmp_path_factory: pytest.TempPathFactory) -> None:
    from stereorig.server.workflows.service import Service
    from tests.support.service_rig import served
    from tests.support.stage_service import rig

    service = Service(rig(url='"/dev/no-such-port"'), tmp_path_factory.mktemp("none") / "data").start()
    try:
        with served(service) as client:
            wait_until(lambda: (client.get(f"{API}/rig").json()["stage"]["fault"] or {}).get("code") == "stage_lost")
            assert client.get(f"{API}/rig").json()["fault"] is None  # the cameras can be used
            assert client.get(f"{API}/stage").json()["fault"]["code"] == "stage_lost"
            assert client.get(f"{API}/stage/messages").json() == {"messages": []}
            for method, path, body in (
                ("POST", "/stage:stop", None),
                ("POST", "/stage:abort", None),
                ("POST", "/stage:enable", None),
                ("POST", "/stage:home?attached=true", None),
                ("POST", "/stage/moves?attached=true", {"positions_mm": {"1": 1.0}}),
                ("PATCH", "/stage/axes/1", {"velocity_mm_s": 1.0}),
                ("POST", "/stage/axes/1:leave-configuration", {"write_flash": True}),
            ):
                problem(client.request(method, f"{API}{path}", json=body), 503, "stage_lost")
    finally:
        service.close()
