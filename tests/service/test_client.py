"""The client: a whole test in twenty lines as the tutorial prints it, sync and async, its errors and its progress."""

from __future__ import annotations

import asyncio
import base64
import inspect
import json
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest

import stereorig
from stereorig.client import AsyncAnalysis, AsyncClient, AsyncTest
from stereorig.client.errors import error_of
from stereorig.client.synchronous import Analysis, Client, Test
from stereorig.core.errors import CalibrationInputError, Cancelled, InputError, StateError, StereorigError
from stereorig.server.api.models import AnalysisRequest, JobReply
from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.document_scripts import WRITTEN, one_block, run
from tests.support.export_results import write_results
from tests.support.service_rig import SMALL, served, true_cameras, wait_for_rig

PAGE = "docs/tutorial/client.md"
#: what the page's pixels are on the small rig, whose images have half as many
SMALLER = {"[90, 80, 420, 400]": "[45, 40, 210, 200]", "(120, 240), (390, 240)": "(60, 120), (195, 120)"}
REGION = {"rectangle": [45, 40, 210, 200]}


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    service = Service(parse_config(SMALL), tmp_path_factory.mktemp("client") / "data").start()
    try:
        with served(service) as made:
            wait_for_rig(made)
            yield str(made.base_url).rstrip("/")
    finally:
        service.close()


@pytest.fixture(scope="module")
def printed(url: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """What the page's script prints, and its folder."""
    text = one_block(PAGE, "python", "stereorig.Client")
    assert len([line for line in text.splitlines() if line.strip()]) <= 20
    for of_page, here in {WRITTEN: url, **SMALLER}.items():
        assert of_page in text
        text = text.replace(of_page, here)
    folder = tmp_path_factory.mktemp("script")
    (folder / "script.py").write_text(text, encoding="utf-8")
    done = run([sys.executable, "script.py"], folder)
    assert done.returncode == 0, done.stderr
    return done.stdout, folder


@pytest.mark.deep
@pytest.mark.delivered
def test_a_whole_test_in_twenty_lines(printed: tuple[str, Path]) -> None:
    text, folder = printed
    assert re.search(r"^calibration: (good|usable|marginal)$", text, re.MULTILINE), text
    w_mm, strain, sigma = (
        float(v) for v in re.findall(r"W from (\S+) mm, strain (\S+), .* uncertainty (\S+)", text)[0]
    )
    assert w_mm == pytest.approx(
        -0.117, abs=0.004
    )  # the clamped plate's middle; the small rig sees 4 um of noise at most
    assert 0.0 < sigma < 2e-4
    assert abs(strain) < 2e-3
    assert (folder / "strain.png").stat().st_size > 3000


@pytest.fixture(scope="module")
def rig(url: str, printed: tuple[str, Path]) -> Iterator[Client]:
    """A client of the service on which the page's script ran."""
    with stereorig.Client(url, progress=False) as made:
        yield made


@pytest.fixture(scope="module")
def tiny(client: httpx.Client) -> Iterator[Client]:
    """A client of a service on which nothing is measured."""
    with stereorig.Client(str(client.base_url), progress=False) as made:
        yield made


@pytest.fixture(scope="module")
def analysis(rig: Client) -> Analysis:
    return rig.test(rig.tests()[-1].id).analyses()[-1]


@pytest.mark.deep
@pytest.mark.delivered
def test_fields_are_data_arrays_with_units_over_all_steps(analysis: Analysis) -> None:
    w = analysis.field("w_mm")
    assert w.dims == ("step", "row", "col")
    assert list(w.step.values) == [1, 2, 3, 4]  # the reference has no displacement
    assert w.attrs["units"] == "mm"
    depth = [float(w.sel(step=n).min()) for n in (1, 2, 3, 4)]
    assert depth == sorted(depth, reverse=True)  # more pressure, deeper
    one = analysis.dataset(4)
    np.testing.assert_array_equal(one["w_mm"].values, w.sel(step=4).values)
    assert float(one["channel_pressure_kpa"]) == 689.0
    assert w.attrs["frame"].startswith("sys")
    specimen = analysis.field("w_mm", 4, frame="specimen")
    assert specimen.attrs["frame"].startswith("aligned by plane")
    everything = analysis.dataset()
    assert list(everything.step.values) == [0, 1, 2, 3, 4]
    assert np.isnan(everything["w_mm"].sel(step=0)).all()


@pytest.mark.deep
@pytest.mark.delivered
def test_a_strain_gauge_has_its_channels_beside_it(analysis: Analysis) -> None:
    gauge = analysis.extensometer((60, 120), (195, 120))
    assert list(gauge.pressure_kpa.values) == [0.0, 172.0, 344.0, 517.0, 689.0]
    assert gauge.pressure_kpa.attrs["units"] == "kPa"
    assert float(gauge.strain[0]) == 0.0
    assert (np.diff(gauge.time_s.values) > 0).all()
    readings = analysis.gauges(extensometers=[{"a_px": [60, 120], "b_px": [195, 120]}])
    expected = [s.extensometers[0].values["strain"].value for s in readings.steps[1:]]
    np.testing.assert_array_equal(gauge.strain.values[1:], np.array(expected, dtype=float))


@pytest.mark.deep
@pytest.mark.delivered
def test_exports_are_written(analysis: Analysis, tmp_path: Path) -> None:
    assert analysis.export(tmp_path / "a" / "last.csv", "csv", step=4).read_bytes().startswith(b"row,col,x_px,")
    with pytest.raises(InputError) as refused:
        analysis.export(tmp_path / "b.csv", "csv", step=77)
    assert refused.value.code == "not_found" or "77" in refused.value.cause
    assert not (tmp_path / "b.csv").exists()


def test_a_calibration_is_imported_and_accepted(tiny: Client, tmp_path: Path) -> None:
    # its path begins with a word and a colon, which must not be read as a URL's scheme
    (tmp_path / "calibration.json").write_text(json.dumps(true_cameras(SMALL)), encoding="utf-8")
    made = tiny.import_calibration(tmp_path / "calibration.json", label="from a file", accept=True)
    assert [entry.id for entry in tiny.calibrations(accepted=True)] == [made.id]
    tiny.ask("DELETE", f"/calibrations/{made.id}")  # other tests have none


def test_a_job_is_watched_and_its_problem_is_raised(tiny: Client) -> None:
    seen: list[JobReply] = []
    tiny.progress = seen.append
    try:
        done = tiny.move(positions_mm={"1": 0.5})
        assert done.state == "succeeded"
        begun = tiny.ask("POST", "/stage/moves", json={"positions_mm": {"1": 4.0, "2": -4.0}}).json()["job"]["id"]
        assert tiny.cancel(begun).state == "cancelled"
        with pytest.raises(Cancelled):
            tiny.wait(begun)
        time.sleep(0.3)  # a stop is sent again until the job has let the stage go
        tiny.move(positions_mm={"1": 0.0, "2": 0.0})
    finally:
        tiny.progress = False
    assert {job.kind for job in seen} == {"move"}
    assert {job.state for job in seen} >= {"succeeded", "cancelled"}


# by name: titles and units, a row of time, force in newtons and stroke, the load's channel
RECORDS = {
    "decimal commas in quotes": ("Time,Load,Extension\n(s),(N),(mm)\n", '"{0:.3f}";"{1:.3f}";"{2:.3f}"', "load_n"),
    "grouped thousands": ("Time (s),Force (N),Stroke (mm)\n", '"{0:.3f}","{1:,.3f}","{2:.3f}"', "force_n"),
    "times in French": ("S/No;C_1_Temps[s];C_1_Force[kN]\n", "{3};{0};{4}", "c_1_force_kn"),
    "units in a row": ("Axial Force\tStroke\tRunning Time\nkN\tmm\tSec\n", "{4}\t{2:.3f}\t{0}", "axial_force_kn"),
}


@pytest.mark.fault(64)
@pytest.mark.parametrize("name", RECORDS)
def test_a_record_is_looked_at_imported_and_kept(tiny: Client, tmp_path: Path, name: str) -> None:
    head, row, load = RECORDS[name]
    rows = [row.format(k / 2, 25.0 * k, 0.005 * k, k, 0.025 * k) for k in range(91)]
    if name.startswith("decimal"):
        rows = [one.replace(".", ",").replace(";", ",") for one in rows]
    (tmp_path / "machine.csv").write_text(head + "\n".join(rows), encoding="utf-8")
    test = tiny.new_test(name, calibration_id=None)
    for k in range(5):
        test.capture(timestamp_utc=f"2026-03-01T12:00:{10 * k:02d}Z")
    how: dict[str, object] = {"at_step": 0, "at_s": 0.0, "load": load}
    seen = test.preview_channels(tmp_path / "machine.csv", **how)
    assert (seen.refused, seen.read.questions, seen.n_aligned) == ("", [], 5)
    assert test.step(4).load_n is None
    found = test.import_channels(tmp_path / "machine.csv", **how)
    assert (found.readings, found.channels, found.steps) == (91, seen.channels, seen.steps)
    for k in range(5):
        step = test.step(k)
        assert step.load_n == pytest.approx(500.0 * k)
        assert step.channels[load] == pytest.approx(500.0 * k / (1000.0 if load.endswith("kn") else 1.0))
        assert step.channel_units == found.channels


def test_what_cannot_be_is_refused_in_the_users_words_before_anything_is_sent() -> None:
    def refuse(_: httpx.Request) -> httpx.Response:
        raise AssertionError("nothing may be sent")

    with Client(transport=httpx.MockTransport(refuse)) as rig:
        test = rig.test("t000001-abcdef")
        with pytest.raises(InputError, match="subset_px must be odd, got 32"):
            test.measure(region=REGION, subset_px=32)
        with pytest.raises(InputError, match="Extra inputs are not permitted"):
            rig.move(targets_mm={"1": 2})
        with pytest.raises(InputError, match="given twice"):
            test.measure(AnalysisRequest.model_validate({"region": REGION}), subset_px=33)


@pytest.mark.parametrize("text", ["nope", "plate 3", "a000001-0c9f1e", ""])
def test_a_name_is_not_taken_for_an_id(tiny: Client, text: str) -> None:
    for client in (tiny, AsyncClient(tiny.url, progress=False)):
        with pytest.raises(InputError, match="is no test's id") as caught:
            client.test(text)
        assert "`tests()`" in caught.value.remedy


def test_a_refusal_is_the_error_that_it_was_in_the_service(tiny: Client) -> None:
    with pytest.raises(InputError) as unknown:
        tiny.test("t000009-abcdef").document()
    assert (unknown.value.code, bool(unknown.value.remedy)) == ("not_found", True)
    with pytest.raises(StereorigError) as limits:
        tiny.move(positions_mm={"1": 99.0})
    assert limits.value.code == "out_of_limits"
    with pytest.raises(StateError) as lost:
        Client("http://127.0.0.1:9", progress=False).rig()
    assert lost.value.code == "service_lost"


@pytest.mark.parametrize(
    ("problem", "status", "kind"),
    [
        ({"code": "calibration_underdetermined", "detail": "a."}, 422, CalibrationInputError),
        ({"code": "hardware_busy", "detail": "b."}, 409, StateError),
        ({"code": "of_a_later_version", "detail": "c."}, 422, InputError),
        ({"code": "of_a_later_version", "detail": "c."}, 409, StateError),
        ({}, 500, StateError),
    ],
)
def test_codes_become_the_classes_of_the_tree(problem: dict[str, object], status: int, kind: type) -> None:
    error = error_of({"remedy": "do.", **problem}, status=status)
    assert type(error) is kind
    assert error.code == problem.get("code", "http_error")


def test_both_clients_have_the_same_methods_and_parameters() -> None:
    for one, two in ((Client, AsyncClient), (Test, AsyncTest), (Analysis, AsyncAnalysis)):
        methods = {n: m for n, m in inspect.getmembers(one, inspect.isfunction) if not n.startswith("_")}
        assert methods.keys() == {n for n, m in inspect.getmembers(two, inspect.isfunction) if not n.startswith("_")}
        for name, method in methods.items():
            other = getattr(two, name)
            assert list(inspect.signature(method).parameters) == list(inspect.signature(other).parameters), name
            assert inspect.iscoroutinefunction(other) or name in ("test", "analysis"), name


def test_a_test_and_its_analysis_show_themselves_in_a_notebook(tiny: Client, service: Service, tmp_path: Path) -> None:
    test = tiny.new_test("Plate & <rod>", calibration_id=None)
    image = np.random.default_rng(1).integers(0, 255, (240, 256), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "view.png"), image)
    cv2.imwrite(str(tmp_path / "other.png"), image[:, ::-1])
    test.import_step(tmp_path / "view.png", tmp_path / "other.png", label="at rest")
    shown = test._repr_html_()
    assert "Plate &amp; &lt;rod&gt;" in shown
    assert "0 at rest" in shown
    found = re.search(r"base64,([^\"]+)", shown)
    assert found is not None
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(found[1]), np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_allclose(decoded.mean(), image.mean(), atol=3.0)
    settings = stereorig.AnalysisSettings.model_validate({"region": {"rectangle": [40, 60, 250, 221]}})
    document = {"kind": "displacement", "steps": [0, 1, 2], "settings": settings.model_dump(mode="json"), "inputs": {}}
    made = service.tests.analyses.create(test.id, document)
    write_results(service.tests.analyses.path(test.id, made.id))
    shown = test.analysis(made.id)._repr_html_()
    assert "3 of 3, 0 failed" in shown
    assert "map of step 2" in shown
    # without the service there is the line
    gone = stereorig.Client("http://127.0.0.1:9", progress=False)
    line = "&lt;Test t000001-abcdef of http://127.0.0.1:9&gt;: "
    assert line in gone.test("t000001-abcdef")._repr_html_()
    # a step that was not measured yet is not simply unknown
    (service.tests.analyses.path(test.id, made.id) / "step_0002.nc").unlink()
    with pytest.raises(StereorigError, match=r"has no result for step 2\. It has measured 2 of 3 steps"):
        test.analysis(made.id).field("w_mm", step=2)


@pytest.mark.deep
@pytest.mark.delivered
def test_the_async_client_reads_what_the_other_reads(url: str, analysis: Analysis) -> None:
    async def read() -> tuple[list[str], np.ndarray, str]:
        async with stereorig.AsyncClient(url, progress=False) as rig:
            accepted = await rig.calibrations(accepted=True)
            test = rig.test(analysis.test_id)
            one = (await test.analyses())[-1]
            field, document, _ = await asyncio.gather(one.field("w_mm", 4), rig.rig(), rig.move(by_mm={"1": 0.1}))
            await rig.move(by_mm={"1": -0.1})
            return [c.id for c in accepted], field.values, document.name

    accepted, field, name = asyncio.run(read())
    assert len(accepted) == 1
    assert name
    np.testing.assert_array_equal(field, analysis.field("w_mm", 4).values)


def test_tests_are_made_and_captured_by_both(tiny: Client) -> None:
    async def made() -> tuple[int, dict[str, float]]:
        async with AsyncClient(tiny.url, progress=False) as rig:
            test = await rig.new_test("async", calibration_id=None)
            step = await test.capture(label="one", channels={"force_kn": 1.5})
            return step.n, step.channels

    assert asyncio.run(made()) == (0, {"force_kn": 1.5})
    test = tiny.new_test("sync", calibration_id=None, specimen="Al")
    assert [step.n for step in test.capture_burst(count=2)] == [0, 1]
    assert [one.name for one in tiny.tests()][-2:] == ["async", "sync"]
    assert test.document().specimen == "Al"
    with pytest.raises(StateError) as refused:
        tiny.new_test("third")
    assert refused.value.code == "no_calibration_accepted"


def test_a_bar_needs_rich_only_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    from stereorig.client.progress import shown

    with shown(None, "Work") as silent:  # no terminal here
        assert silent is None
    with shown(True, "Work") as bar:
        assert bar is not None
    monkeypatch.setitem(sys.modules, "rich.console", None)
    with pytest.raises(StateError) as refused, shown(True, "Work"):
        pass
    assert refused.value.code == "progress_unavailable"
