"""``stereorig channels import`` gives the steps on a running service a load frame's channels."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest

from stereorig.server.cli import main
from tests.support.copied_tests import write_test_folder
from tests.support.service_rig import new_test

API = "/api/v1"
TIMES = ["2026-03-01T12:00:00Z", "2026-03-01T12:00:04Z", "2026-03-01T12:01:00Z"]


def test_a_record_is_aligned_by_time_and_what_each_step_got_is_printed(
    client: httpx.Client, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "t000001-abcdef"
    write_test_folder(folder, 1)
    files = {cam: (folder / "steps" / "0000" / f"{cam}.tif").read_bytes() for cam in ("cam1", "cam2")}
    test_id = new_test(client)
    for time in TIMES:
        sent = {cam: (f"{cam}.tif", data) for cam, data in files.items()}
        url = f"{API}/tests/{test_id}/steps:import"
        client.post(url, files=sent, data={"timestamp_utc": time}).raise_for_status()
    record = tmp_path / "machine.csv"
    # the machine's clock shows 10 s when step 0 is taken: step 1 lies half way from 12 to 16 s
    record.write_text("Time (s),Force (kN)\n8,0\n10,1\n12,2\n16,4\n20,5\n")
    where = ["--url", str(client.base_url).rstrip("/")]
    aligned = ["--at-step", "0", "--at", "10", "--load", "force_kn"]
    assert main(["channels", "import", test_id, str(record), *aligned, *where]) == 0
    said = capsys.readouterr().out
    assert "5 readings" in said
    assert "force_kn (kN)" in said
    assert "step 0 at 10.000 s: force_kn 1" in said
    assert "step 1 at 14.000 s: force_kn 3" in said
    assert "step 2 at 70.000 s: missing: it is outside the record" in said
    steps = [client.get(f"{API}/tests/{test_id}/steps/{n}").json() for n in range(3)]
    assert [step["channels"] for step in steps] == [{"force_kn": 1.0}, {"force_kn": 3.0}, {}]
    assert [step["load_n"] for step in steps] == [1000.0, 3000.0, None]
    # what an import would do, and what is open, is shown before
    unsure = tmp_path / "unsure.csv"
    unsure.write_text("Probe;P-07\nZeit;Kraft\ns;kN\n9;1,025\n11;1,030\n12;OVER\n16;1,050\n", encoding="utf-16")
    assert main(["channels", "import", test_id, str(unsure), "--preview", *aligned[:4], *where]) == 0
    said = capsys.readouterr().out
    assert "column 'Kraft': channel kraft_kn, unit kN, 3 numbers, 0 empty, 1 not read" in said
    assert "line 1: Probe;P-07" in said
    assert "'OVER' in line 6" in said
    assert "Give decimal (--decimal)" in said
    assert main(["channels", "import", test_id, str(unsure), "--decimal", ",", *aligned[:4], *where]) == 0
    said = capsys.readouterr().out
    assert "'OVER' in line 6" in said
    assert "step 1 at 14.000 s: missing: a cell or row could not be read there: kraft_kn" in said
    # refusals with the service's code
    assert main(["channels", "import", test_id, str(record), *where]) == 1
    assert "channels_unaligned" in capsys.readouterr().err
    assert main(["channels", "import", test_id, str(tmp_path / "none.csv"), *where]) == 1
    assert "file_missing" in capsys.readouterr().err
