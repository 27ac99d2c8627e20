"""Every operation of the API in one session on a small simulated rig, with the requests that the description shows."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import httpx
import numpy as np

from stereorig.core.cameras.camera import Camera
from stereorig.core.target import GridTarget
from stereorig.server.config.rig_file import parse_config
from stereorig.server.formats.calibrations.target_toml import target_of
from tests.support.grid_images import grid_image, paper_camera
from tests.support.patience import Deadline
from tests.support.service_rig import SMALL, true_cameras, wait_for_job, wait_for_rig

API = "/api/v1"
REGION = {"rectangle": [95, 95, 165, 150]}
#: placeholder in an example for a file that text cannot hold
FILE = "(the bytes of a file)"


@dataclass
class Sent:
    """A request of an operation, and what came back."""

    operation: str
    media_type: str
    summary: str
    value: Any
    status: int


@dataclass
class Session:
    """What was sent and answered so far.

    Parameters
    ----------
    client
        Talks to the service.
    operations
        The description's operations, by their ids.
    """

    client: httpx.Client
    operations: dict[str, dict[str, Any]]
    requests: list[Sent] = field(default_factory=list)
    replies: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)
    given: dict[str, dict[str, Any]] = field(default_factory=dict)

    def call(
        self,
        operation: str,
        *ids: Any,
        summary: str = "",
        body: Any = None,
        form: dict[str, Any] | None = None,
        files: dict[str, bytes] | None = None,
        text_files: bool = False,
        query: dict[str, Any] | None = None,
        headers: dict[str, str] | None = None,
        body_name: str | None = None,
    ) -> httpx.Response:
        """Send a request and keep both sides; one with a summary becomes an example.

        Parameters
        ----------
        ids
            Values of the path's parameters, in their order.
        form, files
            A multipart body; ``text_files`` where the files are text that an example can hold.
        """
        known = self.operations[operation]
        path = known["path"]
        for value in ids:
            path = re.sub(r"\{[a-z_]+\}", str(value), path, count=1)
        more: dict[str, Any] = {}
        if files is not None:
            more = {"files": {name: (name, data) for name, data in files.items()}, "data": form or {}}
        elif body is not None:
            more = {"json": body}
        with self.client.stream(known["method"], path, params=query, headers=headers, timeout=300.0, **more) as answer:
            media = answer.headers.get("content-type", "").split(";")[0]
            if media in ("text/event-stream", "multipart/x-mixed-replace"):
                content = next(answer.iter_bytes())
            else:
                content = answer.read()
        assert answer.is_success, (operation, answer.status_code, content[:2000])
        if summary:
            value = body
            if files is not None:
                value = {name: data.decode() if text_files else FILE for name, data in files.items()} | (form or {})
            lists = ("cam1", "cam2") if operation == "upload_views" else ("images",)
            value = {name: [given] if name in lists else given for name, given in value.items()}
            media_sent = "application/json" if files is None else "multipart/form-data"
            self.requests.append(Sent(operation, media_sent, summary, value, answer.status_code))
        replies = self.replies.setdefault(operation, {}).setdefault(str(answer.status_code), {})
        if answer.status_code == 204:
            return answer
        if media == "application/json":
            replies.setdefault(media, json.loads(content))
        elif media.startswith("text/"):
            replies.setdefault(media, content.decode())
        elif media:
            replies.setdefault(media, None)
        return answer


def operations_of(description: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the description's operations by id, with method and path."""
    return {
        operation["operationId"]: {"method": method.upper(), "path": path, **operation}
        for path, methods in description["paths"].items()
        for method, operation in methods.items()
    }


def image(seed: int) -> bytes:
    """A textured image of the small rig's size, as PNG."""
    rng = np.random.default_rng(seed)
    pixels = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (240, 256)), (0, 0), 1.2)
    _, data = cv2.imencode(".png", cv2.normalize(pixels, None, 10, 245, cv2.NORM_MINMAX).astype(np.uint8))
    return data.tobytes()


def run(client: httpx.Client, description: dict[str, Any], key: str) -> Session:
    """Go through the whole job; every operation is called at least once. ``key`` is an admin's, `lab-page`."""
    session = Session(client, operations_of(description))
    wait_for_rig(client)
    _sessions(session.call, {"Authorization": f"Bearer {key}"})
    _read_everything(session.call)
    _stage(session)
    calibration = _calibration(session)
    _guided(session)
    noise = session.call("create_noise", summary="Eight frames of what stands still", body={"frames": 8}).json()
    wait_for_job(client, noise["job"])
    session.call("list_noise")
    session.call("get_noise", noise["noise_id"])
    session.call("get_noise_file", noise["noise_id"])
    test = _test(session, calibration)
    analysis = _analysis(session, test)
    _live(session, test)
    _results(session, test, analysis)
    _ends(session, test, analysis, calibration, noise["noise_id"])
    return session


def _guided(session: Session) -> None:
    """A guided acquisition of one view, ended before it could succeed."""
    call, client = session.call, session.client
    goal = {"quantity": "z", "goal_um": 1.0, "automatic": False}
    begun = call("begin_guide", summary="Until Z is known to 1 um, each view on request", body=goal).json()
    identity = begun["calibration_id"]
    call("take_view", identity)
    deadline = Deadline(60.0)
    while deadline.left and _taken(client, identity) == 0:
        time.sleep(0.1)
    call("get_guide", identity)
    wait_for_job(client, call("finish_guide", identity).json()["job"])


def _taken(client: httpx.Client, calibration_id: str) -> int:
    guidance = client.get(f"{API}/calibrations/{calibration_id}/guide").json()["guidance"]
    return 0 if guidance is None else int(guidance["taken"])


def _read_everything(call: Callable[..., httpx.Response]) -> None:
    for operation in ("healthz", "metrics", "get_rig", "get_cameras", "get_devices", "get_channels", "get_session"):
        call(operation)
    etag = call("get_camera", "cam1").headers["ETag"]
    call("patch_camera", "cam1", summary="Expose for 12 ms", body={"exposure_ms": 12.0}, headers={"If-Match": etag})
    call("expose", "cam1", summary="Until the brightest hundredth is at 0.7 of full scale", body={"level": 0.7})
    call("patch_camera", "cam1", body={"exposure_ms": 10.0})
    call("get_frame", "cam1")
    call("get_pixel", "cam1", query={"x_px": 128, "y_px": 120})
    call("get_stats", "cam1")
    call("get_live_map", "cam1", "saturation")
    call("get_stream", "cam1")


def _sessions(call: Callable[..., httpx.Response], key: dict[str, str]) -> None:
    call("log_in", headers=key)
    call("end_session", call("list_sessions").json()["sessions"][0]["id"])
    call("log_in", headers=key)
    call("end_sessions", query={"name": "lab-page"})
    call("log_in", headers=key)
    call("log_out")


def _stage(session: Session) -> None:
    call, client = session.call, session.client

    def done(answer: httpx.Response) -> None:
        wait_for_job(client, answer.json()["job"])

    call("get_stage")
    etag = call("get_axis", 1).headers["ETag"]
    call("patch_axis", 1, summary="4 mm/s", body={"velocity_mm_s": 4.0}, headers={"If-Match": etag})
    done(call("move", summary="Both cameras 1 mm away from the target", body={"dz_mm": {"cam1": 1.0, "cam2": 1.0}}))
    done(call("move", summary="One axis to 0.5 mm", body={"positions_mm": {"1": 0.5}}))
    done(call("move", summary="One axis on by 0.1 mm", body={"by_mm": {"2": 0.1}}))
    call("stop")
    call("abort")
    call("disable", summary="One axis", body={"axes": [1]})
    call("enable", summary="Both axes", body={"axes": [1, 2]})
    done(call("home", summary="Both axes", body={"axes": [1, 2]}))
    done(call("move", body={"dz_mm": {"cam1": 0.0, "cam2": 0.0}}))
    done(call("leave_configuration", 1, summary="Consent", body={"write_flash": True}))
    call("get_messages")
    done(call("reconnect"))
    wait_for_rig(client)


def _calibration(session: Session) -> str:
    call, client = session.call, session.client
    plan = {"positions_mm": [0.0, 5.0], "held_out_mm": [2.0]}
    call("expect_calibration", summary="Two positions", body={"positions_mm": [0.0, 5.0], "noise_px": 0.005})
    call("print_target", summary="The rig's target on A4", body={"paper": "A4", "form": "pdf"})
    call("print_speckle", query={"diameter_mm": 1.0, "form": "svg"})
    beside = call("print_target", body={"form": "toml"}).text
    rulers = {"printed_mm": [150.0, 250.0], "measured_mm": [149.91, 249.8], "u_mm": 0.05}
    call("measure_print", summary="Both rulers", body={"target_file": beside, **rulers})
    made = call("create_calibration", summary="Two positions and one for the check", body={**plan, "frames": 4}).json()
    job = wait_for_job(client, made["job"])
    assert job["state"] == "succeeded", job["problem"]
    calibration = str(made["calibration_id"])
    call("list_calibrations")
    call("get_calibration", calibration)
    call("get_calibration_file", calibration)
    call("get_geometry", calibration)
    call("list_views", calibration)
    call("get_residuals", calibration)
    call("get_view", calibration, 0, "cam1")
    call("get_view_preview", calibration, 0, "cam1")
    for form in ("paper", "opencv", "matchid", "vic3d"):
        call("export_calibration", calibration, query={"format": form})
    call("report_conversion", calibration, query={"format": "opencv"})
    cameras = true_cameras(SMALL)
    marks = {
        cam: Camera.from_paper(**values).project([[-2.0, 0.5, 0.2], [2.0, 0.5, 0.2]]).xy.round(2).tolist()
        for cam, values in cameras.items()
    }
    call(
        "check_distance",
        calibration,
        summary="Two marks, 4 mm apart",
        body={"points_px": marks, "distance_mm": 4.0, "distance_sigma_mm": 0.002},
    )
    decision = {"decision": "accepted", "note": "held-out residuals are small"}
    call("put_review", calibration, summary="Measure with it from now on", body=decision)
    call("check_calibration")
    second = call(
        "import_calibration",
        summary="Both cameras as calibration.json",
        form={"label": "from the old rig"},
        files={"file": json.dumps(true_cameras(SMALL)).encode()},
        text_files=True,
    ).json()
    uploaded = call(
        "upload_views",
        summary="A pair; three are needed at least",
        form={"plan": '{"target": {"kind": "checkerboard", "pitch_mm": 3.0, "size": [11, 8]}, "phd_px": 7000.0}'},
        files={cam: _grid_along_its_normal() for cam in ("cam1", "cam2")},
    )
    wait_for_job(client, uploaded.json()["job"])  # its problem is the job's
    again = call("refit_calibration", calibration, summary="Without the view at 2 mm", body={"without": [1]})
    assert wait_for_job(client, again.json()["job"])["state"] == "succeeded"
    call("compare_calibration", calibration, query={"with": second["id"]})
    call(
        "measure_aspect",
        summary="An image along the grid's normal",
        form={"standoff_mm": 400.0},
        files={"images": _grid_along_its_normal()},
    )
    return calibration


def _grid_along_its_normal() -> bytes:
    target = target_of(parse_config(SMALL).target.plain(), "target")
    assert isinstance(target, GridTarget)
    _, data = cv2.imencode(".png", grid_image(paper_camera(0.2), target))
    return bytes(data.tobytes())


def _test(session: Session, calibration: str) -> str:
    call, client = session.call, session.client
    body = {"name": "Plate under pressure", "specimen": "Al 6061-T6, 1.5 mm", "calibration_id": "latest"}
    test = str(call("create_test", summary="With the newest accepted calibration", body=body).json()["id"])
    call("put_scene", summary="A clamped plate under 20 kPa", body={"scene": "plate", "load": 0.0})
    readings = {"stroke_mm": 0.42, "temperature_c": 21.3}
    step = {"label": "unloaded", "load_n": 0.0, "timestamp_utc": "2026-03-01T12:00:00.250Z", "channels": readings}
    call("create_step", test, summary="One load step, with the load frame's own readings", body=step)
    call("put_scene", summary="A clamped plate under 20 kPa", body={"scene": "plate", "load": 20.0})
    call("create_step", test, body={"label": "20 kPa", "load_n": 1250.0})
    burst = {"label": "cycle 3", "count": 2, "interval_ms": 500.0}
    taken = wait_for_job(client, call("create_step", test, summary="Two steps, two a second", body=burst).json()["job"])
    call("job_steps", taken["id"])
    around = {"label": "knock", "before_s": 0.5, "after_s": 0.2, "rate_hz": 10.0, "trigger": {"kind": "call"}}
    other = client.post(f"{API}/tests", json={"name": "a knock"}).json()["id"]
    kept = call("record", other, summary="Half a second before a call, a fifth behind it", body=around).json()["job"]
    while client.get(f"{API}/jobs/{kept['id']}").json()["progress"]["phase"] != "trigger":
        time.sleep(0.02)
    call("trigger_record", other)
    wait_for_job(client, kept)
    call("get_readings", other)
    form = {"label": "from another program", "load_n": 1300.0, "channels": '{"stroke_mm": 0.42}'}
    files = {cam: image(k) for k, cam in enumerate(("cam1", "cam2"))}
    imported = call("import_images", test, summary="A pair of image files", form=form, files=files).json()["n"]
    record = b"Time (s),Force (kN),Stroke (um)\n0.0,0.00,420\n0.5,0.01,421\n1.0,0.02,422\n"
    aligned = {"at_step": 0, "at_s": 0.75, "max_gap_s": 1.0}
    looked = {"form": aligned, "files": {"file": record}, "text_files": True}
    call("preview_record", test, summary="What an import of that record would do", **looked)
    call(
        "import_channels",
        test,
        summary="A load frame's record; step 0 was taken 0.75 s after its beginning",
        form=aligned,
        files={"file": record},
        text_files=True,
    )
    call("list_tests")
    etag = call("get_test", test).headers["ETag"]
    notes = {"notes": "Second plate of the batch."}
    call("patch_test", test, summary="New notes", body=notes, headers={"If-Match": etag})
    call("list_steps", test)
    etag = call("get_step", test, 1).headers["ETag"]
    call("patch_step", test, 1, summary="New label", body={"label": "20 kPa, held"}, headers={"If-Match": etag})
    call("get_step_image", test, 1, "cam1")
    call("get_step_preview", test, 1, "cam1")
    call("get_step_pixels", test, 1, "cam1", query={"x_px": 128, "y_px": 120})
    call("get_step_map", test, 1, "cam1", "texture")
    metadata = {
        "purpose": "Deflection of a clamped plate",
        "operator": "A. Smith",
        "material": "Aluminium 6061-T6",
        "lighting": "2 LED panels, diffuse",
        "pattern_technique": "matt white ground, black spray paint",
        "cam1": {"maker": "Basler", "pixel_um": 3.45, "lens": {"maker": "Schneider", "focal_length_mm": 50.0}},
        "static_steps": [1],
    }
    call("put_metadata", test, summary="What the guide's tables ask for and no device can say", body=metadata)
    call("get_metadata", test)
    frame = {"frame": {"kind": "plane", "x_line_px": [[80.0, 120.0], [180.0, 121.5]]}}
    call("put_test_frame", test, summary="X along a line of two positions", body=frame)
    call("get_test_frame", test)
    call("delete_test_frame", test)
    _procedure(session)
    watch = {"channel": "load_n", "threshold": 500.0, "frames": 1}
    call("put_watch", test, summary="A step at each further 500 N", body=watch)
    call("get_watch", test)
    reading = {"load_n": 1810.2, "timestamp_utc": "2026-03-01T12:00:01Z", "channels": {"stroke_mm": 0.61}}
    call("post_channels", test, summary="What the load frame reads now", body=reading)
    call("post_channels", test, body={"load_n": 1811.0})
    call("end_watch", test)
    call("rate_texture", test, 0, summary="Subsets of 21 px", body={"region": REGION, "subset_px": 21})
    call("show_scale", test, query={"step": 0})
    drawn = {"region": {"rectangle": [60, 60, 200, 180]}, "settings": {"subset_px": 21, "spacing_px": 10}}
    call("put_workspace", test, summary="A region, subset and step", body=drawn)
    call("get_workspace", test)
    recipe = call("create_recipe", summary="For the next plates", body={"name": "plate", "recipe": drawn}).json()["id"]
    call("list_recipes")
    etag = call("get_recipe", recipe).headers["ETag"]
    call("patch_recipe", recipe, summary="New name", body={"name": "plates"}, headers={"If-Match": etag})
    call("delete_recipe", recipe)
    call("find_region", test, summary="On the specimen", body={"subset_px": 21})
    call("check_seeds", test, summary="One seed", body={"seeds": [[128, 120]], "seeds_cam2": [[128, 120]]})
    call("delete_step", test, imported)
    # one step of a narrow view: whether it is repaired or refused is the job's to say
    repair = {"test_id": test, "steps": [0], "region": {"rectangle": [60, 60, 200, 180]}}
    wait_for_job(client, call("repair_calibration", calibration, summary="From one step", body=repair).json()["job"])
    return test


def _procedure(session: Session) -> None:
    """Plan a verification procedure in a test of its own, and take its reference."""
    call, client = session.call, session.client
    test = client.post(f"{API}/tests", json={"name": "verification"}).json()["id"]
    way = {"n": 4, "translation_mm": [0.0, 0.0, 1.0], "u_mm": 0.0005}
    plan = {"title": "Bench 2", "static_steps": [1, 2, 3], "translations": [way], "rotations": [{"n": 5}]}
    call("put_certificate_plan", test, summary="Three static steps, a way and a turn", body={"plan": plan, "frames": 2})
    taken = call("take_next_step", test, summary="The reference", body={"confirmed": False}).json()
    wait_for_job(client, taken["job"])
    call("get_certificate_plan", test)


def _analysis(session: Session, test: str) -> str:
    call, client = session.call, session.client
    wanted = {"region": REGION, "subset_px": 21, "spacing_px": 10, "strain": {"window": 3}}
    made = call(
        "create_analysis", test, summary="Shape, displacement and strain of two steps", body={**wanted, "steps": [0, 1]}
    ).json()
    job = wait_for_job(client, made["job"], 600.0)  # kernels may be compiled first
    assert job["state"] == "succeeded", job
    following = call(
        "create_analysis", test, summary="Go on with each step that lands", body={**wanted, "follow": True}
    )
    other = following.json()
    _until(lambda: len(client.get(f"{API}/tests/{test}/analyses/{other['analysis_id']}").json()["steps_finished"]) > 1)
    call("cancel_job", other["job"]["id"])
    wait_for_job(client, other["job"])
    again = call("continue_analysis", test, other["analysis_id"], summary="The rest", body={"other_version": False})
    call("finish_analysis", test, other["analysis_id"])
    wait_for_job(client, again.json()["job"])
    call("delete_analysis", test, other["analysis_id"])
    call("get_analysis_recipe", test, made["analysis_id"])
    call("list_analyses", test)
    call("get_analysis", test, made["analysis_id"])
    call("list_analysis_steps", test, made["analysis_id"])
    call("get_history", test, made["analysis_id"], "w_mm", query={"x_px": 120, "y_px": 120})
    wait_for_job(client, call("reproduce_analysis", test, made["analysis_id"]).json()["job"])
    plan = {"title": "Bench 2", "static_steps": [1], "limits": {"displacement_mpe_um": 5.0}, "valid_days": 180}
    asked = {"test_id": test, "analysis_id": made["analysis_id"], "plan": plan}
    certificate = wait_for_job(client, call("create_certificate", summary="Noise floor", body=asked).json()["job"])
    certificate_id = certificate["result"]["certificate_id"]
    call("list_certificates")
    call("get_certificate", certificate_id)
    call("get_certificate_report", certificate_id)
    call(
        "withdraw_certificate",
        certificate_id,
        summary="With the reason",
        body={"reason": "The lens of camera 2 was exchanged."},
    )
    return str(made["analysis_id"])


def _live(session: Session, test: str) -> None:
    """Measure live while the plate is loaded, with a channel whose clock is a quarter of a second behind."""
    call, client = session.call, session.client
    scene = {"scene": "plate", "load": 0.0}
    client.put(f"{API}/sim/scene", json=scene).raise_for_status()
    gauges = {
        "extensometers": [{"name": "e1", "a_px": [128, 95], "b_px": [128, 145]}],
        "points": [{"name": "p1", "xy_px": [128, 120]}],
        "field": True,
    }
    call("begin_live", test, summary="An extensometer, a point and the coarse field", body=gauges)

    def number() -> int:
        return int(client.get(f"{API}/tests/{test}/live").json()["values"]["number"])

    _until(lambda: number() > 1)
    began, readings = time.monotonic(), []
    while (now := time.monotonic()) < began + 9.0:
        scene["load"] = min(max(now - began - 3.0, 0.0) * 100.0, 300.0)
        readings.append({"time_s": now - 0.25, "channels": {"pressure_kpa": scene["load"]}})
        client.put(f"{API}/sim/scene", json=scene).raise_for_status()
        time.sleep(0.02)
    early = [{"time_s": t, "channels": {"pressure_kpa": 0.0}} for t in (1.0, 1.02)]
    last = number()
    _until(lambda: number() > last + 1)
    call("post_live_channels", test, summary="What the load frame read", body={"readings": early})
    client.post(f"{API}/tests/{test}/live/channels", json={"readings": readings}).raise_for_status()
    asked = {"channel": "pressure_kpa", "gauge": "p1", "quantity": "w_mm"}
    call("align_channel", test, summary="By the ramp that both have seen", body=asked)
    for operation in ("get_live", "live_history", "live_field", "live_field_events", "live_events", "stop_live"):
        call(operation, test)
    client.put(f"{API}/sim/scene", json={"scene": "plate", "load": 20.0}).raise_for_status()


def _until(true: Callable[[], bool], seconds: float = 240.0) -> None:
    deadline = Deadline(seconds)
    while not true():
        assert deadline.left
        time.sleep(0.05)


def _results(session: Session, test: str, analysis: str) -> None:
    call, client = session.call, session.client
    call("list_fields", test, analysis, 1)
    part = {"rows": "0:2", "cols": "0:3"}
    for form in ("json", "npy", "csv", "nc", "f32", "png"):
        call("get_field", test, analysis, 1, "w_mm", query={**part, "format": form})
    call("get_positions", test, analysis, 1, "cam1")
    call("get_probe", test, analysis, query={"x_px": 128, "y_px": 120, "step": 1})
    gauges = {
        "extensometers": [{"name": "axial", "a_px": [100.0, 120.0], "b_px": [160.0, 120.0]}],
        "areas": [{"rectangle_px": [100, 100, 160, 145]}],
        "variables": ["u_mm", "w_mm"],
        "remove_rigid": {},
    }
    call(
        "read_gauges",
        test,
        analysis,
        body=gauges,
        summary="An extensometer and the mean displacement of an area, rigid motion taken out",
    )
    call("read_gauges", test, analysis, body=gauges, query={"format": "csv"})
    line = {
        "lines": [{"vertices_px": [[100.0, 120.0], [160.0, 120.0]], "count": 5}],
        "align": {"kind": "plane"},
        "steps": [1],
    }
    call("read_gauges", test, analysis, summary="Deflection along a line in the frame of the best-fit plane", body=line)
    call(
        "make_gauge_field",
        test,
        analysis,
        query={"step": 1},
        body={"align": {"kind": "plane"}, "remove_rigid": {}},
        summary="In the frame of the best-fit plane, rigid motion taken out",
    )
    nodes = [f"{x},{y},0,0,0,-0.05" for y in range(-8, 9, 2) for x in range(-8, 9, 2)]
    table = "\n".join(["x_mm,y_mm,z_mm,u_mm,v_mm,w_mm", *nodes, ""]).encode()
    placed = {"align": '{"kind": "best-fit"}'}
    what = "A table of nodes with their displacements, laid onto the measured shape"
    model = call("create_model", test, summary=what, form=placed, files={"file": table}, text_files=True).json()["id"]
    call("list_models", test)
    asked = {"model_id": model, "step": 1, "load_uncertainty": 0.005}
    call("compare_with_model", test, analysis, summary="The load known to half a per cent", body=asked)
    call("compare_with_model", test, analysis, body=asked, query={"format": "vtu"})
    call("delete_model", test, model)
    call("list_evaluations")
    limits = {"settings": {"variable": "w_mm", "lower": -0.5, "upper": 0.5, "share": 0.99}}
    call("evaluate", test, analysis, "conformity", summary="Points whose w is within limits", body=limits)
    for form in ("csv", "nc"):
        call("export", test, analysis, query={"format": form, "step": 1})
    begun = call("begin_export", test, analysis, query={"format": "csv", "step": 1}).json()["job"]
    wait_for_job(client, begun)
    call("job_file", begun["id"])
    call("get_report", test, analysis)


def _ends(session: Session, test: str, analysis: str, calibration: str, noise: str) -> None:
    call = session.call
    call("readyz")
    jobs = call("list_jobs").json()["jobs"]
    measured = next(job for job in jobs if job["kind"] == "analysis")
    call("get_job", measured["id"])
    call("job_events", measured["id"])
    call("events", headers={"Last-Event-ID": "0"})
    there = call("get_test", test).json()
    copied = {"steps": len(there["steps"]), "results": 2}
    call("acknowledge_exported", test, summary="All of it lies elsewhere", body=copied)
    gone = call("delete_noise", noise).json()["id"]
    call("delete_calibration", calibration)
    call("delete_test", test)
    call("list_trash")
    call("restore_trash", gone)
    again = call("delete_noise", noise).json()["id"]
    call("remove_trash", again)
